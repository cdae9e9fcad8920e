"""The job that exports covariances for filters."""

import os
from typing import Any, Literal

import numpy as np

from tilestream.apps.covariances import covariances
from tilestream.apps.export.covariance_files import (
    WRITERS,
    CovarianceExport,
    Format,
    require_ours,
    summary,
)
from tilestream.apps.runs import crs_of_map
from tilestream.errors import UsageError
from tilestream.files import Files
from tilestream.model.correlation import POOLED
from tilestream.report.segments import check_threshold
from tilestream.report.write import THRESHOLD

What = Literal["covariance"]
"""What can be exported."""
EVERY = 1.0
"""A filter's updates are this far apart [m]: ten a second at 10 m/s."""
LOST = 0.05
"""Where more registrations than this are lost, a stretch is poor."""
FILES: dict[Format, str] = {
    "autoware": "covariance.param.yaml",
    "csv": "covariance.csv",
    "json": "covariance.json",
}
"""What a file is called where nobody names it."""


def export(
    what: What,
    place: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    format: Format = "csv",  # noqa: A002 - as the option is called
    every: float = EVERY,
    inflate: bool = False,
    route: str | None = None,
    threshold: float = THRESHOLD,
    lost: float = LOST,
) -> dict[str, Any]:
    """Write what a run says of registrations, for a filter; the file is whole, or as it was.

    * `csv`: a row per place: route, arc length, position, heading, the 36 numbers of the covariance
      in the order of ROS (x, y, z, and turns about the fixed axes of the map: roll, pitch, yaw; row
      by row), the six expected errors, `p_lost`, and the scores of a normal registration; names say
      frame and unit.
    * `json`: the same in the frames of map and route, with meanings, units, CRS, what the estimates
      are worth, the correlation along the route, and the poor stretches as areas (GeoJSON).
    * `autoware`: a ROS 2 parameter file that `ndt_scan_matcher` loads after its own: one constant
      `output_pose_covariance`, thresholds of its scores, and below `covariance_by_place` flat
      arrays with all places, for a node that looks them up by position; its comments say how.

    Args:
        what: `covariance`.
        place: a run directory of `run` or `estimate`, a path or an fsspec URL.
        out: the file; None: `export/covariance.<format>` in the run directory.
        format: of the file.
        every: distance between two updates of the filter [m].
        inflate: multiply the covariances by what a filter needs that takes the errors of updates
            `every` so many metres as independent.
        route: only this route; None: all.
        threshold: a stretch is poor where the estimate is above this [m] …
        lost: … or `p_lost` above this.

    Returns:
        What was written: `file`, `format`, `places` (with a covariance), `without`, of these
        `interpolated`, `routes`, `spacing_m`, `prediction_error_m`, `every_m`,
        `correlation_length_m` (of the bias along and across; None: not known) and
        `correlation_length` (in words), `inflation` (None: not known)
        and `inflation_low` to `inflation_high`, between which it lies had other pieces of road been
        seen (90 %; None: the road is too short to say), `inflated`,
        `rest_on` (whether they were calibrated, in words), `poor_stretches`, `poor_length_m`, and
        the medians `along_m`, `across_m`, `yaw_deg` of the standard deviations, and of `p_lost`.

    Raises:
        UsageError: no such route, a value that cannot be, a run without covariances, or a file is
            in the way that is no earlier export of this format.
        SourceNotFoundError, IncompleteError, DamagedError: as `ts.covariances`.
        CrsError: a CRS that pyproj does not know.

    Examples:
        >>> ts.export("covariance", "gone")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        tilestream.errors.SourceNotFoundError: gone: no tables of a run: give ...
    """
    if what != "covariance":
        raise UsageError(f"{what!r} cannot be exported: `covariance` can")
    if format not in FILES:
        raise UsageError(f"format {format!r}: choose from {', '.join(FILES)}")
    check_threshold(every, "every")
    check_threshold(threshold)
    if not 0.0 < lost < 1.0:
        raise UsageError(f"lost {lost!r}: give a share between 0 and 1")
    made = _made(place, every, inflate, route, threshold, lost)
    file = Files.at(place).under(f"export/{FILES[format]}") if out is None else Files.at(out)
    require_ours(file, format)
    WRITERS[format](made, file)
    return summary(made) | {"file": file.address, "format": format}


def _made(
    place: str | os.PathLike[str],
    every: float,
    inflate: bool,
    route: str | None,
    threshold: float,
    lost: float,
) -> CovarianceExport:
    """What is exported; errors as `export`."""
    found = covariances(place)
    routes = list(dict.fromkeys(found.places["route_id"]))
    if route is not None and route not in routes:
        raise UsageError(f"{place}: no route {route!r}; its routes are {', '.join(routes)}")
    pooled = found.correlations.get(POOLED)
    inflation = None if pooled is None else pooled.inflation(every)
    if inflate and inflation is None:
        raise UsageError(
            f"{place}: too few places to know how their errors correlate: leave --inflate out"
        )
    chosen = np.ones(len(found.places), bool)
    if route is not None:
        chosen = (found.places["route_id"] == route).to_numpy()
        if found.places.loc[chosen, "cov_along_along"].isna().all():
            raise UsageError(f"{place}: no place of route {route!r} has a covariance")
    times = inflation if inflate and inflation is not None else 1.0
    places = found.places[chosen].reset_index(drop=True)
    step = places["arc_length"].diff() / places["sample"].diff()
    spacing = step[places["route_id"].eq(places["route_id"].shift())].median()
    return CovarianceExport(
        found,
        places,
        found.route[chosen] * times,
        found.in_map[chosen] * times,
        found.bias[chosen],
        found.bias_in_map[chosen],
        float(spacing),
        every,
        inflation,
        inflate,
        crs_of_map(place),
        threshold,
        lost,
    )
