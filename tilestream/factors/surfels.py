"""The surfels of a map, tile by tile: a virtual scan is cast at them instead of points.

One per voxel of 0.2 m that holds map points, or per voxel of the map's leaf where that is larger: a
small disc in the plane of the points around it, or a ball where they form no plane (definitions,
section 4.2).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cells import cell_sums
from tilestream.kernels.depth_image import thin
from tilestream.kernels.surfels import surfels_of
from tilestream.records import Int64
from tilestream.store import MISSING, POINTS, Mark, Tile, TileStore, hash_of
from tilestream.tiling import Box, TileKey, whole_mm

SURFELS_VERSION = 1
"""Raise it when the surfels that are made from the same points change."""
FINEST_MM = 200
"""Smallest edge of the voxels of surfels [mm]."""
REACH_EDGES = 4
"""How far from its voxel the points that a surfel depends on can lie, with their voxels [edges]."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Discs and balls that represent the points of a map."""

    centre_mm: Int64
    """(n, 3) centres [mm, map frame], in the order of their voxels."""
    normal: NDArray[np.int16]
    """(n, 3) unit normals, 32767 for 1, sign arbitrary; 0 of a ball."""
    radius_mm: NDArray[np.int32]
    """(n,) radii [mm]."""

    def __len__(self) -> int:
        return len(self.centre_mm)

    def where(self, chosen: NDArray[np.bool_]) -> Self:
        """The surfels where `chosen` (n,) is True."""
        return type(self)(self.centre_mm[chosen], self.normal[chosen], self.radius_mm[chosen])


def surfel_mm(store: TileStore) -> int:
    """Edge of the voxels that have a surfel each [mm]: 200, or the map's leaf if larger."""
    return max(FINEST_MM, whole_mm(store.settings.map_leaf, "map_leaf"))


def surfels_table(edge_mm: int) -> str:
    """Name of the table of surfels, e.g. `surfels_200`."""
    return f"surfels_{edge_mm}"


def around_tile(store: TileStore, key: TileKey) -> Box:
    """The box [mm] of all points that the surfels of a tile depend on."""
    return store.grid.core(key).grown(REACH_EDGES * surfel_mm(store))


def surfels_inputs(
    store: TileStore, key: TileKey, have: Mapping[TileKey, str] | None = None
) -> str:
    """Hash of all that the surfels of a tile are made from: the points of the tiles in reach.

    Args:
        store: the map.
        key: the tile.
        have: the identity of the points of each tile of the map; None: as the store has them.
    """
    keys = list(store.grid.keys_over(around_tile(store, key)))
    if have is not None:
        return hash_of([(str(near), have.get(near, MISSING.identity)) for near in keys])
    return hash_of([(str(near), Tile(store, near).mark(POINTS).identity) for near in keys])


def surfels_mark(store: TileStore, key: TileKey) -> Mark:
    """The mark of the surfels that are made from the store's points by this code."""
    settings = hash_of(surfel_mm(store), SURFELS_VERSION)
    return Mark("done", inputs=surfels_inputs(store, key), settings=settings)


def tile_surfels(store: TileStore, key: TileKey) -> Surfels:
    """The surfels of the voxels whose lowest corners lie in a tile: the same for any tiling.

    Raises:
        TileNotReadyError: the tile, or a neighbour that exists, is not done; says why.
    """
    edge = surfel_mm(store)
    points = points_in(store, around_tile(store, key), key)
    index, sums = cell_sums(points, edge)
    low, core = index * edge, store.grid.core(key)
    return Surfels(*surfels_of(thin(index, sums, edge), index, edge, _inside(low, core)))


def surfel_columns(store: TileStore, key: TileKey, surfels: Surfels) -> dict[str, NDArray[Any]]:
    """A tile's surfels as the store keeps them: arrays by name, relative to the tile's origin."""
    origin = np.array(store.grid.origin_mm(key), np.int64)
    return {
        "centre": np.ascontiguousarray((surfels.centre_mm - origin).T.astype(np.int32)),
        "normal": np.ascontiguousarray(surfels.normal.T),
        "radius": surfels.radius_mm,
    }


def read_surfels(store: TileStore, key: TileKey) -> Surfels:
    """The surfels of a tile: from their table where it is up to date, else made now.

    Raises:
        TileNotReadyError: as `tile_surfels`.
    """
    tile, name = Tile(store, key), surfels_table(surfel_mm(store))
    if not tile.mark(name).same_work(surfels_mark(store, key)):
        return tile_surfels(store, key)
    kept = tile.read_table(name)
    origin = np.array(store.grid.origin_mm(key), np.int64)
    return Surfels(
        kept["centre"].T.astype(np.int64) + origin,
        np.ascontiguousarray(kept["normal"].T),
        kept["radius"],
    )


def surfels_in(store: TileStore, box: Box) -> Surfels:
    """The surfels of a map whose centres lie in a box.

    Raises:
        TileNotReadyError: a tile in reach failed or was skipped; says why.
    """
    parts = [_NONE]
    for key in store.grid.keys_over(box):
        if Tile(store, key).mark(POINTS).status != "missing":
            found = read_surfels(store, key)
            parts.append(found.where(_inside(found.centre_mm, box)))
    return Surfels(
        np.concatenate([part.centre_mm for part in parts]),
        np.concatenate([part.normal for part in parts]),
        np.concatenate([part.radius_mm for part in parts]),
    )


def points_in(store: TileStore, box: Box, key: TileKey | None = None) -> Int64:
    """(n, 3) the map points in a box [mm].

    Args:
        store: the map.
        box: where [mm]; tiles that the store does not have count as empty …
        key: … except this one, which must be there.

    Raises:
        TileNotReadyError: a tile in the box failed or was skipped; says why.
    """
    parts = [np.zeros((0, 3), np.int64)]
    for near in store.grid.keys_over(box):
        if near == key or Tile(store, near).mark(POINTS).status != "missing":
            points = store.tile(near).points_mm()
            parts.append(points[_inside(points, box)])
    return np.concatenate(parts)


_NONE = Surfels(np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int16), np.zeros(0, np.int32))


def _inside(points_mm: Int64, box: Box) -> NDArray[np.bool_]:
    x, y = points_mm[:, 0], points_mm[:, 1]
    inside: NDArray[np.bool_] = (x >= box.x_lo) & (x < box.x_hi) & (y >= box.y_lo) & (y < box.y_hi)
    return inside
