"""The block bootstrap: how far figures would move had other blocks been driven.

Places along a street err together, so whole blocks are resampled, never places.
"""

import numpy as np

from tilestream.records import Float64, Int64

TIMES = 500
"""How often the blocks are resampled."""
LEVEL = 0.9
"""Share of the resampled figures that an interval holds."""


def resampled(blocks: int) -> Float64:
    """(TIMES, blocks) how often each block is drawn, when as many are drawn with replacement as
    there are; always the same.
    """
    rng = np.random.default_rng(0)
    return rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), TIMES).astype(np.float64)


def span(figures: Float64) -> tuple[float, float]:
    """The ends between which the middle `LEVEL` of resampled figures lies; those that are not known
    (a rank correlation of a constant) are left out. NaN, NaN where most are not known.
    """
    known = figures[np.isfinite(figures)]
    if 2 * len(known) < len(figures):
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL)])
    return float(low), float(high)


def resampled_spearman(one: Float64, two: Float64, block: Int64, counts: Float64) -> Float64:
    """(k,) rank correlations of n points, each block counting so many times; ties have their mean
    rank. NaN where one side is constant.

    Args:
        one: (n,) values.
        two: (n,) the others.
        block: (n,) numbers of the blocks.
        counts: (k, blocks) of `resampled`.
    """
    ranked = [np.unique(values, return_inverse=True) for values in (one, two)]
    drawn, row_of = np.unique(counts, axis=0, return_inverse=True)  # few blocks: often the same
    found = np.empty(len(drawn))
    for row, count in enumerate(drawn):
        weight = count[block]
        a, b = (_centred_ranks(places, len(values), weight) for values, places in ranked)
        spread = np.sqrt((weight @ (a * a)) * (weight @ (b * b)))
        found[row] = weight @ (a * b) / spread if spread > 0.0 else np.nan
    return found[row_of.ravel()]


def _centred_ranks(places: Int64, count: int, weight: Float64) -> Float64:
    """(n,) mean ranks minus their mean, of points whose values have these places in order."""
    size = np.bincount(places, weight, count)
    rank = np.cumsum(size) - 0.5 * size - 0.5 * weight.sum()
    centred: Float64 = rank[places]
    return centred
