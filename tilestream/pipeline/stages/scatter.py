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
"""Memory per point of a block: as read, float64, int64, grouped int32."""
MAX_BLOCK_POINTS = 1_000_000
"""Points per block beyond which larger blocks gain nothing."""
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
    start = dropped = left_out = outside = 0
    outside_at: tuple[float, ...] = ()
    for group in groups:
        dropped += group.dropped
        left_out += group.left_out
        if len(group.outside) and not outside:
            outside_at = tuple(group.outside[0].tolist())
        outside += len(group.outside)
        file.write(group.points.tobytes())
        for key, count, fingerprint in group.tiles:
            pieces.append((*key, start, count))
            prints[key] = add_prints(prints.get(key, (0, 0)), fingerprint)
            start += count
    of_tiles = tuple((*key, *fingerprint) for key, fingerprint in prints.items())
    return Fragment(name, start, dropped, tuple(pieces), of_tiles, left_out, outside, outside_at)


def _memory(counts: Counts) -> int:
    block = counts["block_points"] * BYTES_PER_BLOCK_POINT
    return counts["resident_bytes"] + block + WINDOW * BYTES_PER_WINDOW_TILE


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
        points_mm, outside = to_mm(block.points)
        points, tiles = group(points_mm, grid, where)
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


def to_mm(points: Float64) -> tuple[Int64, Float64]:
    """Finite points [m] as whole millimetres, half to even; and those that do not fit the tile grid
    [m], which are not among them.
    """
    limits = np.array([MAX_XY_MM, MAX_XY_MM, MAX_Z_MM], dtype=np.float64)
    out = np.empty(points.shape, np.int64)
    if kernels.round_to_mm(points, limits, out) < 0:
        return out, points[:0]
    fits = (np.abs(np.rint(points * MM_PER_M)) <= limits).all(axis=1)
    return to_mm(points[fits])[0], points[~fits]


def group(
    points_mm: Int64, grid: TileGrid, where: str
) -> tuple[Int32, list[tuple[TileKey, int, Print]]]:
    """Points sorted by the tile that owns them, relative to its origin.

    Args:
        points_mm: (n, 3).
        grid: the tiles.
        where: which source and span, for messages.

    Returns:
        The (n, 3) int32 points, and for each tile in their order its key, count and fingerprint.

    Raises:
        CorruptSourceError: the points are spread over more places than those of any real map.
    """
    if not len(points_mm):
        return np.zeros((0, 3), np.int32), []
    tile_mm = grid.tile_mm
    ix_lo, iy_lo, ix_hi, iy_hi = kernels.tile_bounds(points_mm, tile_mm)
    rows, window = iy_hi - iy_lo + 1, (ix_hi - ix_lo + 1) * (iy_hi - iy_lo + 1)
    if window > WIDE:
        _refuse_spread(points_mm, tile_mm, window, where)
    if window > WINDOW:
        return _in_halves(points_mm, grid, where, (ix_lo, iy_lo), (ix_hi, iy_hi))
    tile_of = np.empty(len(points_mm), np.int32)
    counts = np.zeros(window, np.int64)
    kernels.tile_of_points(points_mm, tile_mm, ix_lo, iy_lo, rows, tile_of, counts)
    grouped = np.empty(points_mm.shape, np.int32)
    prints = np.zeros((window, 2), np.uint64)
    next_row = np.cumsum(counts) - counts
    kernels.group_by_tile(
        points_mm, tile_of, tile_mm, ix_lo, iy_lo, rows, next_row, grouped, prints
    )
    tiles = [
        (TileKey(ix_lo + t // rows, iy_lo + t % rows), int(counts[t]), tuple(map(int, prints[t])))
        for t in np.flatnonzero(counts).tolist()
    ]
    return grouped, [(key, count, (a, b)) for key, count, (a, b) in tiles]


def _refuse_spread(points_mm: Int64, tile_mm: int, window: int, where: str) -> None:
    """Refuse points that halving would part forever."""
    wide = tile_mm * math.isqrt(WINDOW)
    if len(np.unique(points_mm[:, :2] // wide, axis=0)) > MAX_SPREAD:
        raise CorruptSourceError(
            f"{where}: a block of {len(points_mm):,} points spans {window:,} tiles of "
            f"{tile_mm / MM_PER_M:g} m, all over them: is the file in metres, and its header right?"
        )


def _in_halves(
    points_mm: Int64, grid: TileGrid, where: str, low: tuple[int, int], high: tuple[int, int]
) -> tuple[Int32, list[tuple[TileKey, int, Print]]]:
    """As `group`, of few points far apart: the longer side is halved, which most points survive."""
    axis = 0 if high[0] - low[0] >= high[1] - low[1] else 1
    border = (low[axis] + high[axis] + 1) // 2 * grid.tile_mm
    below = points_mm[:, axis] < border
    halves = [group(points_mm[side], grid, where) for side in (below, ~below) if side.any()]
    return np.concatenate([points for points, _ in halves]), [
        t for _, tiles in halves for t in tiles
    ]
