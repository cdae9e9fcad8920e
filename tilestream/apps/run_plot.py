"""The places of a run from above, coloured by error, or by a column of their table."""

from typing import Any

import numpy as np
import pandas as pd

from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.notebook import axes_of
from tilestream.records import Float64
from tilestream.report.colours import FIXED, MISSING, OTHER, scale_of
from tilestream.report.data import interpolated
from tilestream.report.formatting import CM_PER_M

ESTIMATED = [column.name for column in (*PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)]
DOT, SMALL, LARGE, CROSS = 1.5, 8.0, 30.0, 12.0
"""Area of a place that is interpolated, estimated, measured, and of a cross [points²]: one behind
the other the first look like a thin line, the second like a thick one."""


def plot_places(table: pd.DataFrame, column: str | None, ax: Any | None) -> Any:
    """Draw places: large where measured, small where estimated, a dot where that is interpolated,
    grey crosses where neither is known; the axes.

    Args:
        table: as `read_run` gives it.
        column: a column of numbers to colour by instead.
        ax: matplotlib's axes to draw on; None: those of a new figure.
    """
    small = _numbers(table, column or "estimate")
    large = _numbers(table, "measured" if column is None else "")
    scale = FIXED if column is None else scale_of(small)
    ax = axes_of(ax)
    dots = np.zeros(len(table), np.bool_)
    if (column or "estimate") in ESTIMATED and "status" in table:
        dots = interpolated(table) & ~np.isnan(small)
    for values, sizes in ((small, np.where(dots, DOT, SMALL)), (large, np.full(len(table), LARGE))):
        rows = np.flatnonzero(~np.isnan(values))
        rows = rows[np.argsort(values[rows], kind="stable")]  # the worst on top
        shades, at = scale.shades(values[rows]), table[["x", "y"]].iloc[rows]
        ax.scatter(at["x"], at["y"], s=sizes[rows], c=shades, lw=0)
    neither = table[np.isnan(small) & np.isnan(large)]
    ax.scatter(neither["x"], neither["y"], s=CROSS, c=MISSING, marker="x", lw=1.0)
    if dots.any():
        for size, told in ((SMALL, "evaluated"), (DOT, "interpolated, not evaluated")):
            ax.scatter([], [], s=size, c=OTHER, lw=0, label=told)
        ax.legend()
    per_metre, label = (CM_PER_M, "localization error [cm]") if column is None else (1.0, column)
    ax.figure.colorbar(scale.mappable(per_metre), ax=ax, label=label)
    return ax


def _numbers(table: pd.DataFrame, name: str) -> Float64:
    """(n,) a column; NaN where the table has none of that name."""
    if name not in table:
        return np.full(len(table), np.nan)
    return table[name].to_numpy(np.float64)
