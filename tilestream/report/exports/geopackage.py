"""Places and stretches as a GeoPackage: one file of layers, units and styles, for QGIS and GDAL."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio

from tilestream.errors import TilestreamError
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.files import Files
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.records import Column
from tilestream.report.data import Findings
from tilestream.report.exports.geometry import crs_of, wkb_line, wkb_points
from tilestream.report.exports.labels import worst_labels
from tilestream.report.exports.qgis_styles import (
    style_of_measured,
    style_of_places,
    style_over_threshold,
)
from tilestream.report.measured import MEASURED_COLUMNS, measure_of
from tilestream.report.segments import segments
from tilestream.report.summary import AXES, STARTS

EPOCH = "1970-01-01T00:00:00.001Z"
"""The date of every file, since the same findings give the same bytes; with a millisecond, without
which GDAL writes a date that older ones warn of."""
VERSION = "1.3"
"""Of GeoPackage: what a GDAL of 2021 reads without a warning."""
NO_CRS = "The map names no CRS: positions are in metres of the map's own frame."
UNDEFINED = (
    'ENGCRS["Undefined Cartesian SRS",EDATUM["Undefined engineering datum"],CS[Cartesian,2],'
    'AXIS["x",unspecified],AXIS["y",unspecified],LENGTHUNIT["metre",1]]'
)
"""What a GeoPackage has of a local frame; by this name it gets the number -1 of the standard."""
TYPES = {"str": pa.string(), "int64": pa.int64(), "bool": pa.bool_(), "float64": pa.float64()}
"""Types of the fields by `Column.dtype`."""
RANKED = (
    Column(
        "error", "label", "m", "The larger of `estimate` and `measured`; NaN: neither is known.", ""
    ),
    Column(
        "worst",
        "place",
        "1",
        "Its number among the worst places; null: none of them.",
        "",
        dtype="int64",
    ),
    Column("label", "place", "", "What is written beside one of them.", "", dtype="str"),
)
"""What the layer `places` has besides."""
OF_STRETCH = (
    Column("route_id", "place", "", "Name of the route.", "", dtype="str"),
    Column("begin", "place", "m", "Length of the route where the stretch begins.", ""),
    Column("end", "place", "m", "Length of the route where it ends.", ""),
    Column("length", "place", "m", "Length of road that its sample points stand for.", ""),
    Column("places", "place", "1", "Sample points in it.", "", dtype="int64"),
    Column("worst", "label", "m", "Its largest error, estimated or measured.", ""),
    Column("worst_measured", "label", "", "Whether that was measured.", "", dtype="bool"),
    Column("worst_at", "place", "m", "Length of the route where that is.", ""),
    Column("x", "place", "m", "Position of that place in the map frame.", ""),
    Column("y", "place", "m", "Position of that place in the map frame.", ""),
    Column("mean", "label", "m", "Mean of its estimates.", ""),
    *(
        Column(
            name, "label", "m", f"Estimated {name} of its worst place.", "definitions, section 5"
        )
        for name in (*AXES, *STARTS)
    ),
    Column("p_fail", "label", "1", "Highest estimated share of starts that fail.", ""),
    Column(
        "in_domain",
        "place",
        "",
        "Whether all of it is like the training places; null: not known.",
        "",
        dtype="bool",
    ),
    Column("reason", "place", "", "Why the estimate of its worst place is high.", "", dtype="str"),
)
"""What `summary.segment` tells of a stretch over the threshold."""
_SHOWN = {
    column.name: column
    for column in (
        *PLACE_COLUMNS,
        *PREDICTION_COLUMNS,
        *COVARIANCE_COLUMNS,
        *MEASURED_COLUMNS,
        *RANKED,
    )
    if column.name not in ("x", "y", "z")  # the geometry
}
"""Columns of places that a reader of maps understands; the factors are in the GeoParquet."""


def write_geopackage(
    file: Files, found: Findings, threshold: float, told: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Write the places as a GeoPackage of the layers `places`, `over_threshold` and, where an
    error was measured, `measured`, each with its style for QGIS in the table `layer_styles`.

    Positions are those of the map, in its CRS. Every field has its unit in its alternative name,
    and its meaning as a comment; every layer says what the estimates are worth. A place that has no
    position has no geometry.

    Args:
        file: where to.
        found: what is reported.
        threshold: estimates above this are too large [m].
        told: what is told of each segment over it (`segments` of the summary).

    Returns:
        The names of the layers.

    Raises:
        CrsError: a CRS that pyproj does not know.
        TilestreamError: GDAL cannot write it; says why.
    """
    crs = crs_of(found.crs)
    places = _places(found)
    driven = places[places["measured"].notna()] if "measured" in places else places.iloc[:0]
    layers: dict[str, tuple[pa.Table, str, str]] = {
        "places": (_table(places, found, _SHOWN), "Point Z", style_of_places(found.scale)),
        "over_threshold": _over_threshold(found, threshold, told),
    }
    if len(driven):
        layers["measured"] = (
            _table(driven, found, _SHOWN),
            "Point Z",
            style_of_measured(found.scale),
        )
    about = " ".join(part for part in (found.worth_told, "" if crs else NO_CRS) if part)
    with TemporaryDirectory() as folder:
        path = Path(folder) / file.name
        _write(path, layers, crs.to_wkt() if crs else UNDEFINED, about)
        file.write(path.read_bytes())
    return list(layers)


def _write(
    path: Path, layers: Mapping[str, tuple[pa.Table, str, str]], crs: str, about: str
) -> None:
    """The layers with the table of their styles, as QGIS makes it."""
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": EPOCH})
    try:
        for name, (table, kind, _) in layers.items():
            pyogrio.write_arrow(
                table,
                path,
                layer=name,
                driver="GPKG",
                geometry_name="geometry",
                geometry_type=kind,
                crs=crs,
                append=path.exists(),
                dataset_options={"VERSION": VERSION},
                layer_options={"IDENTIFIER": name, "DESCRIPTION": about},
            )
        pyogrio.write_arrow(
            _styles({name: style for name, (_, _, style) in layers.items()}),
            path,
            layer="layer_styles",
            driver="GPKG",
            append=True,
            layer_options={"FID": "id"},
        )
    except RuntimeError as error:  # what all errors of pyogrio are
        raise TilestreamError(f"GDAL cannot write it ({error})") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _styles(styles: Mapping[str, str]) -> pa.Table:
    """The table in which QGIS looks for the style of a layer."""
    none = [""] * len(styles)
    return pa.table(
        {
            "f_table_catalog": none,
            "f_table_schema": none,
            "f_table_name": list(styles),
            "f_geometry_column": ["geom"] * len(styles),
            "styleName": list(styles),
            "styleQML": list(styles.values()),
            "styleSLD": none,
            "useAsDefault": [True] * len(styles),
            "description": ["by tilestream"] * len(styles),
            "owner": none,
            "ui": pa.nulls(len(styles), pa.string()),
            "update_time": pa.array([1] * len(styles), pa.timestamp("ms", "UTC")),
        }
    )


def _places(found: Findings) -> pd.DataFrame:
    """The places with `RANKED`."""
    labels = worst_labels(found)
    numbers = {row: number for number, row in enumerate(labels, start=1)}
    rows = found.places.index.to_series()  # 0, 1, …
    return found.places.assign(
        error=measure_of(found.places).known,
        worst=rows.map(numbers).astype("Int64"),
        label=rows.map(labels),
    )


def _over_threshold(
    found: Findings, threshold: float, told: Sequence[Mapping[str, Any]]
) -> tuple[pa.Table, str, str]:
    """The stretches over the threshold, what kind they all are, and their style."""
    at = found.places[["x", "y", "z"]].to_numpy(np.float64)
    runs = segments(found.places, threshold)
    columns = {column.name: column for column in OF_STRETCH}
    rows = pd.DataFrame(list(told), columns=list(columns))
    lines = [wkb_line(at[run]) for run in runs]
    table = _documented(rows, columns).append_column("geometry", pa.array(lines, pa.binary()))
    alone = any(np.isfinite(at[run]).all(axis=1).sum() == 1 for run in runs)
    style = style_over_threshold(found.scale, threshold)
    return table, "Unknown" if alone else "LineString Z", style


def _table(places: pd.DataFrame, found: Findings, columns: Mapping[str, Column]) -> pa.Table:
    """Some of the places as points."""
    at = found.places.loc[places.index, ["x", "y", "z"]].to_numpy(np.float64)
    table = _documented(places[[name for name in columns if name in places]], columns)
    return table.append_column("geometry", pa.array(wkb_points(at), pa.binary()))


def _documented(rows: pd.DataFrame, columns: Mapping[str, Column]) -> pa.Table:
    """A table whose fields tell GDAL their unit and meaning."""
    table = pa.Table.from_pandas(rows, preserve_index=False)
    fields = [_field(field, columns[field.name]) for field in table.schema]
    # without the metadata of pandas; in one piece, or the pieces would show in the bytes
    return table.cast(pa.schema(fields)).combine_chunks()


def _field(field: pa.Field, column: Column) -> pa.Field:
    unit = "" if column.unit in ("", "1") else f" [{column.unit}]"
    comment = f"{column.meaning} ({column.source})" if column.source else column.meaning
    about: dict[Any, Any] = {
        "GDAL:OGR:alternative_name": f"{column.name}{unit}",
        "GDAL:OGR:comment": comment,
    }
    return pa.field(field.name, TYPES[column.dtype], metadata=about)
