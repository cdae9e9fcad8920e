"""Three columns of a record as points, without those that are not finite."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit


@njit(nogil=True, error_model="numpy")
def finite_points(
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    scale: NDArray[np.float64],
    offset: NDArray[np.float64],
    points: NDArray[np.float64],
) -> int:
    """Write the finite rows of (x, y, z) scale + offset to `points`, in order; return their number.

    Args:
        x: (n,) coordinates as stored, any real type and stride; so are `y` and `z`.
        y: (n,) coordinates.
        z: (n,) coordinates.
        scale: (3,) metres per stored unit, finite.
        offset: (3,) coordinates of the stored origin [m], finite.
        points: (n, 3) float64 [m], overwritten: the rows without NaN or infinity; rows
            beyond the returned number are arbitrary.
    """
    kept = 0
    for i in range(x.shape[0]):
        px = x[i] * scale[0] + offset[0]
        py = y[i] * scale[1] + offset[1]
        pz = z[i] * scale[2] + offset[2]
        points[kept, 0] = px
        points[kept, 1] = py
        points[kept, 2] = pz
        # a - a is 0 for every finite a, and NaN for the others; no branch
        kept += ((px - px) + (py - py) + (pz - pz)) == 0.0
    return kept
