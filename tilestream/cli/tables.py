"""What the commands print: facts as tables for people, as plain values for machines."""

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.table import Table

from tilestream.counts import count_of
from tilestream.factors.catalogue import COLUMNS
from tilestream.factors.stations import INTERPOLATED
from tilestream.report.diff.data import TILES, MapDiff
from tilestream.report.drives import DriveMeasured
from tilestream.report.formatting import cm, cm_about, cm_limit, distance
from tilestream.report.paper_tables import LIMITS
from tilestream.report.summary import digits_of


def factor_table(rows: pd.DataFrame) -> Table:
    """The factors of a route: how they are spread."""
    table = Table(
        title=f"factors of {count_of(len(rows), 'sample point')}", title_justify="left", box=SIMPLE
    )
    table.add_column("factor")
    for name in ("unit", "lowest", "median", "highest"):
        table.add_column(name, justify="right")
    for column in COLUMNS:
        if column.name in rows:
            values = rows[column.name]
            spread = (values.min(), values.median(), values.max())
            table.add_row(column.name, column.unit, *(f"{value:.4g}" for value in spread))
    for status, count in rows["status"].value_counts().items():
        table.add_row(f"{status}: {count}", "", "", "", "")
    return table


def error_facts(labels: pd.DataFrame) -> dict[str, float | None]:
    """The errors of a drive in a few numbers: mean, median, tails [m], p_fail; None of nothing."""
    done = labels[labels["status"] == "done"]
    error = done["error_mean"]
    facts = {
        "sample_points": len(labels),
        "failed": len(labels) - len(done),
        "mean_m": float(error.mean()),
        "median_m": float(error.median()),
        "p95_m": float(error.quantile(0.95)),
        "max_m": float(error.max()),
        "p_fail": float(done["p_fail"].mean()),
        "floor_m": float(done["error_floor"].mean()),
        "tail_m": float(done["error_tail"].mean()),
        **{f"share_over_{t:.2f}_m": float((error > t).mean()) for t in LIMITS},
    }
    return {name: None if math.isnan(value) else value for name, value in facts.items()}


CM, PERCENT = (100.0, " cm"), (100.0, " %")
READ_AS = {
    "mean_m": (*CM, "mean error"),
    "median_m": (*CM, "median error"),
    "p95_m": (*CM, "95 % of the places have less"),
    "max_m": (*CM, "the largest"),
    **{f"share_over_{t:.2f}_m": (*PERCENT, f"of the places over {t * 100:g} cm") for t in LIMITS},
    "p_fail": (*PERCENT, "of the starts fail: they end over 50 cm away"),
    "floor_m": (*CM, "of the mean is floor: what starts within 1 m end with"),
    "tail_m": (*CM, "of the mean is tail: what farther starts add"),
}
"""Scale, unit and meaning of the facts of a drive, for people."""


def error_table(labels: pd.DataFrame, matcher: str, drive: DriveMeasured) -> Table:
    """The errors of a drive, figure and meaning, how much of it they are of, its worst places."""
    table = Table(title="localization error", title_justify="left", box=SIMPLE, show_header=False)
    table.add_column(justify="right", no_wrap=True)
    table.add_column()
    facts = error_facts(labels)
    table.add_row(matcher, "the matcher")
    why = f"; of the others {drive.why}" if drive.reasons else ""
    table.add_row(f"{drive.measured:,} of {drive.scans:,}", f"scans measured{why}")
    table.add_row(f"{facts['sample_points']:,}", "sample points")
    table.add_row(f"{facts['failed']:,}", "of them without a measurement")
    for name, (scale, unit, meaning) in READ_AS.items():
        value = facts[name]
        table.add_row("none" if value is None else f"{value * scale:.1f}{unit}", meaning)
    worst = labels.nlargest(3, "error_mean")
    for row, error in zip(worst.itertuples(), worst["error_mean"] * 100.0, strict=True):
        place = f"scan {row.scan} at {row.arc_length:.0f} m, ({row.x:.1f}, {row.y:.1f})"
        table.add_row(f"{error:.1f} cm", f"{place}, of the worst places")
    return table


def report_table(report: dict[str, Any], figures: Sequence[tuple[str, str]]) -> Table:
    """The headline of a report, figure and meaning, and its worst places."""
    table = Table(title=str(report["title"]), title_justify="left", box=SIMPLE, show_header=False)
    table.add_column(justify="right", no_wrap=True)
    table.add_column()
    for figure, meaning in figures:
        table.add_row(*(" ".join(text.split()) for text in (figure, meaning)))  # plain spaces
    for worst in report["worst"][:3]:
        where = f"on {worst['route_id']} at {worst['arc_length']:.0f} m, of the worst places"
        where += ", interpolated" if worst["status"] == INTERPOLATED else ""
        estimate = cm_about(worst["estimate"], digits_of(report))
        table.add_row(" ".join(estimate.split()), where)
    return table


STRETCHES = 10
"""Stretches of road that a table shows."""


def diff_table(found: MapDiff) -> Table:
    """What a map update changes: tiles, then how much road got worse or better."""
    table = Table(title="map update", title_justify="left", box=SIMPLE, show_header=False)
    table.add_column()
    table.add_column(justify="right", no_wrap=True)
    table.add_column()
    for kind in TILES:
        keys = [str(key) for key in getattr(found, kind)]
        more = " …" if len(keys) > 10 else ""
        count = "not compared" if found.gone else f"{len(keys):,}"
        table.add_row(f"tiles {kind}", count, " ".join(keys[:10]) + more)
    table.add_row("tiles the same", "not compared" if found.gone else f"{found.same:,}", "")
    places = found.places
    table.add_row("compared", distance(places.length), count_of(places.compared, "sample point"))
    if places.compared_interpolated:
        between = f"{places.compared_interpolated:,} of these, before or after"
        table.add_row("interpolated, not evaluated", "", between)
    by = f"by more than {cm_limit(found.limit)}"
    for what, rows in (("worse", places.worse), ("better", places.better)):
        length = distance(float(rows["length"].sum()))
        table.add_row(f"got {what} {by}", length, count_of(len(rows), "sample point"))
    if places.lost:
        table.add_row("lost their estimate", "", count_of(places.lost, "sample point"))
    if places.appeared:
        table.add_row("have one for the first time", "", count_of(places.appeared, "sample point"))
    if len(places.left):
        table.add_row("not asked for any more", "", count_of(len(places.left), "sample point"))
    return table


def stretch_table(found: MapDiff) -> Table:
    """The stretches of road that got worse, the worst first."""
    rows = found.places.stretches
    more = f", the first {STRETCHES} of {len(rows):,}" if len(rows) > STRETCHES else ""
    table = Table(title=f"what got worse{more}", title_justify="left", box=SIMPLE)
    table.add_column("route")
    for column in ("from", "to", "worst at", "before", "now"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("why")
    for row in rows.head(STRETCHES).to_dict("records"):
        where = (f"{row[name]:.0f} m" for name in ("begin", "end", "at"))
        errors = (cm(row[name]) for name in ("before", "after"))
        between = f"{row['interpolated']:,} of {row['places']:,} places interpolated"
        why = [row["why"], *([between] if row["interpolated"] else [])]
        table.add_row(str(row["route_id"]), *where, *errors, "; ".join(why))
    return table


def comparison_table(content: dict[str, Any]) -> Table:
    """The choices of a comparison, a line each."""
    over = f"over {content['threshold']:g} m"
    table = Table(
        title=f"comparison, matcher {content['facts']['matcher']}", title_justify="left", box=SIMPLE
    )
    table.add_column("choice", no_wrap=True)
    for column in (
        "median [m]",
        "95 % [m]",
        "max [m]",
        over,
        "starts that fail",
        "lost",
        "map [MB]",
    ):
        table.add_column(column, justify="right", min_width=max(map(len, column.split())))
    for choice in content["choices"]:
        figures = (choice[name] for name in ("median", "p95", "max", "over_share", "p_fail"))
        shown = ["none" if figure is None else f"{figure:.3f}" for figure in figures]
        size = f"{choice['map_bytes'] / 1e6:,.2f}"
        table.add_row(choice["choice"], *shown, f"{choice['lost']:,}", size)
    return table
