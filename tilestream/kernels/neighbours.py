"""Lists of the cells near each cell: the neighbours of definitions, section 3.1, and others."""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

WITHIN = 1e-9
"""Distances that exceed a radius by no more than this are within it [m]; on regular maps rounding
would decide."""


def _keys(
    index: NDArray[np.int64], reach: tuple[int, int, int]
) -> tuple[NDArray[np.int64], int, int]:
    """One integer key per voxel, in lexicographic order, so that a neighbouring voxel is a fixed
    step away.

    Empty gaps wider than the reach are shortened, so that the keys of any map fit 63 bits.

    Returns:
        (m,) keys, and the steps to the next voxel in x and in y (in z it is 1).
    """
    narrowed, spans = np.empty_like(index), [0, 0, 0]
    for axis in range(3):
        values, back = np.unique(index[:, axis], return_inverse=True)
        gaps = np.minimum(np.diff(values), reach[axis] + 1)
        narrowed[:, axis] = np.concatenate([[0], np.cumsum(gaps)])[back] if len(values) else 0
        # A margin, so that a step to the side cannot end in the next row.
        spans[axis] = int(gaps.sum()) + 1 + 2 * reach[axis]
    step_y = spans[2]
    step_x = spans[1] * step_y
    return narrowed @ np.array([step_x, step_y, 1]), step_x, step_y


@njit(nogil=True, boundscheck=False)
def _list_near(  # type: ignore[no-untyped-def]
    key, step_x, step_y, reach, mean, radius, itself, fill, start, near
):
    """Write the starts of the lists, and with `fill` the lists too.

    For each column of voxels around a cell, `front` is its first cell not below the reach. Cells
    come in rising order, so fronts only move up: all cells together cost one sweep per column.
    """
    columns = (2 * reach[0] + 1) * (2 * reach[1] + 1)
    front = np.zeros(columns, np.int64)
    found = 0
    for row in range(len(key)):
        x, y, z = mean[row, 0], mean[row, 1], mean[row, 2]
        column = 0
        for dx in range(-reach[0], reach[0] + 1):
            for dy in range(-reach[1], reach[1] + 1):
                middle = key[row] + dx * step_x + dy * step_y
                at = front[column]
                while at < len(key) and key[at] < middle - reach[2]:
                    at += 1
                front[column] = at
                column += 1
                while at < len(key) and key[at] <= middle + reach[2]:
                    ex, ey, ez = mean[at, 0] - x, mean[at, 1] - y, mean[at, 2] - z
                    if (itself or at != row) and np.sqrt(ex * ex + ey * ey + ez * ez) <= radius:
                        if fill:
                            near[found] = at
                        found += 1
                    at += 1
        start[row + 1] = found


def _lists(
    index: NDArray[np.int64],
    reach: tuple[int, int, int],
    mean: NDArray[np.float64],
    radius: float,
    itself: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    key, step_x, step_y = _keys(index, reach)
    start, near = np.zeros(len(index) + 1, np.int64), np.empty(0, np.int32)
    _list_near(key, step_x, step_y, reach, mean, radius, itself, False, start, near)
    near = np.empty(start[-1], np.int32)
    _list_near(key, step_x, step_y, reach, mean, radius, itself, True, start, near)
    return start, near


def neighbours_within(
    index: NDArray[np.int64], mean: NDArray[np.float64], cell_size: float, radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The other cells whose means lie within a radius of each cell's mean: |mu_j - mu_i| <= r.

    Args:
        index: (m, 3) voxel indices, lexicographically sorted, without repeats.
        mean: (m, 3) means [m], each in its voxel; any common origin.
        cell_size: edge of a voxel [m].
        radius: r [m], inclusive: a distance of r counts though rounding adds up to 1e-9 m.

    Returns:
        (m + 1,) starts and (k,) neighbours: those of cell i are `near[start[i]:start[i + 1]]`,
        in rising order (so in that of their voxels).
    """
    # Slightly more than the radius, for means that rounding put just outside of their voxels.
    reach = int(np.ceil(radius / cell_size + 1e-6))
    return _lists(index, (reach, reach, reach), mean, radius + WITHIN, itself=False)


def cells_around(
    index: NDArray[np.int64], reach: tuple[int, int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The cells in the voxels around each cell, itself included.

    Args:
        index: (m, 3) voxel indices, lexicographically sorted, without repeats.
        reach: number of voxels to each side in x, y and z.

    Returns:
        (m + 1,) starts and (k,) cells, as `neighbours_within` gives them.
    """
    return _lists(index, reach, np.zeros(index.shape), np.inf, itself=True)
