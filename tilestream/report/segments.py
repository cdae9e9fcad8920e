"""What is read off the estimates: lengths, the share over a threshold, segments, worst places."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.model.figures import SEGMENT
from tilestream.records import Float64, Int64
from tilestream.report.drives import EVALUATED
from tilestream.report.measured import measure_of

WORST = 10
"""How many of the worst places are shown."""
MEASURED = 6
"""How many of the worst measured places are shown."""
APART = 30.0
"""Least distance between two of them [m]: nearer ones are the same place twice."""
BRIDGE = 5.0
"""Places over the threshold this near along a route are one segment, whatever lies between [m]."""
MISSING = 0.05
"""Share of the places that may be without an estimate where a gate opens."""
Over = Literal["places", "segments"]
"""What a gate asks of."""
NAMED = 5
"""Routes that are named where a gate stays closed."""


def gate(
    places: pd.DataFrame,
    limit: float,
    drives: Sequence[Mapping[str, Any]] = (),
    measure: str = "mean",
    over: Over = "places",
) -> list[str]:
    """Why a map does not pass a limit; empty: it passes.

    A measured error counts as an estimate does. What is not known does not pass: a route without
    any estimate fails the gate, and so does one of whose places less than `EVALUATED` have one, a
    drive that was not evaluated to that share, and a map of which more than `MISSING` of the places
    have no estimate.

    Args:
        places: route_id, arc_length [m] and the estimates of every sample point, with what was
            measured there (`with_measured`).
        limit: greatest error that passes [m]; of p_fail a share.
        drives: how much of each drive was measured (`DriveMeasured.plain`).
        measure: the part of the error that is asked for (`MEASURES`).
        over: `segments`: means over `SEGMENT` of a route instead of single places.

    Raises:
        UsageError: the limit is not positive, or no such measure.
    """
    check_threshold(limit)
    one = measure_of(places, measure)
    estimate, known_error = one.estimate, one.known
    found, total = [], len(places)
    judged = places[["route_id", "arc_length"]].assign(
        error=known_error, measured=known_error == one.measured
    )
    judged = _windows(judged) if over == "segments" else judged
    above = judged[judged["error"] > limit]
    if len(above):
        worst = above.iloc[int(np.argmax(above["error"]))]
        unit = "" if measure == "p_fail" else " m"
        what = "sample points" if over == "places" else f"segments of {SEGMENT:g} m"
        found.append(
            f"{measure}: {len(above)} of {len(judged)} {what} are above {limit:g}{unit}, the worst "
            f"{worst['error']:.2f}{unit} on {worst['route_id']} at {worst['arc_length']:.0f} m, "
            f"{'measured' if worst['measured'] else 'estimated'}"
        )
    known = pd.Series(np.isfinite(estimate)).groupby(places["route_id"].to_numpy(str)).mean()
    blind = known.index[known == 0.0].tolist()
    if blind:
        found.append(f"no estimate at all on {_named(blind)}")
    hardly = known[(known > 0.0) & (known < EVALUATED)]
    if len(hardly):
        told = [f"{route} ({share:.0%})" for route, share in hardly.items()]
        found.append(f"less than {EVALUATED:.0%} of the places have an estimate on {_named(told)}")
    unseen = [
        f"{one['drive']} ({one['measured']:,} of {one['scans']:,} scans)"
        for one in drives
        if not one["evaluated"]
    ]
    if unseen:
        found.append(f"less than {EVALUATED:.0%} was measured of drive {_named(unseen)}")
    missing = int(np.isnan(estimate).sum())
    if missing > MISSING * total:
        found.append(
            f"{missing} of {total} sample points have no estimate, more than {MISSING:.0%}; "
            "report/index.html lists why"
        )
    return found


def _windows(judged: pd.DataFrame) -> pd.DataFrame:
    """Means of `error` over each `SEGMENT` of a route, of the places that have one; `measured`
    where any of them is.
    """
    there = judged[judged["error"].notna()]
    number = (there["arc_length"] // SEGMENT).rename("number")
    parts = there.groupby(["route_id", number])
    how = {"error": "mean", "arc_length": "min", "measured": "any"}
    return parts.agg(how).reset_index()


def _named(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMED]) + (", …" if len(names) > NAMED else "")


def check_threshold(limit: float) -> None:
    """Refuse a threshold that is no positive length.

    Raises:
        UsageError: it is not.
    """
    if not (np.isfinite(limit) and limit > 0.0):
        raise UsageError(f"threshold {limit!r}: give metres above 0")


def joined(places: pd.DataFrame) -> NDArray[np.bool_]:
    """(n - 1,) whether the next row is the next sample point of the same route."""
    route, sample = places["route_id"].to_numpy(), places["sample"].to_numpy()
    next_one: NDArray[np.bool_] = (route[1:] == route[:-1]) & (sample[1:] == sample[:-1] + 1)
    return next_one


def reaches(places: pd.DataFrame) -> Float64:
    """(n,) the length of road that each place stands for: half the way to its neighbours [m].

    They sum up to the length of the routes, gaps between sample points left out.
    """
    step = np.diff(places["arc_length"].to_numpy(np.float64)) * joined(places)
    reach = np.zeros(len(places))
    reach[1:] += 0.5 * step
    reach[:-1] += 0.5 * step
    return reach


def segments(places: pd.DataFrame, threshold: float) -> list[Int64]:
    """Rows of each stretch of road over a threshold, with what it bridges.

    Two places of a route that exceed it belong to one stretch when they are consecutive sample
    points, or at most `BRIDGE` apart; the places between them, lower or without an estimate, are
    part of it. A stretch begins and ends with a place over the threshold.

    Args:
        places: `Findings.places`, in order.
        threshold: of the estimate, or of what was measured there [m].
    """
    over = np.flatnonzero(measure_of(places).known > threshold)
    route, arc = places["route_id"].to_numpy()[over], places["arc_length"].to_numpy()[over]
    near = (np.diff(arc) <= BRIDGE) | ((np.diff(over) == 1) & joined(places)[over[:-1]])
    parts = np.split(over, np.flatnonzero(~near | (route[1:] != route[:-1])) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts if part.size]


def worst_places(places: pd.DataFrame, count: int = WORST, apart: float = APART) -> list[int]:
    """Rows of the highest errors, estimated or measured there, the highest first, no two nearer
    than `apart` [m].

    Distance is straight through the map, so two routes over one spot name it once.
    """
    at = places[["x", "y", "z"]].to_numpy(np.float64)
    return _apart(measure_of(places).known, np.where(np.isfinite(at), at, 0.0), count, apart)


def worst_measured(labels: pd.DataFrame, count: int = MEASURED, apart: float = APART) -> list[int]:
    """Rows of the largest measured errors, the largest first, no two of a path nearer than `apart`
    [m] along it.
    """
    paths, _ = pd.factorize(labels["path"])
    along = labels["arc_length"].to_numpy(np.float64)
    at = np.column_stack([along, paths * 2.0 * (np.ptp(along) + apart)])
    return _apart(labels["error_mean"].to_numpy(np.float64), at, count, apart)


def _apart(error: Float64, at: Float64, count: int, apart: float) -> list[int]:
    """Rows of the largest errors that are known, no two of them nearer than `apart` [m]."""
    chosen: list[int] = []
    for row in np.argsort(-error, kind="stable").tolist():
        if len(chosen) == count or np.isnan(error[row]):
            break
        if all(math.dist(at[row], at[other]) >= apart for other in chosen):
            chosen.append(row)
    return chosen
