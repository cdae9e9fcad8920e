"""How well cells represent their points: distances to the nearest mean (eqs. 19 to 21)."""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

REACH = 2
"""A point's nearest mean lies at most this many voxels from the point's own cell: its own mean is
at most sqrt(3) l away."""
TIE = 1e-9
"""Means count as equally near when their distances differ by no more than this [m]."""
STEPS_PER_M = 2.0**32
"""Distances are summed as whole multiples of 2^-32 m, so that the order of points has no effect."""
STEPS_PER_SIGMA = 2.0**30
"""Mahalanobis distances are summed as whole multiples of 2^-30."""


@njit(nogil=True, boundscheck=False)
def group_by_cell(
    cell_of_point: NDArray[np.int64], cells: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The points of each cell, by a counting sort.

    Args:
        cell_of_point: (n,) row of each point's cell, -1 for none.
        cells: number of cells m.

    Returns:
        (m + 1,) starts and (k,) points: those of cell c are `order[start[c]:start[c + 1]]`.
    """
    start = np.zeros(cells + 1, np.int64)
    for row in cell_of_point:
        if row >= 0:
            start[row + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
    order, at = np.empty(start[cells], np.int64), start[:cells].copy()
    for i in range(len(cell_of_point)):
        row = cell_of_point[i]
        if row >= 0:
            order[at[row]] = i
            at[row] += 1
    return start, order


@njit(nogil=True, boundscheck=False)
def from_corner(points_mm, members, corner_mm):  # type: ignore[no-untyped-def]
    """Points as offsets from a voxel's corner [m], with the box that they fill.

    Returns:
        (n, 3) offsets, (3,) middle and (3,) half size of their bounding box; n >= 1.
    """
    offset = np.empty((len(members), 3))
    for i in range(len(members)):
        for a in range(3):
            offset[i, a] = (points_mm[members[i], a] - corner_mm[a]) * 1e-3
    middle, half = np.empty(3), np.empty(3)
    for a in range(3):
        low, high = offset[:, a].min(), offset[:, a].max()
        middle[a], half[a] = 0.5 * (low + high), 0.5 * (high - low)
    return offset, middle, half


@njit(nogil=True, boundscheck=False)
def _rivals(mean, own, candidates, corner, middle, half, kept, at):  # type: ignore[no-untyped-def]
    """Keep the candidates that can be as near to a point of the box as the cell's own mean: rows
    into `kept`, means from the corner into `at`. Returns their number.

    |x - mu_k|^2 - |x - mu_c|^2 is linear in x, so its least value in the box is at a corner.
    """
    found = 0
    for k in candidates:
        least = -1e-6
        for a in range(3):
            step = mean[own, a] - mean[k, a]
            centre = 0.5 * (mean[own, a] + mean[k, a]) - corner[a]
            least += 2.0 * (step * (middle[a] - centre) - abs(step) * half[a])
        if least <= 0.0:
            kept[found] = k
            for a in range(3):
                at[found, a] = mean[k, a] - corner[a]
            found += 1
    return found


@njit(nogil=True, error_model="numpy", boundscheck=False)
def nearest_mean_sums(
    points_mm: NDArray[np.int64],
    start: NDArray[np.int64],
    order: NDArray[np.int64],
    index: NDArray[np.int64],
    cell_mm: int,
    mean: NDArray[np.float64],
    precision: NDArray[np.float64],
    around_start: NDArray[np.int64],
    around: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums over a cell's points of the distances to the nearest mean among all cells.

    Euclidean |x - mu| and Mahalanobis sqrt((x - mu)^T Sigma'^-1 (x - mu)) to that same cell; of
    means within 1e-9 m of the nearest, the lexicographically first one counts.

    Args:
        points_mm: (n, 3) points [mm, map frame], any order.
        start: (m + 1,) starts of `group_by_cell`.
        order: (k,) points of `group_by_cell`.
        index: (m, 3) voxel indices, lexicographically sorted.
        cell_mm: edge of a voxel [mm].
        mean: (m, 3) means [m, map frame].
        precision: (m, 3, 3) inverses of the regularised covariances [1/m^2].
        around_start: (m + 1,) starts of `cells_around` with `REACH` voxels to each side.
        around: cells of `cells_around`.

    Returns:
        (m,) sums of Euclidean distances [m] and (m,) of Mahalanobis distances (no unit); 0 for a
        cell without points. Summed as whole numbers: tiling and order of points have no effect.
    """
    m = len(index)
    euclidean, mahalanobis = np.zeros(m), np.zeros(m)
    most = np.max(np.diff(around_start)) if m else 0
    kept, at = np.empty(most, np.int64), np.empty((most, 3))
    for c in range(m):
        if start[c] == start[c + 1]:
            continue
        corner_mm = index[c] * cell_mm
        offset, middle, half = from_corner(points_mm, order[start[c] : start[c + 1]], corner_mm)
        candidates = around[around_start[c] : around_start[c + 1]]
        found = _rivals(mean, c, candidates, corner_mm / 1000.0, middle, half, kept, at)
        metres, sigmas = np.int64(0), np.int64(0)
        for i in range(len(offset)):
            px, py, pz = offset[i, 0], offset[i, 1], offset[i, 2]
            nearest = np.inf
            for k in range(found):
                x, y, z = px - at[k, 0], py - at[k, 1], pz - at[k, 2]
                nearest = min(nearest, x * x + y * y + z * z)
            limit = (np.sqrt(nearest) + TIE) ** 2
            for k in range(found):
                x, y, z = px - at[k, 0], py - at[k, 1], pz - at[k, 2]
                square = x * x + y * y + z * z
                if square <= limit:
                    s = precision[kept[k]]
                    form = x * x * s[0, 0] + y * y * s[1, 1] + z * z * s[2, 2]
                    form += 2.0 * (x * y * s[0, 1] + x * z * s[0, 2] + y * z * s[1, 2])
                    metres += np.int64(np.rint(np.sqrt(square) * STEPS_PER_M))
                    sigmas += np.int64(np.rint(np.sqrt(max(form, 0.0)) * STEPS_PER_SIGMA))
                    break
        euclidean[c] = metres / STEPS_PER_M
        mahalanobis[c] = sigmas / STEPS_PER_SIGMA
    return euclidean, mahalanobis
