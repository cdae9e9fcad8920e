"""The CRS of a LAS file, from its records: WKT, or the keys of GeoTIFF with units of their own."""

from typing import Any

import laspy
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError

from tilestream.crs import Entered, Unit, enter
from tilestream.errors import CrsError

_MODEL, _GEOGRAPHIC, _PROJECTED, _VERTICAL = 1024, 2048, 3072, 4096
"""Keys of the kind of CRS (1: projected, 2: geographic, 3: geocentric) and of its codes."""
_LINEAR, _LINEAR_SIZE, _VERTICAL_LINEAR = 3076, 3077, 4099
"""Keys of the units of x and y, of their length where they are user-defined [m], and of z."""
_USER_DEFINED = 32767
_CODES = range(1024, 32767)
"""Those of EPSG."""
_DOUBLES = 34736
"""Where the values of a key lie that are no whole numbers."""
OURS = "tilestream"
"""The program that wrote a file, where that is us: in metres."""
_NO_UNIT = "names no unit of length: taken to be in metres"


def crs_of(header: laspy.LasHeader, path: str) -> Entered:
    """The CRS as it enters a map; notes where a file has records of one that cannot be read, and
    where nothing tells its unit.

    Raises:
        CrsError: a CRS that no map can have; see `crs.enter`.
    """
    records = [*header.vlrs, *(header.evlrs or ())]
    notes: tuple[str, ...] = ()
    for record in records:
        if isinstance(record, WktCoordinateSystemVlr) and record.string.strip("\0 "):
            try:
                return enter(CRS.from_wkt(record.string.strip("\0 ")), path)
            except CRSError as error:
                notes = (_unreadable(error),)
    keys = _keys(records)
    if keys:
        return _of_keys(keys, path, notes)
    if not notes and any(record.user_id == "LASF_Projection" for record in records):
        notes = ("its projection records name no CRS by a code",)
    if header.generating_software != OURS:
        notes = (*notes, _NO_UNIT)
    return Entered(None, notes=notes)


def _of_keys(keys: dict[int, float], path: str, notes: tuple[str, ...]) -> Entered:
    projected = keys.get(_MODEL, 1 if _PROJECTED in keys else 2) == 1
    try:
        plane = _of_code(keys.get(_PROJECTED if projected else _GEOGRAPHIC))
        height = _of_code(keys.get(_VERTICAL))
    except CRSError as error:
        plane, height, notes = None, None, (*notes, _unreadable(error))
    if plane is None and not projected:
        raise CrsError(f"{path}: by its keys of GeoTIFF it is in degrees: project it first")
    if plane is not None and height is not None and height.is_vertical:
        plane = CompoundCRS(f"{plane.name} + {height.name}", [plane, height])
    xy, z = _unit(keys, _LINEAR), _unit(keys, _VERTICAL_LINEAR)
    found = enter(plane, path, xy=xy, z=z)
    if plane is None and not notes:
        notes = ("its projection records name no CRS by a code",)
    if plane is None and xy is None:
        notes = (*notes, _NO_UNIT)
    return Entered(found.crs, found.xy, found.z, (*notes, *found.notes))


def _keys(records: list[Any]) -> dict[int, float]:
    """The keys of GeoTIFF that hold a number."""
    doubles = [d for r in records if isinstance(r, GeoDoubleParamsVlr) for d in r.doubles]
    found: dict[int, float] = {}
    for record in records:
        if isinstance(record, GeoKeyDirectoryVlr):
            for key in record.geo_keys:
                if key.tiff_tag_location == 0:
                    found[key.id] = key.value_offset
                elif key.tiff_tag_location == _DOUBLES and key.value_offset < len(doubles):
                    found[key.id] = float(doubles[key.value_offset].value)
    return found


def _of_code(code: float | None) -> CRS | None:
    return CRS.from_epsg(int(code)) if code is not None and code in _CODES else None


def _unit(keys: dict[int, float], key: int) -> Unit | None:
    """The unit that a key names; None where there is none, or no one tells its length."""
    code = keys.get(key)
    if code == _USER_DEFINED and key == _LINEAR and keys.get(_LINEAR_SIZE, 0.0) > 0.0:
        return Unit("user-defined unit", keys[_LINEAR_SIZE])
    known = get_units_map(auth_name="EPSG", category="linear").values()
    return next((Unit(u.name, u.conv_factor) for u in known if u.code == str(code)), None)


def _unreadable(error: CRSError) -> str:
    said = " ".join(str(error).split())[:200]
    return f"its CRS cannot be read ({said}): taken as unknown, name it as crs (--crs)"
