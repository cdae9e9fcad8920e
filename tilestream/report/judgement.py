"""What is read off the estimates: lengths, the share over a threshold, segments, worst places."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.records import Float64, Int64
from tilestream.report.findings import estimates

WORST = 10
"""How many of the worst places are shown."""
APART = 30.0
"""Least distance between two of them [m]: nearer ones are the same place twice."""


def exceeds(places: pd.DataFrame, limit: float) -> bool:
    """Whether any estimate is above a limit: for gates.

    Args:
        places: `Findings.places`.
        limit: greatest estimate that passes [m].

    Raises:
        UsageError: the limit is not positive, or nothing was estimated: that does not pass.
    """
    check_threshold(limit)
    estimate = estimates(places)
    if np.isnan(estimate).all():
        raise UsageError(f"none of {len(places)} places has an estimate: nothing can be judged")
    return bool((estimate > limit).any())


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
    """Rows of each run of consecutive sample points whose estimates exceed the threshold.

    Args:
        places: `Findings.places`, in order; a missing estimate ends a run.
        threshold: of the estimate [m].
    """
    over = np.flatnonzero(estimates(places) > threshold)
    ends = ~joined(places)[over[:-1]] | (np.diff(over) != 1)
    return [part for part in np.split(over, np.flatnonzero(ends) + 1) if part.size]


def worst_places(places: pd.DataFrame, count: int = WORST, apart: float = APART) -> list[int]:
    """Rows of the highest estimates, the highest first, no two nearer than `apart` [m].

    Distance is straight through the map, so two routes over one spot name it once.
    """
    estimate, at = estimates(places), places[["x", "y", "z"]].to_numpy(np.float64)
    at = np.where(np.isfinite(at), at, 0.0)
    chosen: list[int] = []
    for row in np.argsort(-estimate, kind="stable").tolist():
        if len(chosen) == count or np.isnan(estimate[row]):
            break
        if all(np.linalg.norm(at[row] - at[other]) >= apart for other in chosen):
            chosen.append(row)
    return chosen
