"""Three columns of a record to points, leaving out what is not finite."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True, error_model="numpy")
def finite_points(
    x: NDArray[Any], y: NDArray[Any], z: NDArray[Any], points: NDArray[np.float64]
) -> int:
    """Write the finite rows of x, y, z to `points`, in order, and return how many they are.

    Args:
        x: (n,) coordinates [m], any real type and stride; so are `y` and `z`.
        y: (n,) coordinates [m].
        z: (n,) coordinates [m].
        points: (n, 3) float64 [m], overwritten: row i is the i-th row (x, y, z) without NaN or
            infinity; what is behind the returned number is arbitrary.
    """
    kept = 0
    for i in range(x.shape[0]):
        points[kept, 0] = x[i]
        points[kept, 1] = y[i]
        points[kept, 2] = z[i]
        # a - a is 0 for every finite a, and NaN for the others; no branch
        kept += ((x[i] - x[i]) + (y[i] - y[i]) + (z[i] - z[i])) == 0
    return kept
