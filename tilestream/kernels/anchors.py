"""Which cells a scan point is scored against: a list per voxel of a lattice around the scan.

The voxels of this lattice are called anchors. Their edge is the cell size l for direct1 and
direct7, and l/2 for radius, where an anchor lists every cell that a point in it can reach.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

SHIFT_BITS = 4
"""Bits per axis of a packed shift; a shift s [anchor edges] is kept as s + 8."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _gap(mean, anchor):  # type: ignore[no-untyped-def]
    """Distance along an axis from `mean` to the interval [anchor, anchor + 1]."""
    return max(max(anchor - mean, mean - anchor - 1.0), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _lists(mean, dx, dy, dz, span, reach):  # type: ignore[no-untyped-def]
    """Whether the anchor at (dx, dy, dz) from a cell's corner lists the cell."""
    if reach == 0.0:
        return abs(dx) + abs(dy) + abs(dz) <= span
    x, y, z = _gap(mean[0], dx), _gap(mean[1], dy), _gap(mean[2], dz)
    return x * x + y * y + z * z <= reach * reach


@njit(cache=True, nogil=True, error_model="numpy")
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
    for filling in range(2):
        if filling:
            total = np.int32(0)
            for a in range(first.size):
                count = first[a]
                first[a] = total
                total += count
            cell, shift = np.empty(total, np.int32), np.empty(total, np.int32)
            cursor = first.copy()
        for c in range(corner.shape[0]):
            for dx in range(-span, span + 1):
                for dy in range(-span, span + 1):
                    for dz in range(-span, span + 1):
                        if not _lists(mean[c], dx, dy, dz, span, reach):
                            continue
                        x, y, z = corner[c, 0] + dx, corner[c, 1] + dy, corner[c, 2] + dz
                        a = (x * shape[1] + y) * shape[2] + z
                        if filling:
                            cell[cursor[a]] = c
                            shift[cursor[a]] = ((8 - dx) * 16 + 8 - dy) * 16 + 8 - dz
                            cursor[a] += 1
                        else:
                            first[a] += 1
    return first, cell, shift
