"""Files that draw a path: poses as text (TUM, KITTI), GeoJSON."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.routes.base import Lost, Path3, number, text_of
from tilestream.records import Float64


def read_poses(path: str) -> list[Path3]:
    """Poses in rows of 8 (TUM) or 12 (KITTI) numbers; rows that begin with # are comments.

    Raises:
        CorruptSourceError: no rows, or a row that has another count or something that is no number.
    """
    rows: list[list[float]] = []
    for row, line in enumerate(text_of(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        count = len(rows[0]) if rows else len(words)
        if count not in (8, 12) or len(words) != count:
            raise CorruptSourceError(
                f"{path}: line {row} has {len(words)} numbers; poses have 8 (TUM: stamp x y z "
                "qx qy qz qw) or 12 (KITTI: 3 x 4 matrix), the same in all rows"
            )
        rows.append([number(path, f"line {row}", word) for word in words])
    if not rows:
        raise CorruptSourceError(f"{path}: is empty; poses need rows of 8 or 12 numbers")
    numbers = np.array(rows)
    if len(rows[0]) == 8:
        positions, stamps = numbers[:, 1:4], numbers[:, 0]
        return [Path3(Path(path).stem, positions, recorded=True, stamps_s=stamps)]
    return [Path3(Path(path).stem, numbers[:, [3, 7, 11]], recorded=True)]


def read_geojson(path: str) -> Sequence[Path3 | Lost]:
    """Every LineString of a GeoJSON file, and each part of every MultiLineString. One with a
    coordinate that is no number is lost.

    Raises:
        CorruptSourceError: not GeoJSON, or no lines in it.
    """
    try:
        root = json.loads(text_of(path))
    except json.JSONDecodeError as error:
        raise CorruptSourceError(f"{path}: no GeoJSON ({error})") from error
    if not isinstance(root, dict):
        raise CorruptSourceError(f"{path}: no GeoJSON: an object is expected at its top")
    crs_name = _crs_name(path, root.get("crs"))
    found: list[Path3 | Lost] = []
    seen = []
    for index, (name, geometry) in enumerate(_geometries(root, None)):
        kind, coordinates = geometry.get("type"), geometry.get("coordinates")
        seen.append(str(kind))
        route_id = name or (f"{Path(path).stem}/{index}" if index else Path(path).stem)
        if kind == "LineString":
            found.append(_line(path, route_id, coordinates, crs_name))
        elif kind == "MultiLineString" and isinstance(coordinates, list):
            for part, line in enumerate(coordinates):
                found.append(_line(path, f"{route_id}/{part}", line, crs_name))
    if not found:
        kinds = ", ".join(sorted(set(seen))) or "no geometry"
        raise CorruptSourceError(f"{path}: holds no LineString but {kinds}")
    return found


def _crs_name(path: str, member: object) -> str | None:
    """The CRS of GeoJSON's older edition."""
    if member is None:
        return None
    try:
        return str(member["properties"]["name"])  # type: ignore[index] # whatever a file holds
    except (TypeError, KeyError):
        raise CorruptSourceError(f"{path}: its crs has no name: {member!r}") from None


def _geometries(node: object, name: str | None) -> Iterator[tuple[str | None, dict[str, object]]]:
    """Name and geometry of each feature, depth first."""
    if not isinstance(node, dict):
        return
    kind = node.get("type")
    if kind == "FeatureCollection":
        for feature in node.get("features") or []:
            yield from _geometries(feature, None)
    elif kind == "Feature":
        properties = node.get("properties") or {}
        names = [properties.get(key) for key in ("route_id", "id", "name")] + [node.get("id")]
        found = next((str(value) for value in names if value not in (None, "")), None)
        yield from _geometries(node.get("geometry"), found)
    elif kind == "GeometryCollection":
        for geometry in node.get("geometries") or []:
            yield from _geometries(geometry, name)
    else:
        yield name, node


def _line(path: str, route_id: str, coordinates: object, crs: str | None) -> Path3 | Lost:
    try:
        return Path3(route_id, _points(path, route_id, coordinates), crs)
    except CorruptSourceError as error:
        return Lost(route_id, error)


def _points(path: str, route_id: str, coordinates: object) -> Float64:
    if not isinstance(coordinates, list) or not coordinates:
        raise CorruptSourceError(f"{path}: route {route_id} has no coordinates")
    points = np.full((len(coordinates), 3), np.nan)
    for index, position in enumerate(coordinates):
        place = f"route {route_id}, point {index}"
        if not isinstance(position, list) or len(position) < 2:
            raise CorruptSourceError(f"{path}: {place} is no position: {position!r}")
        values = [number(path, place, value) for value in position[:3]]
        points[index, : len(values)] = values
    return points
