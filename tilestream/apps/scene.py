"""What a view shows: points of the map, places of the route, and their colours.

```
tile store --a tile at a time, thinned--> points, grey by height --+
tables: errors, predictions, factors ---> places, by their error --+--> scene --> window
```
"""

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tilestream.apps.changes import SAME_PLACE
from tilestream.apps.runs import labels_of
from tilestream.errors import TileNotReadyError, UsageError
from tilestream.factors.stations import INTERPOLATED
from tilestream.grid import MM_PER_M, Box, TileKey
from tilestream.pipeline.jobs.run_folder import map_of, rows_of
from tilestream.records import Float64
from tilestream.report.colours import FIXED, greys, height_range
from tilestream.store import TileStore
from tilestream.thinned import thinned

MOST_POINTS = 2_000_000
"""Map points that a view shows: what a laptop turns smoothly."""
TAILS = 0.02
"""Share of the map's extent that is left out at each end: strays."""
SMALLEST, LARGEST, SHARE = 0.8, 5.0, 1 / 150
"""Radius of a place: at least and at most this [m], and between them this share of what is seen."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Points and places relative to an origin, so that float32 suffices to draw them."""

    store: TileStore
    """The map."""
    tiles: tuple[TileKey, ...]
    """The tiles that are shown."""
    total: int
    """Their points before thinning."""
    origin: Float64
    """(3,) what all positions are relative to [m, map frame]."""
    points: Float64
    """(n, 3) map points [m]."""
    places: Float64
    """(k, 3) places of the lidar along the route [m]."""
    error: Float64
    """(k,) measured error of a place, else its estimate; NaN: neither is known [m]."""
    measured: NDArray[np.bool_]
    """(k,) whether it was measured."""
    interpolated: NDArray[np.bool_]
    """(k,) whether its estimate is that of places before and behind it."""

    @cached_property
    def height_range(self) -> tuple[float, float]:
        """Heights at which the greys begin and end [m, map frame]."""
        low, high = height_range(self.points[:, 2])
        return low + float(self.origin[2]), high + float(self.origin[2])

    def point_rgb(self) -> Float64:
        """(n, 3) greys of the points by height, in [0, 1]."""
        return greys(self.points[:, 2] + self.origin[2], self.height_range)

    def place_rgb(self) -> Float64:
        """(k, 3) colours of the places by error as in reports, grey where none is known, in
        [0, 1].
        """
        rgb: Float64 = FIXED.rgb(self.error) / 255.0
        return rgb

    @cached_property
    def seen(self) -> Float64:
        """(m, 3) what the camera must see [m]: the route, else the map without strays."""
        if len(self.places):
            return self.places
        some = self.points[:: 1 + len(self.points) // 100_000]  # they tell the extent as well
        low, high = np.quantile(some, (TAILS, 1.0 - TAILS), axis=0)
        inside: Float64 = some[((some >= low) & (some <= high)).all(axis=1)]
        return inside if len(inside) else some

    @property
    def radius(self) -> float:
        """Radius of a place, large enough to be seen [m]."""
        return float(np.clip(SHARE * np.ptp(self.seen, axis=0).max(), SMALLEST, LARGEST))

    def drawn(self) -> NDArray[np.int64]:
        """Rows of the places to draw: of those within a radius of each other one, by preference
        measured, and of these the worst.
        """
        order = np.lexsort((-np.nan_to_num(self.error, nan=-1.0), ~self.measured))
        cube = np.floor(self.places[order] / self.radius)
        _, first = np.unique(cube, axis=0, return_index=True)
        return np.sort(order[first])


def scene_of(
    place: str | os.PathLike[str],
    *,
    tile: tuple[int, int] | None = None,
    points: int = MOST_POINTS,
) -> Scene:
    """What a view of a tile store or of a run directory shows.

    Args:
        place: a tile store (a path or an fsspec URL: the map alone), or a run directory of `run`,
            `localize` or `factors`.
        tile: show only this tile; None: all.
        points: show at most so many points of the map; of more, a fair and repeatable sample, the
            same share of every tile. One tile at a time is held beyond them.

    Raises:
        UsageError: `points` is not positive, or the store has no such tile; names those it has.
        StoreNotFoundError: no store there, or that of the run has moved.
        TileNotReadyError: the tile failed or was skipped, or no tile is done; says why.
    """
    if points < 1:
        raise UsageError(f"points is {points}: give at least 1")
    store = map_of(place)
    tiles, counts = _tiles(store, tile)
    total, first = sum(counts), np.array(store.grid.origin_mm(tiles[0])) / MM_PER_M
    kept = thinned(store, dict(zip(tiles, counts, strict=True)), points)
    at, error, measured, between = route_of(place)
    if tile is not None:
        here = _inside(store.grid.core(tiles[0]), at)
        at, error, measured, between = at[here], error[here], measured[here], between[here]
    return Scene(store, tiles, total, first, kept - first, at - first, error, measured, between)


def _tiles(store: TileStore, only: tuple[int, int] | None) -> tuple[tuple[TileKey, ...], list[int]]:
    """The tiles to show, and how many points each has."""
    marks = store.marks()
    if only is not None:
        key = TileKey(*only)
        if key not in marks:
            some = ", ".join(str(k) for k in list(marks)[:10]) + (", …" if len(marks) > 10 else "")
            raise UsageError(f"{store.url} has no tile {key}: it has {some or 'none'}")
        store.tile(key)
        marks = {key: marks[key]}
    done = {key: mark.facts["points"] for key, mark in marks.items() if mark.status == "done"}
    filled = {key: count for key, count in done.items() if count}
    if not filled:
        raise TileNotReadyError(f"{store.url}: no point to show; see `tilestream status`")
    return tuple(filled), list(filled.values())


def _inside(box: Box, at: Float64) -> NDArray[np.bool_]:
    x, y = np.round(at[:, :2].T * MM_PER_M)
    inside: NDArray[np.bool_] = (x >= box.x_lo) & (x < box.x_hi) & (y >= box.y_lo) & (y < box.y_hi)
    return inside


def route_of(
    place: str | os.PathLike[str],
) -> tuple[Float64, Float64, NDArray[np.bool_], NDArray[np.bool_]]:
    """The places of a run with what is known of their error, measured with the vehicle's lidar or
    estimated; none for a tile store.

    Returns:
        (k, 3) places of the lidar [m, map frame], (k,) measured errors, else estimates, else NaN
        [m], (k,) whether measured, (k,) whether interpolated. Places without a position are left
        out.
    """
    labels = labels_of(place)
    measured = _places(labels if len(labels) else None, "error_mean")
    estimated = _places(rows_of(place, "predictions"), "estimate")
    unknown = [_places(rows_of(place, "factors")), *(t[_lost(t)] for t in (measured, estimated))]
    measured, estimated = (t[~_lost(t)] for t in (measured, estimated))
    every = measured
    for more in (estimated, *unknown):
        every = np.concatenate([every, _elsewhere(more, every)])
    is_measured = np.arange(len(every)) < len(measured)
    return every[:, :3], every[:, 3], is_measured, every[:, 4] == 1.0


def _places(rows: pd.DataFrame | None, column: str | None = None) -> Float64:
    """(k, 5) position and error of rows with a position, NaN where there is no error, and whether
    it is interpolated.
    """
    if rows is None:
        return np.zeros((0, 5))
    error = rows[column] if column else np.full(len(rows), np.nan)
    between = rows["status"] == INTERPOLATED
    table = np.column_stack([rows[["x", "y", "z"]], error, between]).astype(np.float64)
    kept: Float64 = table[np.isfinite(table[:, :3]).all(axis=1)]
    return kept


def _lost(places: Float64) -> NDArray[np.bool_]:
    return np.isnan(places[:, 3])


def _elsewhere(places: Float64, known: Float64) -> Float64:
    """Those of the places that are at none of the known ones."""
    if not len(known):
        return places
    first = known[0, :3]
    distance, _ = cKDTree(known[:, :3] - first).query(places[:, :3] - first)
    apart: Float64 = places[np.asarray(distance) > SAME_PLACE]
    return apart
