"""Which lanelets of a Lanelet2 map the routes are joined of that are read from it."""

from dataclasses import dataclass

import numpy as np

from tilestream.errors import CorruptSourceError, SourceError, foreign_errors
from tilestream.files import local_path
from tilestream.formats.motion import vertices
from tilestream.formats.routes.arc_length import route_of
from tilestream.formats.routes.base import Path3
from tilestream.formats.routes.degrees import metric
from tilestream.formats.routes.lanelet2 import read_lanelet2
from tilestream.records import Float64, Route


@dataclass(frozen=True, eq=False)
class Lane:
    """A route of a Lanelet2 map."""

    route: Route
    """As `read_all_routes` reads it."""
    lanelets: tuple[str, ...]
    """The numbers of its lanelets, in order of travel."""
    begins: Float64
    """(k,) where along the route each of them begins [m]."""


def read_lanes(path: str, *, project_to: str | None, map_crs: str | None) -> list[Lane]:
    """The lanes of a Lanelet2 map that can be used as routes.

    Args:
        path: the file.
        project_to: as `read_all_routes` takes it.
        map_crs: likewise.

    Raises:
        SourceError: no Lanelet2 map, or it cannot be brought to the map's CRS.
    """
    name = local_path(path)
    with foreign_errors(CorruptSourceError, f"{name}: cannot be read as lanes"):
        paths = [part for part in read_lanelet2(name) if isinstance(part, Path3)]
        if not paths:
            return []
        drawn = [part.positions for part in paths]
        points, crs, _ = metric(name, drawn, paths[0].crs, project_to, map_crs, drawn=True)
    lanes = []
    for part, xyz in zip(paths, points, strict=True):
        try:
            route = route_of(part.route_id, xyz, crs=crs, where=f"{name}: route {part.route_id}")
        except SourceError:
            continue  # it is not among the routes
        numbers, first = zip(*part.lanelets, strict=True)
        kept = vertices(xyz[:, :2] if np.isnan(xyz[:, 2]).all() else xyz)
        lanes.append(Lane(route, numbers, np.interp(first, kept, route.arc_length)))
    return lanes
