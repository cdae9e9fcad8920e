"""A comparison as a folder: one page for people, the same for programs beside it."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from bokeh.models import ColumnDataSource, DataRange1d

from tilestream.report.charts import PATH_TOOLS, finish, hover, item_of, new_plot
from tilestream.report.comparison import QUANTILE, USUAL, Comparison
from tilestream.report.exports import write_csv, write_json, write_text
from tilestream.report.judgement import APART
from tilestream.report.page import document
from tilestream.report.summary import with_gaps
from tilestream.report.words import (
    CM_PER_M,
    DASH,
    count,
    empty,
    esc,
    known,
    length,
    percent,
    section,
    table,
)

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Of the choices, in turn (Okabe and Ito's palette) …"""
DASHES = ("solid", "dashed", "dotted", "dotdash")
"""… and the next of these after each turn."""
MOST_POINTS = 2_000
"""Points of a line; of more, the worst of every few."""
MOST_ROUTES = 24
"""Routes that have a chart."""
MOST_TILES = 60
"""Tiles that the page lists of each vehicle; `compare.json` has all."""
MOST_REASONS = 3
"""Reasons that the page gives for missing estimates of a choice."""
TITLE = "What suffices here"
CONTENTS = (
    ("choices", "Choices"),
    ("routes", "Along the routes"),
    ("differing", "Where they differ"),
    ("cell-sizes", "Cell size per tile"),
    ("facts", "Run facts"),
)
TIP = [("choice", "@choice"), ("along", "@arc{0.0} m"), ("estimate", "@shown")]


def write_comparison(
    found: Comparison, folder: str | Path, *, threshold: float, cap: float
) -> dict[str, Any]:
    """Write `compare.html` (needs no network), `compare.json` and `compare.csv`, each whole.

    Args:
        found: what is told.
        folder: where to; made where it does not exist.
        threshold: estimates above this are too large [m].
        cap: within which the 95 % quantile of a tile's estimates must stay [m].

    Returns:
        The content of `compare.json`.

    Raises:
        UsageError: a threshold or cap that is no positive length.
    """
    content = found.content(threshold, cap)
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    write_csv(place / "compare.csv", found.rows)
    write_text(place / "compare.html", comparison_page(found, content))
    write_json(place / "compare.json", content)
    return content


def comparison_page(found: Comparison, content: Mapping[str, Any]) -> str:
    """The page as HTML.

    Args:
        found: what is told.
        content: its `content`.
    """
    routes = content["routes"][:MOST_ROUTES]
    charts = [route_chart(found, name, f"route-{number}") for number, name in enumerate(routes)]
    parts = (
        _choices(content),
        _routes(content, _shown_every(found)),
        _differing(content),
        _cell_sizes(content),
        _facts(content),
    )
    return document(
        TITLE,
        "The localization error that each choice is expected to have along the same routes, "
        "estimated from the point-cloud map alone: which lidar, which range, which map resolution.",
        CONTENTS,
        "".join(parts),
        charts,
        missing="The charts need JavaScript; their figures are also in compare.csv.",
        footer=f"Made by tilestream {esc(content['tilestream'])}. The same figures for machines: "
        "<code>compare.json</code>, <code>compare.csv</code>.",
    )


def route_chart(found: Comparison, route_id: str, target: str) -> dict[str, Any]:
    """The estimates along a route, a line per choice, as an item for `Bokeh.embed.embed_item`.

    The data sources are named after the choices; lengths in centimetres.
    """
    plot = new_plot(
        340, "along [m]", "estimated error [cm]", PATH_TOOLS, y_range=DataRange1d(start=0)
    )
    rows = found.rows[found.rows["route_id"] == route_id]
    every = _shown_every(found)
    styles = itertools.product(DASHES, COLOURS)
    for choice, (dash, colour) in zip(found.choices["choice"], itertools.cycle(styles)):
        columns = _line(rows[rows["choice"] == choice], every)
        source = ColumnDataSource(columns | {"choice": [choice] * len(columns["arc"])}, name=choice)
        style: dict[str, Any] = {"color": colour, "line_dash": dash, "line_width": 1.7}
        line = plot.line("arc", "estimate", source=source, legend_label=choice, **style)
        # a place between two without an estimate has no line
        plot.scatter("arc", "estimate", source=source, size=3, color=colour, legend_label=choice)
        plot.add_tools(hover(line, TIP, mode="mouse", line_policy="nearest"))
    finish(plot)
    plot.legend.ncols = 4
    return item_of(plot, target)


def _line(rows: pd.DataFrame, every: int) -> dict[str, Any]:
    """A choice along a route; NaN where its line is to be broken."""
    estimate = rows["vd_mean"].to_numpy(np.float64)
    worst = [
        first + int(np.argmax(np.nan_to_num(estimate[first : first + every], nan=-1.0)))
        for first in range(0, len(estimate), every)
    ]
    arc, estimate = rows["arc_length"].to_numpy(np.float64)[worst], estimate[worst]
    breaks = with_gaps(arc) if every == 1 else np.zeros(0, np.int64)
    shown = np.array([length(e) for e in estimate], dtype=object)
    return {
        "arc": np.insert(arc, breaks, np.nan),
        "estimate": np.insert(estimate * CM_PER_M, breaks, np.nan),
        "shown": np.insert(shown, breaks, "").tolist(),
    }


def _shown_every(found: Comparison) -> int:
    """How many consecutive sample points one point of a line stands for; it shows their worst."""
    longest = int(found.rows.groupby(["choice", "route_id"]).size().max())
    return max(1, -(-longest // MOST_POINTS))


def _choices(content: Mapping[str, Any]) -> str:
    choices, limit = content["choices"], length(content["threshold"], 0)
    judged = [c for c in choices if known(c["p95"])]
    # one that is lost where others hold must not win by that
    ranked = sorted(judged, key=lambda c: (c["lost"], c["p95"], c["map_bytes"]))
    if not ranked:
        meaning = "No choice has an estimate anywhere; why is in the last column."
    elif len(ranked) == 1:
        meaning = (
            f"Along {_places(content)}, 95 % of the places are estimated below "
            f"{length(ranked[0]['p95'])} by {esc(ranked[0]['choice'])}."
        )
    else:
        best, worst = ranked[0], ranked[-1]
        meaning = (
            f"Along {_places(content)}, the least is estimated for {esc(best['choice'])}: "
            f"95 % of the places below {length(best['p95'])}; the most for "
            f"{esc(worst['choice'])}: {length(worst['p95'])}."
        )
    meaning += (
        " Figures are of the places that a choice has an estimate for; "
        "<i>lost</i> are those that only others have one for."
    )
    head = ["choice", "median", "95 %", "highest", f"over {limit}", "starts that fail", "lost",
            "cells of the map", "map", "places without an estimate"]  # fmt: skip
    rows = [
        [
            f"<b>{esc(c['choice'])}</b>",
            length(c["median"]),
            length(c["p95"]),
            length(c["max"]),
            percent(c["over_share"]),
            percent(c["p_fail"]),
            count(c["lost"]),
            count(c["cells"]),
            _size(c["map_bytes"]),
            _missing(c["missing"]),
        ]
        for c in choices
    ]
    return section("choices", "The choices", meaning, table(head, rows, "words"))


def _places(content: Mapping[str, Any]) -> str:
    n = len(content["routes"])
    return f"{count(content['places'])} sample points of {n} route{'s' if n > 1 else ''}"


def _missing(reasons: Mapping[str, int]) -> str:
    if not reasons:
        return DASH
    shown = [f"{count(n)}: {esc(why)}" for why, n in list(reasons.items())[:MOST_REASONS]]
    rest = list(reasons.values())[MOST_REASONS:]
    if rest:
        shown.append(f"{count(sum(rest))}: {len(rest)} other reasons")
    return "<br>".join(shown)


def _size(size: Any) -> str:
    """A size in memory."""
    return f"{size / 1e6:,.1f}\u00a0MB".replace(",", "\u202f") if known(size) else DASH


def _routes(content: Mapping[str, Any], every: int) -> str:
    meaning = (
        "The mean 3D error of the virtual drive along each route; a line ends where a choice has "
        "no estimate. Click a name in the legend to hide it."
    )
    if every > 1:
        meaning += f" Each point stands for {every} consecutive sample points and shows the worst."
    body = "".join(
        f'<h3>{esc(name)}</h3><div class="chart" id="route-{number}"></div>'
        for number, name in enumerate(content["routes"][:MOST_ROUTES])
    )
    if more := len(content["routes"][MOST_ROUTES:]):
        body += f"<p>{more} more routes are in <code>compare.csv</code>.</p>"
    return section("routes", "Along the routes", meaning, body)


def _differing(content: Mapping[str, Any]) -> str:
    rows = [
        [
            f"<b>{esc(p['route_id'])}</b>, {p['arc_length']:.0f}\u00a0m along",
            f"x {p['x']:.1f}, y {p['y']:.1f}",
            f"<b>{length(p['difference'])}</b>",
            f"{length(p['best_estimate'])}, {esc(p['best'])}",
            f"{length(p['worst_estimate'])}, {esc(p['worst'])}",
        ]
        for p in content["differing"]
    ]
    meaning = (
        "The places where it matters most what is chosen, by the difference between the largest "
        f"and the smallest estimate, at least {APART:.0f} m apart."
    )
    head = ["where", "in the map", "difference", "smallest", "largest"]
    why = "There is no place where two choices have estimates that differ."
    body = table(head, rows, "words") if rows else empty(why)
    return section("differing", "Where the choices differ most", meaning, body)


def _cell_sizes(content: Mapping[str, Any]) -> str:
    cap = length(content["cap"], 0)
    meaning = (
        f"The largest compared cell size in each tile with which the {percent(QUANTILE, 0)} "
        f"quantile of the estimates stays within {cap}. Each estimate is that of a map of one "
        "cell size throughout; a tile without sample points keeps the smallest."
    )
    body = "".join(_of_vehicle(vehicle, cap) for vehicle in content["cell_sizes"])
    why = "Only one cell size was compared: give several to choose among."
    return section("cell-sizes", "Cell size per tile", meaning, body or empty(why))


def _of_vehicle(vehicle: Mapping[str, Any], cap: str) -> str:
    whole = [f"of the chosen sizes: {_size(vehicle['map_bytes'])}"]
    whole.append(f"{_saved(vehicle, 'finest_bytes')} of the smallest size everywhere")
    if known(vehicle["usual_bytes"]):
        whole.append(f"{_saved(vehicle, 'usual_bytes')} of {USUAL:g} m everywhere")
    over = len(vehicle["over"])
    told = (
        f"<p>{count(over)} tiles stay over {cap} with every size and have the best one.</p>"
        if over
        else ""
    )
    lines = sorted(
        vehicle["tiles"], key=lambda t: (t["suffices"] is not False, not t["places"], t["tile"])
    )
    rows = [
        [
            esc(t["tile"]),
            f"{t['cell_size']:g}\u00a0m",
            length(t["p95"]) if known(t["p95"]) else DASH,
            count(t["places"]),
            count(t["cells"]),
            _verdict(t, cap),
        ]
        for t in lines[:MOST_TILES]
    ]
    head = ["tile", "cell size", f"{percent(QUANTILE, 0)} estimate", "places", "cells", ""]
    more = len(lines) - len(rows)
    note = f"<p>{more} more tiles are in <code>compare.json</code>.</p>" if more else ""
    return (
        f"<h3>{esc(vehicle['vehicle'])}</h3><p>The map {'; '.join(whole)}.</p>{told}"
        + table(head, rows, "words")
        + note
    )


def _saved(vehicle: Mapping[str, Any], other: str) -> str:
    """How much smaller than another map the one of the chosen sizes is."""
    theirs = vehicle[other]
    if not theirs:
        return f"{_size(theirs)} is that"
    saved = 1.0 - vehicle["map_bytes"] / theirs
    return f"{percent(abs(saved), 0)} {'less' if saved >= 0.0 else 'more'} than {_size(theirs)}"


def _verdict(tile: Mapping[str, Any], cap: str) -> str:
    if tile["suffices"] is None:
        return "no estimate to judge by" if tile["places"] else "no sample points"
    return "suffices" if tile["suffices"] else f"<b>over {cap} with every size</b>"


def _facts(content: Mapping[str, Any]) -> str:
    facts = {"tilestream": content["tilestream"], **content["facts"]}
    rows = [[esc(name.replace("_", " ")), esc(value)] for name, value in facts.items()]
    meaning = "With these versions and settings the same map gives the same figures."
    return section("facts", "Run facts", meaning, table(["", ""], rows, "facts"))
