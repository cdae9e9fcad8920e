"""A comparison of two maps in, a folder out."""

import os
from typing import Any

import numpy as np

from tilestream.crs import parsed, projection
from tilestream.files import Files
from tilestream.records import Float64
from tilestream.report.diff.data import Kind, MapDiff
from tilestream.report.diff.gate import Verdict
from tilestream.report.diff.page import diff_page
from tilestream.report.diff.summary import diff_content
from tilestream.report.exports.tables import write_json, write_text
from tilestream.store import require_folder

WGS84 = "EPSG:4326"
IN_FILE: tuple[Kind, ...] = ("worse", "lost")
"""The stretches that are written: a release waits for somebody to look at them."""


def write_diff(
    found: MapDiff, folder: str | os.PathLike[str], verdict: Verdict | None = None
) -> dict[str, Any]:
    """Write `diff.html` (needs no network), `diff.json` and `worse.geojson`, each whole.

    Args:
        found: what is compared (`ts.diff`).
        folder: where to, a local path or any fsspec URL; made where it does not exist.
        verdict: of a gate (`diff_gate`), which the page says first; None: none was asked for.

    Returns:
        The content of `diff.json`.

    Raises:
        UsageError: the folder is a file or a tile store.
        CrsError: a CRS that pyproj does not know.
    """
    require_folder(folder)
    content = diff_content(found, verdict)
    place = Files.at(folder)
    place.make()
    write_json(place.under("worse.geojson"), worse_geojson(found))
    write_text(place.under("diff.html"), diff_page(found, content))
    write_json(place.under("diff.json"), content)
    return content


def worse_geojson(found: MapDiff) -> dict[str, Any]:
    """The stretches that got worse or lost their estimates: lines, and points where one sample
    point stands alone; `what` says which.

    Positions are longitude and latitude, as GeoJSON wants; of a map without a CRS they are its
    metres, and the member `coordinates` of the collection says so.

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    at = _positions(found)
    features = []
    for kind in IN_FILE:
        tables = found.places.stretches_of(kind).to_dict("records")
        for rows, stretch in zip(found.places.stretch_rows(kind), tables, strict=True):
            line = [
                [round(x, 9), round(y, 9)] + ([round(z, 3)] if np.isfinite(z) else [])
                for x, y, z in at[rows].tolist()
                if np.isfinite([x, y]).all()
            ]
            single = len(line) == 1
            geometry = {
                "type": "Point" if single else "LineString",
                "coordinates": line[0] if single else line,
            }
            properties = {"what": kind, **stretch}
            features.append(
                {
                    "type": "Feature",
                    "properties": properties,
                    "geometry": geometry if line else None,
                }
            )
    degrees = "longitude, latitude (WGS 84); z as in the map [m]"
    return {
        "type": "FeatureCollection",
        "name": "worse",
        "limit": found.limit,
        "coordinates": "map frame [m]; the map names no CRS" if found.crs is None else degrees,
        "features": features,
    }


def _positions(found: MapDiff) -> Float64:
    """(n, 3) where the places are, as the file has it."""
    at = found.places.places[["x", "y", "z"]].to_numpy(np.float64).copy()
    if found.crs is not None and len(at):
        to_degrees = projection(parsed(found.crs, "map"), WGS84, "map")
        at[:, 0], at[:, 1] = to_degrees.transform(at[:, 0], at[:, 1])
    return at
