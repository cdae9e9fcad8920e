"""Sample points: places on a route, raised to where the lidar is (definitions, section 2)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.errors import TileNotReadyError, UsageError
from tilestream.factors.ground import ground_under
from tilestream.formats.routes import resample
from tilestream.records import Float64, Route, RouteZ
from tilestream.store import TileStore

MOST_OFF = 5.0
"""How far a route, or the road under it, may be above or below the ground of the map [m]."""
OFF_GROUND = (
    f"the route is more than {MOST_OFF:g} m above or below the ground of the map: are its heights "
    "those of the map? leave z out to take the ground"
)
"""Why a place is not taken."""


def sample_points(
    route: Route,
    store: TileStore,
    spacing: float = 1.0,
    sensor_height: float = 2.0,
    route_z: RouteZ = "ground",
) -> Route:
    """The places of the lidar along a route, at equal steps of arc length.

    Args:
        route: a path on the road, in the map's frame.
        store: the map; it gives the ground.
        spacing: arc length between sample points [m].
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z of the route.

    Returns:
        The sample points as a route; z is NaN where there is no height, see `raised`.

    Raises:
        UsageError: `spacing` is below 1 cm or longer than the route, a height that is not finite.
        TileNotReadyError: a tile under the route failed or was skipped.
    """
    points = resample(route, spacing)
    at = raised(points.positions, store, sensor_height, route_z)
    for reason in at.why:
        if reason not in ("", OFF_GROUND):
            raise TileNotReadyError(reason)
    return replace(points, positions=at.lidar)


@dataclass(frozen=True, eq=False)
class Raised:
    """Places on a route, at the height of the lidar."""

    lidar: Float64
    """(k, 3) places of the lidar [m]; z is NaN where no map points give the ground that is needed,
    and where `why` says something."""
    above_ground: Float64
    """(k,) z of the route - ground [m]; NaN where either is not known."""
    why: NDArray[np.object_]
    """(k,) why a place is not taken: its road would be more than 5 m from the ground, or the map
    there cannot be read; else empty."""


def raised(
    positions: ArrayLike,
    store: TileStore,
    sensor_height: float = 2.0,
    route_z: RouteZ = "ground",
) -> Raised:
    """Places on a route, raised to the lidar.

    The lidar is `sensor_height` above the ground of the map (`ground_under`); with `route_z` `road`
    above z, with `lidar` at z, where there is one.

    Args:
        positions: (k, 3) places [m, map frame]; z may be NaN.
        store: the map.
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z.

    Raises:
        UsageError: a height that is not finite.
    """
    if not np.isfinite(sensor_height):
        raise UsageError(f"sensor_height is {sensor_height!r}: give metres")
    places: Float64 = np.array(positions, np.float64)
    z = places[:, 2].copy()
    ground, why = ground_under(places, store, route_z, sensor_height)
    lidar = ground + sensor_height
    if route_z != "ground":
        own = z + (sensor_height if route_z == "road" else 0.0)
        lidar = np.where(np.isnan(z), lidar, own)
    why[off_ground(z - ground, sensor_height, route_z)] = OFF_GROUND
    places[:, 2] = np.where(why == "", lidar, np.nan)
    return Raised(places, z - ground, why)


def off_ground(above_ground: Float64, sensor_height: float, route_z: RouteZ) -> NDArray[np.bool_]:
    """(k,) whether a road is so far from the ground of the map that no place is taken there.

    Args:
        above_ground: (k,) z of the route - ground [m]; NaN: not known, and not off.
        sensor_height: height of the lidar above the road [m].
        route_z: what z of the route is.
    """
    road = above_ground - (sensor_height if route_z == "lidar" else 0.0)
    far: NDArray[np.bool_] = np.abs(road) > MOST_OFF
    return far
