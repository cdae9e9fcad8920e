"""How covariances are calibrated on labels (definitions, section 6.8)."""

import numpy as np
import pandas as pd

from tilestream.errors import ModelError
from tilestream.factors.along_route import WIDTH, WIDTHS
from tilestream.model.covariance import (
    BIAS,
    Calibration,
    about,
    about_bias,
    as_it_is,
    calibrated,
    cores,
    matrices,
)
from tilestream.model.dataset import Dataset
from tilestream.model.splits import block_splits
from tilestream.moments import AXES, SCORES
from tilestream.records import Float64
from tilestream.settings import PREDICTION_ERROR

NEAR_MEANS = tuple(f"near_{axis}" for axis in AXES)
"""The mean errors of a label's near starts."""
RATIOS = tuple(2.0 ** (k / 4.0) for k in range(-24, 25))
"""Candidates for what is added to a variance, in mean variances of the virtual drive."""


def calibrate_covariance(core: pd.DataFrame, labels: pd.DataFrame, width: float) -> Calibration:
    """What the labels of places add to their cores.

    The gain of an axis is the least squares one of the labels' mean errors on those of the virtual
    drives, from 0 to 1. Scale and addition are the likeliest of Gaussian errors about the expected
    one whose second moment is what the label has, so that errors normalised by them have a mean
    square of 1.

    Args:
        core: of the places (`cores`, averaged over `width`).
        labels: their label rows: `near_p_fail`, `near_along_along`, …; `near_nvtl`, …
        width: of the kernel [m].

    Returns:
        The calibration; that of a virtual drive without training where no place has both.
    """
    good = (core["cov_along_along"].notna() & labels["near_along_along"].notna()).to_numpy()
    if not good.any():
        return as_it_is(width)
    core, labels = core[good], labels[good]
    mean, real = core[list(BIAS)].to_numpy(), labels[list(NEAR_MEANS)].to_numpy()
    power = (mean**2).sum(axis=0)
    gain = np.clip((mean * real).sum(axis=0) / np.where(power > 0.0, power, 1.0), 0.0, 1.0)
    virtual = about(matrices(core), mean, gain * mean)
    measured = about(matrices(labels, "near_"), real, gain * mean)
    fits = [_fitted(virtual[:, i, i], measured[:, i, i]) for i in range(len(AXES))]
    scale, added = np.array(fits).T
    lost = float((labels["near_p_fail"].to_numpy() - core["p_lost"].to_numpy()).mean())
    scores = {name: _scores(core, labels, name) for name in SCORES}
    return Calibration(gain, scale, added, lost, scores, width, len(core))


def _scores(core: pd.DataFrame, labels: pd.DataFrame, name: str) -> tuple[float, float]:
    """How many times larger a real score is, and its standard deviation: of places whose near ring
    holds by one start at least, all their squares together, since that of one start has no spread.
    """
    known = core[name].notna().to_numpy()
    virtual, sd = (core.loc[known, f"{name}{end}"].to_numpy() for end in ("", "_sd"))
    score, spread = (labels.loc[known, f"near_{name}{end}"].to_numpy() for end in ("", "_sd"))
    if not sd.any():
        return 1.0, 1.0
    times = float(np.median(score / virtual))
    off = (score - times * virtual) ** 2 + spread**2
    return times, float(np.sqrt(off.sum() / (sd**2).sum()))


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


def unlikelihood(places: pd.DataFrame, labels: pd.DataFrame) -> Float64:
    """(k,) how unlikely the errors of held starts are: minus the logarithm of a Gaussian density in
    position about the expected error, doubled, without its constant, of the places that have both.
    """
    good = (places["cov_along_along"].notna() & labels["near_along_along"].notna()).to_numpy()
    places, labels = places[good], labels[good]
    bias, mean = places[list(BIAS)].to_numpy(), labels[list(NEAR_MEANS)].to_numpy()
    covariance = about_bias(places)[:, :3, :3]
    measured = about(matrices(labels, "near_"), mean, bias)[:, :3, :3]
    fits = (np.linalg.inv(covariance) * measured).sum(axis=(1, 2))
    found: Float64 = np.linalg.slogdet(covariance)[1] + fits
    return found


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
