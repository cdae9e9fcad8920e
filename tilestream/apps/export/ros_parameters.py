"""The file of parameters that Autoware's scan matcher loads after its own."""

import textwrap
from typing import Any

import numpy as np
import pandas as pd
import yaml
from scipy.stats import norm

from tilestream.model.covariance import NORMAL
from tilestream.records import Float64

PLACES = "covariance_by_place"
"""The group of ours, which Autoware's node passes over."""
NVTL = 1
"""What `converged_param_type` calls the nearest voxel transformation likelihood."""
USE = (
    "For Autoware's ndt_scan_matcher: load this file after ndt_scan_matcher.param.yaml. Metres "
    "and radians."
)
CONSTANT = (
    "covariance.output_pose_covariance is the mean of the places: position in the axes of the "
    "vehicle, as Autoware turns this block, rotation in those of the map, as it does not."
)
POOR = (
    "The poor stretches are areas in the export of format json. Autoware has no parameters for "
    "areas; its pose_estimator_arbiter takes polygons of type pose_estimator_specify in the "
    "Lanelet2 map."
)
"""What the comments say in every file."""
LOOK_UP = """\
p = position of the lidar in the map: that of base_link, moved by its mount
k = the place whose position[3 k .. 3 k + 2] is nearest to p
if it is nearer than spacing:
    the pose's covariance = output_pose_covariance[36 k .. 36 k + 35]
    or: the pose - expected_error[6 k .. 6 k + 5] = e, with the covariance - e e^T
    the registration is normal where its NVTL >= nvtl_low[k], or its TP >= tp_low[k]
else: the constant above"""
"""How a node looks a place up."""


def ros_parameters(
    places: pd.DataFrame,
    route: Float64,
    in_map: Float64,
    bias: Float64,
    spacing: float,
    about: list[str],
) -> str:
    """What places say to Autoware's scan matcher, as the text of a YAML file.

    Its keys are those of `ndt_scan_matcher.param.yaml`; all numbers but one are doubles, as ROS
    wants, and all arrays flat.

    Args:
        places: those that have a covariance: `x`, `y`, `z`, `p_lost` and the scores.
        route: (n, 6, 6) their covariances in the frame of the route.
        in_map: (n, 6, 6) in the map frame.
        bias: (n, 6) the errors that are expected, in the map frame.
        spacing: of the places [m].
        about: what else to say above, a line each.
    """
    thresholds = {name: _threshold(places, name) for name in ("nvtl", "tp")}
    told = [
        USE,
        *about,
        CONSTANT,
        *(
            f"A {name.upper()} of {limit:.3f} is the least normal one of all places: "
            f"{share:.2%} of the registrations that hold are expected above it."
            for name, (limit, share) in thresholds.items()
        ),
        POOR,
        f"{PLACES} has each place, in the axes of the map. How a node looks it up:",
    ]
    lines = [line for sentence in told for line in textwrap.wrap(sentence, 96)]
    lines += [f"  {line}" for line in LOOK_UP.splitlines()]
    by_place = {
        "spacing": spacing,
        "position": places[["x", "y", "z"]].to_numpy(np.float64).round(3),
        "output_pose_covariance": in_map,
        "expected_error": bias,
        **{name: places[name].to_numpy(np.float64) for name in ("nvtl_low", "tp_low", "p_lost")},
    }
    parameters = {
        "score_estimation": {
            "converged_param_type": NVTL,
            "converged_param_transform_probability": thresholds["tp"][0],
            "converged_param_nearest_voxel_transformation_likelihood": thresholds["nvtl"][0],
        },
        "covariance": {"output_pose_covariance": _doubles(_constant(route, in_map))},
        PLACES: {name: _doubles(value) for name, value in by_place.items()},
    }
    comment = "".join(f"# {line}\n" for line in lines)
    node = {"/**": {"ros__parameters": parameters}}
    return comment + yaml.dump(
        node, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None
    )


def _constant(route: Float64, in_map: Float64) -> Float64:
    """(6, 6) the mean of the places, each block in the axes that Autoware takes it to be in; those
    between position and rotation, of which it turns neither side, are 0.
    """
    mean = np.zeros((6, 6))
    mean[:3, :3], mean[3:, 3:] = route[:, :3, :3].mean(axis=0), in_map[:, 3:, 3:].mean(axis=0)
    return mean


def _threshold(places: pd.DataFrame, score: str) -> tuple[float, float]:
    """The least of the low ends of a score, and the share of the registrations that hold which is
    expected above it, every place alike.
    """
    mean, low = (places[name].to_numpy(np.float64) for name in (score, f"{score}_low"))
    known = np.isfinite(mean) & np.isfinite(low)
    limit = float(low[known].min())
    spread = (places[f"{score}_high"].to_numpy(np.float64) - mean) / norm.ppf(0.5 + 0.5 * NORMAL)
    above = norm.sf(limit, mean[known], np.maximum(spread[known], 1e-9))
    return limit, float(above.mean())


def _doubles(values: Any) -> Any:
    """Flat, with nine digits: PyYAML writes them all with a point, which ROS takes for doubles."""
    if isinstance(values, float):
        return values
    return [float(f"{value:.9g}") for value in np.ravel(values).tolist()]
