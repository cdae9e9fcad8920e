"""Routes in and out: from any file that draws a path to points at equal arc length."""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from tilestream.errors import (
    CorruptSourceError,
    CrsError,
    PoseError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    UsageError,
)
from tilestream.formats.logs import open_log
from tilestream.formats.routes.files import Path3, read_csv, read_geojson, read_poses
from tilestream.formats.routes.lanelet2 import read_lanelet2
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64, Route, Trajectory

REPEATED_M = 0.01
"""A point closer than this to the last one kept repeats it (a vehicle that stands) [m]."""
TANGENT_M = 0.5
"""The heading at a point is the direction of the chord from this far before to this far after."""
STEEPEST = 0.5
"""Climb per horizontal length of a whole route that no road has."""

READERS: dict[str, Callable[[str], list[Path3]]] = {
    ".tum": read_poses,
    ".txt": read_poses,
    ".kitti": read_poses,
    ".csv": read_csv,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".osm": read_lanelet2,
}


def read_routes(
    path: str | Path,
    *,
    crs: str | None = None,
    project_to: str | None = None,
    max_jump: float = 1000.0,
    z_offset: float | None = None,
    pose_topic: str | None = None,
) -> list[Route]:
    """The routes in a file, known by its ending:

    * `.tum`, `.txt`, `.kitti`: poses, TUM (stamp x y z qx qy qz qw) or KITTI (12 numbers a row, the
      frame's z axis up, not a camera's); which of the two is told by the numbers in a row;
    * `.csv`: a header that names x and y (or east and north, local_x and local_y, lon and lat) and
      maybe z;
    * `.geojson`, `.json`: every LineString; of a MultiLineString each part;
    * `.osm`: Lanelet2; centre lines of the lanelets for vehicles, joined as long as one follows the
      other without a fork; in `local_x`, `local_y` where every node has them, else degrees;
    * `.mcap`: the poses of a log, see `logs.open_log`.

    Points that repeat the last one within 1 cm are dropped and counted. A path that turns back is
    kept, the heading follows it. The order of a file's routes is the file's.

    Degrees: coordinates are taken for degrees where the file says so, or where all fit longitude
    and latitude and either the whole file extends over less than 1 unit, or (in drawn routes; poses
    are recorded many times a second, also while a vehicle stands) half of the steps are shorter
    than 0.001 units. In metres that would be a route of less than 1 m, or one drawn every
    millimetre. Degrees are refused unless `project_to` says where to.

    Args:
        path: the file.
        crs: coordinate reference system of the file, where it does not say.
        project_to: a metric CRS (any name that pyproj knows) to project degrees to.
        max_jump: longest distance between successive points [m].
        z_offset: added to z, so that the route lies on the road: minus the height of the recorded
            frame. None: z as it is in the file; no z for a log, whose poses are the lidar's.
        pose_topic: topic of the poses of a log.

    Raises:
        SourceNotFoundError: no such file.
        UnknownFormatError: an ending of no supported format.
        CorruptSourceError: no route in it, fewer than 2 different points, a number that is missing
            or not finite (names the place); no plausible road (steeper than 1:2).
        PoseError: a jump longer than `max_jump`; names the point and the distance.
        CrsError: degrees without `project_to`, or a CRS that cannot be used.
    """
    name = str(path)
    if not Path(name).is_file():
        raise SourceNotFoundError(f"{name}: no such file; check the path")
    ending = Path(name).suffix.lower()
    if ending == ".mcap":
        paths = [_log_path(name, pose_topic)]
    elif ending in READERS:
        paths = READERS[ending](name)
    else:
        known = ", ".join([*READERS, ".mcap"])
        raise UnknownFormatError(f"{name}: the ending {ending!r} is of no route; known are {known}")
    if not paths:
        raise CorruptSourceError(f"{name}: holds no route")
    crs = crs or paths[0].crs
    drawn = READERS.get(ending, read_poses) is not read_poses
    points = _metric(name, [p.positions for p in paths], crs, project_to, drawn)
    crs = project_to or crs
    lift = z_offset or (np.nan if ending == ".mcap" and z_offset is None else 0.0)
    return [
        route_of(
            p.route_id,
            xyz + np.array([0.0, 0.0, lift]),
            crs=crs,
            max_jump=max_jump,
            where=f"{name}: route {p.route_id}",
        )
        for p, xyz in zip(paths, points, strict=True)
    ]


def read_route(
    path: str | Path,
    *,
    route_id: str | None = None,
    crs: str | None = None,
    project_to: str | None = None,
    max_jump: float = 1000.0,
    z_offset: float | None = None,
    pose_topic: str | None = None,
) -> Route:
    """The one route of a file, or the one with this id; otherwise as `read_routes`.

    Raises:
        SourceError: several routes and no id, or none with this id; names those that are there.
    """
    routes = read_routes(
        path,
        crs=crs,
        project_to=project_to,
        max_jump=max_jump,
        z_offset=z_offset,
        pose_topic=pose_topic,
    )
    chosen = [r for r in routes if route_id in (None, r.route_id)]
    if len(chosen) != 1:
        ids = ", ".join(r.route_id for r in routes[:20]) + (", ..." if len(routes) > 20 else "")
        asked = f"no route {route_id!r}" if route_id else "more than one route"
        raise SourceError(f"{path}: {asked}; name one of its {len(routes)}: {ids}")
    return chosen[0]


def route_of(
    route_id: str,
    positions: Float64,
    *,
    crs: str | None = None,
    max_jump: float = 1000.0,
    where: str = "route",
) -> Route:
    """A route through some points.

    Args:
        route_id: its name.
        positions: (n, 3) points [m, map frame], in order of travel; z may be NaN (in all points).
        crs: coordinate reference system.
        max_jump: longest distance between successive points [m].
        where: how errors name it.

    Raises:
        CorruptSourceError: a number that is not finite, fewer than 2 different points, or a path
            steeper than 1:2 over its length.
        PoseError: a jump longer than `max_jump`.
    """
    flat = bool(np.isnan(positions[:, 2]).all())
    finite = np.isfinite(positions[:, :2] if flat else positions).all(axis=1)
    if not finite.all():
        index = int(np.flatnonzero(~finite)[0])
        raise CorruptSourceError(f"{where}: point {index} is not finite: {positions[index]}")
    known = positions[:, :2] if flat else positions
    kept = _distinct(known)
    if len(kept) < 2:
        raise CorruptSourceError(
            f"{where}: {len(kept)} different points of {len(positions)}; a route needs at least 2"
        )
    steps = norms(np.diff(known[kept], axis=0))
    if steps.max() > max_jump:
        i = int(np.argmax(steps > max_jump))
        raise PoseError(
            f"{where}: jumps {steps[i]:.1f} m from point {kept[i]} to point {kept[i + 1]}, more "
            f"than max_jump = {max_jump:g} m; split the route there or raise max_jump"
        )
    arc_length: Float64 = np.concatenate([[0.0], np.cumsum(steps)])
    route = positions[kept]
    _check_slope(where, route, arc_length)
    heading = _heading(route, arc_length, arc_length)
    return Route(route_id, route, arc_length, heading, crs, len(positions) - len(kept))


def resample(route: Route, spacing: float = 1.0) -> Route:
    """The route at equal arc length: points at 0, `spacing`, 2 `spacing`, ... on the straight lines
    between its points; what is left at the end (less than `spacing`) is cut off.

    Args:
        route: a route.
        spacing: arc length between points [m].

    Returns:
        A route whose `arc_length` and heading are those of the given one at its points.

    Raises:
        UsageError: `spacing` is not positive, or longer than the route.
    """
    length = route.arc_length[-1]
    if not 0 < spacing <= length:
        raise UsageError(
            f"spacing = {spacing}: must be above 0 and at most the length of route "
            f"{route.route_id}, {length:.2f} m"
        )
    # 1e-9: a route of 10 m that sums to 9.999999999 has its last point
    arc_length: Float64 = spacing * np.arange(np.floor(length / spacing + 1e-9) + 1)
    at = np.minimum(arc_length, length)
    positions = _at(route.positions, route.arc_length, at)
    heading = _heading(route.positions, route.arc_length, at)
    return Route(route.route_id, positions, arc_length, heading, route.crs, route.dropped)


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


def _log_path(path: str, pose_topic: str | None) -> Path3:
    poses = open_log(path, pose_topic=pose_topic).trajectory
    return Path3(Path(path).stem, poses.T_map_lidar[:, :3, 3].copy())


def _metric(
    path: str, points: list[Float64], crs: str | None, project_to: str | None, drawn: bool
) -> list[Float64]:
    """The points in metres: as they are, or projected from degrees."""
    system, target = _crs(path, crs), _crs(path, project_to)
    if target is not None and target.is_geographic:
        raise CrsError(f"{path}: project_to = {project_to!r} is in degrees; name a metric CRS")
    degrees = system.is_geographic if system is not None else _look_like_degrees(points, drawn)
    if not degrees:
        if project_to is not None:
            raise CrsError(f"{path}: is not in degrees, so it cannot be projected to {project_to}")
        return points
    if target is None:
        raise CrsError(
            f"{path}: coordinates in degrees, not metres (or a path of less than a metre); project "
            "them to the map's CRS first, or name it as project_to"
        )
    to_map = Transformer.from_crs(system or CRS.from_epsg(4326), target, always_xy=True)
    projected = []
    for xyz in points:
        x, y = to_map.transform(xyz[:, 0], xyz[:, 1])
        projected.append(np.column_stack([x, y, xyz[:, 2]]))
    return projected


def _crs(path: str, name: str | None) -> CRS | None:
    try:
        return None if name is None else CRS.from_user_input(name)
    except CRSError as error:
        raise CrsError(f"{path}: {name!r} is no CRS that pyproj knows ({error})") from error


def _look_like_degrees(points: list[Float64], drawn: bool) -> bool:
    every = np.concatenate(points)[:, :2]
    every = every[np.isfinite(every).all(axis=1)]
    if len(every) < 2:
        return False
    largest = np.abs(every).max(axis=0)
    if largest.min() > 90 or largest.max() > 180:
        return False
    steps = np.concatenate([norms(np.diff(xyz[:, :2], axis=0)) for xyz in points])
    steps = steps[steps > 0]
    extent = np.ptp(every, axis=0).max()
    return bool(extent > 0 and (extent < 1.0 or (drawn and np.median(steps) < 1e-3)))


def _distinct(points: Float64) -> list[int]:
    """Indices of the points that do not repeat the last one kept."""
    kept: list[int] = []
    last: list[float] | None = None
    for index, point in enumerate(points.tolist()):
        if last is None or math.dist(point, last) >= REPEATED_M:
            kept.append(index)
            last = point
    return kept


def _check_slope(where: str, positions: Float64, arc_length: Float64) -> None:
    # on points a metre apart, since the noise of dense poses climbs too
    coarse = _at(positions, arc_length, np.append(np.arange(0.0, arc_length[-1]), arc_length[-1]))
    steps = np.diff(coarse, axis=0)
    climb, run = np.abs(steps[:, 2]).sum(), np.hypot(steps[:, 0], steps[:, 1]).sum()
    if climb > STEEPEST * run:
        raise CorruptSourceError(
            f"{where}: climbs {climb:.1f} m over {run:.1f} m; its z axis does not point up (poses "
            "of a camera?): turn it into a frame with z up"
        )


def _at(positions: Float64, arc_length: Float64, at: Float64) -> Float64:
    return np.column_stack([np.interp(at, arc_length, column) for column in positions.T])


def _heading(positions: Float64, arc_length: Float64, at: Float64) -> Float64:
    """Direction of the chord around each arc length; of the line itself at a point of return."""
    xy = positions[:, :2]
    before = _at(xy, arc_length, np.maximum(at - TANGENT_M, 0.0))
    after = _at(xy, arc_length, np.minimum(at + TANGENT_M, arc_length[-1]))
    chord = after - before
    segment = np.clip(np.searchsorted(arc_length, at, side="right"), 1, len(arc_length) - 1)
    returning = norms(chord) < 1e-6
    chord[returning] = (xy[segment] - xy[segment - 1])[returning]
    return np.arctan2(chord[:, 1], chord[:, 0])
