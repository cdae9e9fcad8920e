"""The charts that answer to the mouse: Bokeh documents as plain JSON, the same bytes every time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from bokeh.core.types import ID
from bokeh.embed import json_item
from bokeh.models import (
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    LinearColorMapper,
    NumeralTickFormatter,
)
from bokeh.models.annotations.legends import ColorBar
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure
from numpy.typing import NDArray

from tilestream.records import Float64
from tilestream.report.colours import ACTUAL, AGAIN, HELD_OUT, MISSING, palette, scale_of
from tilestream.report.findings import Findings, estimates, like_training
from tilestream.report.judgement import worst_places
from tilestream.report.summary import AXES, STARTS, held_out_along, interval_factor, with_gaps
from tilestream.report.words import CM_PER_M, length, lengths, percent, span

MOST = 20_000
"""Places drawn on the map; of more, the worst of every few along a route."""
MAP_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
PATH_TOOLS = "xpan,xwheel_zoom,xbox_zoom,reset"
PATH_TIP = [
    ("along", "@arc{0.0} m"),
    ("measured", "@measured"),
    ("estimate", "@shown"),
    ("interval", "@interval"),
]
MAP_TIP = (
    '<div style="max-width:24em;font:13px system-ui,sans-serif;color:#222">'
    "<b>@route</b>, @arc{0.0} m along<br>"
    "estimate <b>@shown</b><br>interval @interval<br>starts that fail: @fail<br>"
    "@axes<br>@starts<br>like the training places: @domain<br><i>@reason</i></div>"
)


def city_map(found: Findings) -> dict[str, Any]:
    """The sample points coloured by estimate, the worst on top and numbered, as an item for
    `Bokeh.embed.embed_item`.

    The data sources are named `in_domain`, `outside`, `unjudged`, `missing` and `worst`.
    """
    places = found.places
    estimate = estimates(places)
    scale, colours = scale_of(estimate), palette()
    plot = new_plot(600, "x", "y", MAP_TOOLS, match_aspect=True)
    drawn = _drawn(places)
    origin = _origin(places)
    kinds = _kinds(places)
    mapper = LinearColorMapper(
        palette=colours, low=scale.low * CM_PER_M, high=scale.high * CM_PER_M
    )
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
        source = ColumnDataSource(_columns(places, rows, origin), name=kind)
        style: dict[str, Any] = (
            {"color": MISSING, "size": 7, "line_width": 1.5}
            if kind == "missing"
            else {"color": {"field": "estimate", "transform": mapper}, "size": "size"}
        )
        glyphs = plot.scatter("x", "y", source=source, marker=marker, legend_label=name, **style)
        # of the dots under the mouse the worst, which is the one on top
        plot.add_tools(hover(glyphs, MAP_TIP, sort_by=[("estimate", -1)]))
    _number_the_worst(plot, places, origin)
    if np.isfinite(estimate).any():
        bar = ColorBar(color_mapper=mapper, title="estimated error [cm]", width=12, padding=4)
        bar.background_fill_alpha = 0.0
        plot.add_layout(bar, "right")
    plot.xaxis.axis_label, plot.yaxis.axis_label = (
        f"{axis} − {value:.0f} m" if value else f"{axis} [m]"
        for axis, value in zip("xy", origin, strict=True)
    )
    finish(plot)
    return item_of(plot, "city-map")


def shown_every(places: pd.DataFrame) -> int:
    """How many consecutive sample points one dot of the map stands for; it shows their worst."""
    return max(1, int(np.ceil(len(places) / MOST)))


def _drawn(places: pd.DataFrame) -> NDArray[np.int64]:
    """The rows that are drawn, ascending."""
    every = shown_every(places)
    if every == 1:
        return np.arange(len(places))
    estimate = np.nan_to_num(estimates(places), nan=-1.0)
    number = places.groupby("route_id").cumcount().to_numpy() // every
    keys = pd.DataFrame({"route": places["route_id"], "number": number, "estimate": estimate})
    return np.sort(keys.groupby(["route", "number"])["estimate"].idxmax().to_numpy(np.int64))


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


def _columns(places: pd.DataFrame, rows: NDArray[np.int64], origin: Float64) -> dict[str, Any]:
    part = places.iloc[rows]
    estimate = estimates(part)
    share = np.clip(scale_of(estimates(places)).step(estimate), 0, None) / 255.0
    names = ("low", "high", "p_fail", *AXES, *STARTS)
    value = {name: part[name].to_numpy(np.float64) for name in names}
    return {
        "x": part["x"].to_numpy(np.float64) - origin[0],
        "y": part["y"].to_numpy(np.float64) - origin[1],
        "estimate": estimate * CM_PER_M,
        "size": 5.0 + 7.0 * share,
        "route": part["route_id"].astype(str).tolist(),
        "arc": part["arc_length"].to_numpy(np.float64),
        "shown": [length(e) for e in estimate],
        "interval": [span(lo, hi) for lo, hi in zip(value["low"], value["high"], strict=True)],
        "fail": [percent(p) for p in value["p_fail"]],
        "axes": _told(value, AXES),
        "starts": _told(value, STARTS),
        "domain": like_training(part).tolist(),
        "reason": part["reason"].fillna("").astype(str).tolist(),
    }


def _told(value: Mapping[str, Float64], names: Sequence[str]) -> list[str]:
    """Lengths of each place in words."""
    rows = zip(*(value[name] for name in names), strict=True)
    return [lengths(dict(zip(names, row, strict=True))) for row in rows]


def _number_the_worst(plot: figure, places: pd.DataFrame, origin: Float64) -> None:
    rows = worst_places(places)
    if not rows:
        return
    at = places[["x", "y"]].to_numpy(np.float64)[rows] - origin
    source = ColumnDataSource(
        {"x": at[:, 0], "y": at[:, 1], "number": [str(k + 1) for k in range(len(rows))]},
        name="worst",
    )
    style: dict[str, Any] = {
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
    plot.text("x", "y", "number", source=source, **style)


def path_chart(found: Findings, path: str) -> dict[str, Any]:
    """Measured error and held-out estimate along a path: a line per drive, the interval a band.

    The data sources are named by their group, and `estimate`; lengths in centimetres.
    """
    labels = found.labels[found.labels["path"].astype(str) == path]
    factor = interval_factor(found.coverage, path)
    plot = new_plot(280, "along [m]", "error [cm]", PATH_TOOLS, y_range=DataRange1d(start=0))
    columns = _estimated(labels, factor)
    _band(plot, columns)
    drives = list(labels.groupby("group", sort=True))
    for number, (group, part) in enumerate(drives):
        plot.line(
            "arc",
            "measured",
            source=ColumnDataSource(_measured(part), name=str(group)),
            color=AGAIN if number else ACTUAL,
            line_width=1.6,
            line_dash=(5, 3) if number else "solid",
            legend_label=f"measured, {group}" if len(drives) > 1 else "measured",
        )
    source = ColumnDataSource(columns, name="estimate")
    if np.isfinite(columns["estimate"]).any():
        label = "estimate of a model without this path"
        style: dict[str, Any] = {"color": HELD_OUT, "line_width": 1.8, "legend_label": label}
        plot.line("arc", "estimate", source=source, **style)
    anchor = plot.line("arc", "anchor", source=source, line_alpha=0.0)
    plot.add_tools(hover(anchor, PATH_TIP, mode="vline"))
    finish(plot)
    return item_of(plot, f"path-{path}")


def _measured(part: pd.DataFrame) -> dict[str, Any]:
    """A drive along a path; NaN where its line is to be broken."""
    arc = part["arc_length"].to_numpy(np.float64)
    breaks = with_gaps(arc)
    measured = part["error_mean"].to_numpy(np.float64) * CM_PER_M
    return {
        "arc": np.insert(arc, breaks, np.nan),
        "measured": np.insert(measured, breaks, np.nan),
    }


def _estimated(labels: pd.DataFrame, factor: float | None) -> dict[str, Any]:
    """The estimate at each labelled place of a path, its interval, and what was measured there."""
    along = held_out_along(labels, factor)
    arc = along["arc_length"].to_numpy(np.float64)
    breaks = with_gaps(arc)
    names = ("held_out", "low", "high", "error_mean")
    held, low, high, mean = (along[name].to_numpy(np.float64) for name in names)
    several = len(set(labels["group"])) > 1
    said: dict[float, list[str]] = {}
    for where, group, error in zip(
        labels["arc_length"], labels["group"], labels["error_mean"], strict=True
    ):
        said.setdefault(where, []).append(length(error) + (f" ({group})" if several else ""))
    lengths = {
        "arc": arc,
        "estimate": held * CM_PER_M,
        "low": low * CM_PER_M,
        "high": high * CM_PER_M,
        "anchor": np.where(np.isfinite(held), held, mean) * CM_PER_M,
    }
    words = {
        "measured": [", ".join(said[where]) for where in arc],
        "shown": [length(e) for e in held],
        "interval": [span(a, b) for a, b in zip(low, high, strict=True)],
    }
    columns: dict[str, Any] = {k: np.insert(v, breaks, np.nan) for k, v in lengths.items()}
    return columns | {k: np.insert(v, breaks, "").tolist() for k, v in words.items()}


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
    plot.toolbar.logo = None
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


def item_of(plot: figure, target: str) -> dict[str, Any]:
    """A chart as `Bokeh.embed.embed_item` takes it, to be drawn in the element `target`."""
    item: dict[str, Any] = json_item(plot, ID(target))  # type: ignore[assignment]
    found: dict[str, str] = {}
    _collect(item, found)
    renamed: dict[str, Any] = _renamed(item, found)
    return renamed


def _collect(value: Any, found: dict[str, str]) -> None:
    """Bokeh numbers its models on from one chart to the next: each chart counts from 1 here."""
    if isinstance(value, dict):
        if isinstance(value.get("id"), str):
            found.setdefault(value["id"], f"m{len(found) + 1}")
        for item in value.values():
            _collect(item, found)
    elif isinstance(value, list):
        for item in value:
            _collect(item, found)


def _renamed(value: Any, found: dict[str, str]) -> Any:
    if isinstance(value, dict):
        return {
            key: found[item]
            if key in ("id", "root_id") and isinstance(item, str)
            else _renamed(item, found)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [_renamed(item, found) for item in value]
    return value
