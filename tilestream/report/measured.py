"""Measured errors beside the estimates of the same places: what is known counts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from tilestream.errors import UsageError
from tilestream.model.dataset import nearest_along
from tilestream.model.training import ESTIMATES
from tilestream.records import Column, Float64

MEASURES: Mapping[str, str] = {
    "mean": "error_mean",
    "along": "along_mean",
    "across": "across_mean",
    "up": "up_mean",
    "p_fail": "p_fail",
    "tail": "error_tail",
}
"""What may be asked for, with the label of each."""
Measured = Literal["mean", "along", "across", "up", "p_fail", "tail"]
"""One of `MEASURES`."""


@dataclass(frozen=True)
class Measure:
    """One part of the error, of all places."""

    name: str
    """One of `MEASURES`."""
    estimate: Float64
    """(n,) estimated [m, or 1 of p_fail]; NaN: not known."""
    measured: Float64
    """(n,) measured there; NaN: not driven."""

    @property
    def known(self) -> Float64:
        """(n,) the larger of the two; NaN where there is neither."""
        larger: Float64 = np.fmax(self.estimate, self.measured)
        return larger


def estimated_column(measure: str) -> str:
    """Name of the column of estimates: `estimate` of the mean.

    Raises:
        UsageError: no such measure.
    """
    if measure not in MEASURES:
        raise UsageError(f"no measure {measure!r}: choose from {', '.join(MEASURES)}")
    return ESTIMATES[MEASURES[measure]]


def measured_column(measure: str) -> str:
    """Name of the column of measured errors beside the estimates: `measured` of the mean."""
    return "measured" if measure == "mean" else f"measured_{measure}"


MEASURED_COLUMNS = tuple(
    Column(
        measured_column(name),
        "label",
        "1" if name == "p_fail" else "m",
        f"Measured {label} here, the largest of all drives; NaN where none has one.",
        "definitions, section 5",
    )
    for name, label in MEASURES.items()
)
"""What `with_measured` adds to a place."""


def with_measured(places: pd.DataFrame, labels: pd.DataFrame, reach: float) -> pd.DataFrame:
    """Places with the errors that were measured there.

    Args:
        places: with `route_id` and `arc_length` [m].
        labels: with `group`, `path` and `arc_length` [m], of the lidar that the estimates are for;
            may be empty.
        reach: how far along the route a label may be of a place [m].

    Returns:
        The places with `MEASURED_COLUMNS`: of several drives the largest, since a map has to hold
        for all of them; NaN where nothing was measured.
    """
    at = places[["route_id", "arc_length"]].rename(columns={"route_id": "path"})
    names = [label for label in MEASURES.values() if label in labels]
    found = pd.DataFrame(np.nan, index=places.index, columns=list(MEASURES.values()))
    drives = labels.groupby("group") if len(labels) else ()
    for _, drive in drives:
        near = nearest_along(at, drive[["path", "arc_length", *names]], reach)
        found[names] = np.fmax(found[names], near[names])
    named = {label: measured_column(measure) for measure, label in MEASURES.items()}
    kept = places.drop(columns=list(named.values()), errors="ignore")
    return pd.concat([kept, found.rename(columns=named)], axis=1)


def measure_of(places: pd.DataFrame, name: str = "mean") -> Measure:
    """A part of the error of all places, estimated and, where `with_measured` knows it, measured.

    Raises:
        UsageError: no such measure.
    """
    estimated, column = estimated_column(name), measured_column(name)
    nothing = np.full(len(places), np.nan)
    return Measure(
        name,
        places[estimated].to_numpy(np.float64),
        places[column].to_numpy(np.float64) if column in places else nothing,
    )
