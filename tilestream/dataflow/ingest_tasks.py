"""The two stages of an ingest: scatter (read a span of a source), merge (write a tile)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from tilestream.dataflow.plan import BASE_BYTES, Plan
from tilestream.dataflow.tasks import perform
from tilestream.formats.base import SourceInfo, Span
from tilestream.ingest import (
    BYTES_PER_BLOCK_POINT,
    BYTES_PER_STORED_POINT,
    BYTES_PER_TILE_POINT,
    Fragment,
    Piece,
    add_prints,
    merge,
    points_mark,
    scatter,
)
from tilestream.store import Mark, hash_of, open_store
from tilestream.tiling import TileKey

MAX_BLOCK_POINTS = 1_000_000
"""Points per block beyond which larger blocks gain nothing."""
MIN_BLOCK_POINTS = 20_000
"""Points per block below which the work per block would be overhead."""
MAX_STRIPS = 64
"""Strips that a tile is at most cut into to merge it within the promised memory."""


@dataclass(frozen=True)
class ScatterTask:
    """Read one span of one source, write its points as a fragment sorted by tile."""

    store_url: str
    name: str
    """Name of the fragment, and the end of the key."""
    source: str
    span: Span
    block_points: int
    identity: str
    """Hash of what the fragment is made from."""
    promised_bytes: int
    options: tuple[tuple[str, object], ...] = ()
    """What the source is opened with, as keyword and value."""
    needs: tuple[str, ...] = ()
    stage: str = "scatter"

    @property
    def work(self) -> int:
        """Points of the span (scans, of a log)."""
        return self.span.stop - self.span.start

    @property
    def key(self) -> str:
        """`scatter-<name>`."""
        return f"scatter-{self.name}"


@dataclass(frozen=True)
class MergeTask:
    """Gather one tile from all fragments, thin it, write it, mark it."""

    store_url: str
    tile: TileKey
    pieces: tuple[Piece, ...]
    mark: Mark
    strips: int
    batch: int
    promised_bytes: int
    needs: tuple[str, ...] = ()
    stage: str = "merge"
    work: int = 1

    @property
    def key(self) -> str:
        """`merge-<tile>`."""
        return f"merge-{self.tile}"


@perform.register
def _scatter(task: ScatterTask) -> Fragment:
    return scatter(
        open_store(task.store_url),
        task.name,
        task.source,
        task.span,
        task.block_points,
        task.identity,
        dict(task.options),
    )


@perform.register
def _merge(task: MergeTask) -> Mark:
    store = open_store(task.store_url)
    return merge(store, task.tile, task.pieces, task.mark, task.strips, task.batch)


def plan_scatter(
    store_url: str,
    sources: Iterable[tuple[SourceInfo, Sequence[Span], str, tuple[tuple[str, object], ...]]],
    tile_size: float,
    memory: int,
) -> Plan:
    """The reading half of an ingest: one task per span of a source.

    Args:
        store_url: the store.
        sources: each source's info, its spans, the hash of its state on disk, and the options it
            is opened with.
        tile_size: edge of a tile [m].
        memory: what a task may use [bytes].

    Raises:
        PlanError: a source that only opens whole does not fit the memory.
    """
    tasks: list[ScatterTask] = []
    for number, (info, spans, state, options) in enumerate(sources):
        free = memory - BASE_BYTES - info.resident_bytes
        block = max(MIN_BLOCK_POINTS, min(MAX_BLOCK_POINTS, free // BYTES_PER_BLOCK_POINT))
        promise = BASE_BYTES + info.resident_bytes + block * BYTES_PER_BLOCK_POINT
        tasks += [
            ScatterTask(
                store_url=store_url,
                name=f"{number}-{span.start}",
                source=info.path,
                span=span,
                block_points=block,
                identity=hash_of(info.path, state, span.start, span.stop, tile_size),
                promised_bytes=promise,
                options=options,
            )
            for span in spans
        ]
    return Plan(tuple(tasks), memory).check()


def plan_merge(
    store_url: str,
    fragments: Iterable[Fragment],
    tile_size: float,
    map_leaf: float,
    memory: int,
) -> Plan:
    """The writing half of an ingest: one task per tile that holds a point.

    Args:
        store_url: the store.
        fragments: the indices of all fragments of sources that were read whole.
        tile_size: edge of a tile [m].
        map_leaf: edge of the voxels that the map is thinned to [m].
        memory: what a task may use [bytes].

    Raises:
        PlanError: a tile does not fit the memory, not even strip by strip.
    """
    pieces: dict[TileKey, list[Piece]] = {}
    prints: dict[TileKey, tuple[int, int]] = {}
    for fragment in fragments:
        for ix, iy, start, count in fragment.pieces:
            pieces.setdefault(TileKey(ix, iy), []).append(Piece(fragment.name, start, count))
        for ix, iy, a, b in fragment.prints:
            key = TileKey(ix, iy)
            prints[key] = add_prints(prints.get(key, (0, 0)), (a, b))
    tasks = []
    for key in sorted(pieces):
        count = sum(piece.count for piece in pieces[key])
        batch = MAX_BLOCK_POINTS // 2
        fixed = BASE_BYTES + batch * 40 + count * BYTES_PER_STORED_POINT
        free = max(1, memory - fixed)
        strips = min(MAX_STRIPS, -(-count * BYTES_PER_TILE_POINT // free))
        strips = strips if strips == 1 else min(MAX_STRIPS, 2 * strips)
        promise = fixed + count * BYTES_PER_TILE_POINT // strips
        tasks.append(
            MergeTask(
                store_url=store_url,
                tile=key,
                pieces=tuple(pieces[key]),
                mark=points_mark(tile_size, map_leaf, count, prints[key]),
                strips=strips,
                batch=batch,
                promised_bytes=promise,
            )
        )
    return Plan(tuple(tasks), memory).check()
