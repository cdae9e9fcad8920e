"""Scatter: read a span of a source block by block, write its points tile by tile as a fragment.

Sums of whole numbers only: a tile is the same whatever the blocks, their order, and the number of
workers.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats import open_source
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.grid import MAX_XY_MM, MAX_Z_MM, MM_PER_M, TileGrid, TileKey
from tilestream.kernels import scatter as kernels
from tilestream.kernels.bounds import bounds
from tilestream.marks import hash_of
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import BASE_BYTES, Counts, Task, stage
from tilestream.pipeline.stages.fragments import (
    BYTES_PER_PIECE_POINT,
    PIECE_POINTS,
    FragmentFile,
    Grouped,
    Int32,
    Print,
)
from tilestream.records import Float64, Int64
from tilestream.store import TileStore

BYTES_PER_BLOCK_POINT = 160
"""Memory per point of a block: as read, float64, grouped int32."""
MAX_BLOCK_POINTS = 2**16
"""Points per block beyond which larger blocks leave the caches of a core."""
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
