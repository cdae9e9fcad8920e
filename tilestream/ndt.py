"""Points to cells: the normal distribution map (definitions, section 1)."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.errors import UsageError
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.kernels.bounds import bounds
from tilestream.kernels.cells import EXACT_MM, cell_sums_in, moments
from tilestream.records import Cells, Float64, Int64

MIN_POINTS = 6
"""Least number of map points of a cell."""


def cells_of_mm(points_mm: Int64, cell_mm: int, min_points: int = MIN_POINTS) -> Cells:
    """The cells of points in whole millimetres: the same bits in any order and for any tiling.

    Args:
        points_mm: (n, 3) map points [mm, map frame].
        cell_mm: edge of a cell [mm].
        min_points: fewest points of a cell; voxels with fewer are no cells.

    Raises:
        UsageError: the cell size is not positive or too large for this many points, `min_points`
            is below 2 (a covariance needs two), or a point is farther than 10^9 km out.
    """
    return _cells(np.ascontiguousarray(points_mm), 1, cell_mm, min_points)


def _cells(points: NDArray[Any], unit_mm: int, cell_mm: int, min_points: int) -> Cells:
    """The cells of points [`unit_mm` mm]."""
    if cell_mm <= 0:
        raise UsageError(f"cell_size is {cell_mm / MM_PER_M:g} m: give more than 0")
    if max(len(points), 1) * cell_mm**2 >= 2**62:
        raise UsageError(
            f"cell_size is {cell_mm / MM_PER_M:g} m: too large for {len(points)} points"
        )
    if min_points < 2:
        raise UsageError(f"min_points is {min_points}: a covariance needs at least 2")
    box = bounds(points)
    if not _in_reach(box, unit_mm).all():
        row = int(np.argmin(_in_reach(points, unit_mm).all(axis=1)))
        raise UsageError(f"point {row} is {tuple(points[row].tolist())}: give finite metres")
    index, sums = cell_sums_in(box, points, unit_mm, cell_mm, min_points)
    mean, covariance = moments(index, sums, cell_mm)
    return Cells(index, sums[:, 0].copy(), mean, covariance, cell_mm / MM_PER_M)


def _in_reach(points: NDArray[Any], unit_mm: int) -> NDArray[np.bool_]:
    """Which coordinates [`unit_mm` mm] have an exact voxel index."""
    near: NDArray[np.bool_] = np.abs(np.rint(points * unit_mm)) < EXACT_MM
    return near


def _metres(points: ArrayLike) -> Float64:
    """Points as an array of metres.

    Raises:
        UsageError: another shape, or no numbers.
    """
    try:
        metres = np.asarray(points)
    except ValueError:
        raise UsageError("points are no array: give an (n, 3) array of metres") from None
    if metres.dtype.kind not in "iuf":
        raise UsageError(f"points have type {metres.dtype}: give an (n, 3) array of metres")
    if metres.ndim != 2 or metres.shape[1] != 3:
        raise UsageError(f"points have shape {metres.shape}: give an (n, 3) array of metres")
    return np.ascontiguousarray(metres, np.float64)


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
    return _cells(_metres(points), MM_PER_M, whole_mm(cell_size, "cell_size"), min_points)
