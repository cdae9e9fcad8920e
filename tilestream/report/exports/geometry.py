"""Geometries and the CRS as programs of maps read them."""

import struct

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from tilestream.errors import CrsError
from tilestream.records import Float64

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
