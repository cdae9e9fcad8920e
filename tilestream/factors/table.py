"""The table of factors at sample points, from the terms of the tiles around them."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from typing import get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from tilestream.errors import TileNotReadyError, UsageError
from tilestream.factors.catalogue import COUNTS, CRITERIA, Which, columns_of
from tilestream.factors.terms import terms_table
from tilestream.factors.vicinity import TileTerms, vicinity_sums
from tilestream.grid import MM_PER_M, Box, TileKey, whole_mm
from tilestream.records import Float64, Int64
from tilestream.sensor import VLP16, Sensor
from tilestream.store import POINTS, Tile, TileStore

CHUNK = 256
"""Sample points whose sums are held at once: 45 MB."""
CACHE_BYTES = 2**30
"""Memory for the terms of tiles that the next sample points need again [bytes]."""
NO_GROUND = "no ground: no map points within 1 m to raise the sample point from"
EMPTY = "the vicinity is empty: no cell within the range and field of view of the sensor"


def factors_at(
    places: Float64, sensor: Sensor, tiles: Iterable[TileTerms], which: Which = "faithful"
) -> dict[str, Float64]:
    """The factors of sample points, a column each, in the order of the definitions.

    Args:
        places: (k, 3) finite sample points [m, map frame], best in the order of a route; some
            hundreds at most, for memory.
        sensor: range, field of view and beams.
        tiles: the terms of all tiles within range; best the nearest first.
        which: the paper's factors, their robust twins, or both.

    Returns:
        (k,) columns by name. An empty vicinity has counts of 0 and NaN in all other columns.
    """
    sums = vicinity_sums(places, sensor, tiles)
    empty = sums["cells"] == 0
    found: dict[str, Float64] = {}
    if empty.all():
        nothing = np.full(len(empty), np.nan)
        return {c.name: np.where(c.name in COUNTS, 0.0, nothing) for c in columns_of(which)}
    for criterion in CRITERIA:
        found |= criterion.factors(sums)
    return {
        c.name: np.where(empty, 0.0 if c.name in COUNTS else np.nan, found[c.name])
        for c in columns_of(which)
    }


class TermsCache:
    """The terms of a store's tiles: from their tables where these are up to date, else made now.

    The tiles used last stay in memory, up to a limit.
    """

    def __init__(
        self, store: TileStore, cell_size: float = 2.0, limit_bytes: int = CACHE_BYTES
    ) -> None:
        self.store = store
        self.cell_size = cell_size
        self.limit_bytes = limit_bytes
        self._held: OrderedDict[TileKey, TileTerms | None] = OrderedDict()

    def get(self, key: TileKey) -> TileTerms | None:
        """The terms of a tile; None where the map has no such tile.

        Raises:
            TileNotReadyError: the tile, or one that its terms depend on, failed or was skipped.
        """
        if key not in self._held:
            self._held[key] = self._read(key)
            while len(self._held) > 1 and self._size() > self.limit_bytes:
                self._held.popitem(last=False)
        self._held.move_to_end(key)
        return self._held[key]

    def _size(self) -> int:
        return sum(terms.nbytes for terms in self._held.values() if terms is not None)

    def _read(self, key: TileKey) -> TileTerms | None:
        tile = Tile(self.store, key)
        if tile.mark(POINTS).status == "missing":
            return None
        table = terms_table(whole_mm(self.cell_size, "cell_size"))
        return TileTerms.from_arrays(tile.derived(table))

    def around(self, places: Float64, reach: float) -> Iterator[TileTerms]:
        """The terms of all tiles within `reach` [m] of the places, the nearest first."""
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        keys = self.store.grid.keys_over(Box.around(places, reach))
        middle = (low + high) / 2.0 * MM_PER_M / self.store.grid.tile_mm - 0.5
        for key in sorted(keys, key=lambda k: (float(np.hypot(*(np.array(k) - middle))), k)):
            terms = self.get(key)
            if terms is not None:
                yield terms


def factors(
    store: TileStore,
    positions: ArrayLike,
    sensor: Sensor = VLP16,
    cell_size: float = 2.0,
    which: Which = "faithful",
    cache: TermsCache | None = None,
) -> pd.DataFrame:
    """The factors (definitions, section 3 and definitions, section 4.1) at sample points of a map.

    Args:
        store: the map.
        positions: (k, 3) places of the lidar [m, map frame], already at its height; fastest in the
            order in which they are driven. NaN as z: a place without ground, see `sample_points`.
        sensor: range, field of view and beams.
        cell_size: edge of a cell [m]; the tile size is a multiple of it.
        which: `faithful` (the paper's 20), `robust` (their twins), or `all`.
        cache: terms of this store for cells of this size, from an earlier call.

    Returns:
        A row per position: the factors in the order of the definitions, then `status` (`done`,
        `missing` or `failed`) and `reason`. An empty vicinity is `missing`: counts 0, the rest NaN;
        `failed`, where a tile within range failed: all NaN.

    Raises:
        UsageError: positions of another shape or not finite, an unknown set, a cell size of which
            the tile size is no multiple.

    Examples:
        >>> store = ts.open_store("map.zarr")
        >>> table = ts.factors(store, [[5.0, 0.5, 2.0], [7.0, 0.5, 2.0]])
        >>> table.shape, table["status"].tolist()
        ((2, 22), ['done', 'done'])
    """
    places = places_of(positions)
    if which not in get_args(Which):
        raise UsageError(f"which is {which!r}: give one of {', '.join(get_args(Which))}")
    store.grid.require_cell_size(whole_mm(cell_size, "cell_size"))
    cache = cache or TermsCache(store, cell_size)
    names = [column.name for column in columns_of(which)]
    table = np.full((len(places), len(names)), np.nan)
    reason = np.full(len(places), NO_GROUND, object)
    status = np.full(len(places), "missing", object)
    for rows in _chunks(store, places):
        try:
            tiles = cache.around(places[rows], sensor.range_max)
            found = factors_at(places[rows], sensor, tiles, "all")
        except TileNotReadyError as error:
            status[rows], reason[rows] = "failed", str(error)
            continue
        table[rows] = np.column_stack([found[name] for name in names])
        seen = found["feature_count"] > 0
        status[rows] = np.where(seen, "done", "missing")
        reason[rows] = np.where(seen, "", EMPTY)
    without_ground = np.isnan(places[:, 2])
    table[np.ix_(without_ground, np.array([name in COUNTS for name in names]))] = 0.0
    frame = pd.DataFrame(table, columns=names)
    return frame.assign(status=status.astype(str), reason=reason.astype(str))


def places_of(positions: ArrayLike) -> Float64:
    """Positions as (k, 3) float64, with a height or without (NaN).

    Raises:
        UsageError: another shape, or values that are not finite (but for NaN as z).
    """
    places = np.asarray(positions)
    if places.dtype.kind not in "iuf" or places.ndim != 2 or places.shape[1] != 3:
        raise UsageError(
            f"positions have shape {places.shape} and type {places.dtype}: "
            "give a (k, 3) array of metres"
        )
    places = places.astype(np.float64)
    bad = ~np.isfinite(places[:, :2]).all(axis=1) | np.isinf(places[:, 2])
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise UsageError(f"position {row} is {tuple(places[row].tolist())}: give finite metres")
    return places


def _chunks(store: TileStore, places: Float64) -> Iterator[Int64]:
    """Rows of places with a height, tile by tile, in their order, some hundreds at a time."""
    rows_of: dict[TileKey, list[int]] = {}
    for row, (x, y, z) in enumerate(places.tolist()):
        if not np.isnan(z):
            rows_of.setdefault(store.grid.key_at(x, y), []).append(row)
    for rows in rows_of.values():
        for first in range(0, len(rows), CHUNK):
            yield np.array(rows[first : first + CHUNK], np.int64)
