"""The covariance of a registration at a place (definitions, section 6.8).

Of a filter's registration, which starts from the filter's own prediction and not anywhere in the
disc: the expected error and the core of the starts that hold are made of the moments of the virtual
drive, what real scans add to them is learnt, and the share of the registrations that are lost is
told apart.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from tilestream.errors import ModelError, foreign_errors
from tilestream.factors.along_route import WIDTHS, averaged_along
from tilestream.factors.virtual_drive import RINGS
from tilestream.label import disc_starts
from tilestream.moments import AXES, INDICES, PAIRS, SCORES, unit_of
from tilestream.records import Column, Float64

ELEMENTS = tuple(f"cov_{a}_{b}" for a, b in PAIRS)
"""The upper triangle of the covariance, row by row."""
BIAS = tuple(f"bias_{axis}" for axis in AXES)
"""The expected error."""
_SOURCE = "definitions, section 6.8"
COVARIANCE_COLUMNS = (
    *(
        Column(name, "label", unit_of(a), f"Expected error in {a}, final - true.", _SOURCE)
        for name, a in zip(BIAS, AXES, strict=True)
    ),
    *(
        Column(name, "label", unit_of(a, b), f"Second moment of {a} and {b}.", _SOURCE)
        for name, (a, b) in zip(ELEMENTS, PAIRS, strict=True)
    ),
    Column(
        "p_lost",
        "label",
        "1",
        "Share of registrations from the filter's prediction that end more than 0.5 m away.",
        _SOURCE,
    ),
    *(
        Column(f"{name}{end}", "label", "1", f"{of} {words} of a registration that holds.", _SOURCE)
        for name, words in (("nvtl", "NVTL"), ("tp", "transform probability"))
        for end, of in (("", "Expected"), ("_low", "Least normal"), ("_high", "Largest normal"))
    ),
)
"""What is said of a filter's registration at a place, in the frame of the route."""
NORMAL = 0.95
"""Share of the registrations whose scores are normal."""
_MOMENTS = (*AXES, *(f"{a}_{b}" for a, b in PAIRS))


def ring_weights(prediction_error: float) -> dict[str, float]:
    """The share of a filter's predictions in each ring of the disc, by its name; what lies beyond
    the disc counts as in its outermost ring.

    Args:
        prediction_error: standard deviation in map x and in y [m].
    """
    whole = float(np.hypot(*disc_starts().T).max())
    outer = [edge * whole for _, edge, _ in RINGS.values()][:-1]
    within = [1.0 - math.exp(-0.5 * (edge / prediction_error) ** 2) for edge in outer]
    edges = [0.0, *within, 1.0]
    return {name: edges[k + 1] - edges[k] for k, name in enumerate(RINGS)}


def cores(seen: pd.DataFrame, prediction_error: float, width: float) -> pd.DataFrame:
    """What the virtual drive says of a filter's registration at each place.

    Args:
        seen: a row per sample point: `route_id`, `arc_length`, `status`, and the moments of the
            virtual drive (`factors.virtual_drive.MOMENT_COLUMNS`).
        prediction_error: standard deviation of the filter's prediction in map x and in y [m].
        width: of the kernel along the route over which moments are averaged [m].

    Returns:
        On its index: `BIAS` (mean errors), `ELEMENTS` (second moments about the truth), `p_lost`,
        `nvtl`, `tp`, `nvtl_sd`, `tp_sd`. NaN where nothing holds; `p_lost` is 1 there.
    """
    share, square = np.zeros(len(seen)), np.zeros((len(seen), len(_MOMENTS)))
    for ring, weight in ring_weights(prediction_error).items():
        here = weight * (1.0 - seen[f"vd_{ring}_p_fail"].to_numpy())
        moments = seen[[f"vd_{ring}_{name}" for name in _MOMENTS]].to_numpy()
        share += here
        square += np.where(here[:, None] > 0.0, here[:, None] * moments, 0.0)
    near = 1.0 - seen["vd_near_p_fail"].to_numpy()[:, None]
    mean = seen[[f"vd_near_{name}" for name in SCORES]].to_numpy()
    spread = seen[[f"vd_near_{name}_sd" for name in SCORES]].to_numpy()
    scores = np.where(near > 0.0, near * np.hstack([mean, mean**2 + spread**2]), 0.0)
    columns = ["held", "near", *_MOMENTS, *SCORES, *(f"{name}_square" for name in SCORES)]
    held = pd.DataFrame(np.column_stack([share, near, square, scores]), seen.index, columns)
    keys = seen[["route_id", "arc_length", "status"]]
    held = averaged_along(pd.concat([keys, held], axis=1), width, columns)
    count, near = (held[[name]].where(held[name] > 0.0).to_numpy() for name in ("held", "near"))
    found = np.column_stack(
        [held[list(_MOMENTS)].to_numpy() / count, 1.0 - held["held"], held[list(SCORES)] / near]
    )
    mean = found[:, -len(SCORES) :]
    spread = held[[f"{name}_square" for name in SCORES]].to_numpy() / near - mean**2
    spread = np.sqrt(np.maximum(spread, 0.0))
    names = [*BIAS, *ELEMENTS, "p_lost", *SCORES, *(f"{name}_sd" for name in SCORES)]
    return pd.DataFrame(np.column_stack([found, spread]), seen.index, names)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What real scans add to the cores of virtual ones."""

    gain: Float64
    """(6,) how much of the mean error of the virtual drive is expected of a real scan."""
    scale: Float64
    """(6,) what the variance of each axis about that is multiplied by …"""
    added: Float64
    """(6,) … and what is added to it [m^2, rad^2]."""
    lost: float
    """What is added to the share of lost registrations."""
    scores: Mapping[str, tuple[float, float]]
    """By `SCORES`: how many times larger a real score is than a virtual one, and its standard
    deviation than that of the virtual ones."""
    width: float
    """Of the kernel along the route [m]."""
    places: int
    """On how many labels it was learnt; 0: it is what the virtual drive says."""


def as_json(calibration: Calibration) -> dict[str, Any]:
    """A calibration as plain JSON."""
    return {
        "gain": calibration.gain.tolist(),
        "scale": calibration.scale.tolist(),
        "added": calibration.added.tolist(),
        "lost": calibration.lost,
        "scores": {name: list(pair) for name, pair in calibration.scores.items()},
        "width": calibration.width,
        "places": calibration.places,
    }


def from_json(told: Any) -> Calibration:
    """A calibration from `as_json`.

    Raises:
        ModelError: it is not one.
    """
    with foreign_errors(ModelError, "a damaged model file: no covariances", "train it again"):
        gain, scale, added = (np.array(told[n], np.float64) for n in ("gain", "scale", "added"))
        of_axes = (gain, scale, added)
        scores = {
            name: (float(told["scores"][name][0]), float(told["scores"][name][1]))
            for name in SCORES
        }
        numbers = [*itertools.chain(*of_axes), told["lost"], *itertools.chain(*scores.values())]
        if any(one.shape != (6,) for one in of_axes) or not np.isfinite(numbers).all():
            raise ValueError("not six finite numbers each")
        if any((one < 0.0).any() for one in of_axes) or told["width"] not in WIDTHS:
            raise ValueError("a variance below 0, or no width of averages")
        width, places = float(told["width"]), int(told["places"])
        return Calibration(gain, scale, added, float(told["lost"]), scores, width, places)


def as_it_is(width: float) -> Calibration:
    """Of a virtual drive without training."""
    plain = dict.fromkeys(SCORES, (1.0, 1.0))
    return Calibration(np.ones(6), np.ones(6), np.zeros(6), 0.0, plain, width, 0)


def calibration_told(calibration: Calibration | None) -> str:
    """On what covariances rest, in words; None: of a model without, or of none."""
    if calibration is None or not calibration.places:
        return "not calibrated: the virtual drive as it is"
    return f"calibrated on {calibration.places:,} labels"


def calibrated(core: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """The covariances of places, in `COVARIANCE_COLUMNS`, on the index of `core` (`cores`)."""
    bias = calibration.gain * core[list(BIAS)].to_numpy()
    root = np.sqrt(calibration.scale)
    second = root[:, None] * root * about(matrices(core), core[list(BIAS)].to_numpy(), bias)
    second += np.diag(calibration.added) + bias[:, :, None] * bias[:, None, :]
    p_lost = np.clip(core["p_lost"] + calibration.lost, 0.0, 1.0)
    found = [bias, np.column_stack([second[:, i, j] for i, j in INDICES]), p_lost]
    reach = math.sqrt(float(chi2.ppf(NORMAL, 1)))
    for name in SCORES:
        larger, wider = calibration.scores[name]
        mean = larger * core[name].to_numpy()
        spread = reach * wider * core[f"{name}_sd"].to_numpy()
        found += [mean, np.maximum(mean - spread, 0.0), mean + spread]
    names = [column.name for column in COVARIANCE_COLUMNS]
    return pd.DataFrame(np.column_stack(found), core.index, names)


def about(second: Float64, mean: Float64, expected: Float64) -> Float64:
    """(n, 6, 6) second moments about expected errors from those about the truth.

    Args:
        second: (n, 6, 6) about the truth.
        mean: (n, 6) of the same errors.
        expected: (n, 6) what is taken away.
    """
    both = expected[:, :, None] * mean[:, None, :]
    own = expected[:, :, None] * expected[:, None, :]
    found: Float64 = second - both - both.transpose(0, 2, 1) + own
    return found


def matrices(places: pd.DataFrame, prefix: str = "cov_") -> Float64:
    """(n, 6, 6) second moments about the truth in the frame of the route, from `ELEMENTS`: for a
    filter that takes registrations as they are.

    Args:
        places: with these columns.
        prefix: of their names.
    """
    found = np.empty((len(places), 6, 6))
    for (a, b), (i, j) in zip(PAIRS, INDICES, strict=True):
        found[:, i, j] = found[:, j, i] = places[f"{prefix}{a}_{b}"].to_numpy(np.float64)
    return found


def about_bias(places: pd.DataFrame) -> Float64:
    """(n, 6, 6) covariances about the expected errors (`BIAS`) in the frame of the route: for a
    filter that takes these from its registrations.
    """
    bias = places[list(BIAS)].to_numpy(np.float64)
    found: Float64 = matrices(places) - bias[:, :, None] * bias[:, None, :]
    return found


def in_map(route: Float64, heading: Float64) -> Float64:
    """(n, 6, 6) covariances in the map frame (x, y, z, rotation vector) from those in that of the
    route (along, across, up, rotation vector), whose `heading` (n,) is from the map's x axis [rad].
    """
    turn = _turn(heading)
    turned: Float64 = np.einsum("nij,njk,nlk->nil", turn, route, turn)
    return turned


def errors_in_map(route: Float64, heading: Float64) -> Float64:
    """(n, 6) errors in the map frame from those in that of the route, as `in_map`."""
    turned: Float64 = np.einsum("nij,nj->ni", _turn(heading), route)
    return turned


def _turn(heading: Float64) -> Float64:
    """(n, 6, 6) from the frame of the route to that of the map, position and rotation alike."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.zeros((len(heading), 6, 6))
    for at in (0, 3):
        turn[:, at, at] = turn[:, at + 1, at + 1] = c
        turn[:, at, at + 1], turn[:, at + 1, at] = -s, s
        turn[:, at + 2, at + 2] = 1.0
    return turn
