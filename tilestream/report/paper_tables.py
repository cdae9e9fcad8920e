"""The paper's Table I and Table III of any measured paths: how large errors are, and where."""

from typing import Any

import numpy as np
import pandas as pd

LIMITS = (0.10, 0.15, 0.20, 0.25)
"""The errors that the paper's Table I asks for [m]."""
SURROUNDINGS = ("feature_count", "D1_ratio", "D2_ratio", "D3_ratio")
"""Factors whose medians stand where the paper's Table III describes a path in words: cells in view,
and how many of them are like poles, walls and bushes."""
PAPER_TABLE_I = {
    "I": (0.289, 0.111, 0.043, 0.022),
    "II": (0.408, 0.179, 0.073, 0.019),
    "III": (0.276, 0.232, 0.207, 0.179),
    "IV": (0.187, 0.084, 0.0412, 0.019),
    "V": (0.860, 0.334, 0.150, 0.070),
}
"""The paper's Table I: share of each path's sample points beyond each of `LIMITS`."""
PAPER_TABLE_III = {
    "I": (1160.0, 1163),
    "II": (730.0, 734),
    "III": (270.0, 269),
    "IV": (650.0, 652),
    "V": (790.0, 794),
}
"""The paper's Table III: length of each path [m], and its sample points; cells of 2.0 m."""
PAPER_DESCRIPTIONS = {
    "I": "dense shopping area; wide roads with hedges and trees; several skyscrapers",
    "II": "narrow road; wide pavements with bollards, lamp posts and trees; skyscrapers",
    "III": "residential area; short tunnel; houses on one side, trees on the other",
    "IV": "narrow and dense shopping area",
    "V": "dense shopping area; multi-lane roads; skyscrapers; under several bridges",
}
"""What is there, by the same table, shortened."""

Shares = dict[str, float]


def table_i(labels: pd.DataFrame) -> list[dict[str, Any]]:
    """How large the measured errors are on each path: the paper's Table I, lidar by lidar.

    Args:
        labels: `group`, `path`, `error_mean` [m] of each label, and `as_sensor` where there are
            several.

    Returns:
        For each lidar that drives were read as (`as_sensor`): `paths`, of each `path` the `points`,
        the `median` error [m] and `shares_over` by limit; over all paths `weighted`, every label
        counting the same, and `unweighted`, the mean of the paths (the paper's "93.7 % under 25
        cm"). Empty without labels.
    """
    if labels.empty:
        return []
    known = labels[np.isfinite(labels["error_mean"].to_numpy(np.float64))]
    if "as_sensor" not in known:
        known = known.assign(as_sensor="")
    found = []
    for lidar, part in known.groupby("as_sensor", sort=True):
        paths = [
            {"path": str(path), **_errors(of_path["error_mean"])}
            for path, of_path in part.groupby("path", sort=True)
        ]
        unweighted = _mean_shares([path["shares_over"] for path in paths])
        every = {
            "weighted": _errors(part["error_mean"]),
            "unweighted": {"paths": len(paths), "shares_over": unweighted},
        }
        found.append({"as_sensor": str(lidar), "paths": paths, **every})
    return found


def paper_table_i() -> dict[str, Any]:
    """The paper's Table I as `table_i` has ours; its medians are not known."""
    points = np.array([PAPER_TABLE_III[path][1] for path in PAPER_TABLE_I])
    shares = np.array(list(PAPER_TABLE_I.values()))
    paths = [
        {"path": path, "points": int(n), "shares_over": _by_limit(row)}
        for (path, row), n in zip(PAPER_TABLE_I.items(), points, strict=True)
    ]
    weighted = (shares * points[:, None]).sum(axis=0) / points.sum()
    return {
        "paths": paths,
        "weighted": {"points": int(points.sum()), "shares_over": _by_limit(weighted)},
        "unweighted": {"paths": len(paths), "shares_over": _by_limit(shares.mean(axis=0))},
    }


def table_iii(labels: pd.DataFrame, cell_size: float | None = None) -> list[dict[str, Any]]:
    """What the labelled paths are: the paper's Table III.

    Args:
        labels: `group`, `path`, `arc_length` [m] of each label, and the factors of its place.
        cell_size: edge of the cells of the map [m]; None: not known.

    Returns:
        Of each `path`: `cell_size`, `length` between its first and its last label [m], `points`
        (labels of all its drives), `drives`, and the medians of `SURROUNDINGS`, as far as they are
        there, in place of the paper's words.
    """
    if labels.empty:
        return []
    there = [name for name in SURROUNDINGS if name in labels]
    return [
        {
            "path": str(path),
            "cell_size": cell_size,
            "length": float(part["arc_length"].max() - part["arc_length"].min()),
            "points": len(part),
            "drives": int(part["group"].nunique()),
            **{name: float(part[name].median()) for name in there},
        }
        for path, part in labels.groupby("path", sort=True)
    ]


def paper_table_iii() -> list[dict[str, Any]]:
    """The paper's Table III as `table_iii` has ours, with its `description`."""
    return [
        {
            "path": path,
            "cell_size": 2.0,
            "length": length,
            "points": points,
            "drives": 1,
            "description": PAPER_DESCRIPTIONS[path],
        }
        for path, (length, points) in PAPER_TABLE_III.items()
    ]


def _errors(errors: "pd.Series[float]") -> dict[str, Any]:
    shares = [float((errors > limit).mean()) for limit in LIMITS]
    return {
        "points": len(errors),
        "median": float(errors.median()),
        "shares_over": _by_limit(shares),
    }


def _mean_shares(shares: list[Shares]) -> Shares:
    return {name: float(np.mean([one[name] for one in shares])) for name in shares[0]}


def _by_limit(shares: Any) -> Shares:
    """Shares by limit, as the headline of a report has them."""
    return {f"{limit:.2f}": float(x) for limit, x in zip(LIMITS, shares, strict=True)}
