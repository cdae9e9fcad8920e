"""A comparison of two maps in, a folder out."""

import os
from typing import Any

import numpy as np

from tilestream.files import Files
from tilestream.report.diff.data import Kind, MapDiff
from tilestream.report.diff.gate import Verdict
from tilestream.report.diff.page import diff_page
from tilestream.report.diff.summary import diff_content
from tilestream.report.exports.geometry import crs_of, geojson
from tilestream.report.exports.tables import write_json, write_text
from tilestream.store import require_folder

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

    Positions as `geojson` has them.

    Raises:
        CrsError: a CRS that pyproj does not know.
    """
    lines = [
        (rows, {"what": kind, **{str(name): value for name, value in stretch.items()}})
        for kind in IN_FILE
        for rows, stretch in zip(
            found.places.stretch_rows(kind),
            found.places.stretches_of(kind).to_dict("records"),
            strict=True,
        )
    ]
    at = found.places.places[["x", "y", "z"]].to_numpy(np.float64)
    return geojson("worse", at, crs_of(found.crs), lines, limit=found.limit)
