"""Lines along a road: made once, for the charts of the page and for the pictures."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from tilestream.records import Float64, Int64
from tilestream.report.data import Findings
from tilestream.report.formatting import CM_PER_M, cm, cm_about, cm_span

GAP = 3.0
"""Labels farther apart along a path than this many typical distances are not joined by a line."""


class PathLines(NamedTuple):
    """What a chart of a labelled path shows: columns of equal length, NaN where a line breaks."""

    measured: dict[str, dict[str, Any]]
    """By drive: `arc` [m], `measured` [cm]."""
    estimate: dict[str, Any]
    """By labelled place: `arc` [m], `estimate`, `low`, `high` [cm]; `anchor` [cm], where a pointer
    finds the place; and in words `measured` (of every drive), `shown`, `interval`.
    """


def path_lines(found: Findings, path: str) -> PathLines:
    """Measured error of each drive along a path, and the estimate of a model without it."""
    labels = found.labels[found.labels["path"].astype(str) == path]
    drives = {str(group): _measured(part) for group, part in labels.groupby("group", sort=True)}
    return PathLines(drives, _estimated(labels, found.digits))


def _measured(part: pd.DataFrame) -> dict[str, Any]:
    arc = part["arc_length"].to_numpy(np.float64)
    breaks = with_gaps(arc)
    measured = part["error_mean"].to_numpy(np.float64) * CM_PER_M
    return {
        "arc": np.insert(arc, breaks, np.nan),
        "measured": np.insert(measured, breaks, np.nan),
    }


def _estimated(labels: pd.DataFrame, digits: int | None) -> dict[str, Any]:
    along = held_out_along(labels)
    arc = along["arc_length"].to_numpy(np.float64)
    breaks = with_gaps(arc)
    names = ("held_out", "low", "high", "error_mean")
    held, low, high, mean = (along[name].to_numpy(np.float64) for name in names)
    several = len(set(labels["group"])) > 1
    measured: dict[float, list[str]] = {}
    columns = (labels[name] for name in ("arc_length", "group", "error_mean"))
    for where, group, error in zip(*columns, strict=True):
        measured.setdefault(where, []).append(cm(error) + (f" ({group})" if several else ""))
    lengths = {
        "arc": arc,
        "estimate": held * CM_PER_M,
        "low": low * CM_PER_M,
        "high": high * CM_PER_M,
        "anchor": np.where(np.isfinite(held), held, mean) * CM_PER_M,
    }
    words = {
        "measured": [", ".join(measured[where]) for where in arc],
        "shown": [cm_about(e, digits) for e in held],
        "interval": [cm_span(a, b, digits) for a, b in zip(low, high, strict=True)],
    }
    broken: dict[str, Any] = {k: np.insert(v, breaks, np.nan) for k, v in lengths.items()}
    return broken | {k: np.insert(v, breaks, "").tolist() for k, v in words.items()}


def held_out_along(labels: pd.DataFrame) -> pd.DataFrame:
    """The held-out estimate of each labelled place of a path: drives over a place share it.

    Args:
        labels: of one path.

    Returns:
        A row per `arc_length` [m], rising, with `held_out`, `low`, `high` (NaN where there is no
        interval) and `error_mean` (of all drives) [m].
    """
    names = ["held_out", "low", "high", "error_mean"]
    return labels.groupby("arc_length", as_index=False)[names].mean()


def with_gaps(arc: Float64) -> Int64:
    """Indices before which a line along a path must be broken: the next label is far away."""
    step = np.diff(arc)
    if not step.size:
        return np.zeros(0, np.int64)
    return np.flatnonzero(step > GAP * np.median(step)) + 1


def points_per_mark(points: int, most: int) -> int:
    """How many consecutive points one mark must stand for, so that there are at most `most`."""
    return max(1, -(-points // most))


def worst_of_every(every: int, routes: ArrayLike, errors: Float64) -> Int64:
    """Rows of the largest of every few consecutive errors of a route, ascending.

    Args:
        every: how many consecutive rows give one.
        routes: (n,) name of the route of each row.
        errors: (n,); NaN, none, is less than any.
    """
    if every == 1:
        return np.arange(len(errors))
    rows = pd.DataFrame({"route": routes, "error": np.nan_to_num(errors, nan=-1.0)})
    part = rows.groupby("route").cumcount() // every
    return np.sort(rows.groupby(["route", part])["error"].idxmax().to_numpy(np.int64))
