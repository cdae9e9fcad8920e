"""How the errors of neighbouring places hang together (definitions, section 6.8).

Two registrations of nearby places share what the map does to them, their bias, and not the noise
of their scans. A filter that takes their errors as independent trusts the mean of them too much.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from tilestream.model.bootstrap import TIMES, resampled, span
from tilestream.moments import AXES
from tilestream.records import Float64, Int64

REACH = 20.0
"""Farthest distance along a route over which errors are compared [m]: about the length over which
errors along a street resemble each other."""
BLOCK = 100.0
"""Pieces of road that are resampled [m]: long against `REACH`."""
FEWEST = 30
"""Pairs of places at a distance that say something of it."""
POOLED = "along and across"
"""Name of what is pooled over these two axes."""


@dataclass(frozen=True, eq=False)
class Correlation:
    """How the errors in an axis correlate along a route."""

    lags: Float64
    """(k,) distances [m], from 0 on, evenly."""
    bias: Float64
    """(k,) autocorrelation of the bias there; 1 at 0."""
    share: float
    """Of the second moment of a registration's error that its place's bias is: what the error of
    two registrations at one place, of other scans, correlates by."""
    resampled: Float64
    """(`TIMES`, k) share times bias, had other pieces of road been seen (`model.bootstrap`)."""

    @property
    def length(self) -> float | None:
        """Where the autocorrelation of the bias falls below 1/e [m], linear between distances.
        None: not known (`told` says why).
        """
        first = self._first_below
        if first in (1, len(self.lags)):
            return None
        upper, lower = self.bias[first - 1], self.bias[first]
        part = (upper - math.exp(-1.0)) / (upper - lower)
        return float(self.lags[first - 1] + part * (self.lags[first] - self.lags[first - 1]))

    @property
    def told(self) -> str:
        """The length in words: it may be less than places are apart, or more than `lags`."""
        if self.length is not None:
            return f"{self.length:.1f} m"
        nearer = self._first_below == 1
        return f"less than {self.lags[1]:g} m" if nearer else f"more than {self.lags[-1]:g} m"

    @property
    def _first_below(self) -> int:
        """The number of the first lag whose autocorrelation is below 1/e."""
        below = np.flatnonzero(self.bias < math.exp(-1.0))
        return int(below[0]) if below.size else len(self.lags)

    def at(self, distance: Float64) -> Float64:
        """Correlation of the errors of two registrations, of other scans, that far apart [m]:
        linear between distances, 0 beyond them all.
        """
        return self.share * np.interp(distance, self.lags, self.bias, right=0.0)

    def inflation(self, every: float) -> float:
        """By what covariances have to be multiplied for a filter that takes the errors of updates
        every so many metres as independent, at least 1: then its mean over a stretch that is long
        against the correlation is as certain as it believes.
        """
        return float(self._inflation(every, self.share * self.bias[None])[0])

    def inflation_span(self, every: float) -> tuple[float, float]:
        """Between what the inflation lies had other pieces of road been seen (`bootstrap.LEVEL`);
        NaN, NaN: there are no two of `BLOCK`.
        """
        return span(self._inflation(every, self.resampled))

    def _inflation(self, every: float, correlation: Float64) -> Float64:
        """(n,) of (n, k) correlations of errors at `lags`."""
        apart = every * np.arange(1, math.floor(self.lags[-1] / every + 1e-9) + 1)
        total = [np.interp(apart, self.lags, one).sum() for one in correlation]
        return np.maximum(1.0 + 2.0 * np.array(total), 1.0)


def correlations(seen: pd.DataFrame) -> Mapping[str, Correlation]:
    """The correlations of the errors in each axis, and of `POOLED`, as the virtual drive has them.

    Each place counts by its errors over their root mean square, so that none outweighs the others.
    A bias is the mean of signed errors; their noise, variance / (draws - 1), is subtracted of its
    square, and has no part in products of two places. An autocorrelation at a distance is a plain
    mean over the pairs of places that far apart.

    Args:
        seen: a row per sample point: `route_id`, `sample`, `arc_length` [m], `status`, `vd_draws`
            and the moments of the near starts (`factors.virtual_drive.MOMENT_COLUMNS`); in any
            order.

    Returns:
        By axis; without those of which too little is known: fewer than two draws, fewer than
        `FEWEST` pairs of neighbours, or no bias above its noise.
    """
    done = seen[seen["status"] == "done"].sort_values(["route_id", "sample"], kind="stable")
    step = _step(done)
    if math.isnan(step):
        return {}
    products = {axis: _products(done, axis, math.floor(REACH / step + 1e-9)) for axis in AXES}
    products[POOLED] = 0.5 * (products["along"] + products["across"])
    piece = [done["route_id"], (done["arc_length"] // BLOCK).astype(np.int64)]
    block = np.asarray(done.groupby(piece, sort=False).ngroup(), np.int64)
    found = {name: _correlation(parts, block, step) for name, parts in products.items()}
    return {name: one for name, one in found.items() if one is not None}


def _step(done: pd.DataFrame) -> float:
    """From one sample point to the next [m]; NaN: there are no two neighbours."""
    same = done["route_id"].eq(done["route_id"].shift())
    steps = (done["arc_length"].diff() / done["sample"].diff())[same]
    return float(steps.median())


def _products(done: pd.DataFrame, axis: str, most: int) -> Float64:
    """(most + 1, n) of each place and lag the product of its bias and that of the place so many
    sample points ahead, of lag 0 its square without the noise; all over their root mean squares.
    NaN: not known.
    """
    square = done[f"vd_near_{axis}_{axis}"].to_numpy(np.float64)
    draws = done["vd_draws"].to_numpy(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        bias = done[f"vd_near_{axis}"].to_numpy(np.float64) / np.sqrt(square)
        noise = np.where(draws > 1.0, (1.0 - bias**2) / (draws - 1.0), np.nan)
    bias = np.where(np.isfinite(noise), bias, np.nan)
    found = np.full((most + 1, len(done)), np.nan)
    found[0] = bias**2 - noise
    sample = done["sample"].to_numpy(np.int64)
    route = pd.factorize(done["route_id"])[0]
    number = route * (int(sample.max()) + most + 1) + sample  # no two routes within `most`
    for lag in range(1, most + 1):
        other = np.minimum(np.searchsorted(number, number + lag), len(number) - 1)
        there = number[other] == number + lag
        found[lag, there] = bias[there] * bias[other[there]]
    return found


def _correlation(products: Float64, block: Int64, step: float) -> Correlation | None:
    """Plain means of each lag, up to the first of which too few pairs are known."""
    there = np.isfinite(products)
    enough = there.sum(axis=1) >= FEWEST
    known = len(enough) if enough.all() else int(np.argmin(enough))
    if known < 2:
        return None
    products, there = np.where(there, products, 0.0)[:known], there[:known]
    means: Float64 = products.sum(axis=1) / there.sum(axis=1)
    share = float(means[0])
    if share <= 0.0:
        return None
    blocks = int(block.max()) + 1
    sums, counts = (
        np.array([np.bincount(block, row, blocks) for row in values])
        for values in (products, there)
    )
    drawn = resampled(blocks) if blocks > 1 else np.full((TIMES, 1), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        again = np.einsum("tb,kb->tk", drawn, sums) / np.einsum("tb,kb->tk", drawn, counts)
    return Correlation(np.arange(known, dtype=np.float64) * step, means / share, share, again)
