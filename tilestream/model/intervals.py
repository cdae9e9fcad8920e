"""Intervals from held-out points, calibrated by blocks: neighbouring points err together."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.model.dataset import LEAST
from tilestream.records import Float64

LEVEL = 0.9
"""Share of the places whose error shall lie in the interval."""


@dataclass(frozen=True)
class Interval:
    """An interval round every estimate: from estimate / factor to estimate * factor."""

    level: float
    """Share of the places of new blocks that it is to hold, on average; NaN: not calibrated."""
    factor: float
    """How many times larger or smaller the error may be, >= 1; NaN: not calibrated."""
    blocks: int
    """Blocks that it was calibrated on."""

    def around(self, estimate: Float64) -> tuple[Float64, Float64]:
        """Lower and upper end [the unit of the estimate]; NaN where not calibrated."""
        return estimate / self.factor, estimate * self.factor


NOT_CALIBRATED = Interval(float("nan"), float("nan"), 0)
"""For a drive too short to hold out a block."""


def calibrate(
    actual: Float64, estimate: Float64, block: NDArray[np.str_], level: float = LEVEL
) -> Interval:
    """The interval from points that the model had not seen.

    The score of a point is abs(log(actual / estimate)), and the factor is the `level` quantile of
    the scores, every block weighing the same. One block more stands for the unknown one: it is
    taken to be as hard as the hardest of the known (that of the highest `level` quantile of its own
    scores; of equals the first by name), which therefore weighs twice.

    The level is an estimate: right on average over blocks, while single blocks hold more or less.
    What holds for any blocks whatever (hierarchical conformal prediction: Lee, Barber and Willett
    2023) puts the unknown block at infinity, and holds 95 to 99 % where 90 % are promised, since a
    drive has few blocks.

    Args:
        actual: (n,) labels, lengths.
        estimate: (n,) held-out estimates.
        block: (n,) names of the blocks.
        level: share of the places to hold.

    Returns:
        The interval; `NOT_CALIBRATED` of a single block.
    """
    names, index = np.unique(block, return_inverse=True)
    if len(names) < 2:
        return NOT_CALIBRATED
    score = np.abs(np.log(np.maximum(actual, LEAST) / np.maximum(estimate, LEAST)))
    hard = [np.quantile(score[index == k], level) for k in range(len(names))]
    share = np.ones(len(names))
    share[int(np.argmax(hard))] = 2.0
    weight = (share / np.bincount(index))[index] / share.sum()
    order = np.argsort(score, kind="stable")
    # Sums of weights are not exact: 1e-9 keeps rounding from passing over the last point.
    rank = int(np.searchsorted(np.cumsum(weight[order]), level - 1e-9))
    quantile = score[order][min(rank, len(score) - 1)]
    return Interval(level, float(np.exp(quantile)), len(names))


def coverage(points: pd.DataFrame, level: float = LEVEL) -> pd.DataFrame:
    """How often intervals hold on each path, calibrated on the other paths only.

    Args:
        points: held-out points (`evaluation.held_out`).
        level: share of the places to hold.

    Returns:
        A row per path: `path`, `points`, `level` (what was promised), `covered` (share of the
        points inside), `factor`. A path that has no two blocks elsewhere has NaN.
    """
    rows = []
    path = points["path"].to_numpy(str)
    actual, estimate = points["actual"].to_numpy(), points["estimate"].to_numpy()
    block = points["block"].to_numpy(str)
    for name in np.unique(path):
        here = path == name
        interval = calibrate(actual[~here], estimate[~here], block[~here], level)
        low, high = interval.around(estimate[here])
        inside = (low <= actual[here]) & (actual[here] <= high)
        covered = float(inside.mean()) if interval.blocks else float("nan")
        rows.append(
            {
                "path": name,
                "points": int(here.sum()),
                "level": interval.level,
                "covered": covered,
                "factor": interval.factor,
            }
        )
    return pd.DataFrame(rows)
