"""Pictures of where registrations end that start round a place: the paper's Fig. 11."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from tilestream.kernels.fixed_order import norms
from tilestream.label import FAILED
from tilestream.records import Float64
from tilestream.report.colours import ACTUAL, FIXED, to_rgb
from tilestream.report.formatting import CM_PER_M

FARTHEST = 3.0
"""How far from the true position an end is drawn at most [m]; those beyond are counted."""
NEAREST = 0.6
"""How far a picture of ends reaches at least [m]: the circle of failure is in it."""
LOST = "#111111"
"""Starts that fail, and where they end."""
REPEATED = 1e-6
"""Starts this near are at one place [m]: they differ in yaw or z."""


def ends_figure(title: str, starts: pd.DataFrame) -> Figure:
    """Where the starts of a place were and where they ended.

    Above, each start as a square of the lattice of starts, coloured by the error that it ends with;
    below, where it ended. Starts that fail are black. Along the true heading is to the right, left
    of it up; the cross is the true position, the dashed circle an error of 0.5 m.

    Args:
        title: what to call the place.
        starts: its starts (`starts_of`).
    """
    figure = Figure(figsize=(3.5, 5.6), layout="constrained")
    above, below = figure.subplots(2, 1)
    _draw_starts(above, starts)
    _draw_ends(below, starts)
    above.set_title(title, fontsize=9, parse_math=False)
    above.set_ylabel("starts, across [m]", fontsize=8)
    below.set_ylabel("ends, across [m]", fontsize=8)
    below.set_xlabel("along [m]", fontsize=8)
    _colour_bar(figure, above)
    return figure


def _colour_bar(figure: Figure, axes: Axes) -> None:
    """What the colours mean, right of a panel."""
    beside = axes.inset_axes((1.06, 0.0, 0.06, 1.0))
    bar = figure.colorbar(FIXED.mappable(CM_PER_M), cax=beside)
    bar.set_label("error at the end [cm], black: failed", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _draw_starts(axes: Axes, rows: pd.DataFrame) -> None:
    """Each start as a square as wide as the starts are apart."""
    at, error = _at(rows, "from_along", "from_across"), rows["error"].to_numpy(np.float64)
    apart, turned = _lattice(at)  # a lattice in map x and y
    squares = [
        Rectangle(
            (x - apart / 2, y - apart / 2), apart, apart, angle=turned, rotation_point="center"
        )
        for x, y in at
    ]
    axes.add_collection(PatchCollection(squares, facecolors=_colours(error), linewidths=0))
    _dress(axes, float(np.abs(at).max(initial=0.0)) + apart)


def _draw_ends(axes: Axes, rows: pd.DataFrame) -> None:
    """Where each start ended; those beyond the picture are counted."""
    at, error = _at(rows, "along", "across"), rows["error"].to_numpy(np.float64)
    far = np.abs(at).max(axis=1)
    shown = far <= FARTHEST
    reach = max(NEAREST, 1.08 * float(far[shown].max(initial=0.0)))
    order = np.argsort(error[shown], kind="stable")
    colours = _colours(error)[shown][order]
    along, across = at[shown][order].T
    axes.scatter(along, across, s=9, c=colours.tolist(), linewidths=0, alpha=0.8)
    axes.add_patch(Circle((0.0, 0.0), FAILED, fill=False, ls="--", lw=0.8, color="0.35"))
    _dress(axes, reach)
    failed = int((error > FAILED).sum())
    told = f"{failed} of {len(error)} failed"
    told += f", {int((~shown).sum())} beyond" if not shown.all() else ""
    axes.text(0.03, 0.97, told, transform=axes.transAxes, va="top", fontsize=7)


def _dress(axes: Axes, reach: float) -> None:
    axes.plot(0.0, 0.0, "+", ms=10, mew=1.5, color=ACTUAL)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.2)


def _at(rows: pd.DataFrame, along: str, across: str) -> Float64:
    """(k, 2) along and across the true heading [m]."""
    places: Float64 = rows[[along, across]].to_numpy(np.float64)
    return places


def _lattice(at: Float64) -> tuple[float, float]:
    """How far apart neighbouring starts are [m], and how their rows are turned against the heading
    [deg]; of one start 0.2 m, as they are by default.
    """
    steps = np.diff(at, axis=0)
    lengths = norms(steps)
    if not (lengths > REPEATED).any():
        return 0.2, 0.0
    shortest = int(np.argmin(np.where(lengths > REPEATED, lengths, np.inf)))
    along, across = steps[shortest]
    return float(lengths[shortest]), float(np.degrees(np.arctan2(across, along)))


def _colours(error: Float64) -> Float64:
    """(k, 3) the colour of each error; `LOST` beyond `FAILED`."""
    colours = FIXED.rgb(error) / 255.0
    colours[error > FAILED] = to_rgb([LOST])
    return colours
