"""Routes from any file that draws a path: the formats by their endings, and reading them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tilestream.errors import (
    CorruptSourceError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    foreign_errors,
)
from tilestream.formats.logs import LOG_FORMATS, is_log, open_log
from tilestream.formats.routes.arc_length import resample, route_of
from tilestream.formats.routes.base import Path3
from tilestream.formats.routes.csv_file import read_csv
from tilestream.formats.routes.degrees import metric
from tilestream.formats.routes.files import read_geojson, read_poses
from tilestream.formats.routes.lanelet2 import read_lanelet2
from tilestream.formats.routes.write import write_geojson_route, write_tum
from tilestream.records import Route

__all__ = [
    "READERS",
    "read_route",
    "read_routes",
    "resample",
    "route_of",
    "write_geojson_route",
    "write_tum",
]

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
    points_topic: str | None = None,
) -> list[Route]:
    """The routes in a file, known by its ending:

    * `.tum`, `.txt`, `.kitti`: poses, TUM (stamp x y z qx qy qz qw) or KITTI (12 numbers a row, the
      frame's z axis up, not a camera's); which of the two is told by the numbers in a row;
    * `.csv`: a header that names x and y (or east and north, local_x and local_y, lon and lat) and
      maybe z; parted by commas, semicolons or tabs;
    * `.geojson`, `.json`: every LineString; of a MultiLineString each part;
    * `.osm`: Lanelet2; centre lines of the lanelets for vehicles, joined as long as one follows the
      other without a fork; in `local_x`, `local_y` where every node has them, else degrees;
    * a log (`.mcap`): its poses, see `logs.open_log`.

    Points that repeat the last one within 1 cm are dropped and counted. A path that turns back is
    kept, the heading follows it. The order of a file's routes is the file's.

    Coordinates in degrees (how they are told: `degrees.metric`) are refused unless `project_to`
    says where to.

    Args:
        path: the file.
        crs: coordinate reference system of the file, where it does not say.
        project_to: a metric CRS (any name that pyproj knows) to project degrees to.
        max_jump: longest distance between successive points [m].
        z_offset: added to z, so that the route lies on the road: minus the height of the recorded
            frame. None: z as it is in the file; no z for a log, whose poses are the lidar's.
        pose_topic: topic of the poses of a log.
        points_topic: topic of the scans of a log, of whose lidar its poses are.

    Raises:
        SourceNotFoundError: no such file.
        UnknownFormatError: an ending of no supported format.
        CorruptSourceError: no route in it, fewer than 2 different points, a number that is missing
            or not finite (names the place); no plausible road (steeper than 1:2).
        PoseError: a jump longer than `max_jump`; names the point and the distance.
        CrsError: degrees without `project_to`, or a CRS that cannot be used.
    """
    name = str(path)
    with foreign_errors(CorruptSourceError, f"{name}: cannot be read as routes"):
        paths = _paths(name, pose_topic, points_topic)
        if not paths:
            raise CorruptSourceError(f"{name}: holds no route")
        crs = crs or paths[0].crs
        drawn = READERS.get(Path(name).suffix.lower(), read_poses) is not read_poses
        points = metric(name, [p.positions for p in paths], crs, project_to, drawn)
        lift = z_offset or (np.nan if is_log(name) and z_offset is None else 0.0)
        return [
            route_of(
                p.route_id,
                xyz + np.array([0.0, 0.0, lift]),
                crs=project_to or crs,
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


def _paths(path: str, pose_topic: str | None, points_topic: str | None) -> list[Path3]:
    """The paths that a file draws, in its own coordinates."""
    ending = Path(path).suffix.lower()
    if is_log(path):
        poses = open_log(path, points_topic=points_topic, pose_topic=pose_topic).trajectory
        return [Path3(Path(path).stem, poses.T_map_lidar[:, :3, 3].copy())]
    if not Path(path).is_file():
        raise SourceNotFoundError(f"{path}: no such file; check the path")
    if ending not in READERS:
        known = ", ".join([*READERS, *map(str, LOG_FORMATS)])
        raise UnknownFormatError(f"{path}: the ending {ending!r} is of no route; known are {known}")
    return READERS[ending](path)
