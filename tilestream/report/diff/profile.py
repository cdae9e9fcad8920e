"""The estimates along a route before and after: two lines, each with its interval."""

from typing import Any

import numpy as np
import pandas as pd
from bokeh.models import ColumnDataSource

from tilestream.records import Float64, Int64
from tilestream.report.charts import MOST_POINTS, band, finish, hover, item, new_road
from tilestream.report.colours import ACTUAL, HELD_OUT
from tilestream.report.diff.data import MapDiff
from tilestream.report.formatting import CM_PER_M, cm_about
from tilestream.report.lines import points_per_mark, worst_of_every

TIP = [("along", "@arc{0.0} m"), ("before", "@was"), ("after", "@is")]
LINES = (("before", ACTUAL, "dashed"), ("after", HELD_OUT, "solid"))
"""Each with its colour and its dash."""


def diff_profile(found: MapDiff, route_id: str, target: str) -> dict[str, Any]:
    """The estimates along a route, before dashed and after solid, as an item for
    `Bokeh.embed.embed_item`; of a long route the places of every few that changed most. A click
    shows the place on the map.

    The data source is named `profile`; lengths in centimetres, x and y [m, map frame].
    """
    plot = new_road(310, "error [cm]")  # with two rows of a legend
    plot.name = "profile"  # by which the page finds it
    of = found.places
    places = of.places.assign(change=of.change)
    rows = places[places["route_id"].astype(str) == route_id]
    change = np.abs(rows["change"].to_numpy(np.float64))
    every = points_per_mark(len(rows), MOST_POINTS)
    rows = rows.iloc[worst_of_every(every, rows["route_id"].to_numpy(), change)]
    estimates = {when: rows[when].to_numpy(np.float64) for when, _, _ in LINES}
    columns: dict[str, Any] = {
        "arc": rows["arc_length"].to_numpy(np.float64),
        **{when: estimate * CM_PER_M for when, estimate in estimates.items()},
        "anchor": np.fmax(*estimates.values()) * CM_PER_M,
        "was": _told(rows, "before", found.digits),
        "is": _told(rows, "after", found.digits),
        **{axis: rows[axis].to_numpy(np.float64) for axis in "xy"},
    }
    for when, colour, _ in LINES:
        ends = {f: rows[f"{f}_{when}"].to_numpy(np.float64) * CM_PER_M for f in ("low", "high")}
        band(plot, {"arc": columns["arc"], **ends}, colour, f"interval {when}")
    source = ColumnDataSource(columns, name="profile")
    for when, colour, dash in LINES:
        style: dict[str, Any] = {"color": colour, "line_dash": dash, "line_width": 1.8}
        plot.line("arc", when, source=source, legend_label=when, **style)
        alone = _alone(estimates[when])
        if alone.size:  # a place between two without an estimate has no line
            points = {name: columns[name][alone] for name in ("arc", when)}
            dots = ColumnDataSource(points, name=f"{when}, alone")
            plot.scatter("arc", when, source=dots, size=4, color=colour, legend_label=when)
    anchor = plot.line("arc", "anchor", source=source, line_alpha=0.0)
    plot.add_tools(hover(anchor, TIP, mode="vline"))
    finish(plot)
    plot.legend.ncols = 2
    return item(plot, target)


def _told(rows: pd.DataFrame, when: str, digits: int | None) -> list[str]:
    """The estimates in words."""
    both = zip(rows[when], rows[f"interpolated_{when}"], strict=True)
    return [f"{cm_about(e, digits)}{', interpolated' if between else ''}" for e, between in both]


def _alone(estimate: Float64) -> Int64:
    """Rows of the places whose neighbours have no estimate."""
    there = np.isfinite(estimate)
    beside = np.zeros(len(there), np.bool_)
    beside[1:] |= there[:-1]
    beside[:-1] |= there[1:]
    return np.flatnonzero(there & ~beside)
