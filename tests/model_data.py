"""Synthetic drives with the paper's error tails: factors and labels that vary smoothly."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.factors.along_route import AVERAGED
from tilestream.factors.virtual_drive import RINGS
from tilestream.model.dataset import VIRTUAL_DRIVES, Dataset
from tilestream.model.join import join
from tilestream.model.physics import VIRTUAL
from tilestream.moments import AXES, PAIRS, SCORES
from tilestream.records import Column

Floats = NDArray[np.float64]
LENGTHS = {"I": 1163, "II": 734, "III": 269, "IV": 652, "V": 794}
"""The paper's five paths [m], 3612 points in all (its Table III)."""
CRITERIA = {
    "FS": ["feature_count", *(f"D{d}_{k}" for k in ("count", "ratio") for d in (1, 2, 3))],
    "RQ": ["euclidean_dist", "mahalanobis_dist"],
    "LY": ["r_average", "normal_H_8", "normal_H_16", "normal_H_90", "angular_H", "FDOP"],
    "LS": ["score_H", "pfh_sim_H", "pfh_sim_mnht", "bhatt_sim"],
}
CRITERIA["FS"].append("occupancy_ratio")
COLUMNS = tuple(
    Column(name, criterion, "1", name, "synthetic")  # type: ignore[arg-type]
    for criterion, names in CRITERIA.items()
    for name in names
)
WEAK_AXIS = Column("weak_axis", "LY", "rad", "An axis.", "synthetic", "robust")
MEDIAN, SIGMA = 0.0884, 0.606
"""A lognormal with the paper's tails: > 10 cm 41.9 %, > 25 cm 4.31 % (definitions, section 6)."""


def smooth(rng: np.random.Generator, n: int, k: int, correlation: float = 20.0) -> Floats:
    """(n, k) standard normal columns at a spacing of 1 m, correlated over `correlation` [m]."""
    reach = int(3 * correlation)
    kernel = np.exp(-((np.arange(-reach, reach + 1) / correlation) ** 2))
    noise = rng.normal(size=(n + 2 * reach, k))
    found = np.column_stack([np.convolve(noise[:, j], kernel, "valid") for j in range(k)])
    return found / np.sqrt((kernel**2).sum())


def drives(
    seed: int = 0,
    lengths: dict[str, int] | None = None,
    related: float = 0.0,
    columns: Sequence[Column] = COLUMNS,
    noise: float = 0.0,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Factors and labels of straight paths 1 km apart, at coordinates as large as UTM's.

    Args:
        seed: of the random numbers.
        lengths: of the paths [m].
        related: share of the label's variance (in logarithms) that three factors explain.
        columns: the factors.
        noise: standard deviation of a second drive's label, in logarithms.
    """
    rng = np.random.default_rng(seed)
    factor_rows, label_rows = [], []
    for k, (path, n) in enumerate((lengths or LENGTHS).items()):
        z = smooth(rng, n, len(columns) + 1)
        cause = (z[:, 0] - z[:, -2] + z[:, 9]) / np.sqrt(3.0)
        shape = np.sqrt(related) * cause + np.sqrt(1.0 - related) * z[:, -1]
        error = MEDIAN * np.exp(SIGMA * shape + noise * rng.normal(size=n))
        place = {
            "arc_length": np.arange(n, dtype=float),
            "x": 370_000.0 + np.arange(n),
            "y": np.full(n, 3_950_000.0 + 1000.0 * k),
            "z": np.full(n, 42.0),
            "heading": np.zeros(n),
            "sample": np.arange(n),
            "status": "done",
            "reason": "",
        }
        values = {column.name: z[:, j] for j, column in enumerate(columns)}
        factor_rows.append(pd.DataFrame({"route_id": path, **place, **values}))
        label_rows.append(pd.DataFrame(place | labels_of(error)))
    labels = pd.concat(label_rows, ignore_index=True)
    return pd.concat(factor_rows, ignore_index=True), labels.assign(sample=np.arange(len(labels)))


def labels_of(error: Floats) -> dict[str, Floats]:
    """Labels that belong together, from the mean error."""
    return {
        "error_mean": error,
        "p_fail": np.clip(error - 0.1, 0.0, 1.0),
        "error_floor": 0.5 * error,
        "error_tail": 0.5 * error,
        "along_mean": 0.8 * error,
        "across_mean": 0.5 * error,
        "up_mean": 0.2 * error,
    }


def joined(
    factors: pd.DataFrame,
    labels: Mapping[str, pd.DataFrame],
    columns: Sequence[Column] = COLUMNS,
    **known: Any,
) -> Dataset:
    """Labels whose sample is the row of the factor table that is of their place."""
    own = factors.assign(sample=factors.index)
    return join(factors, dict.fromkeys(labels, own), labels, columns, **known)


def dataset(seed: int = 0, related: float = 0.7, lengths: dict[str, int] | None = None) -> Dataset:
    """The same, joined."""
    factors, labels = drives(seed, lengths, related)
    return joined(factors, {"drive": labels})


def unrelated(seed: int) -> Dataset:
    """Labels that follow from no factor: smooth along the road, as the factors are."""
    found = dataset(seed, 0.0, {"a": 420, "b": 420, "c": 420})
    return found.with_columns(found.columns[:8])


def caused() -> Dataset:
    """Labels that follow from three factors, which vary fast enough to be learnt in 600 points."""
    factors, labels = drives(6, {"a": 210, "b": 210, "c": 210})
    for table in (factors, labels):
        table["arc_length"] *= 2.0
        table["x"] += 0.5 * table["arc_length"]
    rng = np.random.default_rng(6)
    names = [column.name for column in COLUMNS]
    values = rng.normal(size=(len(factors), len(names)))
    factors[names] = values
    shape = (values[:, 0] - values[:, -1] + values[:, 9]) / np.sqrt(3.0)
    labels = labels.assign(**labels_of(0.09 * np.exp(0.6 * shape)))
    return joined(factors, {"drive": labels})


OBSERVED = (
    *(Column(name, "OB", "m", name, "synthetic", "observability") for name in AVERAGED),
    Column("ob_hint", "OB", "1", "What the virtual drive does not see.", "", "observability"),
    Column("ob_noise", "OB", "1", "Nothing.", "", "observability"),
)


def with_virtual_drives(
    found: Dataset, *, noise: float = 0.3, hidden: float = 0.0, seed: int = 0
) -> Dataset:
    """A dataset with virtual drives, 2 cm below the labels.

    Args:
        found: labelled places.
        noise: of each place's own draw, in logarithms.
        hidden: what a place's `ob_hint`, normal and as smooth as the other factors, adds to its
            labels, in shares of them.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    rows = found.rows.reset_index(drop=True)
    hint = smooth(rng, len(rows), 1, 6.0)[:, 0]
    draw = np.exp(noise * rng.normal(size=len(rows)))
    seen: dict[str, Floats] = {}
    for target, column in VIRTUAL.items():
        label = rows[target].to_numpy()
        seen[column] = np.maximum(label - (target != "p_fail") * 0.02, 0.0) * draw
        rows[target] = label * (1.0 + hidden * np.maximum(hint, -1.0))
    seen["vd_tail"] = seen["vd_mean"] - seen["vd_floor"]
    rows = rows.assign(**seen, ob_hint=hint, ob_noise=rng.normal(size=len(rows)))
    rows = rows.assign(**_moments("near", rows, [f"{axis}_mean" for axis in AXES[:3]]))
    virtual = {f"vd_{ring}": [f"vd_{axis}" for axis in AXES[:3]] for ring in RINGS}
    moments = {
        k: v for ring, names in virtual.items() for k, v in _moments(ring, rows, names).items()
    }
    along = rows.assign(route_id=rows["path"], status="done")
    along = pd.concat([along, pd.DataFrame(moments, index=rows.index)], axis=1)[
        list(VIRTUAL_DRIVES)
    ]
    return replace(found, rows=rows, columns=(*found.columns, *OBSERVED), virtual_drives=along)


def _moments(prefix: str, rows: pd.DataFrame, means: Sequence[str]) -> dict[str, Any]:
    """Moments of Gaussian errors whose mean absolute values along, across and up are columns."""
    found: dict[str, Any] = {f"{prefix}_{axis}": 0.0 for axis in AXES}
    found |= {f"{prefix}_{a}_{b}": 1e-4 if a == b else 0.0 for a, b in PAIRS}
    for axis, name in zip(AXES, means, strict=False):
        found[f"{prefix}_{axis}_{axis}"] = 1e-5 + np.pi / 2.0 * rows[name] ** 2
    scores = {f"{prefix}_{name}": 2.0 for name in SCORES} | {
        f"{prefix}_{n}_sd": 0.1 for n in SCORES
    }
    return found | scores | {f"{prefix}_p_fail": rows["p_fail"]}
