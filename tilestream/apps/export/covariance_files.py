"""What the covariances of a run are exported as: CSV, JSON, and Autoware's parameters."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from tilestream.apps.covariances import Covariances
from tilestream.apps.export.poor_stretches import areas, poor_stretches
from tilestream.apps.export.ros_parameters import USE, ros_parameters
from tilestream.apps.runs import open_run
from tilestream.errors import UsageError
from tilestream.files import Files
from tilestream.model.correlation import POOLED
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.moments import SCORES
from tilestream.records import Float64
from tilestream.report.data import interpolated
from tilestream.report.exports.geometry import crs_of
from tilestream.report.exports.tables import write_csv, write_json, write_text
from tilestream.report.segments import reaches
from tilestream.report.summary import plain
from tilestream.version import VERSION

Format = Literal["autoware", "csv", "json"]
"""As what."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""The rows and columns of a covariance in the order of ROS."""
UNITS = ("m2", "m_rad", "rad2")
"""Of an element, by the number of its axes that are turns."""
OF_SCORES = tuple(f"{name}{end}" for name in SCORES for end in ("", "_low", "_high"))
"""Columns of the scores that are normal at a place."""
MEANT = (
    "They are of a registration that starts where a filter predicts the vehicle, off by {:g} m "
    "(standard deviation in map x and in y), and that ends within 0.5 m of the truth; p_lost is "
    "the share of those that end farther away. They are of the pose of the lidar (of several: of "
    "the frame of their mounts), about the truth: a bias counts. A filter that takes the expected "
    "error e (bias) from its registrations has this covariance - e e^T; that helped in simulation, "
    "and not on real drives."
)
"""What the covariances are of."""


@dataclass(frozen=True, eq=False)
class CovarianceExport:
    """What all formats tell."""

    found: Covariances
    places: pd.DataFrame
    """Of the routes that are exported."""
    route: Float64
    """(n, 6, 6) their covariances, as they are exported, …"""
    in_map: Float64
    """… and in the map frame."""
    bias: Float64
    """(n, 6) the errors that are expected, in the frame of the route, …"""
    bias_in_map: Float64
    """… and in the map frame."""
    spacing: float
    """Of the places along a route [m]."""
    every: float
    """Distance between two updates of the filter [m]."""
    inflation: float | None
    """What that filter has to multiply covariances by; None: not known."""
    inflated: bool
    """Whether they are multiplied by it here."""
    crs: str | None
    """Of the map."""
    threshold: float
    """A stretch is poor where the estimate is above this [m] …"""
    lost: float
    """… or `p_lost` above this."""

    @property
    def about(self) -> list[str]:
        """What the covariances are of, and what was done to them, a sentence each."""
        if self.inflation is None:
            told = "How errors of neighbouring places correlate is not known."
        else:
            doing = "are multiplied by this" if self.inflated else "are not multiplied by this"
            told = (
                "Errors of neighbouring places correlate: a filter that takes updates every "
                f"{self.every:g} m as independent needs {self.inflation:.2f} times these "
                f"covariances; they {doing}."
            )
        return [MEANT.format(self.found.prediction_error), f"They are {self.rest_on}.", told]

    @property
    def rest_on(self) -> str:
        """Whether they were calibrated, and on how much, as the run says it."""
        model = (open_run(self.found.run).report.get("facts") or {}).get("model") or {}
        return str(model.get("covariances", "of a run that does not say if they were calibrated"))

    @property
    def worth(self) -> list[str]:
        """What the estimates of the run are worth."""
        worth = open_run(self.found.run).report.get("worth") or {}
        return [str(line) for line in worth.get("told", ())]


def summary(made: CovarianceExport) -> dict[str, Any]:
    """What a file holds, in numbers (`export.covariance.export`)."""
    known = made.places["p_lost"].notna() & made.places["cov_along_along"].notna()
    spread = np.sqrt(np.median(made.route[known].diagonal(axis1=1, axis2=2), axis=0))
    pooled = made.found.correlations.get(POOLED)
    span = (math.nan, math.nan) if pooled is None else pooled.inflation_span(made.every)
    poor = poor_stretches(made.places, made.threshold, made.lost)
    reach = reaches(made.places)
    told = {
        "places": int(known.sum()),
        "without": int((~known).sum()),
        "interpolated": int(interpolated(made.places).sum()),
        "routes": int(made.places["route_id"].nunique()),
        "spacing_m": made.spacing,
        "prediction_error_m": made.found.prediction_error,
        "every_m": made.every,
        "correlation_length_m": None if pooled is None else pooled.length,
        "correlation_length": "not known" if pooled is None else pooled.told,
        "inflation": made.inflation,
        **dict(zip(("inflation_low", "inflation_high"), span, strict=True)),
        "inflated": made.inflated,
        "rest_on": made.rest_on,
        "poor_stretches": len(poor),
        "poor_length_m": float(sum(reach[rows].sum() for rows in poor)),
        "along_m": float(spread[0]),
        "across_m": float(spread[1]),
        "yaw_deg": float(np.degrees(spread[5])),
        "p_lost": float(made.places["p_lost"].median()),
    }
    return dict(plain(told))


def _write_csv(made: CovarianceExport, file: Files) -> None:
    places = made.places
    table = pd.DataFrame(
        {
            "route": places["route_id"],
            "arc_length_m": places["arc_length"],
            **{f"map_{axis}_m": places[axis] for axis in AXES[:3]},
            "map_heading_rad": places["heading"],
        }
    )
    flat = pd.DataFrame(made.in_map.reshape(-1, 36), columns=ELEMENTS)
    bias = pd.DataFrame(made.bias_in_map, columns=EXPECTED)
    write_csv(file, pd.concat([table, flat, bias, places[["p_lost", *OF_SCORES]]], axis=1))


def _element(i: int, j: int) -> str:
    return f"map_cov_{AXES[i]}_{AXES[j]}_{UNITS[(i > 2) + (j > 2)]}"


ELEMENTS = [_element(i, j) for i in range(6) for j in range(6)]
"""Names of the 36 numbers of a covariance."""
EXPECTED = [f"map_bias_{axis}_{'m' if i < 3 else 'rad'}" for i, axis in enumerate(AXES)]
"""Names of the six expected errors."""


def _write_json(made: CovarianceExport, file: Files) -> None:
    places = made.places
    shown = ["route_id", "arc_length", "heading", "x", "y", "z", "estimate", "p_lost", *OF_SCORES]
    rows = places[shown].to_dict("records")
    correlations = {
        name: {
            "lags_m": one.lags,
            "bias": one.bias,
            "share": one.share,
            "length_m": one.length,
            "length": one.told,
            "inflation": one.inflation(made.every),
            "inflation_span": one.inflation_span(made.every),
        }
        for name, one in made.found.correlations.items()
    }
    poor = poor_stretches(places, made.threshold, made.lost)
    told = {column.name: column for column in COVARIANCE_COLUMNS}
    content = {
        "tilestream": VERSION,
        "run": Files.at(made.found.run).name,
        "about": made.about,
        "worth": made.worth,
        "crs": made.crs,
        **summary(made),
        "threshold_m": made.threshold,
        "lost": made.lost,
        "meanings": {
            "heading": "Direction of travel, from the map's x axis [rad].",
            "arc_length": "Along the route [m].",
            "x, y, z": "Of the lidar, in the map frame [m].",
            "estimate": "Estimated mean 3D error, of starts anywhere within 2 m [m].",
            **{name: told[name].meaning for name in ("p_lost", *OF_SCORES)},
            "covariance_map": "6 x 6, row by row: x, y, z [m], turns about the map's fixed x, y, z "
            "axes [rad] (roll, pitch, yaw in ROS's PoseWithCovariance).",
            "covariance_route": "The same along the heading, across (left), up.",
            "bias_map, bias_route": "The error that is expected, in the order of the covariance.",
            "correlation": "bias: autocorrelation of what two registrations a lag apart share; "
            "share: of the second moment of an error that this is; length_m: where it falls below "
            "1/e, null: not known; inflation: what covariances need to be multiplied by where a "
            "filter takes the errors of updates every_m metres apart as independent.",
        },
        "correlation": correlations,
        "areas": areas(places, poor, crs_of(made.crs)),
        "sample_points": [
            {
                **row,
                "covariance_map": in_map.ravel(),
                "covariance_route": along.ravel(),
                "bias_map": expected,
                "bias_route": own,
            }
            for row, in_map, along, expected, own in zip(
                rows, made.in_map, made.route, made.bias_in_map, made.bias, strict=True
            )
        ],
    }
    write_json(file, content)


def _write_autoware(made: CovarianceExport, file: Files) -> None:
    known = made.places[["cov_along_along", "nvtl_low", "tp_low"]].notna().all(axis=1).to_numpy()
    if not known.any():
        raise UsageError(f"{made.found.run}: no place has both a covariance and scores")
    run = Files.at(made.found.run).name
    about = [f"Covariances and scores of the run {run}.", *made.about, *made.worth]
    text = ros_parameters(
        made.places[known],
        made.route[known],
        made.in_map[known],
        made.bias_in_map[known],
        made.spacing,
        about,
    )
    write_text(file, text)


BEGINS: Mapping[Format, str] = {
    "autoware": f"# {USE[:40]}",
    "csv": "route,arc_length_m,map_x_m,",
    "json": '{\n "tilestream": ',
}
"""How each of these files begins."""


def require_ours(file: Files, format: Format) -> None:  # noqa: A002 - as users call it
    """Refuse to write over a file that is no earlier export of this format.

    Raises:
        UsageError: such a file is there.
    """
    try:
        there = file.read()
    except FileNotFoundError:
        return
    if there and not there.startswith(BEGINS[format].encode()):
        raise UsageError(
            f"{file.address} is there, and is no export of this format: name another file, or "
            "remove it"
        )


WRITERS: Mapping[Format, Callable[[CovarianceExport, Files], None]] = {
    "autoware": _write_autoware,
    "csv": _write_csv,
    "json": _write_json,
}
