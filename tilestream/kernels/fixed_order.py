"""Products and sums of rows in a fixed order: a row has the same bits in any company.

A matrix product (BLAS) rounds by how many rows it is given and by how many threads share them,
`numpy.sum` by how the rows lie in memory. What is made here rounds by the row alone.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]


def turned(R: Float64, points: Float64) -> Float64:
    """(n, 3) R p of every row p of `points`; R is (3, 3), or (n, 3, 3), one for each row."""
    return R[..., 0] * points[:, :1] + R[..., 1] * points[:, 1:2] + R[..., 2] * points[:, 2:]


@njit(nogil=True, error_model="numpy", boundscheck=False)
def moved(T: Float64, points: Float64) -> Float64:
    """(n, 3) R p + t of every row p of `points`; T is (4, 4). As `turned` rounds, in one pass."""
    out = np.empty(points.shape)
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for i in range(np.uint64(points.shape[0])):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        out[i, 0] = ((r00 * x + r01 * y) + r02 * z) + tx
        out[i, 1] = ((r10 * x + r11 * y) + r12 * z) + ty
        out[i, 2] = ((r20 * x + r21 * y) + r22 * z) + tz
    return out


def row_sums(values: Float64) -> Float64:
    """(n,) the sum of each row of (n, k), however the rows lie in memory."""
    sums: Float64 = np.ascontiguousarray(values).sum(axis=1)
    return sums


def norms(vectors: Float64) -> Float64:
    """(n,) the length of each row of (n, k)."""
    return np.sqrt(row_sums(vectors * vectors))
