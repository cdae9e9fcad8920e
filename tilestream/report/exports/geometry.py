"""Geometries and the CRS as programs of maps read them."""

import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from tilestream.crs import projection
from tilestream.errors import CrsError
from tilestream.records import Float64, Int64

POINT_Z, LINE_Z = 1001, 1002
"""ISO WKB codes of a point and of a line with z."""
_WKB_POINT = np.dtype([("order", "u1"), ("kind", "<u4"), ("xyz", "<f8", 3)])


def crs_of(name: str | None) -> CRS | None:
    """The CRS of a map; None: it names none.

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    try:
        return None if name is None else CRS.from_user_input(name)
    except CRSError as error:
        raise CrsError(f"{name!r} is no CRS that pyproj knows ({error})") from error


def wkb_points(at: Float64) -> list[bytes | None]:
    """(n, 3) positions as a WKB point each, null where a coordinate is missing."""
    rows = np.zeros(len(at), _WKB_POINT)
    rows["order"], rows["kind"], rows["xyz"] = 1, POINT_Z, at
    placed = np.isfinite(at).all(axis=1)
    return [row.tobytes() if good else None for row, good in zip(rows, placed.ravel(), strict=True)]


def wkb_line(at: Float64) -> bytes | None:
    """(n, 3) positions as one WKB line, those left out that miss a coordinate; a point of a single
    one, null of none.
    """
    placed = at[np.isfinite(at).all(axis=1)]
    if len(placed) < 2:
        return next(iter(wkb_points(placed)), None)
    return struct.pack("<BII", 1, LINE_Z, len(placed)) + placed.astype("<f8").tobytes()


def geojson(
    name: str,
    at: Float64,
    crs: CRS | None,
    lines: Iterable[tuple[Int64, Mapping[str, Any]]],
    **members: Any,
) -> dict[str, Any]:
    """Some of the places as a GeoJSON collection: lines, and points where one stands alone.

    Positions are longitude and latitude, as GeoJSON wants; of a map without a CRS they are its
    metres, and the member `coordinates` of the collection says so.

    Args:
        name: of the collection.
        at: (n, 3) the places [m, map frame]; those without x or y are left out.
        crs: of the map.
        lines: rows of the places of each line, and what is told of it.
        members: what else the collection says.

    Raises:
        CrsError: PROJ knows no way from the CRS to degrees.
    """
    placed, coordinates = as_geojson_has(at, crs)
    return {
        "type": "FeatureCollection",
        "name": name,
        **members,
        "coordinates": coordinates,
        "features": [
            {"type": "Feature", "properties": dict(told), "geometry": _geojson_line(placed[rows])}
            for rows, told in lines
        ],
    }


def as_geojson_has(at: Float64, crs: CRS | None) -> tuple[Float64, str]:
    """Positions (n, 2 or 3) of a map [m] as longitude, latitude (and z), and what they are in
    words; of a map without a CRS as they are.

    Raises:
        CrsError: PROJ knows no way from the CRS to degrees.
    """
    if crs is None:
        return at, "map frame [m]; the map names no CRS"
    placed = at.copy()
    if len(placed):
        to_degrees = projection(crs, CRS.from_epsg(4326), "map")
        placed[:, 0], placed[:, 1] = to_degrees.transform(placed[:, 0], placed[:, 1])
    return placed, "longitude, latitude (WGS 84); z as in the map [m]"


def _geojson_line(at: Float64) -> dict[str, Any] | None:
    positions = [
        [round(x, 9), round(y, 9)] + ([round(z, 3)] if np.isfinite(z) else [])
        for x, y, z in at.tolist()
        if np.isfinite([x, y]).all()
    ]
    if len(positions) < 2:
        return {"type": "Point", "coordinates": positions[0]} if positions else None
    return {"type": "LineString", "coordinates": positions}
