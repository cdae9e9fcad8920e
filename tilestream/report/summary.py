"""The figures of a report as plain values, for machines and for the page alike."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from tilestream.model.evaluation import PAPER_TABLE
from tilestream.model.figures import with_spans
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.records import Float64, Int64
from tilestream.report.data import (
    PLACE_COLUMNS,
    Findings,
    estimates,
    interpolated,
    like_training,
)
from tilestream.report.formatting import cm, cm_about, cm_limit, distance, known, percent, thousands
from tilestream.report.measured import measure_of
from tilestream.report.paper_tables import paper_table_i, paper_table_iii, table_i, table_iii
from tilestream.report.segments import reaches, segments, worst_measured, worst_places
from tilestream.version import VERSION

THRESHOLDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.50)
"""Errors that people ask for [m]: the paper's Table I, and around them."""
REASONS = 3
"""So many reasons for missing estimates are told in a line."""
OF_PATH = ("mae", "spearman", "spearman_low", "spearman_high")
"""How the estimates of a labelled path are told."""
AXES, STARTS = ("along", "across", "up"), ("floor", "tail")
"""The parts of an estimate [m]: by direction; of the starts nearby, and what farther ones add."""


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
        "worth": None if found.worth is None else found.worth.plain(),
        "headline": headline(found.places, threshold) | {"labelled": len(found.labels)},
        "routes": routes(found.places, threshold),
        "segments": [segment(found.places, rows) for rows in runs],
        "worst": [place(found.places, row) for row in worst_places(found.places)],
        "worst_measured": measured_worst(found.labels),
        "paths": paths(found),
        "table_i": table_i(found.labels),
        "paper_table_i": paper_table_i(),
        "table_iii": table_iii(found.labels, found.cell_size),
        "paper_table_iii": paper_table_iii(),
        "protocols": found.protocols.to_dict("records"),
        "table_iv": found.table_iv.to_dict("records"),
        "paper_table_iv": PAPER_TABLE.to_dict("records"),
        "importances": found.importances.to_dict("records"),
        "criterion_importances": found.criterion_importances.to_dict("records"),
        "coverage": found.coverage.to_dict("records"),
        "parts": found.parts.to_dict("records"),
        "differences": found.differences.to_dict("records"),
        "ceilings": found.ceilings,
        "model": found.model,
        "facts": found.facts,
        "notes": found.notes,
        "drives": [drive.plain() for drive in found.drives],
        "lost_labels": found.lost_labels,
    }
    return dict(plain(content))


def headline(places: pd.DataFrame, threshold: float) -> dict[str, Any]:
    """How long, how good, and how much is not known."""
    estimate = estimates(places)
    there = np.isfinite(estimate)
    here = estimate[there]
    reach = reaches(places)
    error = measure_of(places)
    driven = np.isfinite(error.measured)
    over = np.where(driven | there, error.known, 0.0) > threshold
    like = like_training(places)
    outside, compared = int((like == "no").sum()), int((like != "not known").sum())
    missing = places.loc[~there, "reason"]
    known_count = int((driven | there).sum())
    return {
        "places": len(places),
        "routes": int(places["route_id"].nunique()),
        "length": float(reach.sum()),
        "estimated": int(there.sum()),
        "interpolated": int(interpolated(places).sum()),
        **quantiles(here),
        "over": int(over.sum()),
        "over_share": float(over.sum() / known_count) if known_count else None,
        "over_length": float(reach[over].sum()),
        "outside": outside if compared else None,
        "outside_share": outside / compared if compared else None,
        "missing": len(missing),
        "missing_share": len(missing) / len(places),
        "missing_by_reason": by_reason(missing),
        "measured": int(driven.sum()),
        "measured_max": float(error.measured[driven].max()) if driven.any() else None,
        "measured_over": int((error.measured[driven] > threshold).sum()),
        "shares_over": {
            f"{limit:.2f}": float((here > limit).mean()) if here.size else None
            for limit in THRESHOLDS
        },
    }


def quantiles(errors: Float64) -> dict[str, float | None]:
    """`median`, `p95` and `max` of errors, all of them known; None of no error."""
    if not errors.size:
        return {"median": None, "p95": None, "max": None}
    median, p95, most = np.quantile(errors, [0.5, 0.95, 1.0]).tolist()
    return {"median": median, "p95": p95, "max": most}


def by_reason(reasons: pd.Series) -> dict[str, int]:
    """How often each reason for a missing estimate is given, the commonest first."""
    counts = reasons.fillna("").astype(str).replace("", "no reason given").value_counts()
    return {str(r): int(counts[r]) for r in sorted(counts.index, key=lambda r: (-counts[r], r))}


def reasons_told(missing: Mapping[str, int]) -> str:
    """The reasons for missing estimates, the commonest first, in a line."""
    first = list(missing.items())[:REASONS]
    told = [f"{reason.removeprefix('no estimate: ')} ({count:,})" for reason, count in first]
    return ", ".join(told) + (", …" if len(missing) > REASONS else "")


def cards(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures that a map team asks for first, and what each of them is.

    Args:
        content: `summary`, or what `report.json` has of it.
    """
    head, limit = content["headline"], cm_limit(content["threshold"])
    digits = digits_of(content)
    unlike = (percent(head["outside_share"]), "of the places unlike the training places")
    over = f"of the places over {limit}: {distance(head['over_length'])} of road"
    drives = content["drives"]
    measured, scans = (sum(drive[name] for drive in drives) for name in ("measured", "scans"))
    of_drives = (f"{thousands(measured)} of {thousands(scans)}", "scans of the drives measured")
    there = f"the largest measured error, of {thousands(head['measured'])} places"
    highest = (cm(head["measured_max"]), there)
    between = head["interpolated"]
    evaluated = f"{thousands(head['estimated'] - between)} of {thousands(head['places'])}"
    missing = f"places without an estimate ({percent(head['missing_share'])})"
    return [
        (distance(head["length"]), f"of road, {thousands(head['places'])} sample points"),
        (cm_about(head["median"], digits), "median estimated error"),
        (cm_about(head["p95"], digits), "95 % of the places are estimated below this"),
        (cm_about(head["max"], digits), "the highest estimate"),
        *([highest] if head["measured"] else []),
        (percent(head["over_share"]), over),
        *([unlike] if known(head["outside_share"]) else []),
        (evaluated, "places evaluated"),
        *([(thousands(between), "places interpolated between these")] if between else []),
        *([of_drives] if drives else []),
        (thousands(head["labelled"]), "measured errors, of all drives"),
        (thousands(head["missing"]), missing),
    ]


def digits_of(content: Mapping[str, Any]) -> int | None:
    """With how many significant digits estimates are told; None: nobody has said what they are
    worth.
    """
    worth = content.get("worth")
    return None if worth is None else int(worth["digits"])


def routes(places: pd.DataFrame, threshold: float) -> list[dict[str, Any]]:
    """The headline figures of each route."""
    return [
        {"route_id": str(name)} | headline(part.reset_index(drop=True), threshold)
        for name, part in places.groupby("route_id", sort=True)
    ]


def segment(places: pd.DataFrame, rows: Int64) -> dict[str, Any]:
    """A stretch of road over the threshold: where, how long, how bad. `worst` is estimated or
    measured, the parts of the error and the reason are estimates of that place, `mean` is over all
    of it that has an estimate.
    """
    part = places.iloc[rows]
    error = measure_of(part)
    row = int(np.nanargmax(error.known))
    worst = part.iloc[row]
    first = max(int(rows[0]) - 1, 0)  # the reach of a place ends at its neighbours
    reach = reaches(places.iloc[first : int(rows[-1]) + 2])
    return {
        "route_id": str(worst["route_id"]),
        "begin": float(part["arc_length"].iloc[0]),
        "end": float(part["arc_length"].iloc[-1]),
        "length": float(reach[rows - first].sum()),
        "places": len(part),
        "worst": float(error.known[row]),
        "worst_measured": bool(error.known[row] == error.measured[row]),
        "worst_at": float(worst["arc_length"]),
        **{axis: float(worst[axis]) for axis in "xy"},  # of its worst place
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
    found = {name: places[name].iloc[row] for name in names}
    return found | {"measured": float(measure_of(places.iloc[[row]]).measured[0])}


def measured_worst(labels: pd.DataFrame) -> list[dict[str, Any]]:
    """The places with the largest measured errors, the largest first."""
    if labels.empty:
        return []
    names = ("group", "path", "sample", "arc_length", "error_mean", "p_fail")
    rows = labels.iloc[worst_measured(labels)]
    kept = rows[[name for name in names if name in labels]]
    return [{str(k): v for k, v in row.items()} for row in kept.to_dict("records")]


def paths(found: Findings) -> list[dict[str, Any]]:
    """How each labelled path was estimated by a model that had not seen it."""
    if found.labels.empty:
        return []
    rows = []
    for name, part in found.labels.groupby("path", sort=True):
        actual, held = (part[c].to_numpy(np.float64) for c in ("error_mean", "held_out"))
        evaluated = np.isfinite(actual) & np.isfinite(held)
        known_of = actual[evaluated] if evaluated.any() else actual
        row = {
            "path": str(name),
            "points": len(part),
            "groups": sorted(set(part["group"].astype(str))),
            "judged": int(evaluated.sum()),
            "interval": bool(part["low"].notna().any()),
            "actual_median": float(np.nanmedian(known_of)),
            "estimate_median": float(np.median(held[evaluated])) if evaluated.any() else None,
            **dict.fromkeys(OF_PATH),
        }
        if evaluated.any():
            here = part[evaluated].rename(columns={"error_mean": "actual", "held_out": "estimate"})
            of = with_spans(here.assign(median=here["actual"].median(), fold=""))
            row |= {name: of[name] for name in OF_PATH}
        rows.append(row)
    return rows


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
