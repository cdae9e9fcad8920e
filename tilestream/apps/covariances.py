"""The covariance of a filter's registration at each place of a run, as arrays."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from tilestream.apps.runs import NEEDED, PLACE, places_of
from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.files import Files
from tilestream.model.correlation import Correlation, correlations
from tilestream.model.covariance import (
    BIAS,
    COVARIANCE_COLUMNS,
    errors_in_map,
    in_map,
    matrices,
)
from tilestream.moments import AXES, PAIRS
from tilestream.pipeline.jobs.run_folder import job_of, rows_of
from tilestream.records import Float64

COLUMNS = [column.name for column in COVARIANCE_COLUMNS]
OF_CORRELATION = ["route_id", "sample", "arc_length", "status", "vd_draws"] + [
    f"vd_near_{name}" for name in (*AXES, *(f"{a}_{b}" for a, b in PAIRS if a == b))
]


@dataclass(frozen=True, eq=False)
class Covariances:
    """What a filter should believe of a registration at each place of a run (definitions, section
    6.8).
    """

    run: str
    """The run directory, or its URL."""
    places: pd.DataFrame
    """A row per sample point, along each route: `route_id`, `sample`, `arc_length`, `heading`, `x`,
    `y`, `z` (map frame: m, rad), `estimate`, `measured` where it is known [m], `status`, `p_lost`,
    the scores `nvtl`, `nvtl_low`, …, and `cov_along_along`, …; NaN where nothing is known."""
    prediction_error: float
    """How far off the filter's prediction is from which a registration starts, standard deviation
    in map x and in y [m]."""

    @property
    def route(self) -> Float64:
        """(n, 6, 6) about the truth: along, across, up [m], and the rotation vector about these
        axes [rad].
        """
        return matrices(self.places)

    @property
    def in_map(self) -> Float64:
        """(n, 6, 6) x, y, z [m], and the rotation vector about these axes [rad]: the order of ROS's
        `PoseWithCovariance`, whose fixed axes are the map's.
        """
        return in_map(self.route, self.places["heading"].to_numpy(np.float64))

    @property
    def bias(self) -> Float64:
        """(n, 6) errors that are expected, as of `route` [m, rad]: a filter that takes them from
        its registrations has the covariance `route` - bias bias^T.
        """
        return self.places[list(BIAS)].to_numpy(np.float64)

    @property
    def bias_in_map(self) -> Float64:
        """(n, 6) the same, as of `in_map`."""
        return errors_in_map(self.bias, self.places["heading"].to_numpy(np.float64))

    @cached_property
    def correlations(self) -> Mapping[str, Correlation]:
        """How errors of neighbouring places hang together, by axis: `model.correlation`."""
        rows = rows_of(self.run, "observability")
        return {} if rows is None else correlations(rows[OF_CORRELATION])


def covariances(place: str | os.PathLike[str]) -> Covariances:
    """The covariance of a registration at each place of a run, in the frames of route and map.

    It is of a registration that starts where a filter predicts the vehicle, and holds; the share of
    those that do not is `p_lost`.

    Args:
        place: a run directory of `run` or `estimate`, a path or an fsspec URL.

    Returns:
        The places, and their (n, 6, 6) covariances.

    Raises:
        SourceNotFoundError: no tables there.
        UsageError: the run has no virtual drives, or is of an older version; says what to do.
        IncompleteError: a table that must be there is not: the job has not ended.
        DamagedError: a table is not what was written.
    """
    places = places_of(place)
    if places.empty:
        raise SourceNotFoundError(f"{place}: no tables of a run{NEEDED}")
    if "estimate" not in places:
        raise UsageError(f"{place}: has no estimates{NEEDED}")
    error = job_of(Files.at(place)).get("prediction_error")
    if error is None or "cov_along_along" not in places:
        raise UsageError(
            f"{place}: its estimates are of a version without covariances: give the command that "
            "made it again"
        )
    if places["cov_along_along"].isna().all():
        raise UsageError(
            f"{place}: no place has a covariance: it comes from virtual drives, which this run has "
            "not, or nothing holds in them; `tilestream estimate` makes them"
        )
    places = places.sort_values(["route_id", "sample"], kind="stable", ignore_index=True)
    shown = (*PLACE, "estimate", "low", "high", "measured", "status", "reason", *COLUMNS)
    places = places[[name for name in shown if name in places]]
    return Covariances(Files.at(place).address, places, float(error))
