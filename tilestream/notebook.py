"""How things look in a notebook: a table of facts, and pictures in the map's plane.

The drawing of stores, tiles, cells and routes, which know only their arrays. matplotlib is loaded
when something is drawn, so that no worker pays for it.
"""

import html
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

MOST_POINTS = 200_000
"""Points that a picture shows; of more, a fair and repeatable sample."""
MOST_ROWS = 20
"""Rows of a table that are shown; of the others the number."""
DEVIATIONS = 2.0
"""Half an axis of a cell's ellipse, in standard deviations of its points."""
PAPER = "#8a8a8a"
"""Outlines."""


def html_of(title: str, facts: Mapping[str, object]) -> str:
    """A title and a table of facts; all text is shown as it is."""
    rows = (_row("th", [name], _row("td", [value])) for name, value in facts.items())
    return f"<p><b>{html.escape(title)}</b></p><table>{''.join(map(_line, rows))}</table>"


def html_table(title: str, head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A title and a table, of which the first `MOST_ROWS` rows are shown."""
    lines = [_row("th", head), *(_row("td", row) for row in rows[:MOST_ROWS])]
    more = f"<p>… and {len(rows) - MOST_ROWS} more</p>" if len(rows) > MOST_ROWS else ""
    return f"<p>{html.escape(title)}</p><table>{''.join(map(_line, lines))}</table>{more}"


def _row(tag: str, cells: Iterable[object], rest: str = "") -> str:
    return "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells) + rest


def _line(cells: str) -> str:
    return f"<tr>{cells}</tr>"


def axes_of(ax: Any | None) -> Any:
    """Axes of the map's plane, in metres to scale.

    Args:
        ax: matplotlib's axes to draw on; None: those of a new figure.
    """
    if ax is None:
        _, ax = import_module("matplotlib.pyplot").subplots(figsize=(8.0, 6.0))
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
    ax.set_aspect("equal", "datalim")
    ax.ticklabel_format(useOffset=False, style="plain")
    return ax


def draw_points(points: Float64, ax: Any | None = None) -> Any:
    """Points from above, coloured by height; the axes.

    Args:
        points: (n, 3) [m].
        ax: as `axes_of`.
    """
    ax = axes_of(ax)
    if len(points) > MOST_POINTS:
        points = points[np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False)]
    shown = points[np.argsort(points[:, 2], kind="stable")]  # the highest on top, as seen
    drawn = ax.scatter(shown[:, 0], shown[:, 1], c=shown[:, 2], s=1.0, linewidths=0.0)
    ax.figure.colorbar(drawn, ax=ax, label="z [m]")
    return ax


def draw_cells(mean: Float64, covariance: Float64, ax: Any | None = None) -> Any:
    """Cells from above as ellipses of `DEVIATIONS`, coloured by height; the axes.

    Args:
        mean: (n, 3) [m].
        covariance: (n, 3, 3) [m^2].
        ax: as `axes_of`.
    """
    ax = axes_of(ax)
    squares, vectors = np.linalg.eigh(covariance[:, :2, :2])
    width, height = 2.0 * DEVIATIONS * np.sqrt(np.maximum(squares, 0.0)).T
    angle = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    drawn = import_module("matplotlib.collections").EllipseCollection(
        width, height, angle, units="xy", offsets=mean[:, :2], offset_transform=ax.transData
    )
    drawn.set_array(mean[:, 2])
    drawn.set_alpha(0.6)
    ax.add_collection(drawn)
    ax.update_datalim(mean[:, :2])
    ax.autoscale_view()
    ax.figure.colorbar(drawn, ax=ax, label="z [m]")
    return ax


def draw_squares(
    corners: Float64, edge: float, values: Float64, told: str, ax: Any | None = None
) -> Any:
    """Squares coloured by a value, grey where it is NaN; the axes.

    Args:
        corners: (n, 2) their lower left corners [m].
        edge: their edge [m].
        values: (n,).
        told: what the values are.
        ax: as `axes_of`.
    """
    ax = axes_of(ax)
    square = edge * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    drawn = import_module("matplotlib.collections").PolyCollection(
        corners[:, None] + square, edgecolors=PAPER
    )
    drawn.set_array(np.ma.masked_invalid(values))
    drawn.set_cmap(import_module("matplotlib").colormaps["viridis"].with_extremes(bad=PAPER))
    ax.add_collection(drawn)
    ax.autoscale_view()
    ax.figure.colorbar(drawn, ax=ax, label=told)
    return ax


def draw_line(positions: Float64, name: str, ax: Any | None = None) -> Any:
    """A line from above, with a dot where it begins; the axes.

    Args:
        positions: (n, 2 or 3) [m].
        name: what the legend says of it.
        ax: as `axes_of`.
    """
    ax = axes_of(ax)
    (line,) = ax.plot(positions[:, 0], positions[:, 1], label=name)
    ax.plot(positions[0, 0], positions[0, 1], "o", color=line.get_color())
    ax.legend()
    return ax
