"""The ground of the map under a place: which of the levels there a vehicle stands on."""

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import TileNotReadyError
from tilestream.grid import MM_PER_M, Box
from tilestream.records import Float64, Int64, RouteZ
from tilestream.store import TileStore

RADIUS_MM = 1000
"""Horizontal distance around a place within which map points give the ground [mm]."""
PERCENTILE = 5.0
"""Which percentile of the heights of a level is its height; a level holds at least so many percent
of the points around a place."""
GAP_MM = 500
"""Heights farther apart than this are of two levels [mm]."""
UNDER_LIDAR = 0.3
"""How far the ground is at least below a lidar [m]."""


def ground_under(
    positions: Float64, store: TileStore, z_is: RouteZ = "ground", sensor_height: float = 2.0
) -> tuple[Float64, NDArray[np.object_]]:
    """The height of the ground under places (definitions, section 2).

    Args:
        positions: (k, 3) places [m, map frame]; z may be NaN.
        store: the map.
        z_is: what z is, see `RouteZ`.
        sensor_height: height of the lidar above the ground, as far as it is known [m].

    Returns:
        (k,) height [m, map frame]; NaN: no map points within 1 m, or they cannot be read; and (k,)
        why they cannot, empty where they can.
    """
    ground, why = np.full(len(positions), np.nan), np.full(len(positions), "", object)
    tile_of = [store.grid.key_at(x, y) for x, y in positions[:, :2].tolist()]
    for key in sorted(set(tile_of)):
        rows = [row for row, near in enumerate(tile_of) if near == key]
        for row, around in zip(rows, _heights_around(positions[rows], store), strict=True):
            if isinstance(around, str):
                why[row] = around
                continue
            found = levels(around)
            if len(found):
                ground[row] = _stood_on(found, float(positions[row, 2]), z_is, sensor_height)
    return ground, why


def levels(heights_mm: Int64) -> Float64:
    """The heights of the levels of map points around a place, the lowest first [m].

    A level is a run of heights of which none is farther than 0.5 m from the next; its height is
    their 5th percentile. A run of less than 5 % of the points is none.
    """
    heights_mm = np.sort(heights_mm)
    runs = np.split(heights_mm, np.flatnonzero(np.diff(heights_mm) > GAP_MM) + 1)
    enough = len(heights_mm) * PERCENTILE / 100.0
    found = [np.percentile(run, PERCENTILE) for run in runs if len(run) and len(run) >= enough]
    return np.array(found, np.float64) / MM_PER_M


def _stood_on(found: Float64, z: float, z_is: RouteZ, sensor_height: float) -> float:
    """The level on which a vehicle stands whose route or lidar is at z."""
    if np.isnan(z):
        return float(found[0])
    if z_is == "lidar":
        below = found[found <= z - UNDER_LIDAR]
        return float(below[-1] if len(below) else found[0])
    as_road = np.abs(found - z)
    either = np.minimum(as_road, np.abs(found - (z - sensor_height)))
    return float(found[np.lexsort((as_road, either))[0]])


def _heights_around(places: Float64, store: TileStore) -> list[Int64 | str]:
    """The heights [mm] of the map points within 1 m of each of (k, 3) places, horizontally [m]; or
    why they cannot be read.
    """
    try:
        points_mm = store.points_in(Box.around(places, RADIUS_MM / MM_PER_M))
    except TileNotReadyError as error:
        if len(places) == 1:
            return [str(error)]
        return [found for place in places for found in _heights_around(place[None], store)]
    points_mm = points_mm[np.argsort(points_mm[:, 0], kind="stable")]
    at = places[:, :2] * MM_PER_M
    first = np.searchsorted(points_mm[:, 0], at[:, 0] - RADIUS_MM, "left")
    last = np.searchsorted(points_mm[:, 0], at[:, 0] + RADIUS_MM, "right")
    heights: list[Int64 | str] = []
    for low, high, (x, y) in zip(first, last, at, strict=True):
        strip = points_mm[low:high]
        near = (strip[:, 0] - x) ** 2 + (strip[:, 1] - y) ** 2 <= RADIUS_MM**2
        heights.append(strip[near, 2])
    return heights
