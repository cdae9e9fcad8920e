"""What is shown of the worst places: the map round them, what the lidar sees, where starts end."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tilestream.errors import TilestreamError
from tilestream.records import Float64
from tilestream.report.clouds import cloud
from tilestream.report.data import Findings
from tilestream.report.ends import ends_figure
from tilestream.report.formatting import cm, known
from tilestream.report.pictures import png, surroundings

NOT_SEEN: Float64 = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class View:
    """The surroundings of a place."""

    picture: bytes | str
    """From above, as PNG, or why there is no picture."""
    cloud: bytes | None = None
    """As a cloud that turns; None where there is no picture."""
    unseen: str = ""
    """Why it is not known what the lidar sees there; empty: it is."""


def view_of(findings: Findings, place: Mapping[str, Any]) -> View:
    """The surroundings of one of the worst places."""
    if findings.around is None:
        return View("the report was made without the map")
    if not all(known(place[name]) for name in ("x", "y", "z", "heading")):
        return View("the place has no position")
    at = np.array([place[name] for name in "xyz"], np.float64)
    try:
        points = findings.around(*at.tolist())
    except TilestreamError as error:
        return View(str(error))
    if not len(points):
        return View("no map points around it")
    seen, unseen = _seen(findings, at, place["heading"])
    errors = [float(place[name]) for name in ("estimate", "measured") if known(place[name])]
    red, green, blue = findings.scale.rgb(np.array([max(errors, default=np.nan)]))[0].tolist()
    return View(
        png(surroundings(points, at, place["heading"], seen)),
        cloud(points, at, place["heading"], red << 16 | green << 8 | blue, seen),
        unseen,
    )


def _seen(findings: Findings, at: Float64, heading: float) -> tuple[Float64, str]:
    """What the lidar sees at a place, or why that is not known."""
    if findings.seen is None:
        return NOT_SEEN, "no virtual scan was taken in this run"
    try:
        return findings.seen(at, heading), ""
    except TilestreamError as error:
        return NOT_SEEN, str(error)


def ends_of(findings: Findings, worst: Sequence[Mapping[str, Any]]) -> list[bytes | str]:
    """Where the starts of the worst measured places ended, as PNG, or why there is no picture."""
    if findings.ends is None:
        return ["the report was made without the tables of starts"] * len(worst)
    return [_ends(findings, place) for place in worst]


def _ends(findings: Findings, place: Mapping[str, Any]) -> bytes | str:
    assert findings.ends is not None
    try:
        rows = findings.ends(place["group"], place["sample"])
    except TilestreamError as error:
        return str(error)
    title = f"{place['path']}, {place['arc_length']:.0f} m\n{cm(place['error_mean'])}"
    return png(ends_figure(title, rows))
