"""The tile store: a Zarr group per tile, a sub-group per table of a tile, a mark on what is done.

```
map.zarr/                 attributes: schema, settings, CRS, lattice origin, sources
  12_-3/                  a tile, named by its key
    points/xyz            (3, n) int32 millimetres from the tile's origin, sorted by voxel
    cells_2000/...        a table made from them: one array per column
```

A table is written by one task: the arrays first, then, last, its mark (status, reason, identity,
facts). Without a mark a table is missing, whatever lies there; every reader looks at the mark.
"""

import html
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import StoreError, StoreVersionError, TileNotReadyError, UsageError
from tilestream.grid import MM_PER_M, Box, TileGrid, TileKey, whole_mm
from tilestream.marks import Mark
from tilestream.records import Cells, Float64, Int64
from tilestream.store.arrays import (
    Files,
    create_root,
    erase,
    read_columns,
    read_marks,
    read_root,
    write_columns,
    write_root,
)
from tilestream.store.table import CELLS_VERSION as CELLS_VERSION
from tilestream.store.table import TileTable as TileTable
from tilestream.store.table import cells_table as cells_table
from tilestream.version import VERSION

SCHEMA = 2
"""Version of the store's layout; a store with another one is refused."""
POINTS = "points"
"""Name of the table that ingest writes: the column `xyz`."""


@dataclass(frozen=True)
class StoreSettings:
    """What a store is, written once when it is created."""

    tile_size: float
    """Edge of a tile [m], whole millimetres."""
    halo: float
    """Width of the halo around a tile [m], whole millimetres."""
    map_leaf: float
    """Edge of the voxels that points were thinned to [m]; 0: all points were kept."""
    crs: str | None
    """Coordinate reference system of the map, any string that pyproj reads; None: local."""


class Tile:
    """One tile of a store: its points, and the tables made from them."""

    def __init__(self, store: "TileStore", key: TileKey) -> None:
        self.store = store
        self.key = key

    def __repr__(self) -> str:
        mark = self.mark(POINTS)
        size = f"{mark.facts['points']:,} points" if mark.status == "done" else mark.reason
        return f"Tile {self.key} ({mark.status}: {size}) of {self.store.url}"

    def points(self, halo: bool = False) -> Float64:
        """The map points of the tile's core, (n, 3) float64 [m, map frame].

        Args:
            halo: also those of the neighbours within the store's halo, corners included;
                a neighbour that does not exist has none.

        Raises:
            TileNotReadyError: the tile (or, with halo, an existing neighbour) is not done.
        """
        return self.points_mm(halo) / MM_PER_M

    def points_mm(self, halo: bool = False) -> Int64:
        """The same points as (n, 3) int64 whole millimetres in the map frame."""
        if not halo:
            return self._core_mm()
        self.require(POINTS)
        return self.store.points_in(self.store.grid.halo_box(self.key))

    def _core_mm(self) -> Int64:
        xyz = self.read_table(POINTS)["xyz"]
        origin = np.array(self.store.grid.origin_mm(self.key), dtype=np.int64)
        return np.ascontiguousarray(xyz.T).astype(np.int64) + origin

    def cells(self, cell_size: float = 2.0) -> Cells:
        """The NDT cells of the tile's core, from its table where that is done, else made now.

        Args:
            cell_size: edge of a cell [m]; the tile size must be a multiple of it.

        Raises:
            UsageError: the tile size is no multiple of `cell_size`; names sizes that work.
            TileNotReadyError: the tile's points are not done.
        """
        cell_mm = whole_mm(cell_size, "cell_size")
        self.store.grid.require_cell_size(cell_mm)
        return Cells(**self.derived(cells_table(cell_mm)), cell_size=cell_size)

    def derived(self, table: TileTable) -> dict[str, NDArray[Any]]:
        """The columns of a table that is made from the map: as stored where it is up to date, else
        made now.

        Raises:
            TileNotReadyError: the tile, or one in reach that exists, is not done; says why.
        """
        grid = self.store.grid
        near = list(grid.keys_over(grid.core(self.key).grown(table.points_reach_mm)))
        marks = self.store._marks([*((k, POINTS) for k in near), (self.key, table.name)])
        *points, mark = marks
        have = {k: m.identity for k, m in zip(near, points, strict=True) if m.status == "done"}
        if mark.is_of(table.identity(grid, self.key, have)):
            return self.read_table(table.name)
        return table.make(self.store, self.key)

    def mark(self, table: str) -> Mark:
        """What became of a table; `missing` where there is none."""
        return self.store._marks([(self.key, table)])[0]

    def require(self, table: str) -> Mark:
        """The mark of a table that is done.

        Raises:
            TileNotReadyError: it is not; says its status and why.
        """
        mark = self.mark(table)
        if mark.status != "done":
            raise TileNotReadyError(
                f"{self.store.url}: {table} of tile {self.key} is {mark.status}: {mark.reason}"
            )
        return mark

    def read_table(self, table: str) -> dict[str, NDArray[Any]]:
        """All columns of a table, by name.

        Raises:
            TileNotReadyError: the table is not done.
            StoreError: a column of a done table was lost or damaged since.
        """
        columns: list[str] = self.require(table).facts["columns"]
        return read_columns(self.store.files, f"{self.key}/{table}", columns)

    def write_table(self, table: str, columns: Mapping[str, NDArray[Any]], mark: Mark) -> None:
        """Replace a table: the old mark goes first, the new one comes last.

        Args:
            table: its name.
            columns: an array per column, each written as one chunk.
            mark: of status `done`; the names of the columns are added to its facts.
        """
        erase(self.store.files, f"{self.key}/{table}")
        write_columns(self.store.files, f"{self.key}/{table}", columns, mark)

    def write_reason(self, table: str, mark: Mark) -> None:
        """Replace a table by the reason why there is none (`failed` or `skipped`)."""
        erase(self.store.files, f"{self.key}/{table}")
        write_columns(self.store.files, f"{self.key}/{table}", {}, mark)


class TileStore:
    """A map in tiles, at a local path or any fsspec URL (`s3://…`, `memory://…`).

    Open one with `tilestream.open_store`. Credentials and endpoints of a remote store come from
    the environment, as its fsspec filesystem documents (for S3: AWS_ACCESS_KEY_ID,
    AWS_ENDPOINT_URL, …), so that workers on other machines find them too.
    """

    def __init__(self, url: str, settings: StoreSettings) -> None:
        self.url = url
        self.settings = settings
        self.grid = TileGrid.of(settings.tile_size, settings.halo)

    @cached_property
    def files(self) -> Files:
        """Where it lies."""
        return Files.at(self.url)

    @property
    def fs(self) -> Any:
        """The fsspec filesystem that the store is on."""
        return self.files.fs

    @property
    def root(self) -> str:
        """The store's path on that filesystem."""
        return self.files.root

    @property
    def address(self) -> str:
        """The store's URL; of a local store its absolute path, for readers started elsewhere."""
        return self.url if "://" in self.url else str(Path(self.url).absolute())

    def __getstate__(self) -> dict[str, Any]:
        return {"url": self.url, "settings": self.settings, "grid": self.grid}

    @classmethod
    def create(cls, url: str, settings: StoreSettings) -> Self:
        """A new, empty store.

        Raises:
            StoreError: something that is no tile store lies at `url`.
            UsageError: `tile_size` is no multiple of `map_leaf`.
        """
        store = cls(url, settings)
        if settings.map_leaf:
            store.grid.require_cell_size(whole_mm(settings.map_leaf, "map_leaf"))
        if store.fs.exists(store.root) and store.fs.ls(store.root, detail=False):
            raise StoreError(f"{url} is there and is no tile store: choose another path")
        create_root(store.url, store._attributes([], {}))
        return store

    def _attributes(
        self, sources: list[dict[str, Any]], made_by: Mapping[str, int]
    ) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "lattice_origin": [0.0, 0.0, 0.0],
            "settings": asdict(self.settings),
            "sources": sources,
            "made_by": dict(made_by),
        }

    def sources(self) -> list[dict[str, Any]]:
        """What the map was made from: path, format, size, points, fingerprint of each source.

        Empty until an ingest has ended.
        """
        found: list[dict[str, Any]] = _known(self.files)["sources"]
        return found

    def made_by(self) -> dict[str, int]:
        """The stages that made the map, with their versions; empty until an ingest has ended."""
        found: dict[str, int] = _known(self.files)["made_by"]
        return found

    def write_sources(self, sources: list[dict[str, Any]], made_by: Mapping[str, int]) -> None:
        """Record what the map was made from, and by which versions of the stages.

        The one writer is the process that ran the ingest.
        """
        write_root(self.files, self._attributes(sources, made_by))

    def remove(self, key: TileKey) -> None:
        """Remove a tile with all its tables; the mark of its points goes first."""
        erase(self.files, f"{key}/{POINTS}")
        self.fs.rm(f"{self.root}/{key}", recursive=True)

    def remove_fragments(self) -> None:
        """Remove what an ingest left between its two halves."""
        if self.fs.exists(f"{self.root}/fragments"):
            self.fs.rm(f"{self.root}/fragments", recursive=True)

    def keys(self, table: str = POINTS) -> list[TileKey]:
        """The tiles of which a table is done, sorted."""
        return [key for key, mark in self.marks(table).items() if mark.status == "done"]

    def marks(
        self, table: str = POINTS, keys: Iterable[TileKey] | None = None
    ) -> dict[TileKey, Mark]:
        """What became of a table in some tiles, in their order; None: in every tile, sorted."""
        wanted = sorted(self._tile_folders()) if keys is None else list(keys)
        return dict(zip(wanted, self._marks([(key, table) for key in wanted]), strict=True))

    def identities(self) -> dict[TileKey, str]:
        """The identity of the points of each tile that is done: what tables are made from."""
        marks = self.marks()
        return {key: mark.identity for key, mark in marks.items() if mark.status == "done"}

    def _tile_folders(self) -> Iterable[TileKey]:
        for entry in self.fs.ls(self.root, detail=False):
            try:
                yield TileKey.parse(str(entry).rstrip("/").rsplit("/", 1)[-1])
            except UsageError:
                continue

    def _marks(self, wanted: list[tuple[TileKey, str]]) -> list[Mark]:
        return read_marks(self.files, [f"{key}/{table}" for key, table in wanted])

    def tile(self, key: tuple[int, int]) -> Tile:
        """The tile of a key `(ix, iy)`.

        Raises:
            TileNotReadyError: it is missing, failed or skipped; says why.
        """
        tile = Tile(self, TileKey(*key))
        tile.require(POINTS)
        return tile

    def tile_at(self, x: float, y: float) -> Tile:
        """The tile whose core holds the place (x, y) [m, map frame]; raises as `tile` does."""
        return self.tile(self.grid.key_at(x, y))

    def cells_in(self, box: Box, cell_size: float) -> Cells:
        """The NDT cells of all tiles that a box touches, whole tiles, as one map.

        Args:
            box: where; tiles that the store does not have are empty ground.
            cell_size: edge of a cell [m].

        Raises:
            TileNotReadyError: a tile in the box failed or was skipped; says why.
            UsageError: as `Tile.cells`.
        """
        cell_mm = whole_mm(cell_size, "cell_size")
        self.grid.require_cell_size(cell_mm)
        parts = [tile.cells(cell_size) for tile in self.tiles_over(box)]
        return Cells(
            np.concatenate([np.zeros((0, 3), np.int64), *(part.index for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.count for part in parts)]),
            np.concatenate([np.zeros((0, 3)), *(part.mean for part in parts)]),
            np.concatenate([np.zeros((0, 3, 3)), *(part.covariance for part in parts)]),
            cell_size,
        )

    def points_in(self, box: Box) -> Int64:
        """(n, 3) the map points in a box [mm, map frame]; tiles that do not exist have none.

        Raises:
            TileNotReadyError: a tile in the box failed or was skipped; says why.
        """
        parts = [np.zeros((0, 3), np.int64)]
        for tile in self.tiles_over(box):
            points = tile.points_mm()
            parts.append(points[box.holds(points)])
        return np.concatenate(parts)

    def tiles_over(self, box: Box) -> list[Tile]:
        """The tiles that a box touches and that exist, done or not."""
        keys = list(self.grid.keys_over(box))
        marks = self._marks([(key, POINTS) for key in keys])
        return [
            Tile(self, key)
            for key, mark in zip(keys, marks, strict=True)
            if mark.status != "missing"
        ]

    def __repr__(self) -> str:
        counts = [m.facts["points"] for m in self.marks().values() if m.status == "done"]
        return (
            f"TileStore {self.url}: {len(counts)} tiles of {self.settings.tile_size:g} m, "
            f"{sum(counts):,} points, CRS {self.settings.crs or 'local'}"
        )

    def _repr_html_(self) -> str:
        rows = [
            (str(key), mark.status, f"{mark.facts.get('points', 0):,}", mark.reason)
            for key, mark in self.marks().items()
        ]
        head = "<tr><th>tile</th><th>status</th><th>points</th><th>reason</th></tr>"
        cells = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows[:20]]
        more = f"<p>… and {len(rows) - 20} more tiles</p>" if len(rows) > 20 else ""
        body = "".join(f"<tr>{row}</tr>" for row in cells)
        return f"<p>{html.escape(repr(self))}</p><table>{head}{body}</table>{more}"


def open_store(url: str) -> TileStore:
    """Open a tile store that `ingest` made.

    Args:
        url: a local path, or any fsspec URL.

    Raises:
        StoreNotFoundError: nothing there.
        StoreVersionError: written by a newer version of tilestream.
        StoreError: something else lies there.
        UsageError: a file lies there, or where a folder above it would be.
    """
    attributes = _known(Files.at(str(url)))
    return TileStore(str(url), StoreSettings(**attributes["settings"]))


def _known(files: Files) -> dict[str, Any]:
    """What a store says of itself; errors as of `open_store`."""
    attributes = read_root(files)
    schema = int(attributes["schema"])
    if schema != SCHEMA:
        what = "install the newer tilestream" if schema > SCHEMA else "give another path"
        raise StoreVersionError(
            f"{files.url} has schema {schema}, this is tilestream {VERSION} with schema {SCHEMA}: "
            f"{what}, or remove it and ingest the sources again"
        )
    return attributes
