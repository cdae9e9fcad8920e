"""What is told of heights: routes beside the ground of the map, lidars beside the settings."""

import numpy as np
import pandas as pd

from tilestream.factors.sample_points import off_ground
from tilestream.records import RouteZ

TOLD_FROM = 0.5
"""Difference of heights from which it is told [m]."""
LIDAR_TOLD_FROM = 0.3
"""The same of the height of a lidar and the settings [m]."""
WHAT_COUNTS = {
    "ground": "the ground counts (route_z)",
    "road": "z counts, as the road (route_z)",
    "lidar": "z counts, as the lidar (route_z)",
}
"""What a place is taken at, by `RouteZ`."""


def notes_of_routes(places: pd.DataFrame, sensor_height: float, route_z: RouteZ) -> list[str]:
    """A sentence for each route whose z is neither that of the road in the map nor of the lidar.

    Args:
        places: sample points, with `route_id` and `above_ground` [m].
        sensor_height: height of the lidar above the road, as set [m].
        route_z: what is made of z of the routes.
    """
    notes = []
    for name, above in places.groupby("route_id", sort=False)["above_ground"]:
        known = above.dropna().to_numpy(np.float64)
        if not len(known):
            continue
        middle, off = float(np.median(known)), off_ground(known, sensor_height, route_z)
        road = middle - (sensor_height if route_z == "lidar" else 0.0)
        of_lidar = route_z == "ground" and abs(middle - sensor_height) <= LIDAR_TOLD_FROM
        if (abs(road) <= TOLD_FROM or of_lidar) and not off.any():
            continue
        side = "above" if middle >= 0.0 else "below"
        told = (
            f"route {name}: its z is {abs(middle):.1f} m {side} the ground of the map (median of "
            f"{len(known)} places); {WHAT_COUNTS[route_z]}"
        )
        if off.any():
            told += f"; {int(off.sum())} places are farther off than that can be, and left out"
        notes.append(told)
    return notes


def note_of_drive(above_ground: pd.Series, sensor_height: float) -> list[str]:
    """A sentence where the lidar of a drive is not as high above the ground as the settings say.

    Args:
        above_ground: height of the lidar above the ground of the map at each label [m]; NaN: not
            known.
        sensor_height: height of the lidar above the road, as set [m].
    """
    known = above_ground.dropna().to_numpy(np.float64)
    if not len(known) or abs(np.median(known) - sensor_height) <= LIDAR_TOLD_FROM:
        return []
    told = (
        f"its lidar is {np.median(known):.1f} m above the ground of the map (median "
        f"of {len(known)} scans), and sensor_height, which estimates are for, {sensor_height:g} m"
    )
    return [told]
