"""A table that is made from the map, tile by tile: by which stage, from what, how far around."""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from numpy.typing import NDArray

from tilestream.grid import TileGrid, TileKey
from tilestream.marks import hash_of, identity_of
from tilestream.ndt import cells_of_mm

CELLS_VERSION = 1
"""Raise it when the cells that are made from the same points change."""


@dataclass(frozen=True)
class TileTable:
    """A table that every tile can have, made from the map within reach of the tile."""

    name: str
    """Name of the table in a tile, e.g. `cells_2000`."""
    stage: str
    """Name of the stage that makes it."""
    version: int
    """Version of that stage."""
    takes: Mapping[str, Any]
    """The settings of the stage."""
    reach_mm: int
    """How far around the tile the map decides the table [mm]."""
    make: Callable[[Any, TileKey], dict[str, NDArray[Any]]]
    """Makes the columns, from the store and the tile."""
    reads: "TileTable | None" = None
    """The table of the tiles in reach that it is made from; None: their points."""

    @property
    def points_reach_mm(self) -> int:
        """How far around the tile points decide it, through all that it is made from [mm]."""
        return self.reach_mm + (0 if self.reads is None else self.reads.points_reach_mm)

    def tiles(self, grid: TileGrid, key: TileKey, have: Container[TileKey]) -> list[TileKey]:
        """The tiles in reach of one that the map has, sorted."""
        near = grid.keys_over(grid.core(key).grown(self.reach_mm))
        return [k for k in near if k in have]

    def identity(self, grid: TileGrid, key: TileKey, have: Mapping[TileKey, str]) -> str:
        """The identity that the table of a tile has, or will have.

        Args:
            grid: the tiles.
            key: the tile.
            have: the identity of the points of each tile of the map, at least of those in reach.
        """
        near = self.tiles(grid, key, have)
        below = self.reads
        if below is None:
            inputs = [(str(k), have[k]) for k in near]
        else:
            inputs = [(str(k), below.identity(grid, k, have)) for k in near]
        takes = {**self.takes, "tile": key}
        return identity_of(self.stage, self.version, takes, {"map_part": [hash_of(inputs)]})


@lru_cache
def cells_table(cell_mm: int) -> TileTable:
    """The cells of one size: the columns of `Cells`."""
    return TileTable(
        name=f"cells_{cell_mm}",
        stage="cells",
        version=CELLS_VERSION,
        takes={"cell_mm": cell_mm},
        reach_mm=0,
        make=lambda store, key: _cell_columns(store, key, cell_mm),
    )


def _cell_columns(store: Any, key: TileKey, cell_mm: int) -> dict[str, NDArray[Any]]:
    cells = cells_of_mm(store.tile(key).points_mm(), cell_mm)
    columns = ("index", "count", "mean", "covariance")
    return {name: getattr(cells, name) for name in columns}
