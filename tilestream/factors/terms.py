"""The terms of a tile: everything about its cells that does not depend on the sample point.

A cell's neighbours are those of the whole map (definitions, section 2), so the cells of a halo
around the tile are read too; only the tile's own are kept.
"""

from functools import lru_cache

import numpy as np

from tilestream.factors.catalogue import CRITERIA
from tilestream.factors.vicinity import Terms, TileTerms
from tilestream.grid import MM_PER_M, Box, TileKey, whole_mm
from tilestream.kernels.cells import cell_of_points, cell_sums, moments
from tilestream.kernels.thinning import thinned
from tilestream.ndt import MIN_POINTS
from tilestream.records import Cells, Int64
from tilestream.store import POINTS, Tile, TileStore, TileTable, cells_table

TERMS_VERSION = 2
"""Raise it when the terms that are made from the same points change."""
DEPTH_MM = 500
"""Edge of the voxels to which map points are thinned for the depth image [mm]."""
REACH_MM = 10_000
"""Distance within which the terms of a cell depend on other cells [mm]: its neighbours'
neighbours, 5 m and 5 m."""
SHIFT_MM = 3_000
"""Largest of the 441 shifts, sqrt(8) m [mm], rounded up."""


def reach_mm(cell_mm: int) -> int:
    """How far from its voxel a cell's terms can depend on other cells [mm].

    The nearest mean of a point is no farther than its own cell's, sqrt(3) l; that of a shifted
    point counts within l.
    """
    return max(REACH_MM, 2 * cell_mm, SHIFT_MM + cell_mm)


@lru_cache
def terms_table(cell_mm: int) -> TileTable:
    """The terms of cells of one size: the columns of `TileTerms.arrays`."""
    return TileTable(
        name=f"terms_{cell_mm}",
        stage="terms",
        version=TERMS_VERSION,
        takes={"cell_mm": cell_mm},
        reach_mm=reach_mm(cell_mm),
        make=lambda store, key: tile_terms(store, key, cell_mm / MM_PER_M).arrays(),
        reads=cells_table(cell_mm),
    )


def terms_of(cells: Cells, points_mm: Int64, core: Box, depth_mm: Int64 | None = None) -> TileTerms:
    """The terms of a tile's cells.

    Args:
        cells: the cells of the tile, and all others of the map within `reach_mm` of it; more are
            allowed.
        points_mm: (n, 3) the tile's map points [mm].
        core: the tile, whose edges lie on the lattice of the cells.
        depth_mm: (d, 3) the points of the depth image [mm] that this tile keeps; None: the tile's
            points thinned to 0.5 m, which is right where its edges lie on that lattice.
    """
    near = _voxels_in(cells, core.grown(reach_mm(cells.cell_mm)))
    index, count = cells.index[near], cells.count[near]
    cells = Cells(index, count, cells.mean[near], cells.covariance[near], cells.cell_size)
    own = _voxels_in(cells, core)
    cell_of_point = cell_of_points(points_mm, cells.cell_mm, cells.index)
    terms: Terms = {}
    for criterion in CRITERIA:
        terms |= criterion.terms(cells, points_mm, cell_of_point)
    voxels, sums = cell_sums(points_mm, cells.cell_mm)
    loose = sums[:, 0] < MIN_POINTS
    loose_mean, _ = moments(voxels[loose], sums[loose], cells.cell_mm)
    if depth_mm is None:
        _, depth_mm = thinned(points_mm, DEPTH_MM)
    return TileTerms.of(
        mean=cells.mean[own],
        terms={name: term[own] for name, term in terms.items()},
        field="score",
        depth_mm=depth_mm,
        loose_mean=loose_mean,
        loose_count=sums[loose, 0].copy(),
    )


def tile_terms(store: TileStore, key: TileKey, cell_size: float = 2.0) -> TileTerms:
    """The terms of a tile of a store, made from its points and the cells around it.

    Raises:
        UsageError: the tile size is no multiple of `cell_size`.
        TileNotReadyError: the tile, or a neighbour that exists, is not done; says why.
    """
    cell_mm = whole_mm(cell_size, "cell_size")
    core = store.grid.core(key)
    cells = store.cells_in(core.grown(reach_mm(cell_mm)), cell_size)
    depth_mm = _depth_points(store, key) if store.grid.tile_mm % DEPTH_MM else None
    return terms_of(cells, store.tile(key).points_mm(), core, depth_mm)


def _voxels_in(cells: Cells, box: Box) -> Int64:
    """Rows of the cells whose voxels touch a box."""
    low = cells.index[:, :2] * cells.cell_mm
    inside = (low + cells.cell_mm > (box.x_lo, box.y_lo)) & (low < (box.x_hi, box.y_hi))
    return np.flatnonzero(inside.all(axis=1))


def _depth_points(store: TileStore, key: TileKey) -> Int64:
    """The 0.5 m points of a tile whose edges cut their lattice.

    A voxel that is cut has points in several tiles: the first of them, by key, keeps it.
    """
    keys = list(store.grid.keys_over(store.grid.core(key).grown(DEPTH_MM)))
    there = [near for near in keys if Tile(store, near).mark(POINTS).status != "missing"]
    parts = [store.tile(near).points_mm() for near in there]
    points = np.concatenate(parts)
    tile_of_point = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    voxels, centroids = thinned(points, DEPTH_MM)
    first = np.full(len(voxels), len(parts))
    np.minimum.at(first, cell_of_points(points, DEPTH_MM, voxels), tile_of_point)
    kept: Int64 = centroids[first == there.index(key)]
    return kept
