"""Some points of a map, for pictures of it: a tile is read at a time."""

from collections.abc import Mapping

import numpy as np

from tilestream.grid import TileKey
from tilestream.records import Float64
from tilestream.store import TileStore


def thinned(store: TileStore, tiles: Mapping[TileKey, int], most: int) -> Float64:
    """A fair sample of the points of some tiles, always the same: the same share of every tile.

    Args:
        store: the map.
        tiles: how many points each of the tiles has.
        most: so many points at most.

    Returns:
        (n, 3) points [m, map frame].

    Raises:
        TileNotReadyError: a tile is not done.
    """
    total = sum(tiles.values())
    ends = np.cumsum([0, *tiles.values()]) * min(most, total) // max(total, 1)
    parts = [_some(store, *each) for each in zip(tiles, np.diff(ends).tolist(), strict=True)]
    return np.concatenate([np.zeros((0, 3)), *parts])


def _some(store: TileStore, key: TileKey, count: int) -> Float64:
    """Some points of a tile."""
    points = store.tile(key).points()
    random = np.random.default_rng([abs(key.ix), abs(key.iy)])
    kept: Float64 = points[np.sort(random.permutation(len(points))[:count])]
    return kept
