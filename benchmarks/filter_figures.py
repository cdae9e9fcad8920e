"""What filters along drives were worth, and what it would be had other blocks been driven."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from tilestream.model.bootstrap import TIMES, resampled, span
from tilestream.moments import AXES

Floats = NDArray[np.float64]
SHARES = (0.5, 0.9, 0.99)
"""Of the ellipses whose coverage is counted."""
UPDATES = (1, 2, 3, 5, 10)
"""Scans from one update to the next for which an inflation is told."""
LONGEST = 80.0
"""Way up to which errors are correlated with each other [m]."""


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure, and what it would be with other blocks."""

    value: float
    drawn: Floats
    """(TIMES,)"""

    def __sub__(self, other: "Figure") -> "Figure":
        return Figure(self.value - other.value, self.drawn - other.drawn)

    def __truediv__(self, other: "Figure") -> "Figure":
        with np.errstate(invalid="ignore", divide="ignore"):
            return Figure(float(np.float64(self.value) / other.value), self.drawn / other.drawn)

    def told(self) -> dict[str, float]:
        """`value`, and `low` and `high` of the bootstrap."""
        low, high = span(self.drawn)
        return {"value": self.value, "low": low, "high": high}


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a contestant, and the blocks that they lie in."""

    table: pd.DataFrame
    block: NDArray[np.int64]
    counts: Floats
    """(TIMES, blocks) how often each block is drawn; the same for all contestants."""

    def mean(self, values: Floats) -> Figure:
        """Of a value per row; rows without are left out."""
        known = np.isfinite(values)
        size = self.counts.shape[1]
        total = np.bincount(self.block[known], values[known], size)
        count = np.bincount(self.block[known], minlength=size)
        with np.errstate(invalid="ignore"):
            drawn = (self.counts @ total) / (self.counts @ count)
        return Figure(float(values[known].mean()), drawn)

    def quantile(self, values: Floats, share: float = 0.95) -> Figure:
        """The value below which this share of the rows is."""
        order = np.argsort(values)
        weight = np.cumsum(
            np.vstack([np.ones(self.counts.shape[1]), self.counts])[:, self.block[order]], axis=1
        )
        at = [np.searchsorted(one, share * one[-1]) for one in weight]
        found = values[order][at]
        return Figure(float(found[0]), found[1:])


def rows_of(table: pd.DataFrame, length: float) -> dict[str, Rows]:
    """Of each contestant the rows of `filter_run.run`, in blocks of this length [m]; a block of a
    road is one in all its drives.
    """
    name = table["road"] + "/" + (table["arc_length"] // length).astype(int).astype(str)
    block, names = pd.factorize(name)
    counts = resampled(len(names))
    return {
        str(one): Rows(own, block[own.index], counts)
        for one, own in table.groupby("contestant", sort=False)
    }


def figures(rows: Rows) -> dict[str, Any]:
    """Of one contestant."""
    table = rows.table
    e, v, m, r = (
        {axis: table[f"{part}_{axis}"].to_numpy(np.float64) for axis in AXES} for part in "evmr"
    )
    held = table["held"].to_numpy(np.bool_)
    sizes = {
        "horizontal": np.hypot(e["along"], e["across"]),
        "3D": np.sqrt(e["along"] ** 2 + e["across"] ** 2 + e["up"] ** 2),
        "along": np.abs(e["along"]),
        "across": np.abs(e["across"]),
        "up": np.abs(e["up"]),
        "yaw": np.abs(e["yaw_vector"]),
    }
    square = np.where(held, table["m_square"], np.nan)
    return {
        "scans": len(table),
        "lost": int(table["lost"].sum()),
        "taken": rows.mean(table["taken"].to_numpy(np.float64)).told(),
        "held": rows.mean(held.astype(np.float64)).told(),
        "error": {
            name: {
                "mean": rows.mean(x).told(),
                "p95": rows.quantile(x).told(),
                "max": float(x.max()),
            }
            for name, x in sizes.items()
        },
        "consistency of the filter": {a: rows.mean(e[a] ** 2 / v[a]).told() for a in AXES},
        "consistency of the registration": {
            a: rows.mean(np.where(held, m[a] ** 2 / r[a], np.nan)).told() for a in AXES
        },
        "coverage": {
            f"{share:g}": rows.mean(
                np.where(held, square <= chi2.ppf(share, 2), np.nan).astype(np.float64)
            ).told()
            for share in SHARES
        },
    }


def by_drive(table: pd.DataFrame) -> dict[str, dict[str, float]]:
    """By drive and contestant the 95 % horizontal error [m]."""
    size = table.assign(size=np.hypot(table["e_along"], table["e_across"]))
    p95 = size.groupby(["drive", "contestant"], sort=False)["size"].quantile(0.95)
    return {str(drive): one.droplevel(0).to_dict() for drive, one in p95.groupby(level=0)}


def horizontal(rows: Rows) -> Figure:
    """The 95 % horizontal error of the filter [m]."""
    return rows.quantile(np.hypot(rows.table["e_along"], rows.table["e_across"]).to_numpy())


def compared(rows: Mapping[str, Rows], ours: str) -> dict[str, Any]:
    """By how much the 95 % horizontal error is larger than that of each contestant [share]; and the
    `share of the gain` of the true moments over the fitted constant that it has.
    """
    size = {name: horizontal(one) for name, one in rows.items()}
    found = {name: _less(size[ours] / one) for name, one in size.items()}
    constant, true = size["constant, fitted"], size["true"]
    return found | {"share of the gain": ((constant - size[ours]) / (constant - true)).told()}


def _less(ratio: Figure) -> dict[str, float]:
    return Figure(ratio.value - 1.0, ratio.drawn - 1.0).told()


def correlation(rows: Rows, spacing: float) -> dict[str, Any]:
    """How long the errors of registrations, normalised by their covariance, are alike along the
    way, by axis: `length` up to which the correlation (about zero) is above 1/e [m], and the
    `inflation` that updates every so many metres ask for, 1 + 2 sum of the correlations up to the
    first that is not positive.
    """
    table = rows.table
    steps = max(int(LONGEST / spacing), 1)
    drives = table.groupby(["drive", "seed"], sort=False).indices.values()
    held = table["held"].to_numpy(np.bool_)
    found = {}
    for axis in AXES:
        error = np.where(held, table[f"m_{axis}"] / np.sqrt(table[f"r_{axis}"]), 0.0)
        error = error.clip(-10.0, 10.0)  # no single place shall be all that is seen
        size = rows.counts.shape[1]
        products = np.zeros((size, steps + 1))
        weights = np.zeros((size, steps + 1))
        for drive in drives:
            one, ok, block = error[drive], held[drive], rows.block[drive]
            for k in range(min(steps + 1, len(one))):
                a, b = slice(0, len(one) - k), slice(k, len(one))
                both = ok[a] & ok[b]
                products[:, k] += np.bincount(block[a], one[a] * one[b] * both, size)
                weights[:, k] += np.bincount(block[a], both, size)
        every = np.vstack([np.ones(size), rows.counts])
        with np.errstate(invalid="ignore"):
            rho = (every @ products) / (every @ weights)
            rho /= rho[:, :1]
        found[axis] = {
            "correlation": rho[0, : min(steps, 20) + 1].tolist(),
            "length": _each(rho, partial(_length, spacing=spacing)),
            "inflation": {
                f"{spacing * every:.1f}": _each(rho, partial(_inflation, every=every))
                for every in UPDATES
            },
        }
    return found


def _each(rho: Floats, value: Callable[[Floats], float]) -> dict[str, float]:
    drawn = np.array([value(one) for one in rho])
    assert len(drawn) == TIMES + 1
    return Figure(float(drawn[0]), drawn[1:]).told()


def _length(rho: Floats, spacing: float) -> float:
    """Where correlations at whole multiples of a spacing fall below 1/e, between two linearly."""
    low = np.exp(-1.0)
    below = np.flatnonzero(~(rho > low))
    if not below.size:
        return float("inf")
    k = int(below[0])
    return float(spacing * (k - 1 + (rho[k - 1] - low) / (rho[k - 1] - rho[k])))


def _inflation(rho: Floats, every: int) -> float:
    rest = rho[every::every]
    end = np.flatnonzero(~(rest > 0.0))
    return float(1.0 + 2.0 * rest[: end[0] if end.size else None].sum())
