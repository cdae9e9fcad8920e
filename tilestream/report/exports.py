"""Tables and maps for other programs; every file is whole or not there."""

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from tilestream.errors import CrsError
from tilestream.factors import catalogue, observability
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.model.features import SPREAD_ACROSS, SPREAD_ALONG, WEAK_ALONG
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.records import Float64
from tilestream.report.data import Findings, estimates
from tilestream.report.measured import MEASURED_COLUMNS
from tilestream.report.segments import segments
from tilestream.report.summary import plain, segment

GEOPARQUET = "1.1.0"
FORMULA = ("=", "+", "-", "@", "\t", "\n")
"""What a spreadsheet takes for the begin of a formula."""
POINT_Z = 1001
"""ISO WKB code of a point with z."""
_WKB = np.dtype([("order", "u1"), ("kind", "<u4"), ("xyz", "<f8", 3)])
_CATALOGUE = {
    column.name: column
    for column in (
        *PLACE_COLUMNS,
        *catalogue.COLUMNS,
        *MEASURED_COLUMNS,
        WEAK_ALONG,
        SPREAD_ALONG,
        SPREAD_ACROSS,
        *observability.COLUMNS,
        *PREDICTION_COLUMNS,
    )
}
"""What each column of the places means."""


def write_text(file: Files, text: str) -> None:
    """Write text as UTF-8."""
    file.write(text.encode("utf-8"))


def write_json(file: Files, content: Mapping[str, Any]) -> None:
    """Write strict JSON: what is not a number is null."""
    write_text(file, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


def write_csv(file: Files, places: pd.DataFrame) -> None:
    """Write the places; numbers as they are, to the bit, and empty where there is none.

    A text that a spreadsheet would take for a formula has a `'` before it.
    """
    texts = places.select_dtypes(exclude=["number", "bool"])
    safe = {str(name): column.map(_no_formula) for name, column in texts.items()}
    places = places.assign(**safe)
    write_text(file, places.to_csv(index=False, lineterminator="\n"))


def _no_formula(cell: Any) -> Any:
    if not isinstance(cell, str):
        return cell
    cell = cell.replace("\r", "\n")  # which the writer does not take for the end of a line
    return f"'{cell}" if cell.startswith(FORMULA) else cell


def write_geoparquet(file: Files, found: Findings) -> None:
    """Write the places as GeoParquet 1.1: a WKB point each, null where a coordinate is missing.

    Every column of ours carries its unit, meaning and source.

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    at = found.places[["x", "y", "z"]].to_numpy(np.float64)
    placed = np.isfinite(at).all(axis=1)
    crs = _crs(found.crs)
    geometry = {
        "encoding": "WKB",
        "geometry_types": ["Point Z"],
        # null says unknown; without the member a reader would take degrees for granted
        "crs": None if crs is None else crs.to_json_dict(),
        "edges": "planar",
    }
    if placed.any():
        bounds = np.concatenate([at[placed].min(axis=0), at[placed].max(axis=0)])
        geometry["bbox"] = bounds.tolist()
    geo = {"version": GEOPARQUET, "primary_column": "geometry", "columns": {"geometry": geometry}}
    table = pa.Table.from_pandas(found.places, preserve_index=False)
    table = table.append_column("geometry", pa.array(_wkb(at, placed), pa.binary()))
    about = {b"geo": json.dumps(geo).encode()}
    about |= {b"worth": _worth(found).encode()} if found.worth else {}
    schema = pa.schema([_documented(field) for field in table.schema], about)
    buffer = io.BytesIO()
    pq.write_table(table.cast(schema), buffer, compression="zstd")
    file.write(buffer.getvalue())


def _worth(found: Findings) -> str:
    """What the estimates are worth as one line; empty: nobody has said it."""
    return "" if found.worth is None else " ".join(found.worth.told)


def _wkb(at: Float64, placed: np.ndarray[Any, np.dtype[np.bool_]]) -> list[bytes | None]:
    rows = np.zeros(len(at), _WKB)
    rows["order"], rows["kind"], rows["xyz"] = 1, POINT_Z, at
    return [row.tobytes() if good else None for row, good in zip(rows, placed, strict=True)]


def _documented(field: pa.Field) -> pa.Field:
    column = _CATALOGUE.get(field.name)
    if column is None:
        return field
    return field.with_metadata(
        {"unit": column.unit, "meaning": column.meaning, "source": column.source}
    )


def write_geojson(file: Files, found: Findings, threshold: float) -> None:
    """Write the segments over a threshold: lines, and points where one sample point stands alone.

    Positions are longitude and latitude, as GeoJSON wants; of a map without a CRS they are its
    metres, and the member `coordinates` of the collection says so.

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    crs = _crs(found.crs)
    at = found.places[["x", "y", "z"]].to_numpy(np.float64).copy()
    if crs is not None:
        to_degrees = Transformer.from_crs(crs, CRS.from_epsg(4326), always_xy=True)
        at[:, 0], at[:, 1] = to_degrees.transform(at[:, 0], at[:, 1])
    features = []
    for rows in segments(found.places, threshold):
        positions = [
            [round(x, 9), round(y, 9)] + ([round(z, 3)] if np.isfinite(z) else [])
            for x, y, z in at[rows].tolist()
            if np.isfinite([x, y]).all()
        ]
        single = len(positions) == 1
        geometry = {
            "type": "Point" if single else "LineString",
            "coordinates": positions[0] if single else positions,
        }
        features.append(
            {
                "type": "Feature",
                "properties": segment(found.places, rows),
                "geometry": geometry if positions else None,
            }
        )
    degrees = "longitude, latitude (WGS 84); z as in the map [m]"
    collection = {
        "type": "FeatureCollection",
        "name": "over_threshold",
        "threshold": threshold,
        "coordinates": degrees if crs is not None else "map frame [m]; the map names no CRS",
        **({"worth": _worth(found)} if found.worth else {}),
        "features": features,
    }
    write_json(file, collection)


def _crs(name: str | None) -> CRS | None:
    try:
        return None if name is None else CRS.from_user_input(name)
    except CRSError as error:
        raise CrsError(f"{name!r} is no CRS that pyproj knows ({error})") from error


def write_cloud(file: Files, found: Findings) -> int:
    """Write the sample points as PCD, coloured as on the map (`rgb` as PCL packs it), with their
    `estimate` [m]; grey and NaN where there is none. A comment says what they are worth.

    Returns:
        How many places have no position and are not in it.
    """
    at = found.places[["x", "y", "z"]].to_numpy(np.float64)
    placed = np.isfinite(at).all(axis=1)
    estimate = estimates(found.places)
    rgb = found.scale.rgb(estimate[placed]).astype(np.uint32)
    packed = (rgb[:, 0] << 16) | (rgb[:, 1] << 8) | rgb[:, 2]
    fields = {
        "rgb": packed.view(np.float32),
        "estimate": estimate[placed].astype(np.float32),
    }
    write_pcd(
        file.address, at[placed], fields=fields, comments=[_worth(found)] if found.worth else []
    )
    return int((~placed).sum())
