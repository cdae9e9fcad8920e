"""Reading routes from any file that draws a path; the format is told by the ending."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tilestream.errors import (
    CorruptSourceError,
    CrsError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    foreign_errors,
)
from tilestream.files import local_path
from tilestream.formats.logs import LOG_FORMATS, is_log, open_log
from tilestream.formats.routes.arc_length import route_of
from tilestream.formats.routes.base import Lost, Path3
from tilestream.formats.routes.csv_file import read_csv
from tilestream.formats.routes.degrees import metric
from tilestream.formats.routes.files import read_geojson, read_poses
from tilestream.formats.routes.lanelet2 import read_lanelet2
from tilestream.formats.routes.pieces import pieces
from tilestream.formats.routes.routes_read import RoutesRead, named
from tilestream.records import Route
from tilestream.settings import LogOptions

READERS: dict[str, Callable[[str], Sequence[Path3 | Lost]]] = {
    ".tum": read_poses,
    ".txt": read_poses,
    ".kitti": read_poses,
    ".csv": read_csv,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".osm": read_lanelet2,
}


def read_all_routes(
    path: str | Path,
    *,
    crs: str | None = None,
    project_to: str | None = None,
    map_crs: str | None = None,
    max_jump: float = 1000.0,
    z_offset: float = 0.0,
    log_options: LogOptions | None = None,
) -> RoutesRead:
    """The routes in a file that can be used, and which cannot and why. Formats, known by the
    ending:

    * `.tum`, `.txt`, `.kitti`: poses, TUM (stamp x y z qx qy qz qw) or KITTI (12 numbers a row, the
      frame's z axis up, not a camera's); which of the two is told by the numbers in a row;
    * `.csv`: a header that names x and y (or east and north, local_x and local_y, lon and lat) and
      maybe z; parted by commas, semicolons or tabs;
    * `.geojson`, `.json`: every LineString; of a MultiLineString each part;
    * `.osm`: Lanelet2; centre lines of the lanelets for vehicles, joined as long as one follows the
      other without a fork; in `local_x`, `local_y` where every node has them, else degrees;
    * a log (a file, or the folder of a rosbag2): its poses, those of the lidar, see
      `logs.open_log`.

    A route leads through vertices 0.5 m apart or farther (`motion.vertices`), so that a vehicle
    that stands while its poses shake goes nowhere; other points are dropped and counted. A path
    that turns back is kept, the heading follows it. Poses are cut into several routes where there
    is a gap that nobody drove (`pieces.pieces`), which is noted. The order of a file's routes is
    the file's. Where several have one name, the second is called `name-2`, and so on, which is
    noted.

    Coordinates in degrees (how they are told: `degrees.metric`) or in another CRS than the map's
    are projected to it, which is noted; degrees are refused where no one says where to.

    Args:
        path: the file.
        crs: coordinate reference system of the file, where it does not say.
        project_to: a metric CRS (any name that pyproj knows) to project to; None: `map_crs`.
        map_crs: CRS of the map that the routes are for; what names none is in it.
        max_jump: longest distance between successive points [m].
        z_offset: added to z, as where heights of the file and of the map are of two systems [m].
        log_options: topics and frames of a log, and how fast any recorded vehicle drives; None:
            found, and the default.

    Returns:
        The routes, those that are lost, and notes. A file that cannot be read at all is lost as a
        whole.

    Raises:
        SourceNotFoundError: no such file.
        UsageError: a file that is not on this machine.
        UnknownFormatError: an ending of no supported format.
        CrsError: degrees without a CRS to project to, or that no place on earth has; a CRS that
            cannot be used, or that is not the map's and cannot be brought there.
    """
    name = local_path(path)
    options = log_options or LogOptions()
    try:
        with foreign_errors(CorruptSourceError, f"{name}: cannot be read as routes"):
            drawn = _drawn(name, options)
            paths = [part for part in drawn if isinstance(part, Path3)]
            crs = crs or next((part.crs for part in paths), None)
            by_hand = not any(part.recorded for part in paths)
            positions = [part.positions for part in paths]
            points, system, of_crs = (
                metric(name, positions, crs, project_to, map_crs, by_hand)
                if paths
                else ([], None, ())
            )
    except (SourceNotFoundError, UnknownFormatError, CrsError):
        raise
    except SourceError as error:
        return RoutesRead(lost=(Lost(Path(name).stem, error),))
    lost = [part for part in drawn if isinstance(part, Lost)]
    found: list[Route] = []
    notes: list[str] = list(of_crs)
    for drawn_path, xyz in zip(paths, points, strict=True):
        lifted = replace(drawn_path, positions=xyz + np.array([0.0, 0.0, z_offset]))
        parts, told = pieces(lifted, options.max_speed_mps)
        notes += told
        for part in parts:
            where = f"{name}: route {part.route_id}"
            try:
                found.append(
                    route_of(
                        part.route_id,
                        part.positions,
                        crs=system,
                        max_jump=max_jump,
                        where=where,
                    )
                )
            except SourceError as error:
                lost.append(Lost(part.route_id, error))
    routes, renamed = named(found)
    read = (note for part in paths for note in part.notes)
    told_of = tuple(f"{name}: {note}" for note in (*notes, *renamed, *read))
    return RoutesRead(routes, tuple(lost), told_of)


def read_routes(
    path: str | Path,
    *,
    crs: str | None = None,
    project_to: str | None = None,
    map_crs: str | None = None,
    max_jump: float = 1000.0,
    z_offset: float = 0.0,
    log_options: LogOptions | None = None,
) -> list[Route]:
    """All routes in a file; arguments as for `read_all_routes`, which goes on where this refuses.

    Raises:
        SourceNotFoundError: no such file.
        UnknownFormatError: an ending of no supported format.
        CorruptSourceError: no route in it, fewer than 2 different points, a number that is missing
            or not finite (names the place); no plausible road (steeper than 1:2).
        PoseError: a jump longer than `max_jump`; names the point and the distance.
        CrsError: degrees without `project_to`, or a CRS that cannot be used.
    """
    read = read_all_routes(
        path,
        crs=crs,
        project_to=project_to,
        map_crs=map_crs,
        max_jump=max_jump,
        z_offset=z_offset,
        log_options=log_options,
    )
    for lost in read.lost:
        raise lost.error
    return list(read.routes)


def read_route(
    path: str | Path,
    *,
    route_id: str | None = None,
    crs: str | None = None,
    project_to: str | None = None,
    map_crs: str | None = None,
    max_jump: float = 1000.0,
    z_offset: float = 0.0,
    log_options: LogOptions | None = None,
) -> Route:
    """The one route of a file, or the one with this id; otherwise as `read_routes`.

    Raises:
        SourceError: several routes and no id, or none with this id; names those that are there.

    Examples:
        >>> route = ts.read_route("route.csv")
        >>> route
        Route route (2 points, 6.0 m, CRS None)
    """
    read = read_all_routes(
        path,
        crs=crs,
        project_to=project_to,
        map_crs=map_crs,
        max_jump=max_jump,
        z_offset=z_offset,
        log_options=log_options,
    )
    routes = read.routes
    chosen = [r for r in routes if route_id in (None, r.route_id)]
    if read.lost and (route_id is None or not chosen):
        raise read.lost[0].error
    if len(chosen) != 1:
        ids = ", ".join(r.route_id for r in routes[:20]) + (", ..." if len(routes) > 20 else "")
        asked = f"no route {route_id!r}" if route_id else "more than one route"
        raise SourceError(f"{path}: {asked}; name one of its {len(routes)}: {ids}")
    return chosen[0]


def _drawn(path: str, options: LogOptions) -> Sequence[Path3 | Lost]:
    """The paths that a file draws, in its own coordinates; at least one, or one that is lost."""
    ending = Path(path).suffix.lower()
    if is_log(path):
        log = open_log(path, options)
        poses = log.trajectory
        return [
            Path3(
                Path(path).stem,
                poses.T_map_lidar[:, :3, 3].copy(),
                recorded=True,
                stamps_s=(poses.stamps_ns - poses.stamps_ns[0]) / 1e9,
                notes=log.notes,
            )
        ]
    if Path(path).is_dir():
        raise UnknownFormatError(f"{path}: a directory; give the files of routes in it")
    if not Path(path).is_file():
        raise SourceNotFoundError(f"{path}: no such file; check the path")
    if ending not in READERS:
        known = ", ".join([*READERS, *(one.short for one in LOG_FORMATS)])
        raise UnknownFormatError(f"{path}: the ending {ending!r} is of no route; known are {known}")
    drawn = READERS[ending](path)
    if not drawn:
        raise CorruptSourceError(f"{path}: holds no route")
    return drawn
