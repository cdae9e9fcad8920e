"""Findings or a comparison in, a folder out."""

import os
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from tilestream.files import Files
from tilestream.report import pictures
from tilestream.report.comparison import Comparison
from tilestream.report.data import Findings, estimates
from tilestream.report.exports.geometry import crs_of
from tilestream.report.exports.tables import write_csv, write_json, write_text
from tilestream.report.exports.write import write_for_others
from tilestream.report.page import comparison_page, report_page
from tilestream.report.segments import check_threshold
from tilestream.report.summary import plain, summary
from tilestream.report.views import View, ends_of, view_of

THRESHOLD = 0.25
"""Estimates above this are too large [m]: the paper's, and where Autoware warns."""


OURS = re.compile(r"(map|distribution|paths|importances|coverage|ends(_\d+)?|worst_\d+)\.png")
"""What we call our figures: others of the folder are somebody else's."""


def write_report(
    findings: Findings, folder: str | os.PathLike[str], *, threshold: float = THRESHOLD
) -> dict[str, Any]:
    """Write the page and the files beside it: each of them whole, or not there.

    `index.html` (needs no network), `places.parquet` (GeoParquet), `places.csv`, `places.gpkg`
    (GeoPackage with styles for QGIS), `over_threshold.geojson` and its style for QGIS
    `over_threshold.qml`, `map.pcd`, `foxglove.mcap`, `lanelets.osm` (where routes are lanes of a
    Lanelet2 map; of a second one `lanelets-2.osm`), `report.json`, `figures/*.png`. Files of these
    names are replaced; figures and Lanelet2 maps of an earlier report that this one lacks are
    removed. A file for other programs that cannot be written costs only itself: `not_written` in
    `report.json`, and the page, say why.

    Args:
        findings: what is reported.
        folder: where to, a local path or any fsspec URL; made where it does not exist.
        threshold: estimates above this are too large [m].

    Returns:
        The content of `report.json`.

    Raises:
        UsageError: a threshold that is no positive length.
        CrsError: a CRS that pyproj does not know.
    """
    check_threshold(threshold)
    crs_of(findings.crs)  # refused before anything is written
    place = Files.at(folder)
    place.under("figures").make()
    content = summary(findings, threshold)
    content |= write_for_others(place, findings, threshold, content["segments"])
    worst = [view_of(findings, place) for place in content["worst"]]
    ends = ends_of(findings, content["worst_measured"])
    content["figures"] = _write_figures(place.under("figures"), findings, worst, ends)
    write_text(place.under("index.html"), report_page(findings, content, worst, ends))
    write_json(place.under("report.json"), content)
    return dict(plain(content))


def write_comparison(
    found: Comparison, folder: str | os.PathLike[str], *, threshold: float, cap: float
) -> dict[str, Any]:
    """Write `compare.html` (needs no network), `compare.json` and `compare.csv`, each whole.

    Args:
        found: what is compared.
        folder: where to, a local path or any fsspec URL; made where it does not exist.
        threshold: estimates above this are too large [m].
        cap: within which the 95 % quantile of a tile's estimates must stay [m].

    Returns:
        The content of `compare.json`.

    Raises:
        UsageError: a threshold or cap that is no positive length.
    """
    content = found.content(threshold, cap)
    place = Files.at(folder)
    place.make()
    write_csv(place.under("compare.csv"), found.rows)
    write_text(place.under("compare.html"), comparison_page(found, content))
    write_json(place.under("compare.json"), content)
    return content


def _write_figures(
    folder: Files,
    findings: Findings,
    worst: Sequence[View],
    ends: Sequence[bytes | str],
) -> list[str]:
    """Write what there is to draw; the names of the files."""
    drawn = {"map.png": pictures.map_figure(findings)}
    if len(findings.labels) or np.isfinite(estimates(findings.places)).any():
        drawn["distribution.png"] = pictures.distribution_figure(findings)
    if len(findings.labels):
        drawn["paths.png"] = pictures.paths_figure(findings)
    if len(findings.importances):
        drawn["importances.png"] = pictures.importances_figure(findings.importances)
    if len(findings.coverage):
        drawn["coverage.png"] = pictures.coverage_figure(findings.coverage)
    files = {name: pictures.png(figure) for name, figure in drawn.items()}
    of_places = {"worst": [view.picture for view in worst], "ends": ends}
    for what, pngs in of_places.items():
        named = {f"{what}_{n:02d}.png": data for n, data in enumerate(pngs, start=1)}
        files |= {name: data for name, data in named.items() if isinstance(data, bytes)}
    for name, data in files.items():
        folder.under(name).write(data)
    for old in folder.names():
        if OURS.fullmatch(old) and old not in files:
            folder.under(old).remove()
    return sorted(files)
