"""What will run: frozen tasks with their needs and their promised memory, before anything runs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from tilestream.errors import PlanError
from tilestream.formats.base import SourceInfo, Span
from tilestream.ingest import (
    BYTES_PER_BLOCK_POINT,
    BYTES_PER_TILE_POINT,
    Fragment,
    Piece,
    add_prints,
    points_mark,
)
from tilestream.store import Mark, hash_of
from tilestream.tiling import TileKey

BASE_BYTES = 300_000_000
"""Memory of a worker process before its first task: Python, NumPy, Numba, Zarr, Dask (measured
by benchmarks/ingest.py)."""
DEFAULT_MEMORY = 1_000_000_000
"""What a task may use where the user promises nothing else [bytes]."""
MAX_BLOCK_POINTS = 1_000_000
"""Points per block beyond which larger blocks gain nothing."""
MIN_BLOCK_POINTS = 20_000
"""Points per block below which the work per block would be overhead."""
BLOCKS_PER_TASK = 8
"""Blocks that one scatter task reads, so that a task is worth its overhead."""
MAX_STRIPS = 64
"""Strips that a tile is at most cut into to merge it within the promised memory."""


class Task(Protocol):
    """A frozen piece of work: where it reads and writes, and what it may use."""

    @property
    def stage(self) -> str:
        """Name of the stage: the prefix of the key."""

    @property
    def key(self) -> str:
        """Unique name, `stage-…`, as the dashboard shows it."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the tasks that must be done before."""

    @property
    def promised_bytes(self) -> int:
        """Peak memory of a process that runs it [bytes], the interpreter included."""


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

    @property
    def key(self) -> str:
        """`merge-<tile>`."""
        return f"merge-{self.tile}"


@dataclass(frozen=True)
class Plan:
    """Tasks in an order in which they could run one by one."""

    tasks: tuple[Task, ...]
    memory: int
    """What a task may use [bytes]."""

    @property
    def promised_bytes(self) -> int:
        """The largest promise of any task [bytes]."""
        return max((task.promised_bytes for task in self.tasks), default=0)

    def check(self) -> "Plan":
        """Itself, if every task fits the memory it may use.

        Raises:
            PlanError: one does not; names it, and says what to change.
        """
        for task in self.tasks:
            if task.promised_bytes > self.memory:
                raise PlanError(
                    f"{task.key} needs {megabytes(task.promised_bytes)} and may use "
                    f"{megabytes(self.memory)}: allow more with --memory, "
                    "or make the pieces smaller (--tile-size, or a coarser --map-leaf)"
                )
        return self

    def describe(self) -> Iterator[tuple[str, int, int]]:
        """(stage, tasks, largest promise [bytes]) of each stage, in their order."""
        for stage in dict.fromkeys(task.stage for task in self.tasks):
            promises = [task.promised_bytes for task in self.tasks if task.stage == stage]
            yield stage, len(promises), max(promises)


def megabytes(count: int) -> str:
    """`count` bytes as a person reads them."""
    return f"{count / 1e6:,.0f} MB"


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
        free = max(1, memory - BASE_BYTES - batch * 40 - count * 12)
        strips = min(MAX_STRIPS, -(-count * BYTES_PER_TILE_POINT // free))
        strips = strips if strips == 1 else min(MAX_STRIPS, 2 * strips)
        promise = BASE_BYTES + batch * 40 + count * 12 + count * BYTES_PER_TILE_POINT // strips
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
