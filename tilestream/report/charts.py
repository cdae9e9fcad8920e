"""The charts that answer to the mouse: Bokeh documents as plain JSON, the same bytes every time."""

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
from bokeh.plotting import figure
from numpy.typing import NDArray

from tilestream.records import Float64
from tilestream.report.colours import ACTUAL, AGAIN, HELD_OUT, MISSING, palette, scale_of
from tilestream.report.findings import Findings, estimates
from tilestream.report.judgement import worst_places
from tilestream.report.summary import interval_factor, with_gaps
from tilestream.report.words import CM_PER_M, length, percent, span

MOST = 20_000
"""Places drawn on the map; of more, the worst of every few along a route."""
TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
_TIP = (
    '<div style="max-width:24em;font:13px system-ui,sans-serif;color:#222">'
    "<b>@route</b>, @arc{0.0} m along<br>"
    "estimate <b>@shown</b><br>interval @interval<br>starts that fail: @fail<br>"
    "like the training places: @domain<br><i>@reason</i></div>"
)


def city_map(found: Findings) -> dict[str, Any]:
    """The sample points coloured by estimate, the worst on top and numbered, as an item for
    `Bokeh.embed.embed_item`.

    The data sources are named `in_domain`, `outside`, `missing` and `worst`.
    """
    places = found.places
    estimate = estimates(places)
    scale, colours = scale_of(estimate), palette()
    plot = _plot(560, "x", "y", match_aspect=True)
    drawn = _drawn(places)
    origin = _origin(places)
    kinds = _kinds(places)
    mapper = LinearColorMapper(
        palette=colours, low=scale.low * CM_PER_M, high=scale.high * CM_PER_M
    )
    for kind, marker, name in (
        ("missing", "x", "no estimate"),
        ("in_domain", "circle", "like the training places"),
        ("outside", "diamond", "unlike the training places"),
    ):
        rows = drawn[kinds[drawn] == kind]
        if not rows.size:
            continue
        rows = rows[np.argsort(estimate[rows], kind="stable")]
        source = ColumnDataSource(_columns(places, rows, origin), name=kind)
        style: dict[str, Any] = (
            {"color": MISSING, "size": 5, "line_width": 1.5}
            if kind == "missing"
            else {"color": {"field": "estimate", "transform": mapper}, "size": "size"}
        )
        glyphs = plot.scatter("x", "y", source=source, marker=marker, legend_label=name, **style)
        plot.add_tools(HoverTool(renderers=[glyphs], tooltips=_TIP, point_policy="follow_mouse"))
    _number_the_worst(plot, places, origin)
    if np.isfinite(estimate).any():
        bar = ColorBar(color_mapper=mapper, title="estimated error [cm]", width=12, padding=4)
        bar.background_fill_alpha = 0.0
        plot.add_layout(bar, "right")
    plot.xaxis.axis_label, plot.yaxis.axis_label = (
        f"{axis} [m]" + (f" from {value:.0f}" if value else "")
        for axis, value in zip("xy", origin, strict=True)
    )
    _finish(plot)
    return _item(plot, "city-map")


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
    like = places["in_domain"].to_numpy(bool)
    return np.where(known, np.where(like, "in_domain", "outside"), "missing")


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
    value = {name: part[name].to_numpy(np.float64) for name in ("low", "high", "p_fail")}
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
        "domain": [
            ("yes" if like else "no") if known else "not known"
            for like, known in zip(part["in_domain"], np.isfinite(estimate), strict=True)
        ],
        "reason": part["reason"].fillna("").astype(str).tolist(),
    }


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
    """Measured error and held-out estimate along a path, each drive a line, the interval a band.

    The data sources are named by their group; lengths in centimetres.
    """
    labels = found.labels[found.labels["path"].astype(str) == path]
    factor = interval_factor(found.coverage, path)
    plot = _plot(260, "along the path [m]", "error [cm]", y_range=DataRange1d(start=0.0))
    drives = list(labels.groupby("group", sort=True))
    for number, (group, part) in enumerate(drives):
        columns = _along(part, factor)
        source = ColumnDataSource(columns, name=str(group))
        again = number > 0
        if number == 0 and factor is not None:
            _band(plot, columns)
        measured = plot.line(
            "arc",
            "actual",
            source=source,
            color=AGAIN if again else ACTUAL,
            line_width=1.6,
            line_dash=(5, 3) if again else "solid",
            legend_label=f"measured, {group}" if len(drives) > 1 else "measured",
        )
        estimate = f"estimate, {group}" if len(drives) > 1 else "estimate of a model without it"
        plot.line(
            "arc",
            "estimate",
            source=source,
            color=HELD_OUT,
            line_width=1.8,
            line_dash=(2, 3) if again else "solid",
            legend_label=estimate,
        )
        tip = [
            ("along", "@arc{0.0} m"),
            ("drive", "@group"),
            ("measured", "@actual{0.0} cm"),
            ("estimate", "@estimate{0.0} cm"),
            ("interval", "@interval"),
        ]
        plot.add_tools(HoverTool(renderers=[measured], tooltips=tip, mode="vline"))
    _finish(plot)
    return _item(plot, f"path-{path}")


def _along(part: pd.DataFrame, factor: float | None) -> dict[str, Any]:
    """A drive along a path; rows of NaN where its line is to be broken."""
    breaks = with_gaps(part["arc_length"].to_numpy(np.float64))

    def gapped(values: Float64) -> Float64:
        return np.insert(values, breaks, np.nan)

    held = part["held_out"].to_numpy(np.float64)
    low, high = held / (factor or np.nan), held * (factor or np.nan)
    arc = gapped(part["arc_length"].to_numpy(np.float64))
    return {
        "arc": arc,
        "actual": gapped(part["error_mean"].to_numpy(np.float64)) * CM_PER_M,
        "estimate": gapped(held) * CM_PER_M,
        "low": gapped(low) * CM_PER_M,
        "high": gapped(high) * CM_PER_M,
        "interval": [span(a, b) for a, b in zip(gapped(low), gapped(high), strict=True)],
        "group": [str(part["group"].iloc[0])] * len(arc),
    }


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
            legend_label="interval",
        )


def _plot(height: int, x: str, y: str, **options: Any) -> figure:
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        tools=TOOLS,
        x_axis_label=x,
        y_axis_label=y,
        output_backend="canvas",
        **options,
    )
    plot.toolbar.logo = None
    return plot


def _finish(plot: figure) -> None:
    """Calm, and see-through, so that the page's own colours stand behind."""
    plot.background_fill_alpha = plot.border_fill_alpha = 0.0
    plot.outline_line_color = None
    plot.axis.axis_line_alpha = 0.4
    plot.axis.minor_tick_line_color = None
    plot.axis.formatter = NumeralTickFormatter(format="0[.]0")
    plot.grid.grid_line_alpha = 0.35
    if plot.legend:
        plot.add_layout(plot.legend[0], "above")
        plot.legend.orientation = "horizontal"
        plot.legend.background_fill_alpha = 0.0
        plot.legend.border_line_alpha = 0.0
        plot.legend.click_policy = "hide"


def _item(plot: figure, target: str) -> dict[str, Any]:
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
