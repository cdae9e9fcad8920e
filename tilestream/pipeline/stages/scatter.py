"""Scatter: read a span of a source block by block, write its points tile by tile as a fragment.

Sums of whole numbers only: a tile is the same whatever the blocks, their order, and the number of
workers.
"""

import json
import math
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError
from tilestream.files import Files
from tilestream.formats import open_source
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.grid import MAX_XY_MM, MAX_Z_MM, MM_PER_M, TileGrid, TileKey
from tilestream.kernels import scatter as kernels
from tilestream.kernels.bounds import bounds
from tilestream.marks import hash_of, sealed, unsealed
from tilestream.pipeline.engine.outputs import Facts, Made
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import BASE_BYTES, Counts, Task, stage
from tilestream.records import Float64, Int64
from tilestream.store import Share, TileStore

Int32 = NDArray[np.int32]
Print = tuple[int, int]
"""The fingerprint of a set of points: two sums of 64-bit hashes."""

BYTES_PER_BLOCK_POINT = 160
"""Memory per point of a block: as read, float64, grouped int32."""
MAX_BLOCK_POINTS = 2**16
"""Points per block beyond which larger blocks leave the caches of a core."""
PIECE_POINTS = 2**20
"""Points that are held until they are written, tile by tile: short pieces would be slow to read."""
BYTES_PER_PIECE_POINT = 12
"""Memory per point of those."""
MIN_BLOCK_POINTS = 20_000
"""Points per block below which the work per block would be overhead."""
WINDOW = 2**17
"""Tiles that are counted at once: more of them are halved."""
BYTES_PER_WINDOW_TILE = 40
"""Memory per tile of a window: its count, first row and fingerprint."""
WIDE = 50_000_000
"""Tiles that the bounding box of a block spans if it has strays, or its points are nowhere."""
MAX_SPREAD = 1000
"""Windows in which the points of such a block may lie: of strays there are few."""


@dataclass(frozen=True)
class SourceSpan:
    """A span of a source, as a task reads it: block by block."""

    path: str
    """The source."""
    state: str
    """Hash of its state on the disk and of how it is read."""
    span: Span
    options: tuple[tuple[str, object], ...]
    """What `formats.open_source` opens it with, as keyword and value."""
    block_points: int
    """Points of a block at most: for memory, it changes nothing of the result."""
    makers: tuple[str, ...] = ()

    @property
    def identity(self) -> str:
        """Hash of the source and the span."""
        return hash_of(self.path, self.state, self.span.start, self.span.stop)

    def read(self) -> Iterator[Block]:
        """The blocks."""
        return open_source(self.path, **dict(self.options)).blocks(self.span, self.block_points)

    def counts(self) -> Counts:
        """What the plan knows too."""
        return {}


@dataclass(frozen=True, eq=False)
class Grouped:
    """Points of a block, tile by tile."""

    points: Int32
    """(n, 3) millimetres from the origin of the tile that owns each."""
    tiles: Sequence[tuple[TileKey, int, Print]]
    """Each tile in their order: key, count, fingerprint."""
    dropped: int
    """Points of the file that were not finite."""
    left_out: int
    """Points that the file marks as noise or withheld."""
    outside: Float64
    """(m, 3) points that do not fit the tile grid [m]."""


@dataclass(frozen=True)
class Fragment:
    """The index of a file of points by tile."""

    name: str
    """Its file is `fragments/<name>.bin` in the store."""
    points: int
    """Finite points that were read."""
    dropped: int
    """Points that were not finite."""
    pieces: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, start, count) of each run of points of one tile."""
    prints: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, two 64-bit sums): the fingerprint of the points of each tile."""
    left_out: int = 0
    """Points that the file marks as noise or withheld."""
    outside: int = 0
    """Points that do not fit the tile grid."""
    outside_at: tuple[float, ...] = ()
    """The first of those [m]."""

    @property
    def shares(self) -> dict[TileKey, Share]:
        """What each tile has of it."""
        counts: Counter[tuple[int, int]] = Counter()
        for ix, iy, _, count in self.pieces:
            counts[ix, iy] += count
        return {TileKey(ix, iy): (counts[ix, iy], a, b) for ix, iy, a, b in self.prints}

    def only(self, tiles: Container[tuple[int, int]]) -> Self:
        """The same without what is of other tiles."""
        return replace(
            self,
            pieces=tuple(piece for piece in self.pieces if piece[:2] in tiles),
            prints=tuple(row for row in self.prints if row[:2] in tiles),
        )

    @classmethod
    def of(cls, facts: Facts) -> "Fragment":
        """From the facts of a scatter task."""
        rows = {name: tuple(tuple(row) for row in facts[name]) for name in ("pieces", "prints")}
        return cls(**{**facts, **rows, "outside_at": tuple(facts["outside_at"])})


@dataclass(frozen=True)
class FragmentFile:
    """Where a fragment goes: its points, then its index."""

    store_url: str
    name: str

    def known(self, identity: str) -> Facts | None:
        """The index, if the fragment is whole and of this identity."""
        try:
            known = unsealed(json.loads(self._file("json").read()))
        except (FileNotFoundError, ValueError, AttributeError):  # absent or damaged: made anew
            return None
        return dict(known["index"]) if known["identity"] == identity else None

    def write(self, made: Made, identity: str, columns: Sequence[Any]) -> Facts:  # noqa: ARG002
        """Write the groups as they come; the index last."""
        self._file("json").remove()  # an old index must not vouch for new points
        with self._file("bin").writing() as file:
            index = asdict(_written(self.name, made.value, file))
        self._file("json").write(
            json.dumps(sealed({"identity": identity, "index": index})).encode()
        )
        return index

    def read(self) -> Any:
        """Fragments are read piece by piece."""
        raise NotImplementedError

    def _file(self, ending: str) -> Files:
        return fragments_of(self.store_url).under(f"{self.name}.{ending}")


def fragments_of(store_url: str) -> Files:
    """Where an ingest keeps its fragments while it lasts."""
    return Files.at(store_url).under("fragments")


def _written(name: str, groups: Iterable[Grouped], file: Any) -> Fragment:
    pieces: list[tuple[int, int, int, int]] = []
    prints: dict[TileKey, Print] = {}
    held: dict[TileKey, list[Int32]] = {}
    start = points = dropped = left_out = outside = 0
    outside_at: tuple[float, ...] = ()
    for group in groups:
        dropped += group.dropped
        left_out += group.left_out
        if len(group.outside) and not outside:
            outside_at = tuple(group.outside[0].tolist())
        outside += len(group.outside)
        first = 0
        for key, count, fingerprint in group.tiles:
            held.setdefault(key, []).append(group.points[first : first + count])
            prints[key] = add_prints(prints.get(key, (0, 0)), fingerprint)
            first += count
        points += first
        if points - start >= PIECE_POINTS:
            start = _write_pieces(held, start, pieces, file)
    _write_pieces(held, start, pieces, file)
    of_tiles = tuple((*key, *fingerprint) for key, fingerprint in prints.items())
    return Fragment(name, points, dropped, tuple(pieces), of_tiles, left_out, outside, outside_at)


def _write_pieces(
    held: dict[TileKey, list[Int32]], start: int, pieces: list[tuple[int, int, int, int]], file: Any
) -> int:
    """Write what is held, a piece for each tile, and hold nothing; the points that are written."""
    for key, parts in held.items():
        count = sum(map(len, parts))
        pieces.append((*key, start, count))
        start += count
        for part in parts:
            file.write(part.data)
    held.clear()
    return start


def _memory(counts: Counts) -> int:
    block = counts["block_points"] * BYTES_PER_BLOCK_POINT
    held = PIECE_POINTS * BYTES_PER_PIECE_POINT
    return counts["resident_bytes"] + block + held + WINDOW * BYTES_PER_WINDOW_TILE


@stage("scatter", version=2, memory=_memory, seconds=5.5e-8)
def scatter(blocks: Iterator[Block], grid: TileGrid, where: str) -> Iterator[Grouped]:
    """The points of a span of a source, block by block, each sorted by the tile that owns them.

    Args:
        blocks: the points [m, map frame].
        grid: the tiles.
        where: which source and span, for messages.

    Raises:
        SourceError: the source cannot be read whole, or its points are all over the place.
    """
    for block in blocks:
        inside, outside = fitting(np.ascontiguousarray(block.points))
        points, tiles = group(inside, grid, where)
        yield Grouped(points, tiles, block.dropped, block.left_out, outside)


def scatter_tasks(
    store: TileStore,
    sources: Iterable[tuple[SourceInfo, Sequence[Span], str, tuple[tuple[str, object], ...]]],
    memory: int,
) -> Plan:
    """The reading half of an ingest: one task per span of a source.

    Args:
        store: where the fragments go.
        sources: each source's info, its spans, the hash of its state on disk, and the options it
            is opened with.
        memory: what a task may use [bytes].

    Raises:
        PlanError: a source that only opens whole does not fit the memory.
    """
    tasks: list[Task] = []
    for number, (info, spans, state, options) in enumerate(sources):
        fixed = BASE_BYTES + _memory({"resident_bytes": info.resident_bytes, "block_points": 0})
        fitting = (memory - fixed) // BYTES_PER_BLOCK_POINT
        block = max(MIN_BLOCK_POINTS, min(MAX_BLOCK_POINTS, fitting))
        tasks += [
            Task(
                scatter,
                f"{number}-{span.start}",
                FragmentFile(store.url, f"{number}-{span.start}"),
                takes={
                    "grid": store.grid,
                    "where": f"{info.path}, points {span.start}-{span.stop}",
                },
                reads={"blocks": SourceSpan(info.path, state, span, options, block)},
                work=span.stop - span.start,
                counts={"resident_bytes": info.resident_bytes, "block_points": block},
            )
            for span in spans
        ]
    return Plan.of(tasks, memory)


def needed_to_open(info: SourceInfo) -> int:
    """Memory of a process that reads a source, in the smallest blocks [bytes]."""
    counts = {"resident_bytes": info.resident_bytes, "block_points": MIN_BLOCK_POINTS}
    return BASE_BYTES + _memory(counts)


def add_prints(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    """The fingerprint of two sets of points together."""
    return (a[0] + b[0]) % 2**64, (a[1] + b[1]) % 2**64


def fitting(points: Float64) -> tuple[Float64, Float64]:
    """The points [m] that fit the tile grid, and those that do not."""
    limits = np.array([MAX_XY_MM, MAX_XY_MM, MAX_Z_MM])
    if (np.abs(to_mm(bounds(points))) <= limits).all():
        return points, points[:0]
    fits = (np.abs(to_mm(points)) <= limits).all(axis=1)
    return points[fits], points[~fits]


def to_mm(metres: Float64) -> Float64:
    """Whole millimetres, half to even."""
    return np.rint(metres * MM_PER_M)


def group(
    points: Float64, grid: TileGrid, where: str
) -> tuple[Int32, list[tuple[TileKey, int, Print]]]:
    """Points sorted by the tile that owns them, relative to its origin.

    Args:
        points: (n, 3) points that fit the tile grid [m].
        grid: the tiles.
        where: which source and span, for messages.

    Returns:
        The (n, 3) int32 points [mm], and for each tile in their order its key, count and
        fingerprint.

    Raises:
        CorruptSourceError: the points are spread over more places than those of any real map.
    """
    lowest, highest = to_mm(bounds(points)[:, :2]).astype(np.int64) // grid.tile_mm
    columns, rows = (highest - lowest + 1).tolist()
    if columns * rows > WIDE:
        _refuse_spread(points, grid.tile_mm, columns * rows, where)
    if columns * rows > WINDOW:
        return _in_halves(points, grid, where, lowest, highest)
    counts, grouped = np.zeros(columns * rows, np.int64), np.empty(points.shape, np.int32)
    kernels.group_by_tile(points, grid.tile_mm, np.array([*lowest, rows]), counts, grouped)
    there = np.flatnonzero(counts)
    of = zip(
        there.tolist(),
        counts[there].tolist(),
        prints_of(grouped, np.cumsum(counts[there])),
        strict=True,
    )
    column, row = lowest.tolist()
    return grouped, [
        (TileKey(column + tile // rows, row + tile % rows), count, fingerprint)
        for tile, count, fingerprint in of
    ]


def prints_of(points: Int32, ends: Int64) -> list[Print]:
    """The fingerprints of sets of points, one after the other.

    Args:
        points: (n, 3) points [mm from the tile's origin].
        ends: (k,) the row behind each set.
    """
    return [(first, second) for first, second in kernels.prints_of(points, ends).tolist()]


def _refuse_spread(points: Float64, tile_mm: int, window: int, where: str) -> None:
    """Refuse points that halving would part forever."""
    wide = tile_mm * math.isqrt(WINDOW)
    if len(np.unique(to_mm(points[:, :2]) // wide, axis=0)) > MAX_SPREAD:
        raise CorruptSourceError(
            f"{where}: a block of {len(points):,} points spans {window:,} tiles of "
            f"{tile_mm / MM_PER_M:g} m, all over them: is the file in metres, and its header right?"
        )


def _in_halves(
    points: Float64, grid: TileGrid, where: str, lowest: Int64, highest: Int64
) -> tuple[Int32, list[tuple[TileKey, int, Print]]]:
    """As `group`, of few points far apart: the longer side is halved, which most points survive."""
    axis = int(np.argmax(highest - lowest))
    border = (lowest[axis] + highest[axis] + 1) // 2 * grid.tile_mm
    below = to_mm(points[:, axis]) < border
    halves = [group(points[side], grid, where) for side in (below, ~below)]
    return np.concatenate([points for points, _ in halves]), [
        t for _, tiles in halves for t in tiles
    ]
