"""The surfels of a map, tile by tile: a virtual scan is cast at them instead of points.

One per voxel of 0.2 m that holds map points, or per voxel of the map's leaf where that is larger: a
small disc in the plane of the points around it, or a ball where they form no plane. Where the
points are too sparse for that, a disc per voxel of twice the edge (definitions, section 4.2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.ghosts import REACH_EDGES as GHOST_EDGES
from tilestream.factors.ghosts import ghosts_among
from tilestream.grid import Box, TileKey, whole_mm
from tilestream.kernels import in_view as kernel
from tilestream.kernels.cells import cell_of_points
from tilestream.kernels.in_view import Field
from tilestream.kernels.surfels import NORMAL_ONE, surfels_of
from tilestream.kernels.thinning import thinned
from tilestream.records import Float64, Int64
from tilestream.store import Tile, TileStore, TileTable

SURFELS_VERSION = 3
"""Raise it when the surfels that are made from the same points change."""
FINEST_MM = 200
"""Smallest edge of the voxels of surfels [mm]."""
PLANE_EDGES = 4
"""How far from its voxel the points of a surfel's plane can lie, with their voxels [edges]."""
COARSE = 2
"""Edge of the voxels of the second level [edges]."""
CLEAR_EDGES = COARSE * (PLANE_EDGES + 1)
"""How far around a tile it is known what is a ghost [edges]: a voxel of the second level farther
than its planes reach."""
FINE_EDGES = CLEAR_EDGES + GHOST_EDGES
"""How far around a tile the first level is made [edges]."""
REACH_EDGES = FINE_EDGES + PLANE_EDGES
"""How far around a tile its surfels depend on points [edges]: 6.0 m."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Discs and balls that represent the points of a map."""

    centre_mm: Int64
    """(n, 3) centres [mm, map frame], in the order of their voxels."""
    normal: NDArray[np.int16]
    """(n, 3) unit normals, 32767 for 1, sign arbitrary; 0 of a ball."""
    radius_mm: NDArray[np.int32]
    """(n,) radii [mm]."""
    ghost: NDArray[np.bool_]
    """(n,) whether it is of traffic that moved during the survey (`ghosts.py`)."""

    def __len__(self) -> int:
        return len(self.centre_mm)

    def where(self, chosen: NDArray[np.bool_]) -> Self:
        """The surfels where `chosen` (n,) is True."""
        return type(self)(*(getattr(self, part.name)[chosen] for part in fields(self)))

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(n,) whether it is a disc."""
        x, y, z = self.normal.T  # each by itself: `any` along rows of three takes ten times as long
        return np.asarray((x | y | z) != 0)


def surfel_mm(store: TileStore) -> int:
    """Edge of the voxels that have a surfel each [mm]: 200, or the map's leaf if larger."""
    return max(FINEST_MM, whole_mm(store.settings.map_leaf, "map_leaf"))


def surfels_table(edge_mm: int) -> TileTable:
    """The surfels of voxels of one edge, small numbers: `centre` from the tile's origin."""
    return TileTable(
        name=f"surfels_{edge_mm}",
        stage="surfels",
        version=SURFELS_VERSION,
        takes={"edge_mm": edge_mm},
        reach_mm=REACH_EDGES * edge_mm,
        make=lambda store, key: _columns(store, key, tile_surfels(store, key)),
    )


def tile_surfels(store: TileStore, key: TileKey) -> Surfels:
    """The surfels of the voxels whose lowest corners lie in a tile: the same for any tiling.

    First level by voxel, then second level by voxel.

    Raises:
        TileNotReadyError: the tile, or a neighbour that exists, is not done; says why.
    """
    edge, core = surfel_mm(store), store.grid.core(key)
    store.tile(key)  # which must be there, unlike its neighbours
    points = store.points_in(core.grown(REACH_EDGES * edge))
    index, centroids = thinned(points, edge)
    made = core.grown(FINE_EDGES * edge).holds(index * edge)
    fine = _of_voxels(centroids, index, edge, made)
    fine = replace(fine, ghost=ghosts_among(fine.centre_mm, edge))
    voxels, real = index[made], ~fine.ghost
    box = core.grown(COARSE * edge)
    coarse, of = _coarse(centroids[made][real], voxels[fine.flat & real], edge, box)
    stands = core.holds(voxels * edge) & ~_on(fine, voxels, coarse, of, edge)
    return _together([fine.where(stands), coarse.where(core.holds(of * COARSE * edge))])


def _of_voxels(
    points: Int64, index: Int64, edge: int, own: NDArray[np.bool_], touching: bool = False
) -> Surfels:
    """A surfel for each of the voxels `own`, none of them a ghost."""
    none = np.zeros(int(own.sum()), np.bool_)
    return Surfels(*surfels_of(points, index, edge, own, touching), none)


def _coarse(points: Int64, discs: Int64, edge: int, box: Box) -> tuple[Surfels, Int64]:
    """The second level in a box: discs in the larger voxels in which no disc of the first stands;
    and these voxels.

    Args:
        points: (n, 3) centroids of the first level's voxels that are no ghosts, also around the
            tile [mm].
        discs: (m, 3) voxels of its discs.
        edge: edge of the first level's voxels [mm].
        box: where.
    """
    index, centroids = thinned(points, COARSE * edge)
    made = box.holds(index * COARSE * edge)
    found = _of_voxels(centroids, index, COARSE * edge, made, touching=True)
    taken, _ = thinned(discs, COARSE)
    bare = cell_of_points(index[made], 1, taken) < 0
    kept = np.logical_and(found.flat, bare)
    return found.where(kept), index[made][kept]


def _on(fine: Surfels, voxels: Int64, coarse: Surfels, of: Int64, edge: int) -> NDArray[np.bool_]:
    """(n,) which balls of the first level lie on a disc of the second, which stands for them.

    Args:
        fine: the first level.
        voxels: (n, 3) its voxels.
        coarse: the second level.
        of: (m, 3) its voxels, lexicographic.
        edge: edge of the first level's voxels [mm].
    """
    row = cell_of_points(voxels, COARSE, of)
    found = np.logical_and(row >= 0, ~fine.flat)
    disc = row[found]
    offset = (fine.centre_mm[found] - coarse.centre_mm[disc]).astype(np.float64)
    normal = coarse.normal[disc] / NORMAL_ONE
    away = (offset[:, 0] * normal[:, 0] + offset[:, 1] * normal[:, 1]) + offset[:, 2] * normal[:, 2]
    found[found] = np.abs(away) <= 0.5 * edge
    return found


def _columns(store: TileStore, key: TileKey, surfels: Surfels) -> dict[str, NDArray[Any]]:
    """A tile's surfels as the store keeps them: arrays by name, from the tile's origin."""
    origin = np.array(store.grid.origin_mm(key), np.int64)
    return {
        "centre": np.ascontiguousarray((surfels.centre_mm - origin).T.astype(np.int32)),
        "normal": np.ascontiguousarray(surfels.normal.T),
        "radius": surfels.radius_mm,
        "ghost": surfels.ghost,
    }


def _surfels(tile: Tile) -> Surfels:
    """The surfels of a tile; raises as `tile_surfels`."""
    kept = tile.derived(surfels_table(surfel_mm(tile.store)))
    origin = np.array(tile.store.grid.origin_mm(tile.key), np.int64)
    return Surfels(
        kept["centre"].T.astype(np.int64) + origin,
        np.ascontiguousarray(kept["normal"].T),
        kept["radius"],
        kept["ghost"],
    )


def surfels_in(store: TileStore, box: Box) -> Surfels:
    """The surfels of a map whose centres lie in a box.

    Raises:
        TileNotReadyError: a tile in reach failed or was skipped; says why.
    """
    parts = [_surfels(tile) for tile in store.tiles_over(box)]
    return _together([_NONE, *(part.where(box.holds(part.centre_mm)) for part in parts)])


def _together(parts: Sequence[Surfels]) -> Surfels:
    columns = (
        np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Surfels)
    )
    return Surfels(*columns)


_NONE = Surfels(
    np.zeros((0, 3), np.int64),
    np.zeros((0, 3), np.int16),
    np.zeros(0, np.int32),
    np.zeros(0, np.bool_),
)


def in_view(
    surfels: Surfels,
    places: Float64,
    fov_deg: tuple[float, float],
    reach: float,
    rim: float = 0.0,
) -> Surfels:
    """The surfels that a beam from any of the places can meet, and a few more; arguments as of
    `can_be_met`.
    """
    return surfels.where(can_be_met(surfels, places, fov_deg, reach, rim))


def can_be_met(
    surfels: Surfels,
    places: Float64,
    fov_deg: tuple[float, float],
    reach: float,
    rim: float = 0.0,
) -> NDArray[np.bool_]:
    """(n,) which surfels a beam from any of the places can meet, and a few more.

    Args:
        surfels: (n,) the surfels around the places.
        places: (k, 3) places [m, map frame], best near one another.
        fov_deg: lowest and highest elevation of the beams [deg].
        reach: range of the beams [m].
        rim: how far from its place a beam may start [m].
    """
    middle = places.mean(axis=0)
    around = float(np.hypot(*(places - middle)[:, :2].T).max()) + 1.0 + rim
    low, high = (math.tan(math.radians(min(max(edge, -89.0), 89.0))) for edge in fov_deg)
    up = (places - middle)[:, 2]
    bottom, top = float(up.min()) - 1.0 - rim, float(up.max()) + 1.0 + rim
    x, y, z = middle.tolist()
    field = Field((x, y, z), around, reach, bottom, top, low, high)
    met: NDArray[np.bool_] = kernel.can_be_met(np.ascontiguousarray(surfels.centre_mm), field)
    return met
