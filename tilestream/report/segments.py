"""What is read off the estimates: lengths, the share over a threshold, segments, worst places."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.records import Float64, Int64
from tilestream.report.measured import measure_of

WORST = 10
"""How many of the worst places are shown."""
MEASURED = 6
"""How many of the worst measured places are shown."""
APART = 30.0
"""Least distance between two of them [m]: nearer ones are the same place twice."""
BRIDGE = 5.0
"""Places over the threshold this near along a route are one segment, whatever lies between [m]."""


def check_threshold(limit: float, name: str = "threshold") -> None:
    """Refuse a threshold that is no positive length.

    Args:
        limit: the threshold [m].
        name: what it was called where it was given.

    Raises:
        UsageError: it is not.
    """
    if not (np.isfinite(limit) and limit > 0.0):
        raise UsageError(f"{name} {limit!r}: give metres above 0")


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
    return stretches(places, np.flatnonzero(measure_of(places).known > threshold))


def stretches(places: pd.DataFrame, over: Int64) -> list[Int64]:
    """Rows of each stretch of road that these rows make, with what it bridges (`segments`).

    Args:
        places: in order along each route.
        over: the rows, rising.
    """
    route, arc = places["route_id"].to_numpy()[over], places["arc_length"].to_numpy()[over]
    near = (np.diff(arc) <= BRIDGE) | ((np.diff(over) == 1) & joined(places)[over[:-1]])
    parts = np.split(over, np.flatnonzero(~near | (route[1:] != route[:-1])) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts if part.size]


def worst_places(places: pd.DataFrame) -> list[int]:
    """Rows of the `WORST` highest errors, estimated or measured there, the highest first, no two
    nearer than `APART`.

    Distance is straight through the map, so two routes over one spot name it once.
    """
    at = places[["x", "y", "z"]].to_numpy(np.float64)
    return _apart(measure_of(places).known, np.where(np.isfinite(at), at, 0.0), WORST)


def worst_measured(labels: pd.DataFrame) -> list[int]:
    """Rows of the `MEASURED` largest measured errors, the largest first, no two of a path nearer
    than `APART` along it.
    """
    paths, _ = pd.factorize(labels["path"])
    along = labels["arc_length"].to_numpy(np.float64)
    at = np.column_stack([along, paths * 2.0 * (np.ptp(along) + APART)])
    return _apart(labels["error_mean"].to_numpy(np.float64), at, MEASURED)


def _apart(error: Float64, at: Float64, count: int) -> list[int]:
    """Rows of the largest errors that are known, no two of them nearer than `APART`."""
    chosen: list[int] = []
    for row in np.argsort(-error, kind="stable").tolist():
        if len(chosen) == count or np.isnan(error[row]):
            break
        if all(math.dist(at[row], at[other]) >= APART for other in chosen):
            chosen.append(row)
    return chosen
