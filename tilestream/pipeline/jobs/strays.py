"""Points of a source that are far from all others: fill values, zeros among UTM coordinates.

Told by the tiles of a whole source, so that they are the same however it is read.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tilestream.errors import CorruptSourceError
from tilestream.grid import TileGrid
from tilestream.kernels.fixed_order import norms
from tilestream.pipeline.stages.fragments import Fragment
from tilestream.records import Int64

FAR = 10_000.0
"""Edge of the squares of a lattice that tell what is far [m]: parts of a source are apart where an
empty square lies between them, so at least by this, and always by twice as much. The squares are
the same for every tile size that divides them, as 20, 50, 100 and 125 m do; with another one a tile
across a border counts to the square of its lower corner."""
TOO_FAR = 1_000_000.0
"""How far apart the parts of a source may be [m]: no projection in metres reaches further."""
FEW, FEW_SHARE = 10, 0.01
"""Points far away are left out where they are at most so many, or at most this share of all …"""
OUTSIDE_SHARE = 0.1
"""… and those outside of the tile grid, which no map has, up to this share."""


@dataclass(frozen=True)
class Kept:
    """The fragments of a source without its strays."""

    fragments: tuple[Fragment, ...]
    points: int
    notes: tuple[str, ...]
    """What was left out: how many, and where."""


def without_strays(path: str, fragments: Sequence[Fragment], grid: TileGrid) -> Kept:
    """A source without the few points that do not fit the tile grid or are far from all others.

    Args:
        path: the source, for messages.
        fragments: all of it.
        grid: the tiles.

    Raises:
        CorruptSourceError: those are not few; says how many, and where.
    """
    counts: Counter[tuple[int, int]] = Counter()
    for fragment in fragments:
        for ix, iy, _, count in fragment.pieces:
            counts[ix, iy] += count
    points, notes = counts.total(), []
    outside = [fragment for fragment in fragments if fragment.outside]
    if outside:
        lost = sum(fragment.outside for fragment in outside)
        place = ", ".join(f"{value:.6g}" for value in outside[0].outside_at)
        told = f"outside of the tile grid: {lost:,} of {points + lost:,} points, first ({place}) m"
        if not _are_few(lost, points + lost, OUTSIDE_SHARE):
            raise CorruptSourceError(f"{path}: {told}: is it in metres, and its header right?")
        notes.append(f"{told}: left out")
    strays, places = _strays(counts, grid)
    if strays:
        lost = sum(counts[key] for key in strays)
        told = f"{FAR / 1000:g} km from all others: {lost:,} of {points:,} points, {places}"
        if not _are_few(lost, points):
            raise CorruptSourceError(f"{path}: {told}: remove them, or give one area in a file")
        notes.append(f"{told}: left out")
        fragments = [fragment.only(counts.keys() - strays) for fragment in fragments]
        points -= lost
    return Kept(tuple(fragments), points, tuple(notes))


def _are_few(strays: int, points: int, share: float = FEW_SHARE) -> bool:
    return 2 * strays < points and strays <= max(FEW, share * points)


def _strays(counts: Counter[tuple[int, int]], grid: TileGrid) -> tuple[set[tuple[int, int]], str]:
    """The tiles of small parts of a source that are far from the rest, and where they are."""
    if not counts:
        return set(), ""
    tiles: Int64 = np.array(sorted(counts), np.int64)
    points = np.array([counts[x, y] for x, y in tiles.tolist()])
    part = _parts(tiles * grid.tile_mm // round(FAR * 1000))
    size = np.bincount(part, points).astype(np.int64)
    main = int(np.argmax(size))
    corners = tiles * grid.tile_mm / 1000.0
    centre = corners[part == main].mean(axis=0)
    first = [int(np.argmax(part == i)) for i in range(len(size))]
    away = norms(corners[first] - centre)
    few = [_are_few(int(n), int(points.sum())) for n in size]
    lost = [i for i in range(len(size)) if i != main and (few[i] or away[i] > TOO_FAR)]
    places = ", ".join(f"{size[i]:,} near {_place(corners[first[i]])} m" for i in lost[:3])
    more = ", …" if len(lost) > 3 else ""
    return {(x, y) for x, y in tiles[np.isin(part, lost)].tolist()}, places + more


def _parts(cells: Int64) -> Int64:
    """Which part each cell is of: cells that touch, corners included, are of one."""
    known, cell_of = np.unique(cells, axis=0, return_inverse=True)
    pairs = cKDTree(known).query_pairs(1.0, p=np.inf, output_type="ndarray")
    ones = np.ones(len(pairs), np.int8)
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(known), len(known)))
    part: Int64 = connected_components(graph, directed=False)[1].astype(np.int64)
    return part[cell_of.ravel()]


def _place(corner: np.ndarray) -> str:
    return f"({corner[0]:.0f}, {corner[1]:.0f})"
