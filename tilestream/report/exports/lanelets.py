"""The estimates as tags on the lanelets of a Lanelet2 map."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import CorruptSourceError, SourceNotFoundError, foreign_errors
from tilestream.files import Files
from tilestream.formats.routes import with_tags
from tilestream.report.data import LaneletMap, estimates, interpolated, like_training
from tilestream.report.measured import measure_of
from tilestream.report.summary import by_reason

PREFIX = "tilestream:"
"""Of the keys of all our tags."""
LONGEST = 255
"""What OpenStreetMap's programs take for the value of a tag [characters]."""
NO_PLACE = "no sample point lies in it"
NO_ROUTE = "its lane is not among the routes of the run: shorter than their spacing, or left out"


def write_lanelets(file: Files, source: LaneletMap, places: pd.DataFrame) -> dict[str, Any]:
    """Write a copy of a Lanelet2 map whose lanelets have the estimates as tags; nothing else is
    changed, and tags of an earlier run are replaced.

    Of the sample points of its lane that lie in it, a lanelet has `tilestream:error`, the mean of
    their estimates, `tilestream:error_max`, the highest, and `tilestream:measured`, the largest
    measured error (all in metres), `tilestream:p_fail`, the highest estimated share of starts that
    fail, `tilestream:in_domain`, whether all are like the training places (`yes` or `no`),
    `tilestream:places`, how many they are, `tilestream:missing`, how many of them have no
    estimate, and `tilestream:interpolated`, how many were not evaluated. What is not known has no
    tag; a lanelet without any estimate has the reason in `tilestream:reason`. Lanelets that are not
    for vehicles, or whose bounds are broken, have none.

    Args:
        file: where to.
        source: the map.
        places: `Findings.places`.

    Returns:
        `source`: the map, `lanelets`: how many have tags, `estimated`: how many an estimate.

    Raises:
        SourceError: the map cannot be read.
    """
    path = Path(source.file)
    if not path.is_file():
        raise SourceNotFoundError(f"{source.file}: is no longer there")
    of_route = {str(name): part for name, part in places.groupby("route_id")}
    tags: dict[str, Mapping[str, str]] = {}
    for name, lane in source.lanes():
        if name is None or name not in of_route:
            tags |= {number: {f"{PREFIX}reason": NO_ROUTE} for number in lane.lanelets}
            continue
        part = of_route[name]
        arc = part["arc_length"].to_numpy(np.float64)
        within = np.searchsorted(lane.begins, arc, side="right") - 1
        for k, number in enumerate(lane.lanelets):
            told = _told(part[within == k])
            tags[number] = {f"{PREFIX}{key}": value for key, value in told.items()}
    with foreign_errors(CorruptSourceError, f"{source.file}: cannot be copied"):
        written = with_tags(path.read_bytes(), tags, PREFIX)
    file.write(written)
    estimated = sum(f"{PREFIX}error" in told for told in tags.values())
    return {"source": source.file, "lanelets": len(tags), "estimated": estimated}


def _told(places: pd.DataFrame) -> dict[str, str]:
    """What is to be said of the sample points of a lanelet."""
    if places.empty:
        return {"reason": NO_PLACE}
    estimate, measured = estimates(places), measure_of(places).measured
    known = np.isfinite(estimate)
    driven = {"measured": f"{np.nanmax(measured):.3f}"} if np.isfinite(measured).any() else {}
    counts = {"places": str(len(places))}
    if not known.any():
        reason = next(iter(by_reason(places["reason"])))
        return {"reason": shorten(reason, LONGEST, placeholder=" …"), **driven, **counts}
    between = interpolated(places)
    like = set(like_training(places[known & ~between]))
    told = like and "not known" not in like
    domain = {"in_domain": "no" if "no" in like else "yes"} if told else {}
    fail = places["p_fail"].max()
    return {
        "error": f"{estimate[known].mean():.3f}",
        "error_max": f"{estimate[known].max():.3f}",
        **({"p_fail": f"{fail:.3f}"} if np.isfinite(fail) else {}),
        **driven,
        **domain,
        **counts,
        **({} if known.all() else {"missing": str(int((~known).sum()))}),
        **({"interpolated": str(int(between.sum()))} if between.any() else {}),
    }
