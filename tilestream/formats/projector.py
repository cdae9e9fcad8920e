"""`map_projector_info.yaml`, which says where on earth an Autoware map lies."""

import math
import re
from pathlib import Path
from typing import Any

from pyproj import Transformer

from tilestream.bounded_yaml import read_yaml
from tilestream.errors import CorruptSourceError

PROJECTOR = "map_projector_info.yaml"
METADATA = "pointcloud_map_metadata.yaml"
CLOUD = "pointcloud_map.pcd"
"""The one PCD file of a map, or the sub-directory of several."""
_BANDS = "CDEFGHJKLMNPQRSTUVWX"
_COLUMNS = ("STUVWXYZ", "ABCDEFGH", "JKLMNPQR")
"""Letters of the 100 km columns from 100 km east on, by zone modulo 3."""
_ROWS = "ABCDEFGHJKLMNPQRSTUV"
"""Letters of the 100 km rows, from the equator in odd zones, five later in even ones."""
_K0 = 0.9996
"""Scale of UTM at its central meridian; Autoware's default for its own transverse Mercator."""


def read_mapping(path: Path) -> dict[Any, Any]:
    """The mapping that a YAML file holds.

    Raises:
        SourceNotFoundError: there is no such file.
        CorruptSourceError: it is no YAML, or no mapping.
    """
    content = read_yaml(path, CorruptSourceError)
    if not isinstance(content, dict):
        raise CorruptSourceError(f"{path}: holds {type(content).__name__}, not `name: value` lines")
    return content


def crs_beside(path: Path) -> tuple[str | None, tuple[str, ...]]:
    """CRS and a note for a PCD of Autoware: from its folder, or the one above if it is of its map.

    (None, ()) where no `map_projector_info.yaml` belongs to the file.
    """
    folders = [path.parent]
    if path.parent.name == CLOUD or (path.parent.parent / METADATA).is_file():
        folders.append(path.parent.parent)
    for folder in folders:
        if (folder / PROJECTOR).is_file():
            return read_projector(folder / PROJECTOR)
    return None, ()


def read_projector(path: Path) -> tuple[str | None, tuple[str, ...]]:
    """CRS of the map's x and y as a PROJ string where the file tells one, and a note.

    MGRS coordinates count from the corner of a 100 km square of UTM, LocalCartesianUTM ones from an
    origin in UTM, TransverseMercator ones from an origin on its own central meridian: all three
    are a transverse Mercator projection with a false origin.

    Raises:
        CorruptSourceError: no YAML, no projector_type, or a grid or origin that cannot be.
    """
    content = read_mapping(path)
    kind = content.get("projector_type")
    if not isinstance(kind, str):
        raise CorruptSourceError(f"{path}: has no projector_type")
    crs: str | None = None
    match kind.lower():
        case "mgrs":
            crs = _of_mgrs(str(content.get("mgrs_grid")), path)
        case "localcartesianutm":
            crs = _of_utm_origin(*_origin(content, path))
        case "transversemercator":
            latitude, longitude = _origin(content, path)
            scale = _number(content, "scale_factor", path) if "scale_factor" in content else _K0
            crs = _tmerc(latitude, longitude, scale, 0.0, 0.0)
    what = ", ".join(f"{key}: {value}" for key, value in content.items())
    return crs, (f"{PROJECTOR}: {what}",)


def _tmerc(latitude: float, longitude: float, scale: float, x_0: float, y_0: float) -> str:
    return (
        f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k={scale!r} +x_0={x_0!r} "
        f"+y_0={y_0!r} +datum=WGS84 +units=m +no_defs +type=crs"
    )


def _of_mgrs(grid: str, path: Path) -> str:
    """The transverse Mercator whose origin is the corner of a 100 km square, e.g. 54SUE."""
    found = re.fullmatch(rf"(\d\d?)([{_BANDS}])([A-Z])([{_ROWS}])", grid)
    zone = int(found[1]) if found else 0
    columns = _COLUMNS[zone % 3]
    if not found or not 1 <= zone <= 60 or found[3] not in columns:
        raise CorruptSourceError(f"{path}: mgrs_grid {grid!r} is no 100 km square like 54SUE")
    meridian = 6.0 * zone - 183.0
    easting = 1e5 * (columns.index(found[3]) + 1)
    row = (_ROWS.index(found[4]) - (0 if zone % 2 else 5)) % 20
    # rows repeat every 2000 km: the one that meets the band of latitude
    south = 8.0 * _BANDS.index(found[2]) - 80.0
    north = south + (12.0 if found[2] == "X" else 8.0)
    to_utm = Transformer.from_crs("EPSG:4326", _tmerc(0.0, meridian, _K0, 5e5, 0.0), always_xy=True)
    low, high = (to_utm.transform(meridian, latitude)[1] for latitude in (south, north))
    # a parallel bends away from the equator by up to 30 km within a zone
    fits = [n for k in range(-5, 5) if low - 1.3e5 < (n := 1e5 * row + 2e6 * k) < high + 3e4]
    if len(fits) != 1:
        raise CorruptSourceError(f"{path}: mgrs_grid {grid!r}: its row is not in its band")
    return _tmerc(0.0, meridian, _K0, 5e5 - easting, -fits[0])


def _of_utm_origin(latitude: float, longitude: float) -> str | None:
    """UTM relative to an origin; None where UTM's zones are irregular (north of 56 deg, 0-42 E)."""
    if (latitude >= 56.0 and 0.0 <= longitude < 42.0) or not -80.0 <= latitude < 84.0:
        return None
    meridian = 6.0 * math.floor(longitude / 6.0) + 3.0
    utm = _tmerc(0.0, meridian, _K0, 5e5, 0.0)
    easting, northing = Transformer.from_crs("EPSG:4326", utm, always_xy=True).transform(
        longitude, latitude
    )
    return _tmerc(0.0, meridian, _K0, 5e5 - easting, -northing)


def _origin(content: dict[Any, Any], path: Path) -> tuple[float, float]:
    origin = content.get("map_origin")
    if not isinstance(origin, dict):
        raise CorruptSourceError(f"{path}: has no map_origin with latitude and longitude")
    latitude, longitude = (_number(origin, name, path) for name in ("latitude", "longitude"))
    if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 180.0):
        raise CorruptSourceError(f"{path}: map_origin {latitude}, {longitude} is not on earth")
    return latitude, longitude


def _number(content: dict[Any, Any], name: str, path: Path) -> float:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CorruptSourceError(f"{path}: {name} is {value!r}, no number")
    return float(value)
