"""Products and sums of rows in a fixed order: a row has the same bits in any company.

A matrix product (BLAS) rounds by how many rows it is given and by how many threads share them,
`numpy.sum` by how the rows lie in memory. What is made here rounds by the row alone.
"""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def turned(R: Float64, points: Float64) -> Float64:
    """(n, 3) R p of every row p of `points`; R is (3, 3), or (n, 3, 3), one for each row."""
    return R[..., 0] * points[:, :1] + R[..., 1] * points[:, 1:2] + R[..., 2] * points[:, 2:]


def row_sums(values: Float64) -> Float64:
    """(n,) the sum of each row of (n, k), however the rows lie in memory."""
    sums: Float64 = np.ascontiguousarray(values).sum(axis=1)
    return sums


def norms(vectors: Float64) -> Float64:
    """(n,) the length of each row of (n, k)."""
    return np.sqrt(row_sums(vectors * vectors))
