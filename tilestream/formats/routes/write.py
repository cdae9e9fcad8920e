"""Routes and poses out, in formats that `read_routes` reads back."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tilestream.errors import UsageError
from tilestream.records import Route, Trajectory


def write_geojson_route(path: str | Path, routes: Route | Iterable[Route]) -> None:
    """Write routes as GeoJSON LineStrings, which `read_routes` reads back to the bit. A CRS goes
    into the `crs` member that GIS programs still read.

    Raises:
        UsageError: routes of different CRS.
    """
    routes = [routes] if isinstance(routes, Route) else list(routes)
    systems = {route.crs for route in routes}
    if len(systems) > 1:
        raise UsageError(f"{path}: routes of different CRS do not go into one file: {systems}")
    collection: dict[str, object] = {"type": "FeatureCollection"}
    if systems and (crs := systems.pop()):
        collection["crs"] = {"type": "name", "properties": {"name": crs}}
    collection["features"] = [
        {
            "type": "Feature",
            "properties": {"route_id": route.route_id, "length_m": float(route.arc_length[-1])},
            "geometry": {
                "type": "LineString",
                "coordinates": [
                    [value for value in point if not np.isnan(value)]
                    for point in route.positions.tolist()
                ],
            },
        }
        for route in routes
    ]
    Path(path).write_text(json.dumps(collection, allow_nan=False) + "\n", encoding="utf-8")


def write_tum(path: str | Path, poses: Trajectory) -> None:
    """Write poses in the TUM format, a row of stamp [s] x y z qx qy qz qw each; stamps keep their
    nanoseconds, positions their bits.
    """
    quaternions = Rotation.from_matrix(poses.T_map_lidar[:, :3, :3]).as_quat(canonical=True)
    rows = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(map(repr, [*position, *quaternion]))
        for stamp, position, quaternion in zip(
            poses.stamps_ns.tolist(),
            poses.T_map_lidar[:, :3, 3].tolist(),
            quaternions.tolist(),
            strict=True,
        )
    ]
    Path(path).write_text("\n".join(["# stamp x y z qx qy qz qw", *rows]) + "\n", encoding="utf-8")
