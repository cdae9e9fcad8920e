"""Is a place like the training places? A regressor gives an estimate either way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tilestream.model.intervals import weighted_quantile
from tilestream.records import Float64

QUANTILE = 0.99
"""Share of held-out training places that count as inside."""
CLIP = 5.0
"""Scaled factors beyond this do not stretch the covariance."""
RIDGE = 1e-2
"""Variance added in every direction, of scaled factors: ratios that sum to 1 make it singular."""
TINY = 1e-12
"""Threshold of training places that are all alike."""
WIDEST = 3.0
"""An interval outside is at most so many times wider: beyond, nobody knows how wrong it is."""


@dataclass(frozen=True, eq=False)
class Domain:
    """The training factors as one cloud: distances from its middle."""

    middle: Float64
    """(f,) median of each factor [its unit]."""
    scale: Float64
    """(f,) spread of each: interquartile range / 1.349, a standard deviation of a normal."""
    whitening: Float64
    """(f, f) W: the distance is |W z| / sqrt(f), z the scaled factors."""
    threshold: float
    """Distances above this are outside; 1 is typical, no unit."""

    def distance(self, X: Float64) -> Float64:
        """(n,) distance from the middle, in typical distances; the same bits for any company."""
        z = (X - self.middle) / self.scale
        total = np.zeros(len(X))
        # Not a matrix product: its rounding depends on the number of rows.
        for row in self.whitening:
            part = np.zeros(len(X))
            for k in range(len(row)):
                part += z[:, k] * row[k]
            total += part * part
        return np.sqrt(total / len(self.middle))

    def widen(self, distance: Float64) -> Float64:
        """(n,) how many times wider the interval is at these distances: 1 up to the threshold,
        then distance / threshold, at most `WIDEST`.
        """
        wider: Float64 = np.clip(distance / max(self.threshold, TINY), 1.0, WIDEST)
        return wider

    def farthest(self, X: Float64) -> NDArray[np.int64]:
        """(n,) the factor that lies farthest out on its own."""
        factor: NDArray[np.int64] = np.abs((X - self.middle) / self.scale).argmax(axis=1)
        return factor


def domain_of(X: Float64, block: NDArray[np.str_]) -> Domain:
    """The domain of training factors.

    The threshold is the 99 % quantile of the distances of each block's points from the cloud of the
    other blocks, every block weighing the same: a new place is as far from the training places as
    they are from each other. A single block is compared with itself.

    Args:
        X: (n, f) factors, all finite.
        block: (n,) names of their blocks.
    """
    names, index = np.unique(block, return_inverse=True)
    if len(names) < 2:
        distance = _cloud(X, 0.0).distance(X)
    else:
        distance = np.empty(len(X))
        for k in range(len(names)):
            distance[index == k] = _cloud(X[index != k], 0.0).distance(X[index == k])
    weight = 1.0 / (np.bincount(index)[index] * len(names))
    return _cloud(X, weighted_quantile(distance, weight, QUANTILE))


def _cloud(X: Float64, threshold: float) -> Domain:
    low, middle, high = np.percentile(X, [25, 50, 75], axis=0)
    scale = (high - low) / 1.349
    deviation = X.std(axis=0)
    scale = np.where(scale > 1e-3 * deviation, scale, deviation)
    scale = np.where(scale > 0.0, scale, np.maximum(1e-6 * np.abs(middle), 1e-12))
    z = np.clip((X - middle) / scale, -CLIP, CLIP)
    covariance = z.T @ z / len(z) + RIDGE * np.eye(X.shape[1])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    return Domain(middle, scale, whitening, threshold)
