"""Which cells a scan point is scored against: a list per voxel of a lattice around the scan.

The voxels of this lattice are called anchors. Their edge is the cell size l for direct1 and
direct7, and l/2 for radius, where an anchor lists every cell that a point in it can reach.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


@njit(nogil=True, error_model="numpy", inline="always")
def _gap(mean, anchor):  # type: ignore[no-untyped-def]
    """Distance along an axis from `mean` to the interval [anchor, anchor + 1]."""
    return max(max(anchor - mean, mean - anchor - 1.0), 0.0)


@njit(nogil=True, inline="always")
def _pack(sx, sy, sz):  # type: ignore[no-untyped-def]
    """A shift of -8 to 7 anchor edges per axis in 12 bits."""
    return ((sx + 8) * 16 + sy + 8) * 16 + sz + 8


@njit(nogil=True, error_model="numpy")
def _costs(mean, span, reach, cost):  # type: ignore[no-untyped-def]
    """Per axis and anchor around a cell's corner: faces away, or the squared gap to its mean.

    An anchor lists the cell where the three add up to no more than what this returns.
    """
    for axis in range(3):
        for k in range(2 * span + 1):
            gap = _gap(mean[axis], k - span)
            cost[axis, k] = gap * gap if reach > 0.0 else float(abs(k - span))
    return reach * reach if reach > 0.0 else float(span)


@njit(nogil=True, error_model="numpy")
def _visit(corner, mean, shape, span, reach, count, cursor, cell, shift):  # type: ignore[no-untyped-def]
    """Count the entries of every anchor, or, where `count` is empty, write them at `cursor`."""
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
    """The cells of every anchor, as one table in compressed rows.

    With reach 0 an anchor lists the cells whose voxel it is, or shares `span` = 1 face with;
    else the cells whose mean lies within `reach` of some point of it.

    Args:
        corner: (m, 3) anchors at the lower corners of the cells, each in [span, shape - span - 1).
        mean: (m, 3) means of the cells from these corners [anchor edges].
        shape: (3,) number of anchors of the dense grid.
        span: how many anchors from its corner a cell can be listed at most.
        reach: radius [anchor edges]; 0 for the direct modes.

    Returns:
        first (anchors + 1,), and for each entry from first[a] to first[a + 1] the row of its cell
        (by rising row) and the packed shift from the anchor to the cell's corner.
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
