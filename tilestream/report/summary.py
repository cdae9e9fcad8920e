"""The figures of a report as plain values, for machines and for the page alike."""

import math
from typing import Any

import numpy as np
import pandas as pd

from tilestream.forest.evaluation import PAPER_TABLE, figures
from tilestream.forest.training import PREDICTION_COLUMNS
from tilestream.records import Float64, Int64
from tilestream.report.findings import PLACE_COLUMNS, Findings, estimates, like_training
from tilestream.report.judgement import reaches, segments, worst_places
from tilestream.version import VERSION

THRESHOLDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.50)
"""Errors that people ask for [m]: the paper's Table I, and around them."""
AXES, STARTS = ("along", "across", "up"), ("floor", "tail")
"""The parts of an estimate [m]: by direction; of the starts nearby, and what farther ones add."""
GAP = 3.0
"""Labels farther apart along a path than this many typical distances are not joined by a line."""


def summary(found: Findings, threshold: float) -> dict[str, Any]:
    """All figures of the report; lengths in metres, shares 0 to 1, None where there is none.

    Args:
        found: what is reported.
        threshold: estimates above this are too large [m].
    """
    runs = segments(found.places, threshold)
    content = {
        "title": found.title,
        "tilestream": VERSION,
        "threshold": threshold,
        "crs": found.crs,
        "headline": headline(found.places, threshold) | {"labelled": len(found.labels)},
        "routes": routes(found.places, threshold),
        "segments": [segment(found.places, rows) for rows in runs],
        "worst": [place(found.places, row) for row in worst_places(found.places)],
        "paths": paths(found),
        "protocols": found.protocols.to_dict("records"),
        "table_iv": found.table_iv.to_dict("records"),
        "paper_table_iv": PAPER_TABLE.to_dict("records"),
        "importances": found.importances.to_dict("records"),
        "criterion_importances": found.criterion_importances.to_dict("records"),
        "coverage": found.coverage.to_dict("records"),
        "parts": found.parts.to_dict("records"),
        "ceilings": found.ceilings,
        "model": found.model,
        "facts": found.facts,
    }
    return dict(plain(content))


def headline(places: pd.DataFrame, threshold: float) -> dict[str, Any]:
    """How long, how good, and how much is not known."""
    estimate = estimates(places)
    known = np.isfinite(estimate)
    here = estimate[known]
    reach = reaches(places)
    over = known & (np.where(known, estimate, 0.0) > threshold)
    like = like_training(places)
    outside, judged = int((like == "no").sum()), int((like != "not known").sum())
    missing = places.loc[~known, "reason"].fillna("").astype(str).replace("", "no reason given")
    counts = missing.value_counts()
    return {
        "places": len(places),
        "routes": int(places["route_id"].nunique()),
        "length": float(reach.sum()),
        "estimated": int(known.sum()),
        "median": float(np.median(here)) if here.size else None,
        "p95": float(np.quantile(here, 0.95)) if here.size else None,
        "max": float(here.max()) if here.size else None,
        "over": int(over.sum()),
        "over_share": float(over.sum() / here.size) if here.size else None,
        "over_length": float(reach[over].sum()),
        "outside": outside if judged else None,
        "outside_share": outside / judged if judged else None,
        "missing": len(missing),
        "missing_share": len(missing) / len(places),
        "missing_by_reason": {
            str(reason): int(counts[reason])
            for reason in sorted(counts.index, key=lambda r: (-counts[r], r))
        },
        "shares_over": {
            f"{limit:.2f}": float((here > limit).mean()) if here.size else None
            for limit in THRESHOLDS
        },
    }


def routes(places: pd.DataFrame, threshold: float) -> list[dict[str, Any]]:
    """The headline figures of each route."""
    return [
        {"route_id": str(name)} | headline(part.reset_index(drop=True), threshold)
        for name, part in places.groupby("route_id", sort=True)
    ]


def segment(places: pd.DataFrame, rows: Int64) -> dict[str, Any]:
    """A stretch of road over the threshold: where, how long, how bad. `worst`, the parts of the
    error and the reason are those of its worst place, `mean` is over all of it that has an
    estimate.
    """
    part = places.iloc[rows]
    worst = part.iloc[int(np.nanargmax(estimates(part)))]
    return {
        "route_id": str(worst["route_id"]),
        "begin": float(part["arc_length"].iloc[0]),
        "end": float(part["arc_length"].iloc[-1]),
        "length": float(reaches(places)[rows].sum()),
        "places": len(part),
        "worst": float(worst["estimate"]),
        "worst_at": float(worst["arc_length"]),
        "mean": float(part["estimate"].mean()),
        **{name: float(worst[name]) for name in (*AXES, *STARTS)},
        "p_fail": float(part["p_fail"].max()),
        "in_domain": _all_like(part[part["estimate"].notna()]),
        "reason": str(worst["reason"] or ""),
    }


def _all_like(part: pd.DataFrame) -> bool | None:
    """Whether all these places are like the training places; None: not known."""
    like = like_training(part)
    return None if (like == "not known").any() else bool((like == "yes").all())


def place(places: pd.DataFrame, row: int) -> dict[str, Any]:
    """One sample point with its estimate."""
    names = (*PLACE_COLUMNS, *(column.name for column in PREDICTION_COLUMNS))
    return {name: places[name].iloc[row] for name in names}


def paths(found: Findings) -> list[dict[str, Any]]:
    """How each labelled path was estimated by a model that had not seen it."""
    if found.labels.empty:
        return []
    rows = []
    for name, part in found.labels.groupby("path", sort=True):
        actual, held = (part[c].to_numpy(np.float64) for c in ("error_mean", "held_out"))
        judged = np.isfinite(actual) & np.isfinite(held)
        factor = interval_factor(found.coverage, str(name))
        row = {
            "path": str(name),
            "points": len(part),
            "groups": sorted(set(part["group"].astype(str))),
            "judged": int(judged.sum()),
            "factor": factor,
            "interval": bool(held_out_along(part, factor)["low"].notna().any()),
            "actual_median": float(np.nanmedian(actual)),
            "estimate_median": float(np.median(held[judged])) if judged.any() else None,
            "mae": None,
            "spearman": None,
        }
        if judged.any():
            median = np.full(int(judged.sum()), np.median(actual[judged]))
            of = figures(actual[judged], held[judged], median)
            row |= {"mae": of.mae, "spearman": of.spearman}
        rows.append(row)
    return rows


def interval_factor(coverage: pd.DataFrame, path: str) -> float | None:
    """The factor of a path's interval, calibrated on the other paths; None where there is none."""
    if coverage.empty:
        return None
    factor = coverage.loc[coverage["path"].astype(str) == path, "factor"].to_numpy(np.float64)
    return float(factor[0]) if factor.size and np.isfinite(factor[0]) else None


def held_out_along(labels: pd.DataFrame, factor: float | None) -> pd.DataFrame:
    """The held-out estimate of each labelled place of a path: drives over a place share it.

    Args:
        labels: of one path.
        factor: of its interval (`interval_factor`), where the labels have no `low` and `high`.

    Returns:
        A row per `arc_length` [m], rising, with `held_out`, `low`, `high` (NaN where there is no
        interval) and `error_mean` (of all drives) [m].
    """
    if not {"low", "high"} <= set(labels):
        held, wide = labels["held_out"], np.nan if factor is None else factor
        labels = labels.assign(low=held / wide, high=held * wide)
    names = ["held_out", "low", "high", "error_mean"]
    return labels.groupby("arc_length", as_index=False)[names].mean()


def with_gaps(arc: Float64) -> Int64:
    """Indices before which a line along a path must be broken: the next label is far away."""
    step = np.diff(arc)
    if not step.size:
        return np.zeros(0, np.int64)
    return np.flatnonzero(step > GAP * np.median(step)) + 1


def plain(value: Any) -> Any:
    """Any value as strict JSON has it: no NaN, no infinity, no type of NumPy."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        items = sorted(value, key=str) if isinstance(value, set | frozenset) else value
        return [plain(item) for item in items]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if value is pd.NA or value is pd.NaT:
        return None
    return str(value)
