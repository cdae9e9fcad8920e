"""The sections about places: how large the error is estimated to be, where, and why."""

import base64
from collections.abc import Mapping
from typing import Any

from tilestream.report.charts import shown_every
from tilestream.report.colours import CLIP
from tilestream.report.findings import AROUND, Findings
from tilestream.report.judgement import APART, BRIDGE
from tilestream.report.pictures import ABOVE, BELOW, heights_ramp
from tilestream.report.summary import AXES, STARTS
from tilestream.report.words import (
    DASH,
    count,
    empty,
    esc,
    known,
    length,
    lengths,
    percent,
    plain_number,
    road,
    section,
    span,
    table,
)

MOST_REASONS = 8
"""Reasons for missing estimates that are listed; the rest is summed up."""
MOST_SEGMENTS = 15
"""Segments that the page lists; the file has all."""
MOST_PATHS = 24
"""Labelled paths that have a chart."""
MOST_ROUTES = 40
"""Routes that the page lists, the worst by their 95 % quantile; `report.json` has all."""


def cards(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures that a map team asks for first, and what each of them is."""
    head, limit = content["headline"], length(content["threshold"], 0)
    unlike = (percent(head["outside_share"]), "of the places unlike the training places")
    return [
        (road(head["length"]), f"of road, {count(head['places'])} sample points"),
        (length(head["median"]), "median estimated error"),
        (length(head["p95"]), "95 % of the places are estimated below this"),
        (length(head["max"]), "the highest estimate"),
        (
            percent(head["over_share"]),
            f"of the places over {limit}: {road(head['over_length'])} of road",
        ),
        *([unlike] if known(head["outside_share"]) else []),
        (count(head["labelled"]), "measured errors to train on and to judge by"),
        (count(head["missing"]), f"places without an estimate ({percent(head['missing_share'])})"),
    ]


def headline(content: Mapping[str, Any]) -> str:
    """The section that begins the page."""
    head, limit = content["headline"], length(content["threshold"], 0)
    over = f"{percent(head['over_share'])} over {limit}"
    body = '<div class="cards">' + "".join(
        f'<div class="card"><b>{figure}</b><span>{what}</span></div>'
        for figure, what in cards(content)
    )
    body += "</div>" + _missing(head) + _routes(content, limit)
    if not head["estimated"]:
        meaning = "No place has an estimate; below is why."
    else:
        meaning = (
            f"Half of the places are estimated below {length(head['median'])}, and {over}; an "
            "estimate is the mean 3D error that a vehicle's scan matching is expected to have "
            "there."
        )
    return section("headline", "In short", meaning, body)


def _missing(head: Mapping[str, Any]) -> str:
    reasons = list(head["missing_by_reason"].items())
    if not reasons:
        return empty("Every place has an estimate.")
    rows = [[esc(reason), count(number)] for reason, number in reasons[:MOST_REASONS]]
    if rest := reasons[MOST_REASONS:]:
        rows.append([f"{len(rest)} other reasons", count(sum(number for _, number in rest))])
    return "<h3>Places without an estimate</h3>" + table(["why", "places"], rows, "narrow")


def _routes(content: Mapping[str, Any], limit: str) -> str:
    head = ["route", "length", "places", "median", "95 %", "highest", f"over {limit}", "unlike",
            "no estimate"]  # fmt: skip
    rows = [
        [
            esc(r["route_id"]),
            road(r["length"]),
            count(r["places"]),
            length(r["median"]),
            length(r["p95"]),
            length(r["max"]),
            percent(r["over_share"]),
            percent(r["outside_share"]) if known(r["outside_share"]) else DASH,
            count(r["missing"]),
        ]
        for r in _listed(content["routes"])
    ]
    more = len(content["routes"]) - len(rows)
    note = f"<p>{more} routes with lower estimates are in <code>report.json</code>.</p>"
    return "<h3>By route</h3>" + table(head, rows) + (note if more else "")


def _listed(routes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    if len(routes) <= MOST_ROUTES:
        return routes
    return sorted(routes, key=lambda r: (-(r["p95"] or 0.0), r["route_id"]))[:MOST_ROUTES]


def city_map(found: Findings, content: Mapping[str, Any]) -> str:
    """The map, coloured by estimate."""
    every = shown_every(found.places)
    meaning = (
        "Every dot is a sample point, coloured and sized by its estimated error; colours end at "
        f"the {percent(CLIP, 0)} quantile of the estimates, and what lies above has the last "
        "colour. Point at one for its interval and reason (of several, the worst is shown); click "
        "a name in the legend to hide it."
    )
    if every > 1:
        meaning += f" Each dot stands for {every} consecutive sample points and shows the worst."
    body = '<div class="chart" id="city-map"></div>' + _segments(content)
    return section("map", "The map", meaning, body)


def _segments(content: Mapping[str, Any]) -> str:
    limit, found = length(content["threshold"], 0), content["segments"]
    title = f"<h3>Stretches over {limit}</h3>"
    if not found:
        return title + empty(f"No estimate exceeds {limit}.")
    ranked = sorted(found, key=lambda s: (-s["worst"], s["route_id"], s["begin"]))
    rows = [
        [
            esc(s["route_id"]),
            f"{s['begin']:.0f} to {s['end']:.0f} m",
            road(s["length"]),
            length(s["worst"]),
            length(s["mean"]),
            percent(s["p_fail"]),
            esc(s["reason"]) or DASH,
        ]
        for s in ranked[:MOST_SEGMENTS]
    ]
    head = ["route", "from, to", "length", "worst", "mean", "starts that fail", "why at its worst"]
    more = len(found) - len(rows)
    note = f"<p>{more} more are in <code>over_threshold.geojson</code>.</p>" if more else ""
    told = (
        f"<p>Places over it at most {BRIDGE:.0f} m apart are one stretch; the mean is over all that"
        " lies in it.</p>"
    )
    return title + told + table(head, rows, "words") + note


def worst(content: Mapping[str, Any], pictures: Mapping[int, bytes | str]) -> str:
    """The worst places in words and from above.

    Args:
        content: the summary.
        pictures: PNG by number of the place, or why there is none.
    """
    rows = [
        [
            str(number),
            f"<b>{esc(p['route_id'])}</b>, {p['arc_length']:.0f}\u00a0m along" + _small(_at(p)),
            f"<b>{length(p['estimate'])}</b>" + _parts(p),
            span(p["low"], p["high"]),
            percent(p["p_fail"]),
            {True: "yes", False: "no"}.get(p["in_domain"], "not known"),
            esc(p["reason"] or "") or DASH,
        ]
        for number, p in enumerate(content["worst"], start=1)
    ]
    head = ["", "where", "estimate", "interval", "starts that fail", "like training", "why"]
    meaning = (
        f"The highest estimates that lie at least {APART:.0f} m apart, and what drives each of "
        "them; numbers as on the map. Below an estimate are its parts: along and across the road "
        "and in height; the floor, which starts within 1 m end with, and the tail, which farther "
        "ones add."
    )
    title = f"The worst {len(rows)} places" if len(rows) > 1 else "The worst place"
    if not rows:
        return section("worst", title, meaning, empty("No place has an estimate."))
    views = "".join(_view(n, p, pictures) for n, p in enumerate(content["worst"], start=1))
    body = table(head, rows, "words worst") + _HEIGHTS + f'<div class="views">{views}</div>'
    return section("worst", title, meaning, body)


def _parts(p: Mapping[str, Any]) -> str:
    """Of which directions and starts an estimate is made."""
    return "".join(_small(lengths({name: p[name] for name in kind})) for kind in (AXES, STARTS))


def _at(p: Mapping[str, Any]) -> str:
    return f"x {p['x']:.1f}, y {p['y']:.1f}" if known(p["x"]) and known(p["y"]) else "no position"


def _small(text: str) -> str:
    return f'<br><span class="small">{text}</span>'


def _view(number: int, p: Mapping[str, Any], pictures: Mapping[int, bytes | str]) -> str:
    """A place from above, or why there is no picture of it."""
    picture = pictures.get(number, "none was taken")
    if isinstance(picture, str):
        shown = f'<span class="none">no picture: {esc(picture)}</span>'
    else:
        data = base64.b64encode(picture).decode("ascii")
        text = f"The map round place {number} from above"
        shown = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    where = f"{esc(p['route_id'])}, {p['arc_length']:.0f}\u00a0m"
    return f"<figure>{shown}<figcaption><b>{number}</b> {where}</figcaption></figure>"


_HEIGHTS = (
    '<p class="ramp">Each picture is the map within '
    f"{AROUND:.0f} m from above, its y axis up, the arrow the direction of travel; height from the "
    f'lidar: {-BELOW:.0f}\u00a0m <span style="background:linear-gradient(to right,'
    f'{",".join(heights_ramp())})"></span> {ABOVE:.0f}\u00a0m and more</p>'
)


def paths(content: Mapping[str, Any]) -> str:
    """Measured against estimated error along each labelled path."""
    meaning = (
        "The measured error beside the estimate of a model that has never seen that path (the "
        "paper's Fig. 12 and 13, without its random split); the band should hold nine of ten "
        "measured errors."
    )
    body = "".join(
        f'<h3>Path {esc(p["path"])}</h3><p>{_of_path(p)}</p><div class="chart" id="path-{k}"></div>'
        for k, p in enumerate(content["paths"][:MOST_PATHS])
    )
    if more := len(content["paths"][MOST_PATHS:]):
        body += f"<p>{more} more paths are in <code>report.json</code>.</p>"
    why = "No place was labelled: without a log of scans there is no measured error to show."
    return section("paths", "Measured and estimated error", meaning, body or empty(why))


def _of_path(p: Mapping[str, Any]) -> str:
    drives = f"{len(p['groups'])} drives" if len(p["groups"]) > 1 else "one drive"
    text = f"{count(p['points'])} labels of {drives}, median {length(p['actual_median'])}"
    if not p["judged"]:
        return text + "; no model was trained without this path, so there is no estimate to show."
    text += (
        f"; estimates are off by {length(p['mae'])} on average, rank correlation "
        f"{plain_number(p['spearman'])}."
    )
    return text if p["interval"] else text + " No interval could be calibrated on the other paths."


def facts(content: Mapping[str, Any]) -> str:
    """What was run, with which settings, and whose data it is."""
    given = dict(content["facts"])
    lists = [(title, given.pop(name, [])) for name, title in _LISTS]
    single = {"tilestream": content["tilestream"], "CRS": content["crs"] or "none: a local frame"}
    single |= {name: value for name, value in given.items() if not isinstance(value, dict)}
    parts = [_facts("run", single)]
    parts += [_facts(name, value) for name, value in given.items() if isinstance(value, dict)]
    for title, sentences in lists:
        lines = [sentences] if isinstance(sentences, str) else list(sentences)
        if lines:
            items = "".join(f"<li>{esc(line)}</li>" for line in lines)
            parts.append(f"<h3>{title}</h3><ul>{items}</ul>")
    meaning = "With these versions and settings the same input gives the same figures."
    return section("facts", "Run facts", meaning, "".join(parts))


_LISTS = (("notes", "Notes"), ("attributions", "Data and attributions"))


def _facts(title: str, values: Mapping[str, Any]) -> str:
    rows = [[esc(name), esc(value)] for name, value in _flat("", values)]
    if not rows:
        return ""
    return f"<h3>{esc(title.replace('_', ' '))}</h3>" + table(["", ""], rows, "facts")


def _flat(prefix: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Nested facts as lines, the names joined by dots."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict):
            lines += _flat(f"{prefix}{name}.", value)
        elif isinstance(value, list):
            lines.append((f"{prefix}{name}", ", ".join(map(str, value)) or DASH))
        elif isinstance(value, bool):
            lines.append((f"{prefix}{name}", "yes" if value else "no"))
        elif isinstance(value, float):
            lines.append((f"{prefix}{name}", f"{value:.6g}"))
        else:
            lines.append((f"{prefix}{name}", DASH if value is None else str(value)))
    return lines
