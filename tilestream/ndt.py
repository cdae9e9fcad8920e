"""Points to cells: the normal distribution map (definitions, section 1)."""

import numpy as np
from numpy.typing import ArrayLike

from tilestream.errors import UsageError
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.kernels.cells import EXACT_MM, cell_sums, moments
from tilestream.kernels.scatter import round_to_mm
from tilestream.records import Cells, Int64

MIN_POINTS = 6
"""Least number of map points of a cell."""
_LIMITS_MM = np.full(3, EXACT_MM - 1.0)


def to_mm(points: ArrayLike) -> Int64:
    """Points [m] as whole millimetres, rounded half to even: what the tile store holds.

    Args:
        points: (n, 3) points [m, map frame].

    Raises:
        UsageError: another shape, values that are not finite numbers, or farther than 10^9 km out.
    """
    try:
        metres = np.asarray(points)
    except ValueError:
        raise UsageError("points are no array: give an (n, 3) array of metres") from None
    if metres.dtype.kind not in "iuf":
        raise UsageError(f"points have type {metres.dtype}: give an (n, 3) array of metres")
    if metres.ndim != 2 or metres.shape[1] != 3:
        raise UsageError(f"points have shape {metres.shape}: give an (n, 3) array of metres")
    metres = np.ascontiguousarray(metres, np.float64)
    mm = np.empty(metres.shape, np.int64)
    row = round_to_mm(metres, _LIMITS_MM, mm)
    if row >= 0:
        raise UsageError(f"point {row} is {tuple(metres[row].tolist())}: give finite metres")
    return mm


def cells_of_mm(points_mm: Int64, cell_mm: int, min_points: int = MIN_POINTS) -> Cells:
    """The cells of points in whole millimetres: the same bits in any order and for any tiling.

    Args:
        points_mm: (n, 3) map points [mm, map frame].
        cell_mm: edge of a cell [mm].
        min_points: fewest points of a cell; voxels with fewer are no cells.

    Raises:
        UsageError: the cell size is not positive or too large for this many points, `min_points`
            is below 2 (a covariance needs two).
    """
    if cell_mm <= 0:
        raise UsageError(f"cell_size is {cell_mm / MM_PER_M:g} m: give more than 0")
    if max(len(points_mm), 1) * cell_mm**2 >= 2**62:
        raise UsageError(
            f"cell_size is {cell_mm / MM_PER_M:g} m: too large for {len(points_mm)} points"
        )
    if min_points < 2:
        raise UsageError(f"min_points is {min_points}: a covariance needs at least 2")
    index, sums = cell_sums(points_mm, cell_mm, min_points)
    mean, covariance = moments(index, sums, cell_mm)
    return Cells(index, sums[:, 0].copy(), mean, covariance, cell_mm / MM_PER_M)


def cells_of(points: ArrayLike, cell_size: float = 2.0, min_points: int = MIN_POINTS) -> Cells:
    """The normal distributions of points: mean and unbiased covariance per occupied voxel.

    The points are first rounded to whole millimetres (half to even), as `ingest` does; sums are
    exact integers, so the result does not depend on the order of the points.

    Args:
        points: (n, 3) points [m, map frame], n >= 0.
        cell_size: edge of a cell [m], whole millimetres.
        min_points: fewest points of a cell; voxels with fewer are no cells.

    Returns:
        The cells, by lexicographic voxel index; none where no voxel has enough points.

    Raises:
        UsageError: points of another shape or not finite, a cell size that is not a positive
            number of whole millimetres, `min_points` below 2.

    Examples:
        >>> points = np.random.default_rng(0).normal([1.0, 1.0, 1.0], 0.1, (50, 3))
        >>> cells = ts.cells_of(points)
        >>> len(cells), cells.index[0].tolist(), cells.count[0].item()
        (1, [0, 0, 0], 50)
    """
    return cells_of_mm(to_mm(points), whole_mm(cell_size, "cell_size"), min_points)
