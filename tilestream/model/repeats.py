"""What drives that were repeated say of each other: how much any estimate can know."""

import numpy as np
import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.bootstrap import resampled, span
from tilestream.model.dataset import Dataset, nearest_along
from tilestream.model.figures import with_spans
from tilestream.records import Float64, Int64

SAME_PLACE = 0.5
"""How far apart along a path the labels of two drives are of one place [m]."""


def repeated(dataset: Dataset, target: str = "error_mean") -> dict[str, float]:
    """How well a repeated drive estimates another, and how well their true mean would.

    A drive is one noisy draw, so a repeated drive is no ceiling: what knows the mean of all draws
    is nearer to each than they are to each other. With a truth and independent normal noise the
    mean of m drives is off another one by sqrt(1 + 1/m) times what the truth is off it. The mean
    errors of the means of 1, 2, … drives are fitted by that (least squares), and `limit` is the
    skill where m has no end.

    Every label is compared with the nearest of each other drive, at most 0.5 m away along the path;
    a drive that is read as another lidar is none.
    The median of the skill is that of all labels.

    Returns:
        The figures of a repeated drive (`figures.FIGURES`), `drives` (the most that a place has),
        `limit`, and its 90 % interval by resampled blocks, `limit_low` and `limit_high`.

    Raises:
        ModelError: no place was driven twice.
    """
    places, labels = _of_other_drives(dataset, target)
    there = np.isfinite(labels)
    if not there.any():
        raise ModelError("no place was driven twice: that needs a repeated drive")
    median = float(np.median(dataset.label(target)))
    row, other = np.nonzero(there)
    pairs = places.iloc[row].assign(estimate=labels[row, other], median=median, fold="")
    pairs = pairs.assign(group=pairs["group"] + pd.Series(other, pairs.index).map(" by {}".format))
    most = int(there.sum(axis=1).max())
    names, block = np.unique(places["block"].to_numpy(str), return_inverse=True)
    errors, of_median = _by_drives(places["actual"].to_numpy(), labels, median, block, most)
    counts = resampled(len(names))
    low, high = span(_limit(counts @ errors.T, counts @ of_median.T))
    known = len(names) > 1
    return with_spans(pairs) | {
        "drives": most + 1,
        "limit": float(_limit(errors.sum(axis=1)[None], of_median.sum(axis=1)[None])[0]),
        "limit_low": low if known else float("nan"),
        "limit_high": high if known else float("nan"),
    }


def _of_other_drives(dataset: Dataset, target: str) -> tuple[pd.DataFrame, Float64]:
    """The labelled places (`actual` is the label), and (n, drives) what each other drive has there;
    NaN where it has nothing, and for the drive itself.
    """
    here = dataset.rows[["path", "block", "arc_length", "group", "as_sensor", target]]
    here = here.rename(columns={target: "actual"})
    names = sorted(here["group"].unique())
    labels = np.full((len(here), len(names)), np.nan)
    for k, name in enumerate(names):
        own = (here["group"] == name).to_numpy()
        drive = here.loc[own, ["path", "arc_length", "actual"]].rename(columns={"actual": "again"})
        others = ~own & here["as_sensor"].isin(here.loc[own, "as_sensor"]).to_numpy()
        if others.any():
            found = nearest_along(here[others], drive, SAME_PLACE)
            labels[others, k] = found["again"].to_numpy(np.float64)
    return here, labels


def _by_drives(
    actual: Float64, labels: Float64, median: float, block: Int64, most: int
) -> tuple[Float64, Float64]:
    """(most, blocks) sums of what means of 1, 2, … other drives are off a label, and of what the
    median is off the same labels.

    Of the drives of a place so many neighbours in the order of their names make a mean, in a ring.
    """
    blocks = int(block.max()) + 1
    errors, of_median = np.zeros((most, blocks)), np.zeros((most, blocks))
    order = np.argsort(np.isnan(labels), axis=1, kind="stable")
    first = np.take_along_axis(labels, order, axis=1)  # those that are there
    count = np.isfinite(labels).sum(axis=1)
    for drives in range(1, most + 1):
        rows = np.flatnonzero(count == drives)
        others = np.hstack([first[rows, :drives]] * 2)
        for m in range(1, drives + 1):
            means = [others[:, k : k + m].mean(axis=1) for k in range(drives)]
            off = np.mean([np.abs(mean - actual[rows]) for mean in means], axis=0)
            errors[m - 1] += np.bincount(block[rows], off, blocks)
            of_median[m - 1] += np.bincount(block[rows], np.abs(median - actual[rows]), blocks)
    return errors, of_median


def _limit(errors: Float64, of_median: Float64) -> Float64:
    """(k,) skill of the truth, from (k, most) sums by the number of drives."""
    expected = np.sqrt(1.0 + 1.0 / np.arange(1, errors.shape[1] + 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = errors / of_median
    there = np.isfinite(ratio)
    fitted = (np.where(there, ratio, 0.0) * expected).sum(axis=1)
    with np.errstate(invalid="ignore"):
        limit: Float64 = 1.0 - fitted / (there * expected**2).sum(axis=1)
    return limit
