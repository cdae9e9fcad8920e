"""The tile store: a Zarr group per tile, a sub-group per table of a tile, a mark on what is done.

```
map.zarr/                 attributes: schema, settings, CRS, lattice origin, sources
  12_-3/                  a tile, named by its key
    points/xyz            (3, n) int32 millimetres from the tile's origin, sorted by voxel
    cells_2000/...        a table made from them: one array per column
```

A table is written by one task: the arrays first, then, last, its mark (status, reason, hashes,
version). Without a mark a table is missing, whatever lies there; every reader looks at the mark.
"""

import hashlib
import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import fsspec
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from tilestream.errors import (
    StoreError,
    StoreNotFoundError,
    StoreVersionError,
    TileNotReadyError,
    UsageError,
)
from tilestream.ndt import cells_of_mm
from tilestream.records import Cells, Float64, Int64
from tilestream.tiling import MM_PER_M, Box, TileGrid, TileKey, whole_mm
from tilestream.version import VERSION

SCHEMA = 1
"""Version of the store's layout; a store with a larger one is refused."""
POINTS = "points"
"""Name of the table that ingest writes: the column `xyz`."""
CELLS_VERSION = 1
"""Raise it when the cells that are made from the same points change."""
_CODEC = BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")
_OURS = "tilestream"

Status = Literal["missing", "done", "failed", "skipped"]


@dataclass(frozen=True)
class Mark:
    """What became of a table of a tile; written last, checked by every reader."""

    status: Status
    """`done`: whole. `failed` or `skipped`: not there, and `reason` says why."""
    reason: str = ""
    """Why it failed or was skipped."""
    inputs: str = ""
    """Hash of what it was made from."""
    settings: str = ""
    """Hash of the settings it was made with."""
    code: str = VERSION
    """Version of the code that made it."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Small numbers that a listing shows without reading the table: counts, extents."""

    @property
    def identity(self) -> str:
        """Hash of everything the table depends on: what a table made from it has as input."""
        return hash_of(self.inputs, self.settings, self.code)

    def same_work(self, other: "Mark") -> bool:
        """Whether both say: done, from the same inputs, settings and code."""
        return self.status == other.status == "done" and self.identity == other.identity


MISSING = Mark(status="missing", reason="not written yet", code="")


def hash_of(*values: Any) -> str:
    """Hex digest (128 bit) of values that JSON can hold, the same on every machine."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


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
        box = self.store.grid.halo_box(self.key)
        parts = []
        for key in self.store.grid.keys_over(box):
            tile = Tile(self.store, key)
            if key != self.key and tile.mark(POINTS).status == "missing":
                continue
            points = tile._core_mm()
            x, y = points[:, 0], points[:, 1]
            inside = (x >= box.x_lo) & (x < box.x_hi) & (y >= box.y_lo) & (y < box.y_hi)
            parts.append(points if key == self.key else points[inside])
        return np.concatenate(parts)

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
        name = cells_table(cell_mm)
        if self.mark(name).same_work(cells_mark(self.mark(POINTS), cell_mm)):
            return Cells(**self.read_table(name), cell_size=cell_size)
        return cells_of_mm(self.points_mm(), cell_mm)

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
        found = {}
        for name in columns:
            path = f"{self.key}/{table}/{name}"
            try:
                column = np.asarray(zarr.open_array(self.store._zarr, path=path, mode="r")[...])
            except (FileNotFoundError, KeyError, ValueError, RuntimeError) as error:
                raise StoreError(
                    f"{self.store.url}/{path} cannot be read ({error}): "
                    f"delete the folder {self.key}/{table} and run the same command again"
                ) from error
            chunk = "/".join(["c", *("0" for _ in column.shape)])  # of a lost one, zeros are read
            if column.size and not self.store.fs.exists(f"{self.store.root}/{path}/{chunk}"):
                raise StoreError(
                    f"{self.store.url}/{path} has lost a chunk: "
                    f"delete the folder {self.key}/{table} and run the same command again"
                )
            found[name] = column
        return found

    def write_table(self, table: str, columns: Mapping[str, NDArray[Any]], mark: Mark) -> None:
        """Replace a table: the old mark goes first, the new one comes last.

        Args:
            table: its name.
            columns: an array per column, each written as one chunk.
            mark: of status `done`; the names of the columns are added to its facts.
        """
        self._erase(table)
        for name, column in columns.items():
            array = zarr.create_array(
                self.store._zarr,
                name=f"{self.key}/{table}/{name}",
                shape=column.shape,
                chunks=tuple(max(1, n) for n in column.shape),
                dtype=column.dtype,
                compressors=_CODEC,
                config={"write_empty_chunks": True},
            )
            array[...] = column
        self._write_mark(table, mark, columns=list(columns))

    def write_reason(self, table: str, mark: Mark) -> None:
        """Replace a table by the reason why there is none (`failed` or `skipped`)."""
        self._erase(table)
        self._write_mark(table, mark, columns=[])

    def _write_mark(self, table: str, mark: Mark, columns: list[str]) -> None:
        known = asdict(mark)
        known["facts"] = {**mark.facts, "columns": columns}
        zarr.open_group(self.store._zarr, path=f"{self.key}/{table}", mode="a").attrs[_OURS] = known

    def _erase(self, table: str) -> None:
        folder = f"{self.store.root}/{self.key}/{table}"
        fs = self.store.fs
        if fs.exists(folder):
            if fs.exists(f"{folder}/zarr.json"):
                fs.rm(f"{folder}/zarr.json")
            fs.rm(folder, recursive=True)


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
    def _place(self) -> tuple[Any, str]:
        fs, root = fsspec.core.url_to_fs(self.url)
        fs.use_listings_cache = False
        return fs, str(root).rstrip("/")

    @property
    def fs(self) -> Any:
        """The fsspec filesystem that the store is on."""
        return self._place[0]

    @property
    def root(self) -> str:
        """The store's path on that filesystem."""
        return self._place[1]

    @property
    def address(self) -> str:
        """The store's URL; of a local store its absolute path, for readers started elsewhere."""
        return self.url if "://" in self.url else str(Path(self.url).absolute())

    @cached_property
    def _zarr(self) -> Any:
        return zarr.open_group(self.url, mode="r+").store

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
        zarr.open_group(url, mode="w", attributes={_OURS: store._attributes(sources=[])})
        return store

    def _attributes(self, sources: list[dict[str, Any]]) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "lattice_origin": [0.0, 0.0, 0.0],
            "settings": asdict(self.settings),
            "sources": sources,
        }

    def sources(self) -> list[dict[str, Any]]:
        """What the map was made from: path, format, size, points, fingerprint of each source.

        Empty until an ingest has ended.
        """
        found: list[dict[str, Any]] = _root_attributes(self.fs, self.root, self.url)["sources"]
        return found

    def write_sources(self, sources: list[dict[str, Any]]) -> None:
        """Record what the map was made from; the one writer is the process that ran the ingest."""
        zarr.open_group(self._zarr, mode="r+").attrs[_OURS] = self._attributes(sources)

    def remove(self, key: TileKey) -> None:
        """Remove a tile with all its tables; the mark of its points goes first."""
        Tile(self, key)._erase(POINTS)
        self.fs.rm(f"{self.root}/{key}", recursive=True)

    def remove_fragments(self) -> None:
        """Remove what an ingest left between its two halves."""
        if self.fs.exists(f"{self.root}/fragments"):
            self.fs.rm(f"{self.root}/fragments", recursive=True)

    def keys(self, table: str = POINTS) -> list[TileKey]:
        """The tiles of which a table is done, sorted."""
        return [key for key, mark in self.marks(table).items() if mark.status == "done"]

    def marks(self, table: str = POINTS) -> dict[TileKey, Mark]:
        """What became of a table in every tile of the store, sorted by tile."""
        keys = sorted(self._tile_folders())
        return dict(zip(keys, self._marks([(key, table) for key in keys]), strict=True))

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
        paths = [f"{self.root}/{key}/{table}/zarr.json" for key, table in wanted]
        if not paths:
            return []
        texts = self.fs.cat(paths, on_error="omit")
        by_end = {"/".join(str(path).split("/")[-3:]): text for path, text in texts.items()}
        return [_parse_mark(by_end.get(f"{key}/{table}/zarr.json")) for key, table in wanted]

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
        tiles = [Tile(self, key) for key in self.grid.keys_over(box)]
        parts = [tile.cells(cell_size) for tile in tiles if tile.mark(POINTS).status != "missing"]
        return Cells(
            np.concatenate([np.zeros((0, 3), np.int64), *(part.index for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.count for part in parts)]),
            np.concatenate([np.zeros((0, 3)), *(part.mean for part in parts)]),
            np.concatenate([np.zeros((0, 3, 3)), *(part.covariance for part in parts)]),
            cell_size,
        )

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


def cells_table(cell_mm: int) -> str:
    """Name of the table of cells of one size, e.g. `cells_2000` for 2 m."""
    return f"cells_{cell_mm}"


def cells_mark(points: Mark, cell_mm: int) -> Mark:
    """The mark of the cells of one size, made from a tile's points by this code."""
    return Mark("done", inputs=points.identity, settings=hash_of(cell_mm, CELLS_VERSION))


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
    fs, root = fsspec.core.url_to_fs(str(url))
    attributes = _root_attributes(fs, str(root).rstrip("/"), str(url))
    return TileStore(str(url), StoreSettings(**attributes["settings"]))


def _root_attributes(fs: Any, root: str, url: str) -> dict[str, Any]:
    try:
        text = fs.cat_file(f"{root}/zarr.json")
    except FileNotFoundError:
        raise StoreNotFoundError(
            f"no tile store at {url}: make one with `tilestream ingest SOURCES --store {url}`"
        ) from None
    except NotADirectoryError:
        raise UsageError(
            f"{url} is a file, or below one, and a tile store is a folder: name another path"
        ) from None
    try:
        attributes: dict[str, Any] = json.loads(text)["attributes"][_OURS]
        schema = int(attributes["schema"])
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{url} is a Zarr group but no tile store of tilestream") from error
    if schema > SCHEMA:
        raise StoreVersionError(
            f"{url} has schema {schema}, this is tilestream {VERSION} with schema {SCHEMA}: "
            "install the newer tilestream, or ingest the sources again"
        )
    return attributes


def _parse_mark(text: bytes | None) -> Mark:
    if text is None:
        return MISSING
    known = json.loads(text).get("attributes", {}).get(_OURS)
    return Mark(**known) if known else MISSING
