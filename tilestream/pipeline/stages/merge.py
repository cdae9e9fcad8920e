"""Merge: gather the points of a tile from all fragments, thin them, write the tile."""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from tilestream.errors import DamagedError
from tilestream.grid import MM_PER_M, TileGrid, TileKey, whole_mm
from tilestream.kernels.thinning import sort, thin
from tilestream.marks import hash_of
from tilestream.pipeline.engine.outputs import Made, TileArrays
from tilestream.pipeline.engine.stage import BASE_BYTES, Counts, Task, stage
from tilestream.pipeline.stages.fragments import Fragment, Int32, Print, add_prints, fragments_of
from tilestream.pipeline.stages.scatter import prints_of
from tilestream.store import POINTS, Share, TileStore

BATCH_POINTS = 500_000
"""Points that are read at a time."""
BYTES_PER_BATCH_POINT = 40
"""Memory per point of a batch: read, and those of a strip picked."""
BYTES_PER_STRIP_POINT = 40
"""Memory per point of a strip: read, as sorted numbers, ordered."""
BYTES_PER_STORED_POINT = 32
"""Memory per point of the tile: the strips that are done, the tile, packed."""
MAX_STRIPS = 64
"""Strips that a tile is at most cut into to merge it within the promised memory."""
SORT_EDGE_MM = 1000
"""Unthinned points are stored sorted by voxels of this edge, then by x, y, z."""


@dataclass(frozen=True)
class Piece:
    """Points of one tile that lie together in one fragment file."""

    fragment: str
    """Name of the fragment."""
    start: int
    """First point in the file."""
    count: int
    """Number of points."""


@dataclass(frozen=True)
class Pieces:
    """The points of one tile in all fragments: the same set of points, the same identity."""

    store_url: str
    pieces: tuple[Piece, ...]
    """Where they lie: all of them, of a tile that is to be merged."""
    count: int
    """Number of points."""
    fingerprint: Print
    strips: int
    """Into how many strips along x the tile is cut, one in memory at a time; changes no result."""
    makers: tuple[str, ...] = ()

    @property
    def identity(self) -> str:
        """Hash of the set of points."""
        return hash_of(self.count, *self.fingerprint)

    def read(self) -> "Pieces":
        """Itself: `batches` reads, strip by strip."""
        return self

    def counts(self) -> Counts:
        """What the plan knows too."""
        return {}

    def batches(self) -> Iterator[Int32]:
        """The points, (n, 3) int32 [mm from the tile's origin], n <= `BATCH_POINTS`.

        Raises:
            DamagedError: a fragment is not what was written (removed, cut or changed meanwhile).
        """
        folder, point = fragments_of(self.store_url), 3 * np.dtype(np.int32).itemsize
        found: Print = (0, 0)
        for piece in self.pieces:
            file = folder.under(f"{piece.fragment}.bin")
            end = piece.start + piece.count
            for start in range(piece.start, end, BATCH_POINTS):
                stop = min(start + BATCH_POINTS, end)
                data = file.fs.cat_file(file.root, start=start * point, end=stop * point)
                if len(data) != (stop - start) * point:
                    raise DamagedError(f"{file.root} was cut short: run the same command again")
                points = np.frombuffer(data, np.int32).reshape(-1, 3)
                found = add_prints(found, *prints_of(points, np.array([len(points)])))
                yield points
        self._require_all(found)

    def _require_all(self, found: Print) -> None:
        """Refuse points that are not those that were scattered."""
        if found != self.fingerprint:
            files = ", ".join(f"{name}.bin" for name in sorted({p.fragment for p in self.pieces}))
            folder = fragments_of(self.store_url).root
            raise DamagedError(f"{folder}: one of {files} is damaged: run the same command again")


def memory_of(points: int, strips: int) -> int:
    """Memory of merging a tile of so many points in so many strips [bytes]."""
    batch = min(points, BATCH_POINTS) * BYTES_PER_BATCH_POINT
    return batch + points * BYTES_PER_STORED_POINT + points * BYTES_PER_STRIP_POINT // strips


def strips_fitting(points: int, memory: int) -> int:
    """The fewest strips that fit so much memory; strips differ, so twice as many as on average."""
    of_strips = points * BYTES_PER_STRIP_POINT
    free = max(1, memory - memory_of(points, 1) + of_strips)
    needed = -(-of_strips // free)
    return 1 if needed <= 1 else min(MAX_STRIPS, 2 * needed)


@stage(
    "merge",
    version=3,
    memory=lambda counts: memory_of(counts["points"], counts["strips"]),
    seconds=0.1,
)
def merge(pieces: Pieces, grid: TileGrid, tile: TileKey, map_leaf: float) -> Made:
    """The points of one tile, thinned: one column `xyz`, (3, n) int32 [mm from its origin].

    Args:
        pieces: its points, in any order.
        grid: the tiles.
        tile: which.
        map_leaf: edge of the voxels that the map is thinned to [m]; 0: all points are kept.

    Returns:
        The column, with the count and extents of the points.
    """
    origin, leaf = np.array(grid.origin_mm(tile), np.int64), whole_mm(map_leaf, "map_leaf")
    edge = leaf or SORT_EDGE_MM
    columns = -(-grid.tile_mm // edge)
    borders = [edge * (columns * i // pieces.strips) for i in range(pieces.strips + 1)]
    parts = []
    for lo, hi in itertools.pairwise(borders):
        batches = [
            b[(b[:, 0] >= lo) & (b[:, 0] < hi)] if pieces.strips > 1 else b
            for b in pieces.batches()
        ]
        points = np.concatenate(batches)
        del batches
        parts.append(thin(points, leaf, origin) if leaf else sort(points, SORT_EDGE_MM))
    xyz = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
    facts = {
        "points": xyz.shape[1],
        "read": pieces.count,
        "lowest": ((xyz.min(axis=1) + origin) / MM_PER_M).tolist(),
        "highest": ((xyz.max(axis=1) + origin) / MM_PER_M).tolist(),
    }
    return Made({"xyz": xyz}, facts)


def merge_tasks(
    store: TileStore,
    totals: Mapping[TileKey, Share],
    fragments: Iterable[Fragment],
    memory: int,
) -> list[Task]:
    """The writing half of an ingest: a task for each tile that holds a point, sorted.

    Args:
        store: where the tiles go.
        totals: the points of each tile.
        fragments: the indices of the fragments that are there; those of tiles that are written and
            have not changed may be absent.
        memory: what a task may use [bytes].
    """
    pieces: dict[TileKey, list[Piece]] = {key: [] for key in sorted(totals)}
    for fragment in fragments:
        for ix, iy, start, count in fragment.pieces:
            pieces[TileKey(ix, iy)].append(Piece(fragment.name, start, count))
    tasks = []
    for key, there in pieces.items():
        points, *fingerprint = totals[key]
        strips = strips_fitting(points, memory - BASE_BYTES)
        read = Pieces(store.url, tuple(there), points, (fingerprint[0], fingerprint[1]), strips)
        tasks.append(
            Task(
                merge,
                str(key),
                TileArrays(store.url, key, POINTS),
                takes={"grid": store.grid, "tile": key, "map_leaf": store.settings.map_leaf},
                reads={"pieces": read},
                counts={"points": points, "strips": strips},
                tile=key,
            )
        )
    return tasks
