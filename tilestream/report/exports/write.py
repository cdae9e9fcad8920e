"""The files of a report that other programs read."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from tilestream.errors import TilestreamError
from tilestream.files import Files
from tilestream.report.data import Findings
from tilestream.report.exports.foxglove import write_foxglove
from tilestream.report.exports.geopackage import write_geopackage
from tilestream.report.exports.lanelets import write_lanelets
from tilestream.report.exports.qgis_styles import style_over_threshold
from tilestream.report.exports.tables import (
    write_cloud,
    write_csv,
    write_geojson,
    write_geoparquet,
    write_text,
)

LANELETS = re.compile(r"lanelets(-\d+)?\.osm")
"""What we call copies of Lanelet2 maps."""


def write_for_others(
    place: Files, found: Findings, threshold: float, told: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Write the files of a report that other programs read, each of them whole or not there.

    Args:
        place: the folder.
        found: what is reported.
        threshold: estimates above this are too large [m].
        told: what is told of each segment over it (`segments` of the summary).

    Returns:
        `files`: the names of what was written; `not_written`: why others were not, by name, and one
        of an earlier report is removed then; and what is to be told of some: `not_in_cloud`: how
        many places have no position and are not in the cloud, `foxglove` (`write_foxglove`),
        `lanelet_maps`: by name `source` and the counts of `write_lanelets`.
    """
    written: dict[str, Any] = {}
    failed: dict[str, str] = {}
    writers = _writers(found, threshold, told)
    for name, write in writers.items():
        try:
            written[name] = write(place.under(name))
        except TilestreamError as error:
            failed[name] = str(error)
            place.under(name).remove()
    for old in place.names():
        if LANELETS.fullmatch(old) and old not in writers:
            place.under(old).remove()
    return {
        "files": list(written),
        "not_written": failed,
        "not_in_cloud": written.get("map.pcd"),
        "foxglove": written.get("foxglove.mcap"),
        "lanelet_maps": {name: told for name, told in written.items() if LANELETS.fullmatch(name)},
    }


def _writers(
    found: Findings, threshold: float, told: Sequence[Mapping[str, Any]]
) -> Mapping[str, Callable[[Files], Any]]:
    """What writes each file, by its name."""
    maps = {
        f"lanelets{f'-{number}' if number > 1 else ''}.osm": partial(
            write_lanelets, source=source, places=found.places
        )
        for number, source in enumerate(found.lanelet_maps, start=1)
    }
    return {
        "places.parquet": lambda file: write_geoparquet(file, found),
        "places.gpkg": lambda file: write_geopackage(file, found, threshold, told),
        "places.csv": lambda file: write_csv(file, found.places),
        "over_threshold.geojson": lambda file: write_geojson(file, found, threshold, told),
        "over_threshold.qml": lambda file: write_text(
            file, style_over_threshold(found.scale, threshold)
        ),
        "map.pcd": lambda file: write_cloud(file, found),
        "foxglove.mcap": lambda file: write_foxglove(file, found),
        **maps,
    }
