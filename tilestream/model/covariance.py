"""The covariance of a registration at a place (definitions, section 6.8).

Of a filter's registration, which starts from the filter's own prediction and not anywhere in the
disc: the core of the starts that hold is made of the moments of the virtual drive, what real scans
add to it is learnt, and the share of the registrations that are lost is told apart.
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
from tilestream.factors.along_route import WIDTH, WIDTHS, averaged_along
from tilestream.factors.virtual_drive import RINGS
from tilestream.label import disc_starts
from tilestream.model.dataset import Dataset
from tilestream.model.splits import block_splits
from tilestream.moments import AXES, PAIRS, SCORES, unit_of
from tilestream.records import Column, Float64
from tilestream.settings import PREDICTION_ERROR

ELEMENTS = tuple(f"cov_{a}_{b}" for a, b in PAIRS)
"""The upper triangle of the covariance, row by row."""
_SOURCE = "definitions, section 6.8"
COVARIANCE_COLUMNS = (
    *(
        Column(name, "label", unit_of(a, b), f"Covariance of the errors in {a} and {b}.", _SOURCE)
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
RATIOS = tuple(2.0 ** (k / 4.0) for k in range(-24, 25))
"""Candidates for what is added to a variance, in mean variances of the virtual drive."""
_INDEX = tuple((AXES.index(a), AXES.index(b)) for a, b in PAIRS)
_MOMENTS = tuple(f"{a}_{b}" for a, b in PAIRS)


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
        On its index: `ELEMENTS` (second moments about the truth, so that a bias counts), `p_lost`,
        `nvtl`, `nvtl_sd`, `tp`, `tp_sd`. NaN where nothing holds; `p_lost` is 1 there.
    """
    share, square = np.zeros(len(seen)), np.zeros((len(seen), len(PAIRS)))
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
    names = [*ELEMENTS, "p_lost", *SCORES, *(f"{name}_sd" for name in SCORES)]
    return pd.DataFrame(np.column_stack([found, spread]), seen.index, names)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What real scans add to the cores of virtual ones."""

    scale: Float64
    """(6,) what the second moment of each axis is multiplied by …"""
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
        scale, added = (np.array(told[name], np.float64) for name in ("scale", "added"))
        scores = {
            name: (float(told["scores"][name][0]), float(told["scores"][name][1]))
            for name in SCORES
        }
        numbers = [*scale, *added, told["lost"], *itertools.chain(*scores.values())]
        if scale.shape != (6,) or added.shape != (6,) or not np.isfinite(numbers).all():
            raise ValueError("not six finite numbers each")
        if (scale < 0.0).any() or (added < 0.0).any() or told["width"] not in WIDTHS:
            raise ValueError("a variance below 0, or no width of averages")
        width, places = float(told["width"]), int(told["places"])
        return Calibration(scale, added, float(told["lost"]), scores, width, places)


def as_it_is(width: float) -> Calibration:
    """Of a virtual drive without training."""
    plain = dict.fromkeys(SCORES, (1.0, 1.0))
    return Calibration(np.ones(6), np.zeros(6), 0.0, plain, width, 0)


def calibrated(core: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """The covariances of places, in `COVARIANCE_COLUMNS`, on the index of `core` (`cores`)."""
    root = np.sqrt(calibration.scale)
    times = [root[i] * root[j] for i, j in _INDEX]
    added = [calibration.added[i] if i == j else 0.0 for i, j in _INDEX]
    p_lost = np.clip(core["p_lost"] + calibration.lost, 0.0, 1.0)
    found = [core[list(ELEMENTS)].to_numpy() * times + added, p_lost]
    reach = math.sqrt(float(chi2.ppf(NORMAL, 1)))
    for name in SCORES:
        larger, wider = calibration.scores[name]
        mean = larger * core[name].to_numpy()
        spread = reach * wider * core[f"{name}_sd"].to_numpy()
        found += [mean, np.maximum(mean - spread, 0.0), mean + spread]
    names = [column.name for column in COVARIANCE_COLUMNS]
    return pd.DataFrame(np.column_stack(found), core.index, names)


def calibrate_covariance(core: pd.DataFrame, labels: pd.DataFrame, width: float) -> Calibration:
    """What the labels of places add to their cores.

    Scale and addition of an axis are the likeliest of Gaussian errors whose second moment is what
    the label has, so that errors normalised by them have a mean square of 1.

    Args:
        core: of the places (`cores`, averaged over `width`).
        labels: their label rows: `near_p_fail`, `near_along_along`, …; `near_nvtl`, …
        width: of the kernel [m].
    """
    good = (core["cov_along_along"].notna() & labels["near_along_along"].notna()).to_numpy()
    core, labels = core[good], labels[good]
    fits = [
        _fitted(core[f"cov_{a}_{a}"].to_numpy(), labels[f"near_{a}_{a}"].to_numpy()) for a in AXES
    ]
    scale, added = np.array(fits).T
    lost = float((labels["near_p_fail"].to_numpy() - core["p_lost"].to_numpy()).mean())
    scores = {}
    for name in SCORES:
        real, spread = (labels[f"near_{name}{end}"].to_numpy() for end in ("", "_sd"))
        times = float(np.median(real / core[name]))
        off = ((real - times * core[name]) ** 2 + spread**2) / core[f"{name}_sd"] ** 2
        scores[name] = (times, float(np.sqrt(off.mean())))
    return Calibration(scale, added, lost, scores, width, len(core))


def cores_of(dataset: Dataset, prediction_error: float, width: float) -> pd.DataFrame:
    """The cores (`cores`) of the places of a dataset, on the index of its rows; their neighbours
    are all places of the same drive, labelled or not.
    """
    seen = dataset.virtual_drives
    drives = [cores(drive, prediction_error, width) for _, drive in seen.groupby("group")]
    keys = ["group", "sample"]
    found = pd.concat(drives).join(seen[keys]).set_index(keys)
    here = found.reindex(pd.MultiIndex.from_frame(dataset.rows[keys]))
    return here.set_index(dataset.rows.index)


def calibration_of(dataset: Dataset) -> Calibration | None:
    """What the labels of a dataset add to the cores of its places.

    The width of the kernel is the candidate whose calibration makes the errors on held-out blocks
    likeliest; `WIDTH` where none can be held out.

    Returns:
        None: no virtual drives, or labels without moments, as those of older versions.
    """
    if dataset.virtual_drives.empty or "near_along_along" not in dataset.rows:
        return None
    try:
        splits = block_splits(dataset)
    except ModelError:
        widths: tuple[float, ...] = (WIDTH,)
        splits = []
    else:
        widths = WIDTHS
    labels, found = dataset.rows, []
    for width in widths:
        core = cores_of(dataset, PREDICTION_ERROR, width)
        surprise = [
            unlikelihood(
                calibrated(
                    core.iloc[s.test],
                    calibrate_covariance(core.iloc[s.train], labels.iloc[s.train], width),
                ),
                labels.iloc[s.test],
            )
            for s in splits
        ]
        total = sum(float(one.sum()) for one in surprise)
        found.append((total, calibrate_covariance(core, labels, width)))
    return min(found, key=lambda one: one[0])[1]


def unlikelihood(places: pd.DataFrame, labels: pd.DataFrame) -> pd.Series:
    """How unlikely the errors of held starts are under covariances: minus the logarithm of a
    Gaussian density in position, doubled, without its constant; a row per place that has both.
    """
    good = (places["cov_along_along"].notna() & labels["near_along_along"].notna()).to_numpy()
    covariance = matrices(places[good])[:, :3, :3]
    seen = np.empty_like(covariance)
    for (a, b), (i, j) in zip(PAIRS, _INDEX, strict=True):
        if i < 3 and j < 3:
            seen[:, i, j] = seen[:, j, i] = labels.loc[good, f"near_{a}_{b}"]
    fits = np.einsum("nij,nji->n", np.linalg.inv(covariance), seen)
    return pd.Series(np.linalg.slogdet(covariance)[1] + fits, index=places.index[good])


def _fitted(core: Float64, label: Float64) -> tuple[float, float]:
    """Scale and addition of one axis: of variances s (core + r) the likeliest s is the mean of
    label / (core + r), so only r is searched for.
    """
    typical = max(float(core.mean()), 1e-18)
    added = typical * np.array([0.0, *RATIOS])
    variance = np.maximum(core + added[:, None], 1e-6 * typical)
    scale = (label / variance).mean(axis=1)
    unlikely = np.log(np.maximum(scale, 1e-12)) + np.log(variance).mean(axis=1)
    best = int(np.argmin(unlikely))
    return float(scale[best]), float(scale[best] * added[best])


def matrices(places: pd.DataFrame) -> Float64:
    """(n, 6, 6) covariances in the frame of the route, from `ELEMENTS`."""
    found = np.empty((len(places), 6, 6))
    for name, (i, j) in zip(ELEMENTS, _INDEX, strict=True):
        found[:, i, j] = found[:, j, i] = places[name].to_numpy(np.float64)
    return found


def in_map(route: Float64, heading: Float64) -> Float64:
    """(n, 6, 6) covariances in the map frame (x, y, z, rotation vector) from those in that of the
    route (along, across, up, rotation vector), whose `heading` (n,) is from the map's x axis [rad].
    """
    c, s = np.cos(heading), np.sin(heading)
    turn = np.zeros((len(heading), 6, 6))
    for at in (0, 3):
        turn[:, at, at] = turn[:, at + 1, at + 1] = c
        turn[:, at, at + 1], turn[:, at + 1, at] = -s, s
        turn[:, at + 2, at + 2] = 1.0
    turned: Float64 = np.einsum("nij,njk,nlk->nil", turn, route, turn)
    return turned
