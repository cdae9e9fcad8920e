"""Tables and maps for other programs; every file is whole or not there."""

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.report.columns import CATALOGUE
from tilestream.report.data import Findings, estimates, interpolated
from tilestream.report.exports.geometry import crs_of, geojson, wkb_points
from tilestream.report.segments import segments
from tilestream.report.summary import plain

GEOPARQUET = "1.1.0"
FORMULA = ("=", "+", "-", "@", "\t", "\n")
"""What a spreadsheet takes for the begin of a formula."""


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
    crs = crs_of(found.crs)
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
    table = table.append_column("geometry", pa.array(wkb_points(at), pa.binary()))
    about = {b"geo": json.dumps(geo).encode()}
    about |= {b"worth": found.worth_told.encode()} if found.worth else {}
    schema = pa.schema([_documented(field) for field in table.schema], about)
    buffer = io.BytesIO()
    pq.write_table(table.cast(schema), buffer, compression="zstd")
    file.write(buffer.getvalue())


def _documented(field: pa.Field) -> pa.Field:
    column = CATALOGUE.get(field.name)
    if column is None:
        return field
    return field.with_metadata(
        {"unit": column.unit, "meaning": column.meaning, "source": column.source}
    )


def write_geojson(
    file: Files, found: Findings, threshold: float, told: Sequence[Mapping[str, Any]]
) -> None:
    """Write the segments over a threshold: lines, and points where one sample point stands alone.

    Positions as `geojson` has them.

    Args:
        file: where to.
        found: what is reported.
        threshold: estimates above this are too large [m].
        told: what is told of each segment (`segments` of the summary).

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    told_of = zip(segments(found.places, threshold), told, strict=True)
    at = found.places[["x", "y", "z"]].to_numpy(np.float64)
    worth = {"worth": found.worth_told} if found.worth else {}
    crs = crs_of(found.crs)
    write_json(file, geojson("over_threshold", at, crs, told_of, threshold=threshold, **worth))


def write_cloud(file: Files, found: Findings) -> int:
    """Write the sample points as PCD, coloured as on the map (`rgb` as PCL packs it), with their
    `estimate` [m]; grey and NaN where there is none; `interpolated` is 1 where that was not
    evaluated, else 0. A comment says what they are worth.

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
        "interpolated": interpolated(found.places)[placed].astype(np.uint8),
    }
    write_pcd(
        file.address, at[placed], fields=fields, comments=[found.worth_told] if found.worth else []
    )
    return int((~placed).sum())
