"""The charts that answer to the mouse: Bokeh documents as plain JSON, the same bytes every time."""

import base64
import itertools
from typing import Any

import numpy as np
import pandas as pd
from bokeh.core.types import ID
from bokeh.embed import json_item
from bokeh.models import (
    ColumnDataSource,
    DataRange1d,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    NumeralTickFormatter,
)
from bokeh.models.annotations.labels import Label
from bokeh.models.annotations.legends import ColorBar, ScaleBar
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure
from numpy.typing import NDArray

from tilestream.from_above import FromAbove
from tilestream.records import Float64, Int64
from tilestream.report.colours import (
    ACTUAL,
    AGAIN,
    CHOICES,
    HELD_OUT,
    MISSING,
    Scale,
)
from tilestream.report.comparison import Comparison
from tilestream.report.data import Findings, estimates, like_training
from tilestream.report.formatting import CM_PER_M, cm, cm_about, cm_by_name, cm_span, percent
from tilestream.report.lines import path_lines, points_per_mark, with_gaps, worst_of_every
from tilestream.report.measured import measure_of
from tilestream.report.relief import relief_png
from tilestream.report.segments import worst_places
from tilestream.report.summary import AXES, STARTS

MOST = 20_000
"""Places drawn on the map; of more, the worst of every few along a route."""
MOST_POINTS = 2_000
"""Points of a line; of more, the worst of every few."""
MAP_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
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
NUMBER: dict[str, Any] = {
    "text_color": "#ffffff",
    "text_font_size": "11px",
    "text_font_style": "bold",
    "text_align": "center",
    "text_baseline": "bottom",
    "y_offset": -9,
    "background_fill_color": "#111111",
    "border_line_color": "#ffffff",
    "border_radius": 8,
    "padding": 4,
}
"""How the number of one of the worst places looks."""
HERE = "#d55e00"
"""Of the ring round the place that the page's address names."""
SCALE_BAR: dict[str, Any] = {
    "unit": "m",
    "location": "bottom_left",
    "orientation": "horizontal",
    "background_fill_alpha": 0.0,
    "border_line_alpha": 0.0,
    "bar_line_color": "#828a94",
}
NORTH: dict[str, Any] = {
    "x": 16,
    "y": 52,
    "x_units": "screen",
    "y_units": "screen",
    "text": "N ↑",
    "text_font_size": "13px",
}


def city_map(found: Findings, tip: str) -> dict[str, Any]:
    """The sample points coloured by estimate, the worst on top and numbered, as an item for
    `Bokeh.embed.embed_item`.

    The data sources are named `above`, `in_domain`, `outside`, `unjudged`, `missing`, `measured`,
    `worst` and `here`.

    Args:
        found: what is reported.
        tip: HTML that a point shows under the mouse, with `@` before the name of a column.
    """
    places = found.places
    estimate = estimates(places)
    plot = _new_plot(600, "x", "y", MAP_TOOLS, match_aspect=True)
    drawn = worst_of_every(map_shows_every(found), places["route_id"], estimate)
    origin = _origin(places)
    _draw_map(plot, found.above, origin)
    kinds = _kinds(places)
    mapper = LinearColorMapper(palette=found.scale.colours, low=0, high=len(found.scale.colours))
    for kind, marker, name in (
        ("in_domain", "circle", "like the training places"),
        ("outside", "diamond", "unlike the training places"),
        ("unjudged", "circle", "estimated without training"),
        ("missing", "x", "no estimate"),
    ):
        rows = drawn[kinds[drawn] == kind]
        if not rows.size:
            continue
        rows = rows[np.argsort(estimate[rows], kind="stable")]
        source = ColumnDataSource(_columns(found, rows, origin), name=kind)
        style: dict[str, Any] = (
            {"color": MISSING, "size": 7, "line_width": 1.5}
            if kind == "missing"
            else {"color": {"field": "step", "transform": mapper}, "size": "size"}
        )
        glyphs = plot.scatter("x", "y", source=source, marker=marker, legend_label=name, **style)
        # of the dots under the mouse the worst, which is the one on top
        plot.add_tools(_hover(glyphs, tip, sort_by=[("estimate", -1)]))
    _draw_measured(plot, found, origin, (tip, mapper))
    _number_the_worst(plot, places, origin)
    plot.name, plot.tags = "city-map", origin.tolist()  # by which the page finds a place on it
    here = ColumnDataSource({"x": [], "y": []}, name="here")
    plot.scatter("x", "y", source=here, size=26, fill_alpha=0.0, line_width=3, line_color=HERE)
    if np.isfinite(estimate).any():
        plot.add_layout(_colour_bar(found.scale, mapper), "below")
    plot.xaxis.axis_label, plot.yaxis.axis_label = (
        f"{axis} [m] from {value:.0f} on" if value else f"{axis} [m]"
        for axis, value in zip("xy", origin, strict=True)
    )
    _finish(plot)
    return _item(plot, "city-map")


def _draw_map(plot: figure, above: FromAbove | None, origin: Float64) -> None:
    """The map itself below all else, how long it is, and where north is."""
    plot.add_layout(ScaleBar(**SCALE_BAR))
    plot.add_layout(Label(**NORTH))
    if above is None:
        return
    data = base64.b64encode(relief_png(above)).decode()
    rows, columns = above.height.shape
    plot.image_url(
        url="url",
        source=ColumnDataSource({"url": [f"data:image/png;base64,{data}"]}, name="above"),
        x=above.corner[0] - origin[0],
        y=above.corner[1] - origin[1],
        w=columns * above.pixel,
        h=rows * above.pixel,
        anchor="bottom_left",
        level="underlay",
    )


def _colour_bar(scale: Scale, mapper: LinearColorMapper) -> ColorBar:
    """Equally wide steps, with the error between two of them; below the map, which is narrow on
    a phone.
    """
    return ColorBar(
        color_mapper=mapper,
        title="error [cm]",
        height=12,
        padding=4,
        ticker=FixedTicker(ticks=list(range(1, len(scale.colours)))),
        major_label_overrides={
            k: f"{edge * CM_PER_M:.3g}" for k, edge in enumerate(scale.edges, start=1)
        },
        background_fill_alpha=0.0,
    )


def map_shows_every(found: Findings) -> int:
    """How many consecutive sample points one dot of the map stands for; it shows their worst."""
    return points_per_mark(len(found.places), MOST)


def _kinds(places: pd.DataFrame) -> NDArray[np.str_]:
    known = np.isfinite(estimates(places))
    names = {"yes": "in_domain", "no": "outside", "not known": "unjudged"}
    return np.where(known, [names[like] for like in like_training(places)], "missing")


def _origin(places: pd.DataFrame) -> Float64:
    """A round corner near the places, so that axes need not show seven digits [m]."""
    at = places[["x", "y"]].to_numpy(np.float64)
    at = at[np.isfinite(at).all(axis=1)]
    corner = np.floor(at.min(axis=0) / 1000.0) * 1000.0 if len(at) else np.zeros(2)
    return np.where(np.abs(corner) >= 10_000.0, corner, 0.0)


def _columns(found: Findings, rows: Int64, origin: Float64) -> dict[str, Any]:
    part, digits = found.places.iloc[rows], found.digits
    estimate = estimates(part)
    step = found.scale.step(estimate)
    share = np.clip(step, 0, None) / (len(found.scale.colours) - 1)
    figures = part[["low", "high", "p_fail", *AXES, *STARTS]].to_dict("records")
    return {
        "x": part["x"].to_numpy(np.float64) - origin[0],
        "y": part["y"].to_numpy(np.float64) - origin[1],
        "estimate": estimate * CM_PER_M,
        "step": step + 0.5,
        "size": 5.0 + 7.0 * share,
        "route": part["route_id"].astype(str).tolist(),
        "arc": part["arc_length"].to_numpy(np.float64),
        "shown": [
            f"{cm_about(e, digits)}{f', measured {cm(m)}' if np.isfinite(m) else ''}"
            for e, m in zip(estimate, measure_of(part).measured, strict=True)
        ],
        "interval": [cm_span(of["low"], of["high"], digits) for of in figures],
        "fail": [percent(of["p_fail"]) for of in figures],
        "axes": [cm_by_name(of, AXES) for of in figures],
        "starts": [cm_by_name(of, STARTS) for of in figures],
        "domain": like_training(part).tolist(),
        "reason": part["reason"].fillna("").astype(str).tolist(),
    }


def _draw_measured(plot: figure, found: Findings, origin: Float64, how: tuple[str, Any]) -> None:
    """Squares in the colour of the error that was measured there, on top of the estimates."""
    tip, mapper = how
    measured = measure_of(found.places).measured
    rows = np.flatnonzero(np.isfinite(measured))
    if not rows.size:
        return
    every = points_per_mark(len(rows), MOST)
    route = found.places["route_id"].to_numpy()[rows]
    rows = rows[worst_of_every(every, route, measured[rows])]
    columns = _columns(found, rows, origin)
    columns["measured"] = measured[rows] * CM_PER_M
    columns["step"] = found.scale.step(measured[rows]) + 0.5
    source = ColumnDataSource(columns, name="measured")
    style: dict[str, Any] = {"fill_color": {"field": "step", "transform": mapper}}
    style |= {"marker": "square", "size": 9, "line_color": "black", "legend_label": "measured"}
    glyphs = plot.scatter("x", "y", source=source, **style)
    plot.add_tools(_hover(glyphs, tip, sort_by=[("measured", -1)]))


def _number_the_worst(plot: figure, places: pd.DataFrame, origin: Float64) -> None:
    rows = worst_places(places)
    if not rows:
        return
    at = places[["x", "y"]].to_numpy(np.float64)[rows] - origin
    source = ColumnDataSource(
        {"x": at[:, 0], "y": at[:, 1], "number": [str(k + 1) for k in range(len(rows))]},
        name="worst",
    )
    plot.text("x", "y", "number", source=source, **NUMBER)


def path_chart(found: Findings, path: str, target: str) -> dict[str, Any]:
    """Measured error and held-out estimate along a path: a line per drive, the interval a band.

    The data sources are named by their group, and `estimate`; lengths in centimetres.
    """
    plot = _new_road(280, "error [cm]")
    lines = path_lines(found, path)
    _band(plot, lines.estimate)
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
    plot.add_tools(_hover(anchor, PATH_TIP, mode="vline"))
    _finish(plot)
    return _item(plot, target)


def _band(plot: figure, columns: dict[str, Any]) -> None:
    """The interval as a polygon per unbroken stretch."""
    known = np.flatnonzero(np.isfinite(columns["low"]) & np.isfinite(columns["arc"]))
    runs = [run for run in np.split(known, np.flatnonzero(np.diff(known) != 1) + 1) if run.size > 1]
    if runs:
        arc, low, high = (columns[name] for name in ("arc", "low", "high"))
        plot.patches(
            [np.concatenate([arc[r], arc[r][::-1]]).tolist() for r in runs],
            [np.concatenate([low[r], high[r][::-1]]).tolist() for r in runs],
            color=HELD_OUT,
            alpha=0.18,
            line_width=0,
            legend_label="its interval",
        )


def route_chart(found: Comparison, route_id: str, target: str) -> dict[str, Any]:
    """The estimates along a route, a line per choice, as an item for `Bokeh.embed.embed_item`.

    The data sources are named after the choices; lengths in centimetres.
    """
    plot = _new_road(340, "estimated error [cm]")
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
        plot.add_tools(_hover(line, ROUTE_TIP, mode="mouse", line_policy="nearest"))
    _finish(plot)
    plot.legend.ncols = 4
    return _item(plot, target)


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


def _hover(glyphs: "GlyphRenderer[Any]", tip: Any, **options: Any) -> HoverTool:
    """Shows what is under the mouse; no button of its own in the toolbar."""
    return HoverTool(
        renderers=[glyphs],
        tooltips=tip,
        visible=False,
        limit=1,
        point_policy="follow_mouse",
        **options,
    )


def _new_road(height: int, y: str) -> figure:
    """An empty chart of errors along a road."""
    return _new_plot(height, "along [m]", y, ROAD_TOOLS, y_range=DataRange1d(start=0))


def _new_plot(height: int, x: str, y: str, tools: str, **options: Any) -> figure:
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


def _finish(plot: figure) -> None:
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


def _item(plot: figure, target: str) -> dict[str, Any]:
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
