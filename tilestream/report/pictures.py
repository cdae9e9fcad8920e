"""Pictures as PNG: the worst places from above, and the charts for papers and slides."""

import io
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tilestream.from_above import FromAbove
from tilestream.records import Float64
from tilestream.report.colours import (
    ACTUAL,
    AGAIN,
    CRITERION,
    HELD_OUT,
    MISSING,
    OTHER,
    SEEN,
)
from tilestream.report.data import AROUND, Findings, estimates
from tilestream.report.formatting import CM_PER_M
from tilestream.report.lines import path_lines
from tilestream.report.relief import relief
from tilestream.report.segments import worst_places

PIXEL = 0.25
"""Edge of a pixel of the view from above [m]."""
BELOW, ABOVE = 3.0, 10.0
"""Heights that the colours span, below and above the lidar [m]."""
HEIGHTS, NOTHING = "viridis", "#15181d"
"""Colour map of the heights, and where the map has no points."""
PATHS_ON_A_FIGURE = 12


def png(figure: Figure) -> bytes:
    """A figure as PNG; the same figure gives the same bytes."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(
        buffer, format="png", dpi=110, metadata={"Software": None}, pil_kwargs={"optimize": True}
    )
    return buffer.getvalue()


def surroundings(points: Float64, place: Float64, heading: float, seen: Float64) -> Figure:
    """The map round a place from above, coloured by height, north (map y) up, and on it what the
    lidar sees.

    Args:
        points: (n, 3) map points [m].
        place: (3,) the place of the lidar [m].
        heading: of travel there [rad].
        seen: (k, 3) returns of a virtual scan [m]; none: it was not taken.
    """
    height = _seen_from_above(points - place)
    figure = Figure(figsize=(3.0, 3.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_facecolor(NOTHING)
    axes.imshow(
        height,
        origin="lower",
        extent=(-AROUND, AROUND, -AROUND, AROUND),
        cmap=HEIGHTS,
        vmin=-BELOW,
        vmax=ABOVE,
        interpolation="nearest",
    )
    x, y = (seen - place)[:, :2].T
    axes.scatter(x, y, s=0.5, color=SEEN, linewidths=0)
    step = 11.0 * np.array([np.cos(heading), np.sin(heading)])
    arrow = {"arrowstyle": "-|>", "color": "#ff5a36", "lw": 2.2, "mutation_scale": 16}
    axes.annotate("", xy=(step[0], step[1]), xytext=(0.0, 0.0), arrowprops=arrow)
    axes.plot(0.0, 0.0, "o", ms=7, color="#ff5a36", mec="white", mew=1.2)
    axes.plot([-36.0, -26.0], [-36.0, -36.0], color="white", lw=2.0)
    axes.text(-31.0, -34.5, "10 m", color="white", ha="center", va="bottom", fontsize=8)
    axes.set(xlim=(-AROUND, AROUND), ylim=(-AROUND, AROUND), xticks=[], yticks=[])
    return figure


def heights_ramp() -> list[str]:
    """The colours of the heights from `BELOW` to `ABOVE`, for a legend."""
    return [mpl.colors.to_hex(c) for c in mpl.colormaps[HEIGHTS](np.linspace(0.0, 1.0, 9))]


def _seen_from_above(offset: Float64) -> Float64:
    """The highest point of each pixel up to what overhangs the road [m]; NaN where nothing is."""
    size = round(2.0 * AROUND / PIXEL)
    image = np.full((size, size), -np.inf)
    column, row = np.floor((offset[:, :2].T + AROUND) / PIXEL).astype(np.int64)
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    np.maximum.at(image, (row[inside], column[inside]), offset[inside, 2])
    return np.where(np.isfinite(image), image, np.nan)


def map_figure(found: Findings) -> Figure:
    """The city map, coloured by estimate, the worst places numbered."""
    places, estimate = found.places, estimates(found.places)
    at, known = places[["x", "y"]].to_numpy(np.float64), np.isfinite(estimate)
    figure = Figure(figsize=(10.0, 7.5), layout="constrained")
    axes = figure.add_subplot()
    _draw_map(axes, found.above)
    order = np.flatnonzero(known)[np.argsort(estimate[known], kind="stable")]
    size = 8.0 + 42.0 * found.scale.step(estimate[order]) / (len(found.scale.colours) - 1)
    shades = found.scale.shades(estimate[order])
    axes.scatter(at[order, 0], at[order, 1], s=size, c=shades, lw=0)
    axes.scatter(at[~known, 0], at[~known, 1], s=20, c=MISSING, marker="x", lw=1.0)
    for number, row in enumerate(worst_places(places), start=1):
        box = {"boxstyle": "circle,pad=0.25", "fc": "#111111", "ec": "white"}
        axes.annotate(
            str(number), at[row], (0, 12), textcoords="offset points", ha="center", color="white",
            fontsize=8, bbox=box,
        )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="Estimated localization error")
    axes.grid(alpha=0.25)
    axes.ticklabel_format(useOffset=False, style="plain")
    shown = found.scale.mappable(CM_PER_M)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="estimated error [cm]")
    return figure


def _draw_map(axes: Axes, above: FromAbove | None) -> None:
    """The map itself, below all else."""
    if above is None:
        return
    (left, low), (rows, columns) = above.corner, above.height.shape
    extent = left, left + columns * above.pixel, low, low + rows * above.pixel
    axes.imshow(relief(above), extent=extent, interpolation="nearest", zorder=0)


def paths_figure(found: Findings) -> Figure:
    """Measured error and held-out estimate along each path (the paper's Fig. 12 and 13)."""
    names = sorted(set(found.labels["path"].astype(str)))[:PATHS_ON_A_FIGURE]
    figure = Figure(figsize=(10.0, 2.1 * len(names) + 0.6), layout="constrained")
    panels = figure.subplots(len(names), 1, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        lines = path_lines(found, name)
        for number, drive in enumerate(lines.measured.values()):
            style: dict[str, Any] = {"ls": "--", "color": AGAIN} if number else {"color": ACTUAL}
            axes.plot(drive["arc"], drive["measured"], lw=1.1, **style)
        along = lines.estimate
        axes.plot(along["arc"], along["estimate"], color=HELD_OUT, lw=1.4)
        band: dict[str, Any] = {"color": HELD_OUT, "alpha": 0.18, "lw": 0}
        axes.fill_between(along["arc"], along["low"], along["high"], **band)
        axes.set_title(f"path {name}", loc="left", fontsize=10, parse_math=False)
        axes.set(ylabel="error [cm]", ylim=(0.0, None))
        axes.grid(alpha=0.25)
    panels[-1].set_xlabel("along the path [m]")
    figure.legend(
        handles=[
            Line2D([], [], color=ACTUAL, label="measured"),
            Line2D([], [], color=AGAIN, ls="--", label="measured again"),
            Line2D([], [], color=HELD_OUT, label="estimate of a model without the path"),
            Patch(color=HELD_OUT, alpha=0.18, label="its interval"),
        ],
        loc="outside upper center",
        ncols=4,
        frameon=False,
    )
    return figure


def importances_figure(importances: pd.DataFrame) -> Figure:
    """The importance of each factor to the model in use and to the paper's (its Fig. 14), coloured
    by criterion.
    """
    kinds = [(name, importances[importances["model"] == name]) for name in ("used", "paper")]
    there = [(name, part) for name, part in kinds if len(part)]
    most = max(len(part) for _, part in there)
    figure = Figure(figsize=(6.5 * len(there), 0.24 * most + 1.2), layout="constrained")
    for number, (name, part) in enumerate(there, start=1):
        ranked = part.sort_values("importance", kind="stable")
        axes = figure.add_subplot(1, len(there), number)
        colours = [CRITERION.get(str(c), OTHER) for c in ranked["criterion"]]
        rows = np.arange(len(ranked))
        axes.barh(rows, ranked["importance"].to_numpy(np.float64), color=colours)
        axes.set_yticks(rows, ranked["factor"].astype(str), fontsize=8, parse_math=False)
        whose = "the model in use" if name == "used" else "the paper's forest on its factors"
        axes.set(xlabel=f"importance to {whose}", ylim=(-0.6, len(ranked) - 0.4))
        axes.grid(axis="x", alpha=0.25)
        known = [c for c in CRITERION if c in set(ranked["criterion"].astype(str))]
        patches = [Patch(color=CRITERION[c], label=c) for c in known]
        axes.legend(handles=patches, frameon=False, loc="lower right")
    return figure


def coverage_figure(coverage: pd.DataFrame) -> Figure:
    """Share of each path's measured errors inside the intervals, against the promise."""
    figure = Figure(figsize=(7.0, 0.4 * len(coverage) + 1.3), layout="constrained")
    axes = figure.add_subplot()
    row = np.arange(len(coverage))[::-1]
    covered, level = (coverage[c].to_numpy(np.float64) for c in ("covered", "level"))
    error = np.nan_to_num(coverage["error"].to_numpy(np.float64))
    axes.barh(row, covered, color=ACTUAL, height=0.6, label="inside", xerr=error)
    axes.plot(level, row, "|", color=HELD_OUT, ms=18, mew=2.5, label="promised")
    axes.set_yticks(row, coverage["path"].replace("", "all").astype(str), parse_math=False)
    axes.set(xlim=(0.0, 1.0), xlabel="share of the measured errors inside the interval")
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return figure


def distribution_figure(found: Findings) -> Figure:
    """How large errors are, as the share of places above each error, measured and estimated."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    curves = [("estimated, all places", estimates(found.places), HELD_OUT)]
    if len(found.labels):
        measured = found.labels["error_mean"].to_numpy(np.float64)
        curves.append(("measured, labelled places", measured, ACTUAL))
    for name, errors, colour in curves:
        there = np.sort(errors[np.isfinite(errors)]) * CM_PER_M
        if there.size:
            above = 1.0 - np.arange(1, there.size + 1) / there.size
            axes.step(there, above, where="post", color=colour, label=name)
    axes.set(xlabel="error [cm]", ylabel="share of places above it", ylim=(0.0, 1.0))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    return figure
