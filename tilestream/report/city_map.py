"""The map of a report that answers to the mouse: places by error on the map itself."""

import base64
from typing import Any

import numpy as np
import pandas as pd
from bokeh.models import (
    BooleanFilter,
    CDSView,
    ColumnDataSource,
    FixedTicker,
    LinearColorMapper,
)
from bokeh.models.annotations.labels import Label
from bokeh.models.annotations.legends import ColorBar, ScaleBar
from bokeh.plotting import figure
from numpy.typing import NDArray

from tilestream.from_above import FromAbove
from tilestream.records import Float64, Int64
from tilestream.report.charts import finish, hover, item, new_plot
from tilestream.report.colours import HERE, MISSING, Scale
from tilestream.report.covariance import registrations_told
from tilestream.report.data import Findings, estimates, interpolated, like_training
from tilestream.report.formatting import CM_PER_M, cm, cm_about, cm_by_name, cm_span, percent
from tilestream.report.lines import points_per_mark, worst_of_every
from tilestream.report.measured import measure_of
from tilestream.report.relief import relief_png
from tilestream.report.segments import worst_places
from tilestream.report.summary import AXES, STARTS

MOST = 20_000
"""Places drawn on the map; of more, the worst of every few along a route."""
MAP_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
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

    The data sources are named `above`, `in_domain`, `outside`, `unjudged`, `interpolated`,
    `missing`, `measured`, `worst` and `here`.

    Args:
        found: what is reported.
        tip: HTML that a point shows under the mouse, with `@` before the name of a column.
    """
    places = found.places
    estimate = estimates(places)
    plot = new_plot(600, "x", "y", MAP_TOOLS, match_aspect=True)
    drawn = worst_of_every(map_shows_every(found), places["route_id"], estimate)
    origin = origin_of(places)
    draw_map(plot, found.above, origin)
    kinds = _kinds(places)
    mapper = LinearColorMapper(palette=found.scale.colours, low=0, high=len(found.scale.colours))
    for kind, marker, name in (
        ("in_domain", "circle", "like the training places"),
        ("outside", "diamond", "unlike the training places"),
        ("unjudged", "circle", "estimated without training"),
        ("interpolated", "circle", "interpolated, not evaluated"),
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
        style |= {"marker": marker, "legend_label": name, "view": _choosable()}
        if kind == "interpolated":
            style |= {"fill_alpha": 0.0}
        glyphs = plot.scatter("x", "y", source=source, **style)
        # of the dots under the mouse the worst, which is the one on top
        plot.add_tools(hover(glyphs, tip, sort_by=[("estimate", -1)]))
    _draw_measured(plot, found, origin, (tip, mapper))
    number_the_worst(plot, places.iloc[worst_places(places)], origin)
    mark_here(plot, origin)
    if np.isfinite(estimate).any():
        plot.add_layout(colour_bar(found.scale, mapper), "below")
    name_axes(plot, origin)
    finish(plot)
    plot.legend.ncols, plot.legend.spacing = 2, 6  # so that it fits a phone
    return item(plot, "city-map")


def mark_here(plot: figure, origin: Float64) -> None:
    """The ring round the place that the address names, and by what the page finds the map."""
    plot.name, plot.tags = "city-map", origin.tolist()
    here = ColumnDataSource({"x": [], "y": []}, name="here")
    plot.scatter("x", "y", source=here, size=26, fill_alpha=0.0, line_width=3, line_color=HERE)


def name_axes(plot: figure, origin: Float64) -> None:
    """What the axes of a map are, and from where they count."""
    plot.xaxis.axis_label, plot.yaxis.axis_label = (
        f"{axis} [m] from {value:.0f} on" if value else f"{axis} [m]"
        for axis, value in zip("xy", origin, strict=True)
    )


def draw_map(plot: figure, above: FromAbove | None, origin: Float64) -> None:
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


def _choosable() -> CDSView:
    """All places, until the page's search chooses some."""
    return CDSView(filter=BooleanFilter(booleans=None))


def colour_bar(scale: Scale, mapper: LinearColorMapper, title: str = "error [cm]") -> ColorBar:
    """Equally wide steps, with the error between two of them; below the map, which is narrow on
    a phone.
    """
    return ColorBar(
        color_mapper=mapper,
        title=title,
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
    kinds = np.where(known, [names[like] for like in like_training(places)], "missing")
    return np.where(interpolated(places), "interpolated", kinds)


def origin_of(places: pd.DataFrame) -> Float64:
    """A round corner near the places, so that axes need not show seven digits [m]."""
    at = places[["x", "y"]].to_numpy(np.float64)
    at = at[np.isfinite(at).all(axis=1)]
    return round_corner(at.min(axis=0)) if len(at) else np.zeros(2)


def round_corner(low: Float64) -> Float64:
    """A corner (2,) at or below another one [m], round, or 0 where that needs few digits too."""
    corner = np.floor(low / 1000.0) * 1000.0
    return np.where(np.abs(corner) >= 10_000.0, corner, 0.0)


def _columns(found: Findings, rows: Int64, origin: Float64) -> dict[str, Any]:
    part, digits = found.places.iloc[rows], found.digits
    estimate = estimates(part)
    step = found.scale.step(estimate)
    figures = part[["low", "high", "p_fail", *AXES, *STARTS]].to_dict("records")
    return {
        "x": part["x"].to_numpy(np.float64) - origin[0],
        "y": part["y"].to_numpy(np.float64) - origin[1],
        "estimate": estimate * CM_PER_M,
        "step": step + 0.5,
        "size": _size(found.scale, estimate),
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
        **registrations_told(part),
    }


def _size(scale: Scale, error: Float64) -> Float64:
    """(n,) diameters of marks [pixels]: larger errors stand out, as in the paper's Fig. 2."""
    size: Float64 = 5.0 + 7.0 * np.clip(scale.step(error), 0, None) / (len(scale.colours) - 1)
    return size


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
    columns["size"] = _size(found.scale, measured[rows])
    source = ColumnDataSource(columns, name="measured")
    style: dict[str, Any] = {"fill_color": {"field": "step", "transform": mapper}}
    style |= {"marker": "square", "size": "size", "line_color": "black", "legend_label": "measured"}
    style["view"] = _choosable()
    glyphs = plot.scatter("x", "y", source=source, **style)
    plot.add_tools(hover(glyphs, tip, sort_by=[("measured", -1)]))


def number_the_worst(plot: figure, worst: pd.DataFrame, origin: Float64) -> None:
    """A number at each of the worst places, which have `x` and `y` [m], the worst first."""
    if worst.empty:
        return
    at = worst[["x", "y"]].to_numpy(np.float64) - origin
    numbers = [str(k + 1) for k in range(len(worst))]
    source = ColumnDataSource({"x": at[:, 0], "y": at[:, 1], "number": numbers}, name="worst")
    plot.text("x", "y", "number", source=source, **NUMBER)
