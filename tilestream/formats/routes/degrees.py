"""The CRS of a route: degrees told from metres, and the way from there to that of the map."""

from collections.abc import Sequence

import numpy as np

from tilestream.crs import enter, named, parsed, projection, require_same, same
from tilestream.errors import CrsError
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64


def metric(
    path: str,
    points: Sequence[Float64],
    crs: str | None,
    project_to: str | None,
    map_crs: str | None,
    drawn: bool,
) -> tuple[list[Float64], str | None, tuple[str, ...]]:
    """The points of each path of a file in metres: as they are, or projected.

    Coordinates are taken for degrees where the file says so, or where all fit longitude and
    latitude and either the whole file extends over less than 1 unit, or (in drawn routes; poses are
    recorded many times a second, also while a vehicle stands) half of the steps are shorter than
    0.001 units. In metres that would be a route of less than 1 m, or one drawn every millimetre.

    Args:
        path: the file, for messages.
        points: (n, 3) points of each path, as the file gives them.
        crs: coordinate reference system of the file; None: it does not say.
        project_to: CRS to project to what is in degrees or in another one; None: that of the map.
        map_crs: CRS of the map that the paths are for; what names none is in it. None: not known.
        drawn: whether the paths were drawn, not recorded: their points do not lie close together.

    Returns:
        (n, 3) points of each path [m], their CRS (None: not known), and what was done to them.

    Raises:
        CrsError: degrees and no CRS to project them to, metres of no CRS with `project_to`, a
            `project_to` that is not the map's, a place that is none on earth, or a CRS that cannot
            be used.
    """
    target = _target(path, project_to, map_crs)
    degrees = in_degrees(path, points, crs, drawn)
    if degrees:
        _check_on_earth(path, points)
    if degrees and target is None:
        raise CrsError(
            f"{path}: coordinates in degrees, not metres (or a path of less than a metre); project "
            "them to the map's CRS first, or name it as project_to"
        )
    if degrees and target is not None:
        told = "degrees" if crs else "degrees, as which its numbers look,"
        note = f"brought from {told} to {named(target)}"
        return _projected(path, points, crs or "EPSG:4326", target), target, (note,)
    if crs is None:
        if project_to is not None:
            raise CrsError(f"{path}: is not in degrees, so it cannot be projected to {project_to}")
        if map_crs is None:
            return list(points), None, ()
        return list(points), map_crs, (f"names no CRS: taken to be in {named(map_crs)}",)
    found = enter(crs, path)
    metres = np.array([found.xy.metres, found.xy.metres, found.z.metres])
    points = points if found.metric else [xyz * metres for xyz in points]
    if target is None or found.crs is None or same(found.crs, target):
        return list(points), found.crs, found.notes
    note = f"projected from {named(found.crs)} to the map's {named(target)}"
    return _projected(path, points, found.crs, target), target, (*found.notes, note)


def in_degrees(path: str, points: Sequence[Float64], crs: str | None, drawn: bool) -> bool:
    """Whether the points of the paths of a file are degrees; how that is told, and arguments, as
    for `metric`.
    """
    system = None if crs is None else parsed(crs, path)
    return bool(system.is_geographic) if system else _look_like_degrees(points, drawn)


def _target(path: str, project_to: str | None, map_crs: str | None) -> str | None:
    """Where to project to: in metres, and the map's CRS where that is known."""
    if project_to is None:
        return map_crs
    system = parsed(project_to, path)
    if system.is_geographic:
        raise CrsError(f"{path}: project_to = {project_to!r} is in degrees; name a metric CRS")
    require_same("project_to", project_to, "the map", map_crs)
    return map_crs or enter(project_to, "project_to").crs


def _projected(path: str, points: Sequence[Float64], crs: str, target: str) -> list[Float64]:
    """The points in another CRS; heights stay as they are.

    Raises:
        CrsError: PROJ knows no way there, or none for one of the points.
    """
    to_map = projection(crs, target, path)
    found = []
    for xyz in points:
        x, y = to_map.transform(xyz[:, 0], xyz[:, 1])
        lost = ~(np.isfinite(x) & np.isfinite(y)) & np.isfinite(xyz[:, :2]).all(axis=1)
        if lost.any():
            place = ", ".join(f"{value:.6g}" for value in xyz[np.argmax(lost), :2])
            raise CrsError(
                f"{path}: ({place}) of {named(crs)} is nowhere in {named(target)}: is the CRS of "
                "the file right, and is it of this map?"
            )
        found.append(np.column_stack([x, y, xyz[:, 2]]))
    return found


def _check_on_earth(path: str, points: Sequence[Float64]) -> None:
    """Refuse longitudes and latitudes that no place on earth has, with what they look like."""
    every = np.concatenate(list(points))
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


def _look_like_degrees(points: Sequence[Float64], drawn: bool) -> bool:
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
