"""The box that holds points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit


@njit(nogil=True, fastmath={"nnan", "nsz"})
def _lesser(a, b):  # type: ignore[no-untyped-def]
    return min(b, a)


@njit(nogil=True, fastmath={"nnan", "nsz"})
def _greater(a, b):  # type: ignore[no-untyped-def]
    return max(b, a)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def bounds(points: NDArray[Any]) -> NDArray[Any]:
    """The lowest and the highest coordinates of (n, 3) contiguous points: (2, 3) of their type; all
    NaN if one of them is, all 0 where there are none.
    """
    if not points.size:
        return np.zeros((2, 3), points.dtype)
    numbers, lost = points.reshape(-1), 0
    x_lo, y_lo, z_lo = points[0, 0], points[0, 1], points[0, 2]
    x_hi, y_hi, z_hi = x_lo, y_lo, z_lo
    for i in range(np.uint64(points.shape[0])):
        j = np.uint64(3) * np.uint64(i)  # unsigned: no index from the end, which would be a branch
        x, y, z = numbers[j], numbers[j + np.uint64(1)], numbers[j + np.uint64(2)]
        lost += (x != x) | (y != y) | (z != z)
        x_lo, y_lo, z_lo = _lesser(x, x_lo), _lesser(y, y_lo), _lesser(z, z_lo)
        x_hi, y_hi, z_hi = _greater(x, x_hi), _greater(y, y_hi), _greater(z, z_hi)
    out = np.array([[x_lo, y_lo, z_lo], [x_hi, y_hi, z_hi]], points.dtype)
    if lost:
        out[:] = np.nan
    return out
