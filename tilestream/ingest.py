"""Sources to tiles: the bodies of the two kinds of task that an ingest is made of.

`scatter` reads a span of one source block by block and writes its points, tile by tile, into one
fragment file with an index. `merge` gathers the pieces of one tile from all fragments, thins them
to the map leaf, and writes the tile. Sums of whole numbers only: the tile is the same whatever the
blocks, their order, and the number of workers.
"""

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError
from tilestream.formats import open_source
from tilestream.formats.base import Span
from tilestream.kernels import scatter as scatter_kernels
from tilestream.kernels import thinning
from tilestream.records import Int64
from tilestream.store import POINTS, Mark, Tile, TileStore, hash_of
from tilestream.tiling import MAX_XY_MM, MAX_Z_MM, MM_PER_M, TileGrid, TileKey, whole_mm

Int32 = NDArray[np.int32]

MERGE_VERSION = 2
"""Raise it when the points that a merge writes change: tiles made by another one are redone."""
BYTES_PER_BLOCK_POINT = 160
"""Memory of a scatter task per point of its block: as read, float64, int64, grouped int32."""
BYTES_PER_TILE_POINT = 40
"""Memory of a merge task per point of a strip: read, ordered, keys of an axis."""
BYTES_PER_STORED_POINT = 32
"""Memory of a merge task per point of the tile: the strips that are done, the tile, packed."""
MAX_BINS = 2**22
"""Widest range of voxels along an axis that is counted as it is."""
SORT_EDGE_MM = 1000
"""Unthinned points are stored sorted by voxels of this edge, then by x, y, z."""
MAX_WINDOW = 50_000_000
"""Most tiles that the bounding box of one block may span."""


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
class Fragment:
    """What a scatter task wrote: the index of its file."""

    name: str
    """Name of the fragment; its file is `fragments/<name>.bin` in the store."""
    identity: str
    """Hash of the source, the span and the grid that it was made from."""
    points: int
    """Finite points that were read."""
    dropped: int
    """Points that were not finite."""
    pieces: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, start, count) of each run of points of one tile."""
    prints: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, two 64-bit sums): the fingerprint of the points of each tile."""


def fragment_path(store: TileStore, name: str) -> str:
    """Where a fragment's points lie, without the ending."""
    return f"{store.root}/fragments/{name}"


def scatter(
    store: TileStore,
    name: str,
    source: str,
    span: Span,
    block_points: int,
    identity: str,
    options: dict[str, object],
) -> Fragment:
    """Write the points of a span of a source as one fragment, its index last.

    Args:
        store: the store that will hold the tiles.
        name: of the fragment.
        source: path of the source.
        span: which of its points.
        block_points: points per block.
        identity: hash of what the fragment is made from; one with the same is kept as it is.
        options: what `formats.open_source` needs to read the source again.

    Raises:
        SourceError: the source cannot be read whole, or a point does not fit the tile grid.
    """
    known = read_fragment(store, name)
    if known is not None and known.identity == identity:
        return known
    path = fragment_path(store, name)
    store.fs.makedirs(f"{store.root}/fragments", exist_ok=True)
    pieces: list[tuple[int, int, int, int]] = []
    prints: dict[TileKey, tuple[int, int]] = {}
    start = dropped = 0
    if store.fs.exists(f"{path}.json"):
        store.fs.rm(f"{path}.json")  # an old index must not vouch for new points
    with store.fs.open(f"{path}.bin", "wb") as file:
        for block in open_source(source, **options).blocks(span, block_points):
            dropped += block.dropped
            if not len(block.points):
                continue
            points_mm = to_mm(block.points, f"{source}, points {span.start}-{span.stop}")
            grouped, tiles = group(points_mm, store.grid)
            file.write(grouped.tobytes())
            for key, count, fingerprint in tiles:
                pieces.append((*key, start, count))
                prints[key] = add_prints(prints.get(key, (0, 0)), fingerprint)
                start += count
    fragment = Fragment(
        name, identity, start, dropped, tuple(pieces), tuple((*k, *p) for k, p in prints.items())
    )
    with store.fs.open(f"{path}.json", "w") as file:
        json.dump(vars(fragment), file)
    return fragment


def read_fragment(store: TileStore, name: str) -> Fragment | None:
    """The index of a fragment that was written whole; None where there is none."""
    try:
        text = store.fs.cat_file(f"{fragment_path(store, name)}.json")
        known = json.loads(text)
    except (FileNotFoundError, ValueError):
        return None
    for column in ("pieces", "prints"):
        known[column] = tuple(tuple(row) for row in known[column])
    return Fragment(**known)


def add_prints(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    """The fingerprint of two sets of points together."""
    return (a[0] + b[0]) % 2**64, (a[1] + b[1]) % 2**64


def to_mm(points: NDArray[np.float64], where: str) -> Int64:
    """Finite points [m] as whole millimetres, half to even.

    Raises:
        CorruptSourceError: a point does not fit the tile grid; says where and which.
    """
    out = np.empty(points.shape, np.int64)
    limits = np.array([MAX_XY_MM, MAX_XY_MM, MAX_Z_MM], dtype=np.float64)
    bad = scatter_kernels.round_to_mm(points, limits, out)
    if bad >= 0:
        place = ", ".join(f"{value:.6g}" for value in points[bad])
        raise CorruptSourceError(
            f"{where}: a point at ({place}) m does not fit the tile grid "
            f"(|x|, |y| <= {MAX_XY_MM // MM_PER_M} m, |z| <= {MAX_Z_MM // MM_PER_M} m): "
            "is the file in metres, and its header right?"
        )
    return out


def group(
    points_mm: Int64, grid: TileGrid
) -> tuple[Int32, list[tuple[TileKey, int, tuple[int, int]]]]:
    """Points sorted by the tile that owns them, relative to its origin.

    Args:
        points_mm: (n, 3), n >= 1.
        grid: the tiles.

    Returns:
        The (n, 3) int32 points, and for each tile in their order its key, count and fingerprint.

    Raises:
        CorruptSourceError: the block spans more tiles than any real map.
    """
    tile_mm = grid.tile_mm
    ix_lo, iy_lo, ix_hi, iy_hi = scatter_kernels.tile_bounds(points_mm, tile_mm)
    rows, window = iy_hi - iy_lo + 1, (ix_hi - ix_lo + 1) * (iy_hi - iy_lo + 1)
    if window > MAX_WINDOW:
        raise CorruptSourceError(
            f"a block of {len(points_mm):,} points spans {window:,} tiles of "
            f"{tile_mm / MM_PER_M:g} m: use larger tiles, or remove the stray points"
        )
    tile_of = np.empty(len(points_mm), np.int32)
    counts = np.zeros(window, np.int64)
    scatter_kernels.tile_of_points(points_mm, tile_mm, ix_lo, iy_lo, rows, tile_of, counts)
    grouped = np.empty(points_mm.shape, np.int32)
    prints = np.zeros((window, 2), np.uint64)
    scatter_kernels.group_by_tile(
        points_mm, tile_of, tile_mm, ix_lo, iy_lo, rows, np.cumsum(counts) - counts, grouped, prints
    )
    tiles = [
        (TileKey(ix_lo + t // rows, iy_lo + t % rows), int(counts[t]), tuple(map(int, prints[t])))
        for t in np.flatnonzero(counts).tolist()
    ]
    return grouped, [(key, count, (a, b)) for key, count, (a, b) in tiles]


def points_mark(
    tile_size: float, map_leaf: float, count: int, fingerprint: tuple[int, int]
) -> Mark:
    """The mark of a tile made from a set of points: the same set, the same mark."""
    return Mark(
        status="done",
        inputs=hash_of(count, *fingerprint),
        settings=hash_of(tile_size, map_leaf, MERGE_VERSION),
    )


def merge(
    store: TileStore, key: TileKey, pieces: Sequence[Piece], mark: Mark, strips: int, batch: int
) -> Mark:
    """Write one tile from its pieces, thinned to the store's map leaf.

    Args:
        store: the store.
        key: the tile.
        pieces: where its points lie, in any order.
        mark: what the tile will be; a tile that carries the same mark is kept as it is.
        strips: into how many strips along x the tile is cut, one in memory at a time.
        batch: points read at a time.

    Returns:
        The mark as written, with the count and extents of the points.
    """
    tile, origin = Tile(store, key), np.array(store.grid.origin_mm(key), np.int64)
    known = tile.mark(POINTS)
    if known.same_work(mark):
        return known
    leaf = whole_mm(store.settings.map_leaf, "map_leaf")
    edge = leaf or SORT_EDGE_MM
    columns = -(-store.grid.tile_mm // edge)
    borders = [edge * (columns * i // strips) for i in range(strips + 1)]
    parts = []
    for lo, hi in itertools.pairwise(borders):
        batches = [
            b[(b[:, 0] >= lo) & (b[:, 0] < hi)] if strips > 1 else b
            for b in read_pieces(store, pieces, batch)
        ]
        points = np.concatenate(batches)
        del batches
        parts.append(thin(points, leaf, origin) if leaf else sort(points))
    xyz = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
    facts = {
        "points": xyz.shape[1],
        "read": sum(piece.count for piece in pieces),
        "lowest": ((xyz.min(axis=1) + origin) / MM_PER_M).tolist(),
        "highest": ((xyz.max(axis=1) + origin) / MM_PER_M).tolist(),
    }
    written = Mark(mark.status, mark.reason, mark.inputs, mark.settings, mark.code, facts)
    tile.write_table(POINTS, {"xyz": xyz}, written)
    return written


def read_pieces(store: TileStore, pieces: Iterable[Piece], batch: int) -> Iterator[Int32]:
    """The points of the pieces, (n, 3) int32 [mm from the tile's origin], n <= batch.

    Raises:
        CorruptSourceError: a fragment is shorter than its index says (removed or cut meanwhile).
    """
    point = 3 * np.dtype(np.int32).itemsize
    for piece in pieces:
        path = f"{fragment_path(store, piece.fragment)}.bin"
        for start in range(piece.start, piece.start + piece.count, batch):
            stop = min(start + batch, piece.start + piece.count)
            data = store.fs.cat_file(path, start=start * point, end=stop * point)
            if len(data) != (stop - start) * point:
                raise CorruptSourceError(f"{path} was cut short: run the same command again")
            yield np.frombuffer(data, np.int32).reshape(-1, 3)


def thin(points: Int32, leaf: int, origin: Int64) -> Int32:
    """One point per voxel: (3, m) int32 centroids [mm from the tile's origin], in voxel order."""
    ordered = by_voxel(points, leaf)
    out = np.empty_like(ordered)
    voxels = thinning.centroids(ordered, leaf, origin, out)
    return np.ascontiguousarray(out[:voxels].T)


def sort(points: Int32) -> Int32:
    """All points, (3, n) int32, by voxels of SORT_EDGE_MM, then x, y, z."""
    ordered = by_voxel(points, SORT_EDGE_MM)
    thinning.sort_in_voxels(ordered, SORT_EDGE_MM)
    return np.ascontiguousarray(ordered.T)


def by_voxel(points: Int32, edge: int) -> Int32:
    """The (n, 3) points ordered by voxel, lexicographically: a counting sort per axis, z first."""
    for axis in (2, 1, 0):
        keys = dense(points[:, axis] // np.int32(edge))
        counts = np.bincount(keys)
        ordered = np.empty_like(points)
        thinning.place_rows(points, keys, np.cumsum(counts) - counts, ordered)
        points = ordered
    return points


def dense(keys: Int32) -> Int64:
    """The keys from 0, in their order; without gaps where stray points make these too wide."""
    lowest = int(keys.min(initial=0))
    if int(keys.max(initial=0)) - lowest > MAX_BINS:
        return np.unique(keys, return_inverse=True)[1].astype(np.int64)
    return keys.astype(np.int64) - lowest
