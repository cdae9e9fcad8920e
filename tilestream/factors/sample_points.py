"""Sample points: places on a route, raised to where the lidar is (definitions, section 2)."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tilestream.errors import UsageError
from tilestream.formats.routes import resample
from tilestream.grid import MM_PER_M, Box, TileKey
from tilestream.records import Float64, Int64, Route
from tilestream.store import POINTS, Tile, TileStore

GROUND_RADIUS_MM = 1000
"""Horizontal distance around a place within which map points give the ground [mm]."""
GROUND_PERCENTILE = 5.0
"""Which percentile of the heights there counts as the ground."""


def sample_points(
    route: Route, store: TileStore, spacing: float = 1.0, sensor_height: float = 2.0
) -> Route:
    """The places of the lidar along a route, at equal steps of arc length.

    Args:
        route: a path on the road, in the map's frame.
        store: the map; it gives the ground where the route has no z.
        spacing: arc length between sample points [m].
        sensor_height: height of the lidar above the road [m].

    Returns:
        The sample points as a route; z is NaN where there is neither route z nor ground.

    Raises:
        UsageError: `spacing` is not positive or longer than the route, a height that is not finite.
        TileNotReadyError: a tile under the route failed or was skipped.
    """
    points = resample(route, spacing)
    return replace(points, positions=raised(points.positions, store, sensor_height))


def raised(positions: ArrayLike, store: TileStore, sensor_height: float = 2.0) -> Float64:
    """Places on the road, raised to the lidar's height: z + height, or ground + height if z is NaN.

    The ground is the 5th percentile (linear between ranks) of z of the map points within 1.0 m
    horizontally.

    Args:
        positions: (k, 3) places [m, map frame]; z may be NaN.
        store: the map.
        sensor_height: height of the lidar above the road [m].

    Returns:
        (k, 3) places of the lidar [m]; z stays NaN where there are no map points.

    Raises:
        UsageError: a height that is not finite.
        TileNotReadyError: a tile under the route failed or was skipped.
    """
    if not np.isfinite(sensor_height):
        raise UsageError(f"sensor_height is {sensor_height!r}: give metres")
    places: Float64 = np.array(positions, np.float64)
    flat = np.flatnonzero(np.isnan(places[:, 2]))
    tile_of = [store.grid.key_at(x, y) for x, y in places[flat, :2].tolist()]
    for key in sorted(set(tile_of)):
        rows = flat[[near == key for near in tile_of]]
        places[rows, 2] = _ground(places[rows, :2], _points_around(store, key))
    places[:, 2] += sensor_height
    return places


def _points_around(store: TileStore, key: TileKey) -> Int64:
    """The map points [mm] of a tile and of 1 m around it."""
    box: Box = store.grid.core(key).grown(GROUND_RADIUS_MM + 1)
    parts = [np.zeros((0, 3), np.int64)]
    for near in store.grid.keys_over(box):
        if Tile(store, near).mark(POINTS).status != "missing":
            points = store.tile(near).points_mm()
            x, y = points[:, 0], points[:, 1]
            inside = (x >= box.x_lo) & (x < box.x_hi) & (y >= box.y_lo) & (y < box.y_hi)
            parts.append(points[inside])
    return np.concatenate(parts)


def _ground(places: Float64, points_mm: Int64) -> Float64:
    """(k,) height of the ground under (k, 2) places [m]; NaN where there are no points."""
    points_mm = points_mm[np.argsort(points_mm[:, 0], kind="stable")]
    at = places * MM_PER_M
    first = np.searchsorted(points_mm[:, 0], at[:, 0] - GROUND_RADIUS_MM, "left")
    last = np.searchsorted(points_mm[:, 0], at[:, 0] + GROUND_RADIUS_MM, "right")
    ground = np.full(len(places), np.nan)
    for row, (x, y) in enumerate(at):
        strip = points_mm[first[row] : last[row]]
        near = (strip[:, 0] - x) ** 2 + (strip[:, 1] - y) ** 2 <= GROUND_RADIUS_MM**2
        if near.any():
            ground[row] = np.percentile(strip[near, 2], GROUND_PERCENTILE) / MM_PER_M
    return ground
