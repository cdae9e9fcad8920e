"""Intervals from held-out points, calibrated by blocks: neighbouring points err together."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from tilestream.model.bootstrap import resampled
from tilestream.model.dataset import LEAST
from tilestream.records import Float64

LEVEL = 0.9
"""Share of the places whose error shall lie in the interval."""
SHARES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Candidates for `Interval.constant`, as shares of the median error: from intervals that grow with
the estimate to such that are equally wide everywhere."""
SIDE = 0.95
"""Share of the misses that the shape of an interval is taken from, on each side."""
LEAST_SIDE = 0.5
"""Shortest side of an interval, as a share of the other: with 0.1 the intervals of three blocks
that differ much held 78 % instead of 85 (tests/test_model_intervals.py), and were no narrower."""
TINY = 1e-12
"""Where nothing misses on any side."""


@dataclass(frozen=True)
class Interval:
    """An interval round every estimate: from estimate - below s to estimate + above s, with the
    scale s = constant + estimate; what is below 0 is cut off.
    """

    level: float
    """Share of the places of new blocks that it is to hold, on average; NaN: not calibrated."""
    constant: float
    """Part of the scale that is the same everywhere [m]; NaN: not calibrated."""
    below: float
    """How far down it reaches, in scales, at least 0; NaN: not calibrated."""
    above: float
    """How far up, likewise."""
    blocks: int
    """Blocks that it was calibrated on."""

    def around(self, estimate: Float64, widen: Float64 | float = 1.0) -> tuple[Float64, Float64]:
        """Lower and upper end [the unit of the estimate]; NaN where not calibrated.

        Args:
            estimate: (n,) at least 0.
            widen: (n,) or one: both sides are so many times longer; at least 1.
        """
        scale = widen * (self.constant + estimate)
        return np.maximum(estimate - self.below * scale, 0.0), estimate + self.above * scale


_NAN = float("nan")
NOT_CALIBRATED = Interval(_NAN, _NAN, _NAN, _NAN, 0)
"""For a drive too short to hold out a block."""


def calibrate(
    actual: Float64, estimate: Float64, block: NDArray[np.str_], level: float = LEVEL
) -> Interval:
    """The interval from points that the model had not seen.

    Of each candidate for the constant the misses (actual - estimate) / scale give the shape, how
    far the interval reaches down for each step up: the 95 % quantiles of the misses on the two
    sides, each at least half of the other, every block weighing the same. The score of a point
    is its miss in shapes of its side, and the size of the interval is the `level` quantile of the
    scores, every block weighing the same. One block more stands for the unknown one: it is taken to
    be as hard as the hardest of the known (that of the highest `level` quantile of its own scores;
    of equals the first by name), which therefore weighs twice. The candidate counts whose interval
    has the least interval score (`interval_score`) in the geometric mean over the places, every
    block weighing the same: widths are compared as ratios, so places of small errors and of large
    ones count alike. The narrowest interval in the plain mean would be as wide for all, and hold
    nearly all of the small errors and few of the large ones.

    The level is an estimate: right on average over blocks, while single blocks hold more or less.
    What holds for any blocks whatever (hierarchical conformal prediction: Lee, Barber and Willett
    2023) puts the unknown block at infinity, and holds 95 to 99 % where 90 % are promised, since a
    drive has few blocks.

    Args:
        actual: (n,) labels, lengths.
        estimate: (n,) held-out estimates, at least 0.
        block: (n,) names of the blocks.
        level: share of the places to hold.

    Returns:
        The interval; `NOT_CALIBRATED` of a single block.
    """
    names, index = np.unique(block, return_inverse=True)
    if len(names) < 2:
        return NOT_CALIBRATED
    even = (1.0 / np.bincount(index))[index] / len(names)
    typical = max(float(np.median(actual)), LEAST)
    found: list[tuple[float, Interval]] = []
    for share in SHARES:
        constant = share * typical
        miss = (actual - estimate) / (constant + estimate)
        sides = [max(weighted_quantile(x, even, SIDE), 0.0) for x in (-miss, miss)]
        down, up = (max(side, LEAST_SIDE * max(sides), TINY) for side in sides)
        score = np.maximum(miss / up, -miss / down)
        size = _of_blocks(score, index, level) * wider_for_few(len(names), level)
        interval = Interval(level, constant, size * down, size * up, len(names))
        low, high = interval.around(estimate)
        score = np.maximum(interval_score(actual, low, high, level), TINY)
        found.append((float((even * np.log(score)).sum()), interval))
    return min(found, key=lambda one: one[0])[1]


def stretch(
    interval: Interval, actual: Float64, estimate: Float64, block: NDArray[np.str_]
) -> float:
    """How many times longer an interval has to be to hold `LEVEL` of the places of some blocks.

    As in `calibrate` every block weighs the same, the hardest twice, and few blocks ask for more.

    Args:
        interval: a calibrated one.
        actual: (n,) labels.
        estimate: (n,) their estimates.
        block: (n,) names of the blocks.
    """
    names, index = np.unique(block, return_inverse=True)
    miss = (actual - estimate) / (interval.constant + estimate)
    score = np.maximum(miss / interval.above, -miss / interval.below)
    return _of_blocks(score, index, LEVEL) * wider_for_few(len(names))


def interval_score(actual: Float64, low: Float64, high: Float64, level: float) -> Float64:
    """(n,) width of each interval and a fine for a miss: 2 / (1 - level) times how far it is off.

    Least in the mean where the ends are the true quantiles (Gneiting and Raftery 2007, eq. 43).
    """
    off = np.maximum(low - actual, 0.0) + np.maximum(actual - high, 0.0)
    return high - low + 2.0 / (1.0 - level) * off


def wider_for_few(blocks: int, level: float = LEVEL) -> float:
    """How many times longer an interval is for being calibrated on few blocks; 1 for many.

    The quantile of Student's t over that of a normal. With a block more that is as hard as the
    hardest, what B blocks lack falls faster than 1 / B: with B^2 degrees of freedom the intervals
    of 2, 3, 4, 6 and 12 blocks hold 90 % within 3 % in the mean over drives whose blocks differ not
    at all up to by a factor of 2.2 (one standard deviation), and without it those of two blocks
    83 % (tests/test_model_intervals.py).

    Args:
        blocks: how many, at least 1.
        level: share of the places to hold, in (0, 1).
    """
    share = 0.5 + 0.5 * level
    return float(stdtrit(float(blocks) ** 2, share) / ndtri(share))


def _of_blocks(score: Float64, index: NDArray[np.int64], level: float) -> float:
    """The quantile of scores where blocks weigh the same, and the hardest twice."""
    count = np.bincount(index)
    hard = [np.quantile(score[index == k], level) for k in range(len(count))]
    weights = np.ones(len(count))
    weights[int(np.argmax(np.isclose(hard, max(hard))))] = 2.0  # of equals the first, if rounded
    return weighted_quantile(score, (weights / count)[index] / weights.sum(), level)


def weighted_quantile(values: Float64, weight: Float64, share: float) -> float:
    """The least of (n,) values up to which a share of their (n,) weights lies, which sum to 1."""
    order = np.argsort(values, kind="stable")
    # Sums of weights are not exact: 1e-9 keeps rounding from passing over the last point.
    rank = int(np.searchsorted(np.cumsum(weight[order]), share - 1e-9))
    return float(values[order][min(rank, len(values) - 1)])


def with_intervals(points: pd.DataFrame, level: float = LEVEL) -> pd.DataFrame:
    """Held-out points with intervals that were calibrated on the other paths only.

    Args:
        points: held-out points (`evaluation.held_out`).
        level: share of the places to hold.

    Returns:
        The points with `low` and `high` [unit of the estimate]; NaN on a path that has no two
        blocks elsewhere.
    """
    path, block = points["path"].to_numpy(str), points["block"].to_numpy(str)
    actual, estimate = points["actual"].to_numpy(), points["estimate"].to_numpy()
    low, high = np.full(len(points), np.nan), np.full(len(points), np.nan)
    for name in np.unique(path):
        here = path == name
        interval = calibrate(actual[~here], estimate[~here], block[~here], level)
        low[here], high[here] = interval.around(estimate[here])
    return points.assign(low=low, high=high)


def coverage(points: pd.DataFrame, level: float = LEVEL) -> pd.DataFrame:
    """How often intervals hold on each path, calibrated on the other paths only, and on all.

    Args:
        points: held-out points (`evaluation.held_out`).
        level: share of the places to hold.

    Returns:
        A row per path, and first one with an empty `path` for all that have an interval: `path`,
        `points`, `blocks`, `level` (what was promised), `covered` (share of the points inside),
        `error` (its standard error by resampled blocks; NaN of one block), `width` (mean, unit of
        the estimate). Without an interval `level` and all after it are NaN.
    """
    seen = with_intervals(points, level)
    there = seen[seen["low"].notna()]
    parts = [("", there)] + [(str(name), part) for name, part in seen.groupby("path")]
    return pd.DataFrame([{"path": name, **_covered(part, level)} for name, part in parts])


def _covered(points: pd.DataFrame, level: float) -> dict[str, float]:
    """A row of `coverage`."""
    blocks = points["block"].nunique()
    found = {"points": len(points), "blocks": blocks}
    if points.empty or points["low"].isna().any():
        return found | dict.fromkeys(("level", "covered", "error", "width"), _NAN)
    inside = points["actual"].between(points["low"], points["high"])
    by_block = inside.groupby(points["block"]).agg(["sum", "size"]).to_numpy(np.float64)
    held = resampled(len(by_block)) @ by_block
    return found | {
        "level": level,
        "covered": float(inside.mean()),
        "error": float((held[:, 0] / held[:, 1]).std(ddof=1)) if blocks > 1 else _NAN,
        "width": float((points["high"] - points["low"]).mean()),
    }
