"""The charts that answer to the mouse: Bokeh documents as plain JSON, the same bytes every time."""

import itertools
from typing import Any

import numpy as np
import pandas as pd
from bokeh.core.types import ID
from bokeh.embed import json_item
from bokeh.models import (
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    NumeralTickFormatter,
)
from bokeh.models.annotations.geometry import Span
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure

from tilestream.report.colours import (
    ACTUAL,
    AGAIN,
    CHOICES,
    HELD_OUT,
    HERE,
)
from tilestream.report.comparison import Comparison
from tilestream.report.data import Findings, estimates
from tilestream.report.formatting import CM_PER_M, cm, cm_about, cm_span
from tilestream.report.lines import path_lines, points_per_mark, with_gaps, worst_of_every
from tilestream.report.measured import measure_of

MOST_POINTS = 2_000
"""Points of a line; of more, the worst of every few."""
ROAD_TOOLS = "xpan,xwheel_zoom,xbox_zoom,reset"
PATH_TIP = [
    ("along", "@arc{0.0} m"),
    ("measured", "@measured"),
    ("estimate", "@shown"),
    ("interval", "@interval"),
]
ROUTE_TIP = [("choice", "@choice"), ("along", "@arc{0.0} m"), ("estimate", "@shown")]
DASHES = ("solid", "dashed", "dotted", "dotdash")
"""Of the lines of a comparison: the next of them after each turn of the colours."""


def path_chart(found: Findings, path: str, target: str) -> dict[str, Any]:
    """Measured error and held-out estimate along a path: a line per drive, the interval a band.

    The data sources are named by their group, and `estimate`; lengths in centimetres.
    """
    plot = new_road(280, "error [cm]")
    lines = path_lines(found, path)
    band(plot, lines.estimate)
    for number, (group, columns) in enumerate(lines.measured.items()):
        plot.line(
            "arc",
            "measured",
            source=ColumnDataSource(columns, name=group),
            color=AGAIN if number else ACTUAL,
            line_width=1.6,
            line_dash=(5, 3) if number else "solid",
            legend_label=f"measured, {group}" if len(lines.measured) > 1 else "measured",
        )
    source = ColumnDataSource(lines.estimate, name="estimate")
    if np.isfinite(lines.estimate["estimate"]).any():
        label = "estimate of a model without this path"
        style: dict[str, Any] = {"color": HELD_OUT, "line_width": 1.8, "legend_label": label}
        plot.line("arc", "estimate", source=source, **style)
    anchor = plot.line("arc", "anchor", source=source, line_alpha=0.0)
    plot.add_tools(hover(anchor, PATH_TIP, mode="vline"))
    finish(plot)
    return item(plot, target)


def profile_chart(found: Findings, route_id: str, target: str) -> dict[str, Any]:
    """The estimate along a route with its interval, and squares where errors were measured; of a
    long route the worst of every few places. A click shows the place on the map.

    The data sources are named `profile` and `measured`; lengths in centimetres, x and y [m, map
    frame].
    """
    plot = new_road(270, "error [cm]")
    plot.name, plot.tags = "profile", [route_id]  # by which the page finds it
    rows = found.places[found.places["route_id"].astype(str) == route_id]
    estimate, measured = estimates(rows), measure_of(rows).measured
    every = points_per_mark(len(rows), MOST_POINTS)
    kept = worst_of_every(every, rows["route_id"].to_numpy(), np.fmax(estimate, measured))
    rows, estimate, measured = rows.iloc[kept], estimate[kept], measured[kept]
    low, high = (rows[name].to_numpy(np.float64) for name in ("low", "high"))
    columns: dict[str, Any] = {
        "arc": rows["arc_length"].to_numpy(np.float64),
        "estimate": estimate * CM_PER_M,
        "low": low * CM_PER_M,
        "high": high * CM_PER_M,
        "measured": [cm(error) for error in measured],
        "shown": [cm_about(error, found.digits) for error in estimate],
        "interval": [cm_span(a, b, found.digits) for a, b in zip(low, high, strict=True)],
        **{axis: rows[axis].to_numpy(np.float64) for axis in "xy"},
    }
    band(plot, columns)
    source = ColumnDataSource(columns, name="profile")
    of_line: dict[str, Any] = {"color": HELD_OUT, "line_width": 1.8, "legend_label": "estimate"}
    line = plot.line("arc", "estimate", source=source, **of_line)
    there = np.flatnonzero(np.isfinite(measured))
    if there.size:
        squares = {"arc": columns["arc"][there], "error": measured[there] * CM_PER_M}
        style: dict[str, Any] = {
            "marker": "square",
            "size": 6,
            "color": ACTUAL,
            "legend_label": "measured",
        }
        plot.scatter("arc", "error", source=ColumnDataSource(squares, name="measured"), **style)
    here: dict[str, Any] = {"line_color": HERE, "line_width": 2, "line_dash": "dashed"}
    plot.add_layout(Span(dimension="height", name="here", visible=False, location=0.0, **here))
    plot.add_tools(hover(line, PATH_TIP, mode="vline"))
    finish(plot)
    return item(plot, target)


def band(
    plot: figure, columns: dict[str, Any], colour: str = HELD_OUT, name: str = "its interval"
) -> None:
    """The interval as a polygon per unbroken stretch."""
    known = np.flatnonzero(np.isfinite(columns["low"]) & np.isfinite(columns["arc"]))
    runs = [run for run in np.split(known, np.flatnonzero(np.diff(known) != 1) + 1) if run.size > 1]
    if runs:
        arc, low, high = (columns[name] for name in ("arc", "low", "high"))
        plot.patches(
            [np.concatenate([arc[r], arc[r][::-1]]).tolist() for r in runs],
            [np.concatenate([low[r], high[r][::-1]]).tolist() for r in runs],
            color=colour,
            alpha=0.18,
            line_width=0,
            legend_label=name,
        )


def route_chart(found: Comparison, route_id: str, target: str) -> dict[str, Any]:
    """The estimates along a route, a line per choice, as an item for `Bokeh.embed.embed_item`.

    The data sources are named after the choices; lengths in centimetres.
    """
    plot = new_road(340, "estimated error [cm]")
    rows = found.rows[found.rows["route_id"] == route_id]
    every = line_shows_every(found)
    styles = itertools.cycle(itertools.product(DASHES, CHOICES))
    for choice, (dash, colour) in zip(found.choices["choice"], styles, strict=False):
        columns = _line(rows[rows["choice"] == choice], every)
        source = ColumnDataSource(columns | {"choice": [choice] * len(columns["arc"])}, name=choice)
        style: dict[str, Any] = {"color": colour, "line_dash": dash, "line_width": 1.7}
        line = plot.line("arc", "estimate", source=source, legend_label=choice, **style)
        # a place between two without an estimate has no line
        plot.scatter("arc", "estimate", source=source, size=3, color=colour, legend_label=choice)
        plot.add_tools(hover(line, ROUTE_TIP, mode="mouse", line_policy="nearest"))
    finish(plot)
    plot.legend.ncols = 4
    return item(plot, target)


def line_shows_every(found: Comparison) -> int:
    """How many consecutive sample points one point of a line stands for; it shows their worst."""
    return points_per_mark(
        int(found.rows.groupby(["choice", "route_id"]).size().max()), MOST_POINTS
    )


def _line(rows: pd.DataFrame, every: int) -> dict[str, Any]:
    """A choice along a route; NaN where its line is to be broken."""
    estimate = rows["vd_mean"].to_numpy(np.float64)
    worst = worst_of_every(every, rows["route_id"].to_numpy(), estimate)
    arc, estimate = rows["arc_length"].to_numpy(np.float64)[worst], estimate[worst]
    breaks = with_gaps(arc) if every == 1 else np.zeros(0, np.int64)
    shown = np.array([cm(e) for e in estimate], dtype=object)
    return {
        "arc": np.insert(arc, breaks, np.nan),
        "estimate": np.insert(estimate * CM_PER_M, breaks, np.nan),
        "shown": np.insert(shown, breaks, "").tolist(),
    }


def hover(glyphs: "GlyphRenderer[Any]", tip: Any, **options: Any) -> HoverTool:
    """Shows what is under the mouse; no button of its own in the toolbar."""
    return HoverTool(
        renderers=[glyphs],
        tooltips=tip,
        visible=False,
        limit=1,
        point_policy="follow_mouse",
        **options,
    )


def new_road(height: int, y: str) -> figure:
    """An empty chart of errors along a road."""
    return new_plot(height, "along [m]", y, ROAD_TOOLS, y_range=DataRange1d(start=0))


def new_plot(height: int, x: str, y: str, tools: str, **options: Any) -> figure:
    """An empty chart as wide as the page, its axes named."""
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        tools=tools,
        x_axis_label=x,
        y_axis_label=y,
        output_backend="canvas",
        **options,
    )
    plot.toolbar.logo, plot.toolbar_location = None, "above"
    return plot


def finish(plot: figure) -> None:
    """Calm, and see-through, so that the page's own colours stand behind."""
    plot.background_fill_alpha = plot.border_fill_alpha = 0.0
    plot.outline_line_color = None
    plot.axis.axis_line_alpha = 0.4
    plot.axis.minor_tick_line_color = None
    plot.axis.formatter = NumeralTickFormatter(format="0[.]0")
    # Short and small: BokehJS 3.9 draws a wide label of the x axis twice, once off to the left.
    plot.axis.axis_label_text_font_size = "12px"
    plot.grid.grid_line_alpha = 0.35
    if plot.legend:
        plot.add_layout(plot.legend[0], "above")
        plot.legend.location = "left"
        plot.legend.spacing = 14
        plot.legend.margin = 0
        plot.legend.orientation = "horizontal"
        plot.legend.background_fill_alpha = 0.0
        plot.legend.border_line_alpha = 0.0
        plot.legend.click_policy = "hide"


def item(plot: figure, target: str) -> dict[str, Any]:
    """A chart as `Bokeh.embed.embed_item` takes it, to be drawn in the element `target`."""
    item: dict[str, Any] = _renumbered(json_item(plot, ID(target)), {})
    return item


def _renumbered(value: Any, ids: dict[str, str]) -> Any:
    """Bokeh numbers its models on from one chart to the next: each chart counts from 1 here."""
    if isinstance(value, list):
        return [_renumbered(item, ids) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: ids.setdefault(item, f"m{len(ids) + 1}")
        if key in ("id", "root_id") and isinstance(item, str)
        else _renumbered(item, ids)
        for key, item in value.items()
    }
