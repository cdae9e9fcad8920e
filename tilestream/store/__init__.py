"""The tile store: a Zarr group per tile, an array per table of a tile, a mark on what is done.

```
map.zarr/                 attributes: schema, settings, CRS, lattice origin, sources, the manifest
  manifest_4f.../         which tiles there must be, with the identity of each
  12_-3/                  a tile, named by its key
    points                int32 millimetres from the tile's origin: all x, y, z, sorted by voxel
    cells_2000            a table made from them: its columns one after the other
```

A table is two objects, written by one task: its values, then, last, its mark (status, reason,
identity, facts). Without a mark a table is missing, whatever lies there, and a tile that the
manifest does not name is none; every reader looks at both. All that is read has a checksum.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.counts import count_of
from tilestream.errors import (
    DamagedError,
    IncompleteError,
    StoreError,
    TileNotReadyError,
)
from tilestream.files import Files, place_of
from tilestream.grid import MM_PER_M, Box, TileGrid, TileKey, whole_mm
from tilestream.lock import LOCK, writer_of
from tilestream.marks import Mark
from tilestream.notebook import draw_points, draw_squares, html_of, html_table
from tilestream.records import Cells, Float64, Int64
from tilestream.store.arrays import NODE as NODE
from tilestream.store.arrays import (
    erase,
    read_columns,
    read_group,
    read_marks,
    write_columns,
    write_group,
)
from tilestream.store.condition import Condition as Condition
from tilestream.store.manifest import PREFIX as MANIFEST
from tilestream.store.manifest import Manifest as Manifest
from tilestream.store.manifest import read_manifest
from tilestream.store.record import Record, State, read_record, source_of, way_of, write_record
from tilestream.store.record import StoreSettings as StoreSettings
from tilestream.store.record import require_folder as require_folder
from tilestream.store.shares import PREFIX as SHARES
from tilestream.store.shares import Share as Share
from tilestream.store.shares import Shares as Shares
from tilestream.store.shares import added as added
from tilestream.store.table import CELLS_VERSION as CELLS_VERSION
from tilestream.store.table import TileTable as TileTable
from tilestream.store.table import cells_table as cells_table

POINTS = "points"
"""Name of the table that ingest writes: the column `xyz`."""


class Tile:
    """One tile of a store: its points, and the tables made from them."""

    def __init__(self, store: "TileStore", key: TileKey) -> None:
        self.store = store
        self.key = key

    def __repr__(self) -> str:
        mark = self.mark(POINTS)
        size = count_of(mark.facts["points"], "point") if mark.status == "done" else mark.reason
        return f"Tile {self.key} ({mark.status}: {size}) of {self.store.url}"

    def _repr_html_(self) -> str:
        mark, box = self.mark(POINTS), self.store.grid.core(self.key)
        spans = ((box.x_lo, box.x_hi), (box.y_lo, box.y_hi))
        facts = {
            f"{axis} [m]": f"{low / MM_PER_M:g} to {high / MM_PER_M:g}"
            for axis, (low, high) in zip("xy", spans, strict=True)
        }
        told = {"status": mark.status, "points": f"{mark.facts.get('points', 0):,}", **facts}
        return html_of(f"Tile {self.key} of {self.store.url}", told)

    def plot(self, ax: Any | None = None) -> Any:
        """Its points from above, coloured by height; the axes.

        Args:
            ax: matplotlib's axes to draw on; None: those of a new figure.

        Raises:
            TileNotReadyError: the tile is not done.
        """
        return draw_points(self.points(), ax)

    def points(self, halo: bool = False) -> Float64:
        """The map points of the tile's core, (n, 3) float64 [m, map frame].

        Args:
            halo: also those of the neighbours within the store's halo, corners included;
                a neighbour that the map does not have has none.

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
        points = np.empty(xyz.shape[::-1], np.int64)
        for axis, at in enumerate(self.store.grid.origin_mm(self.key)):
            np.add(xyz[axis], np.int64(at), out=points[:, axis])
        return points

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
        near = [
            t.key for t in self.store.tiles_over(grid.core(self.key).grown(table.points_reach_mm))
        ]
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
            DamagedError: its mark is not what was written.
        """
        mark = self.mark(table)
        if mark.status == "damaged":
            raise DamagedError(mark.reason)
        if mark.status != "done":
            raise TileNotReadyError(
                f"{self.store.url}: {table} of tile {self.key} is {mark.status}: {mark.reason}"
            )
        return mark

    def read_table(self, table: str) -> dict[str, NDArray[Any]]:
        """All columns of a table, by name.

        Raises:
            TileNotReadyError: the table is not done.
            DamagedError: it was lost or damaged since.
        """
        self.require(table)
        return read_columns(self.store.files, f"{self.key}/{table}")

    def write_table(self, table: str, columns: Mapping[str, NDArray[Any]], mark: Mark) -> None:
        """Replace a table: the old mark goes first, the new one comes last.

        Args:
            table: its name.
            columns: an array per column.
            mark: of status `done`; the names of the columns are added to its facts.
        """
        files = self.store.files
        if table == POINTS and not files.under(f"{self.key}/{NODE}").there():
            files.under(str(self.key)).remove_parts()
            write_group(files.under(str(self.key)), {"tile": str(self.key)})
        erase(files, f"{self.key}/{table}")
        write_columns(files, f"{self.key}/{table}", columns, mark)

    def check_group(self) -> None:
        """Read what a Zarr reader needs to find the tile's tables; we do not.

        Raises:
            DamagedError: it is not what was written.
            OSError: it cannot be read.
        """
        read_group(self.store.files.under(str(self.key)))

    def erase(self, table: str) -> None:
        """Remove a table, if it is there: its mark first."""
        erase(self.store.files, f"{self.key}/{table}")

    def write_reason(self, table: str, mark: Mark) -> None:
        """Replace a table by the reason why there is none (`failed` or `skipped`)."""
        self.write_table(table, {}, mark)


class TileStore:
    """A map in tiles, at a local path or any fsspec URL (`s3://…`, `memory://…`).

    Open one with `tilestream.open_store`. Credentials and endpoints of a remote store come from
    the environment, as its fsspec filesystem documents (for S3: AWS_ACCESS_KEY_ID,
    AWS_ENDPOINT_URL, …), so that workers on other machines find them too.
    """

    def __init__(self, url: str | os.PathLike[str], settings: StoreSettings) -> None:
        self.url = place_of(url)
        """Where it lies: an absolute path, or a URL."""
        self.settings = settings
        self.grid = TileGrid.of(settings.tile_size, settings.halo)

    @cached_property
    def files(self) -> Files:
        """Where it lies."""
        return Files.at(self.url)

    def __getstate__(self) -> dict[str, Any]:
        return {"url": self.url, "settings": self.settings, "grid": self.grid}

    @classmethod
    def create(cls, url: str | os.PathLike[str], settings: StoreSettings) -> Self:
        """A new, empty store, whose tiles are not known yet.

        Raises:
            StoreError: something that is no tile store lies at `url`.
            UsageError: `tile_size` is no multiple of `map_leaf`.
        """
        store = cls(url, settings)
        if settings.map_leaf:
            store.grid.require_cell_size(whole_mm(settings.map_leaf, "map_leaf"))
        if set(store.files.names()) - {LOCK}:
            raise StoreError(f"{url} is there and is no tile store: choose another path")
        store._write(Record(settings))
        return store

    def _write(self, record: Record) -> None:
        write_record(self.files, record)
        self.files.remove_parts()
        for name in self.files.names():
            if name.startswith((MANIFEST, SHARES)) and name not in (record.manifest, record.shares):
                erase(self.files, name)
        self.__dict__.pop("manifest", None)  # the one that was read before

    def sources(self) -> list[dict[str, Any]]:
        """What the map was made from: path, format, size, points, fingerprint of each source.

        Empty until an ingest has ended.
        """
        here = os.path.realpath(self.files.root) if self.files.local else None
        return [source_of(here, source) for source in read_record(self.url).sources]

    def made_by(self) -> dict[str, int]:
        """The stages that made the map, with their versions; empty until an ingest has ended."""
        return dict(read_record(self.url).made_by or {})

    def shares(self) -> Shares | None:
        """What each of `sources` gave to each tile; None: that is not known, as of a map that an
        older version made.

        Raises:
            DamagedError: it was lost, or is not what was written.
        """
        name = read_record(self.url).shares
        return None if name is None else Shares.read(self.files, name)

    @cached_property
    def manifest(self) -> Manifest | None:
        """Which tiles the map must have; None: that is not known yet."""
        name = read_record(self.url).manifest
        return None if name is None else read_manifest(self.files, name)

    def begin(self, manifest: Manifest) -> None:
        """Write down which tiles the map will have; until `end` it is being written.

        Tiles that it has and will not have are removed, with all their tables. The one writer of
        this and of `end` is the process that runs the ingest.
        """
        had = self.manifest
        for key in [] if had is None else had.identities:
            if key not in manifest:
                self.remove(key)
        name = manifest.write(self.files)
        self._write(replace(read_record(self.url), state="being written", manifest=name))

    def end(
        self,
        sources: Sequence[Mapping[str, Any]],
        made_by: Mapping[str, int],
        shares: Shares | None = None,
    ) -> None:
        """Record what the map was made from, by which versions of the stages, and what each of the
        sources gave to each tile; None: what it says of that stays.

        A map whose tiles were never known is not whole by that.
        """
        known = [{**source, "way": way_of(self.files, source["path"])} for source in sources]
        record = replace(read_record(self.url), sources=known, made_by=made_by)
        if shares is not None:
            record = replace(record, shares=shares.write(self.files))
        self._write(record if record.manifest is None else replace(record, state="whole"))

    def forget(self) -> None:
        """Say that it is not known which tiles the map must have: its ingest finds out again."""
        self._write(replace(read_record(self.url), state="being written", manifest=None))

    def forget_shares(self) -> None:
        """Say that it is not known what each source gave to each tile: the next update reads all
        of them.
        """
        self._write(replace(read_record(self.url), shares=None))

    def written(self, keys: Iterable[TileKey]) -> dict[TileKey, Mark]:
        """The marks of the points of those of some tiles that are done, of whichever map, also of
        one that an interrupted update has left.
        """
        wanted = list(keys)
        marks = read_marks(self.files, [f"{key}/{POINTS}" for key in wanted])
        return {k: mark for k, mark in zip(wanted, marks, strict=True) if mark.status == "done"}

    def remove(self, key: TileKey) -> None:
        """Remove a tile with all its tables; the mark of its points goes first."""
        erase(self.files, f"{key}/{POINTS}")
        self.files.under(str(key)).remove()

    def keys(self, table: str = POINTS) -> list[TileKey]:
        """The tiles of which a table is done, sorted."""
        return [key for key, mark in self.marks(table).items() if mark.status == "done"]

    def marks(
        self, table: str = POINTS, keys: Iterable[TileKey] | None = None
    ) -> dict[TileKey, Mark]:
        """What became of a table in some tiles, in their order; None: in every tile that the map
        must have, sorted.
        """
        every = () if self.manifest is None else self.manifest.identities
        wanted = list(every if keys is None else keys)
        return dict(zip(wanted, self._marks([(key, table) for key in wanted]), strict=True))

    def identities(self) -> dict[TileKey, str]:
        """The identity of the points of each tile that is done: what tables are made from."""
        marks = self.marks()
        return {key: mark.identity for key, mark in marks.items() if mark.status == "done"}

    def _marks(self, wanted: list[tuple[TileKey, str]]) -> list[Mark]:
        found = read_marks(self.files, [f"{key}/{table}" for key, table in wanted])
        return [
            self._as_promised(key, mark) if table == POINTS else mark
            for (key, table), mark in zip(wanted, found, strict=True)
        ]

    def _as_promised(self, key: TileKey, mark: Mark) -> Mark:
        """The mark of a tile's points, as far as the manifest knows of it."""
        if self.manifest is None:
            return Mark("missing", "the map is being made, its tiles are not known yet")
        if key not in self.manifest:
            return Mark("missing", "the map has no such tile")
        older = mark.status == "done" and mark.identity != self.manifest.identities[key]
        if mark.status != "missing" and not older:
            return mark
        reason = "there is one of an older map" if older else "not written yet, or lost"
        return Mark("missing", reason, facts={"read": self.manifest.points[key]})

    def condition(self) -> Condition:
        """Whether the map is whole, being written, or damaged."""
        return Condition(self.url, self.state(), self.marks(), writer_of(self.url))

    def state(self) -> State:
        """Whether the ingest that makes the map has ended."""
        return read_record(self.url).state

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
            TileNotReadyError: a tile in the box is missing, failed or was skipped; says why.
            IncompleteError: it is not known yet which tiles there are.
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
        """(n, 3) the map points in a box [mm, map frame]; there are none where the map has no tile.

        Raises:
            TileNotReadyError: a tile in the box is missing, failed or was skipped; says why.
            IncompleteError: it is not known yet which tiles there are.
        """
        parts = [np.zeros((0, 3), np.int64)]
        for tile in self.tiles_over(box):
            points = tile.points_mm()
            parts.append(points[box.holds(points)])
        return np.concatenate(parts)

    def tiles_over(self, box: Box) -> list[Tile]:
        """The tiles that a box touches and that the map must have, done or not.

        Raises:
            IncompleteError: it is not known yet which those are.
        """
        if self.manifest is None:
            raise IncompleteError(f"{self.url} is being made: its tiles are not known yet")
        return [Tile(self, key) for key in self.grid.keys_over(box) if key in self.manifest]

    def __repr__(self) -> str:
        counts = [m.facts["points"] for m in self.marks().values() if m.status == "done"]
        return (
            f"TileStore {self.url}: {count_of(len(counts), 'tile')} of "
            f"{self.settings.tile_size:g} m, {count_of(sum(counts), 'point')}, "
            f"CRS {self.settings.crs or 'local'}"
        )

    def _repr_html_(self) -> str:
        rows = [
            (str(key), mark.status, f"{mark.facts.get('points', 0):,}", mark.reason)
            for key, mark in self.marks().items()
        ]
        return html_table(repr(self), ("tile", "status", "points", "reason"), rows)

    def plot(self, ax: Any | None = None) -> Any:
        """Its tiles from above, coloured by their points, grey where a tile is not done; the axes.

        Args:
            ax: matplotlib's axes to draw on; None: those of a new figure.
        """
        marks, edge = self.marks(), self.settings.tile_size
        done = [m.facts["points"] if m.status == "done" else np.nan for m in marks.values()]
        corners = np.array(list(marks), np.float64).reshape(-1, 2) * edge
        return draw_squares(corners, edge, np.array(done, np.float64), "map points of a tile", ax)


def open_store(url: str | os.PathLike[str]) -> TileStore:
    """Open a tile store that `ingest` made, or is making (`TileStore.condition`).

    Args:
        url: a local path, or any fsspec URL.

    Raises:
        StoreNotFoundError: nothing there.
        StoreVersionError: written by another version of tilestream.
        DamagedError: the store's own record is not what was written.
        StoreError: something else lies there.
        UsageError: a file lies there, or where a folder above it would be.

    Examples:
        >>> store = ts.open_store("map.zarr")
        >>> store.keys()
        [TileKey(ix=0, iy=-1), TileKey(ix=0, iy=0)]
        >>> tile = store.tile_at(5.0, 1.0)
        >>> tile.points().shape[1], tile.cells().cell_size
        (3, 2.0)
    """
    place = place_of(url)
    return TileStore(place, read_record(place).settings)
