"""Coordinates in degrees: how they are told from metres, and their projection."""

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from tilestream.errors import CrsError
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64


def metric(
    path: str, points: list[Float64], crs: str | None, project_to: str | None, drawn: bool
) -> list[Float64]:
    """The points of each path of a file in metres: as they are, or projected from degrees.

    Coordinates are taken for degrees where the file says so, or where all fit longitude and
    latitude and either the whole file extends over less than 1 unit, or (in drawn routes; poses are
    recorded many times a second, also while a vehicle stands) half of the steps are shorter than
    0.001 units. In metres that would be a route of less than 1 m, or one drawn every millimetre.

    Args:
        path: the file, for messages.
        points: (n, 3) points of each path, as the file gives them.
        crs: coordinate reference system of the file; None: it does not say.
        project_to: CRS to project degrees to.
        drawn: whether the paths were drawn, not recorded: their points do not lie close together.

    Returns:
        (n, 3) points of each path [m].

    Raises:
        CrsError: degrees without `project_to`, or that no place on earth has; metres with it; or a
            CRS that cannot be used.
    """
    system, target = _crs(path, crs), _crs(path, project_to)
    if target is not None and target.is_geographic:
        raise CrsError(f"{path}: project_to = {project_to!r} is in degrees; name a metric CRS")
    degrees = system.is_geographic if system is not None else _look_like_degrees(points, drawn)
    if not degrees:
        if project_to is not None:
            raise CrsError(f"{path}: is not in degrees, so it cannot be projected to {project_to}")
        return points
    _check_on_earth(path, points)
    if target is None:
        raise CrsError(
            f"{path}: coordinates in degrees, not metres (or a path of less than a metre); project "
            "them to the map's CRS first, or name it as project_to"
        )
    to_map = Transformer.from_crs(system or CRS.from_epsg(4326), target, always_xy=True)
    projected = []
    for xyz in points:
        x, y = to_map.transform(xyz[:, 0], xyz[:, 1])
        known = np.isfinite(xyz[:, :2]).all(axis=1)
        if not np.isfinite(np.stack([x, y])[:, known]).all():
            raise CrsError(f"{path}: {project_to} cannot hold its places; name the map's CRS")
        projected.append(np.column_stack([x, y, xyz[:, 2]]))
    return projected


def _check_on_earth(path: str, points: list[Float64]) -> None:
    """Refuse longitudes and latitudes that no place on earth has, with what they look like."""
    every = np.concatenate(points)
    beyond = np.flatnonzero((np.abs(every[:, 0]) > 180) | (np.abs(every[:, 1]) > 90))
    if not len(beyond):
        return
    x, y = every[beyond[0], :2]
    swapped = np.abs(every[:, 0]).max() <= 90 and np.abs(every[:, 1]).max() <= 180
    like = (
        "latitude and longitude look swapped: swap them"
        if swapped
        else "these look like metres: give them as metres (in Lanelet2: local_x and local_y of "
        "every node), or project them back to degrees"
    )
    raise CrsError(f"{path}: longitude {x:g}, latitude {y:g} is no place on earth; {like}")


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
