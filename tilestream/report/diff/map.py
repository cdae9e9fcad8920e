"""The map of a comparison of two maps: tiles that differ, and places by what became of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from bokeh.models import ColumnDataSource, LinearColorMapper
from bokeh.plotting import figure

from tilestream.records import Float64
from tilestream.report.charts import finish, hover, item, new_plot
from tilestream.report.city_map import (
    MAP_TOOLS,
    MOST,
    colour_bar,
    draw_map,
    mark_here,
    name_axes,
    number_the_worst,
    origin_of,
)
from tilestream.report.colours import FIXED, MISSING, Scale
from tilestream.report.diff.data import MapDiff
from tilestream.report.formatting import DASH, cm_about, cm_span, known
from tilestream.report.lines import points_per_mark, worst_of_every

MOST_OUTLINES = 10_000
"""Tiles of a kind that are outlined; `diff.json` has all."""
MOST_NUMBERS = 10
"""Stretches that got worse that have a number on the map, as in their table."""
CHANGES = (-0.20, -0.10, -0.05, -0.02, 0.02, 0.05, 0.10, 0.20)
"""Changes at which the colour changes [m]: the same in every comparison."""
SHADES = (
    "#2166ac", "#4393c3", "#77b3d6", "#a5cde3", "#bdbdbd", "#fdc27a", "#f19a38", "#dd7a1a",
    "#b35806",
)  # fmt: skip
"""Blue: better; orange: worse; told apart by the colour-blind, and seen on light and on dark."""
SHOWN = ("change", "before", "after")
"""What may colour the places; the page lets one choose."""
MARKERS = (
    # what became of a place, its marker and its name, from the lowest to the one on top
    ("neither", "dot", "no estimate"),
    ("alike", "circle", "as before"),
    ("left", "asterisk", "left out"),
    ("appeared", "plus", "new"),
    ("better", "inverted_triangle", "better"),
    ("worse", "triangle", "worse"),
    ("lost", "x", "lost"),
)
INTERPOLATED = ("interpolated_before", "interpolated_after")
"""A mark is hollow and small where one of these holds …"""
SMALLER = 0.6
"""… by so much."""
OUTLINES = {
    "changed": {"line_dash": "solid", "line_color": "#8560a8", "hatch_pattern": "/"},
    "added": {"line_dash": "dashed", "line_color": "#009e73", "hatch_pattern": "+"},
    "removed": {"line_dash": "dotted", "line_color": "#b5458c", "hatch_pattern": "x"},
}
"""How tiles that differ are told apart: by line and hatching, not by colour alone."""


@dataclass(frozen=True)
class ChangeScale(Scale):
    """From a change to one of a few colours."""

    @cached_property
    def colours(self) -> list[str]:
        """From better to worse."""
        return list(SHADES)


CHANGE = ChangeScale(CHANGES)
"""The scale of changes of all comparisons."""


def diff_map(found: MapDiff, tip: str) -> dict[str, Any]:
    """Tiles that differ and places on the newer map, as an item for `Bokeh.embed.embed_item`.

    The data sources are named after what became of places (`MARKERS`) and of tiles (`OUTLINES`),
    `above`, `worst` and `here`. Places are coloured by the column `step`, which the page takes from
    `change`, `before` or `after`: an index into the colours of errors, and of changes behind them.

    Args:
        found: what is compared.
        tip: HTML that a place shows under the mouse, with `@` before the name of a column.
    """
    plot = new_plot(600, "x", "y", MAP_TOOLS, match_aspect=True)
    table = _table(found)
    origin = origin_of(table if len(table) else _corners(found))
    draw_map(plot, found.above(), origin)
    for kind, how in OUTLINES.items():
        _outline(plot, found, kind, how, origin)
    colours = [*FIXED.colours, *CHANGE.colours]
    mapper = LinearColorMapper(palette=colours, low=0, high=len(colours), low_color=MISSING)
    for kind, marker, name in MARKERS:
        rows = table[table["kind"] == kind]
        if rows.empty:
            continue
        source = ColumnDataSource(_columns(rows, origin, found.digits), name=kind)
        style: dict[str, Any] = {"color": {"field": "step", "transform": mapper}, "size": "size"}
        style["fill_alpha"] = "filled"
        if kind in ("lost", "left"):
            style |= {"line_width": 2.0}
        glyphs = plot.scatter("x", "y", source=source, marker=marker, legend_label=name, **style)
        plot.add_tools(hover(glyphs, tip, sort_by=[("weight", -1)]))
    number_the_worst(plot, found.places.stretches.head(MOST_NUMBERS), origin)
    mark_here(plot, origin)
    if len(table):
        for scale, title, of in ((FIXED, "error [cm]", "error"), (CHANGE, "change [cm]", "change")):
            own = LinearColorMapper(palette=scale.colours, low=0, high=len(scale.colours))
            bar = colour_bar(scale, own, title)
            bar.name, bar.visible = of, of == "change"
            plot.add_layout(bar, "below")
    name_axes(plot, origin)
    finish(plot)
    if plot.legend:
        plot.legend.spacing, plot.legend.ncols = 6, 2  # as many as a phone has room for
    return item(plot, "city-map")


def places_shown_every(found: MapDiff) -> int:
    """How many consecutive sample points one mark of the map stands for."""
    return points_per_mark(len(found.places.places) + len(found.places.left), MOST)


def _table(found: MapDiff) -> pd.DataFrame:
    """The places that are drawn, those that changed most last, with `kind`, `change` and `weight`;
    of too many the one of every few that changed most.
    """
    of = found.places
    places = of.places.assign(kind=of.kind, change=of.change)
    left = of.left.assign(kind="left", interpolated_before=False, interpolated_after=False)
    table = pd.concat([part for part in (places, left) if len(part)] or [places])
    gone = table["kind"].isin(["lost", "left", "appeared"])
    weight = table["change"].abs().astype(np.float64).fillna(0.0).mask(gone, np.inf)
    table = table.assign(weight=weight).reset_index(drop=True)
    kept = worst_of_every(places_shown_every(found), table["route_id"], table["weight"].to_numpy())
    return table.iloc[kept].sort_values("weight", kind="stable")


def _columns(rows: pd.DataFrame, origin: Float64, digits: int | None) -> dict[str, Any]:
    def of(name: str) -> Float64:
        return rows[name].to_numpy(np.float64)

    change = CHANGE.step(of("change"))
    lost = (rows["kind"] == "lost").to_numpy()
    last = len(FIXED.colours)
    steps = {
        "change": np.where(lost, last + len(SHADES) - 1, np.where(change < 0, -1, last + change)),
        "before": FIXED.step(of("before")),
        "after": FIXED.step(of("after")),
    }
    middle = len(SHADES) // 2
    hollow = rows[list(INTERPOLATED)].to_numpy(bool).any(axis=1)
    size = np.where(change < 0, 9.0, 5.0 + 1.5 * np.abs(change - middle))
    size = np.where(hollow, SMALLER * size, size)
    return {
        "x": of("x") - origin[0],
        "y": of("y") - origin[1],
        **{name: (step + 0.5).astype(np.float32) for name, step in steps.items()},
        "step": (steps["change"] + 0.5).astype(np.float32),
        "size": np.where(rows["kind"] == "neither", 5.0, size).astype(np.float32),
        "filled": (~hollow).astype(np.float32),
        "weight": np.nan_to_num(of("weight"), posinf=1e9).astype(np.float32),
        "route": rows["route_id"].astype(str).tolist(),
        "arc": of("arc_length").astype(np.float32),
        "grown": [_signed(one, digits) for one in of("change")],
        "was": _told(rows, "before", digits),
        "is": _told(rows, "after", digits),
        "why": rows["why"].mask(lost, rows["reason"]).fillna("").tolist(),
    }


def _signed(change: float, digits: int | None) -> str:
    """A change in words; a dash: nothing is compared."""
    return f"{'+' if change > 0.0 else ''}{cm_about(change, digits)}" if known(change) else DASH


def _told(rows: pd.DataFrame, when: str, digits: int | None) -> list[str]:
    """The estimates in words, with their intervals where there are some."""
    names = [when, f"low_{when}", f"high_{when}", f"interpolated_{when}"]
    found = []
    for estimate, low, high, between in rows[names].astype(np.float64).to_numpy().tolist():
        how = f" ({cm_span(low, high, digits)})" if np.isfinite([low, high]).all() else ""
        how = ", interpolated" if between else how
        found.append(f"{cm_about(estimate, digits)}{how}")
    return found


def _outline(
    plot: figure, found: MapDiff, kind: str, style: dict[str, Any], origin: Float64
) -> None:
    keys = getattr(found, kind)[:MOST_OUTLINES]
    if not keys:
        return
    low = np.array(keys, np.float64) * found.tile_size - origin
    source = ColumnDataSource(
        {
            "left": low[:, 0],
            "bottom": low[:, 1],
            "right": low[:, 0] + found.tile_size,
            "top": low[:, 1] + found.tile_size,
            "tile": [str(key) for key in keys],
        },
        name=kind,
    )
    quads = plot.quad(
        source=source,
        fill_alpha=0.0,
        line_width=2.0,
        hatch_color=style["line_color"],
        hatch_alpha=0.22,
        hatch_scale=16.0,
        legend_label=f"tile {kind}",
        level="underlay",
        **style,
    )
    plot.add_tools(hover(quads, f"tile @tile, {kind}"))


def _corners(found: MapDiff) -> pd.DataFrame:
    """Corners of the tiles that differ [m]."""
    keys: Sequence[Any] = (*found.added, *found.removed, *found.changed)
    low = np.array(keys, np.float64).reshape(-1, 2)
    return pd.DataFrame(np.concatenate([low, low + 1.0]) * found.tile_size, columns=["x", "y"])
