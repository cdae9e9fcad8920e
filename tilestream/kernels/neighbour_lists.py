"""Neighbour lists: the cells that a scan point is scored against, one list per bucket.

Buckets are the voxels of a dense grid around the scan. Their edge is the cell size l for direct1
and direct7. For radius it is l/2, and a bucket lists every cell that any point in it can reach.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


@njit(nogil=True, error_model="numpy", inline="always")
def _gap(mean, bucket):  # type: ignore[no-untyped-def]
    """Distance along an axis from `mean` to the interval [bucket, bucket + 1]."""
    return max(max(bucket - mean, mean - bucket - 1.0), 0.0)


@njit(nogil=True, inline="always")
def _pack(sx, sy, sz):  # type: ignore[no-untyped-def]
    """A shift of -8 to 7 bucket edges per axis in 12 bits."""
    return ((sx + 8) * 16 + sy + 8) * 16 + sz + 8


@njit(nogil=True, error_model="numpy")
def _costs(mean, span, reach, cost):  # type: ignore[no-untyped-def]
    """Fill `cost` (3, 2 span + 1) for one cell: per axis and bucket, the steps from the cell's
    corner, or with a reach the squared gap to its mean. Returns the budget.

    A bucket lists the cell where its three costs add up to no more than the budget.
    """
    for axis in range(3):
        for k in range(2 * span + 1):
            gap = _gap(mean[axis], k - span)
            cost[axis, k] = gap * gap if reach > 0.0 else float(abs(k - span))
    return reach * reach if reach > 0.0 else float(span)


@njit(nogil=True, error_model="numpy")
def _visit(corner, mean, shape, span, reach, count, cursor, cell, shift):  # type: ignore[no-untyped-def]
    """Count the entries of every bucket; where `count` is empty, write the entries at `cursor`."""
    width = 2 * span + 1
    cost = np.empty((3, width))
    for c in range(corner.shape[0]):
        budget = _costs(mean[c], span, reach, cost)
        for ij in range(width * width):
            i, j = ij // width, ij % width
            left = budget - cost[0, i] - cost[1, j]
            if left < 0.0:
                continue
            a = (corner[c, 0] + i - span) * shape[1] + corner[c, 1] + j - span
            a = a * shape[2] + corner[c, 2] - span
            for k in range(width):
                if cost[2, k] > left:
                    continue
                if count.size:
                    count[a + k] += 1
                    continue
                at = cursor[a + k]
                cell[at], shift[at] = c, _pack(span - i, span - j, span - k)
                cursor[a + k] = at + 1


@njit(nogil=True, error_model="numpy")
def neighbour_lists(
    corner: Int64, mean: Float64, shape: Int64, span: int, reach: float
) -> tuple[Int32, Int32, Int32]:
    """The cells of every bucket, as one table in compressed sparse rows.

    With reach 0 a bucket lists the cells whose voxel it is, or shares `span` = 1 face with;
    else the cells whose mean lies within `reach` of some point of it.

    Args:
        corner: (m, 3) buckets at the lower corners of the cells, each in [span, shape - span - 1).
        mean: (m, 3) means of the cells from these corners [bucket edges].
        shape: (3,) number of buckets of the dense grid.
        span: how many buckets from its corner a cell can be listed at most.
        reach: radius [bucket edges]; 0 for the direct modes.

    Returns:
        first (buckets + 1,): the entries of bucket a are first[a] to first[a + 1]. Per entry the
        row of its cell (rising within a bucket) and the packed shift from bucket to cell corner.
    """
    first = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int32)
    none = first[:0]
    _visit(corner, mean, shape, span, reach, first, none, none, none)
    total = np.int32(0)
    for a in range(first.size):
        count = first[a]
        first[a] = total
        total += count
    cell, shift = np.empty(total, np.int32), np.empty(total, np.int32)
    _visit(corner, mean, shape, span, reach, none, first.copy(), cell, shift)
    return first, cell, shift
