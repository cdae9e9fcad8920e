"""Places whose estimate a map update changed: by how much, over how much road, and why."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from tilestream.factors import catalogue, observability
from tilestream.model.explain import AXES, CLEAR, NOTICEABLE, told_beside
from tilestream.model.features import with_derived
from tilestream.model.phrases import PHRASES, REASSURING, phrase_of
from tilestream.model.training import ESTIMATES, MAIN
from tilestream.records import Float64
from tilestream.report.segments import reaches, stretches

SAME_PLACE = 0.5
"""Sample points this near to each other are compared [m]: half their spacing."""
FEWEST = 8
"""Places from which on a rank correlation says on which side of a factor errors are larger."""
UNITS = {column.name: column.unit for column in (*catalogue.COLUMNS, *observability.COLUMNS)}
"""Units of the factors."""
PARTS = {name: name for target, name in ESTIMATES.items() if target != MAIN}
"""The parts of an estimate, where nothing is known of the virtual drive."""
NOTHING = "its factors are as they were: the model is another one"
"""Why an estimate changed where no factor did."""
PLACE = ("route_id", "arc_length", "x", "y", "before", "after", "change", "length", "why")
"""The columns of a place that changed."""


@dataclass(frozen=True, eq=False)
class Changes:
    """How the estimates of places differ from earlier ones."""

    worse: pd.DataFrame
    """Places whose estimate grew by more than the limit, the worst first (`PLACE`; lengths and
    errors in m)."""
    better: pd.DataFrame
    """Those whose estimate fell by more than that, the best first; without `why`."""
    stretches: pd.DataFrame
    """Stretches of road that got worse, the worst first: `route_id`, `begin`, `end`, `length` [m],
    `places`, and of the place that got worse most `at`, `before`, `after` [m] and `why`."""
    compared: int
    """Places with an estimate in both."""
    length: float
    """Of road that they stand for [m]."""
    lost: int
    """Places that had an estimate and have none."""


def changes(old: pd.DataFrame | None, new: pd.DataFrame | None, limit: float) -> Changes:
    """Compare the estimates of the same places.

    Args:
        old: places with estimates, and the factors as far as they are known; None: there are none.
        new: likewise.
        limit: what counts as worse or better [m].
    """
    if old is None or new is None or old.empty or new.empty:
        none = pd.DataFrame(columns=list(PLACE))
        return Changes(none, none, _stretches(none, np.zeros(0, bool)), 0, 0.0, 0)
    now = new.sort_values(["route_id", "sample"], kind="stable").reset_index(drop=True)
    then = _beside(old, now)
    before, after = (table["estimate"].to_numpy(np.float64) for table in (then, now))
    both = np.isfinite(before) & np.isfinite(after)
    length = reaches(now)
    change = after - before
    table = now[["route_id", "arc_length", "x", "y"]].assign(
        before=before, after=after, change=change, length=length, why=""
    )
    worse, better = both & (change > limit), both & (change < -limit)
    table.loc[worse, "why"] = _reasons(then, now, np.flatnonzero(worse))
    return Changes(
        _sorted(table[worse], ascending=False),
        _sorted(table[better], ascending=True).drop(columns="why"),
        _stretches(table.assign(sample=now["sample"]), worse),
        int(both.sum()),
        float(length[both].sum()),
        int((np.isfinite(before) & ~np.isfinite(after)).sum()),
    )


def _beside(old: pd.DataFrame, now: pd.DataFrame) -> pd.DataFrame:
    """For each place the same of the older ones: of its route and number, as long as that is near,
    else the nearest; NaN where none is near.
    """
    keys = ["route_id", "sample"]
    numbered = old[keys].assign(row=np.arange(len(old))).drop_duplicates(keys)
    numbers = now[keys].merge(numbered, on=keys, how="left")["row"].fillna(-1)
    row = numbers.to_numpy(np.int64, copy=True)
    at, had = (table[["x", "y", "z"]].to_numpy(np.float64) for table in (now, old))
    with np.errstate(invalid="ignore"):
        near = (row >= 0) & (np.abs(at - had[row])[:, :2].max(axis=1) <= SAME_PLACE)
    known = np.flatnonzero(np.isfinite(had).all(axis=1))
    left = np.flatnonzero(np.isfinite(at).all(axis=1) & ~near)
    if known.size and left.size:
        origin = had[known[0]]
        distance, nearest = cKDTree(had[known] - origin).query(at[left] - origin)
        row[left], near[left] = known[nearest], np.asarray(distance) <= SAME_PLACE
    then = old.iloc[row].reset_index(drop=True)
    names = then.select_dtypes("number").columns
    then = then.astype(dict.fromkeys(names, np.float64))
    then.loc[~near, names] = np.nan
    return then


def _sorted(table: pd.DataFrame, *, ascending: bool) -> pd.DataFrame:
    order = table.sort_values(
        ["change", "route_id", "arc_length"], ascending=[ascending, True, True]
    )
    return order[list(PLACE)].reset_index(drop=True)


def _stretches(places: pd.DataFrame, worse: np.ndarray) -> pd.DataFrame:
    """Stretches of road that got worse, with what they bridge."""
    rows: list[Mapping[str, Any]] = []
    for part in stretches(places, np.flatnonzero(worse)) if worse.any() else ():
        here = places.iloc[part]
        worst = here.iloc[int(np.nanargmax(here["change"].to_numpy(np.float64)))]
        rows.append(
            {
                "route_id": worst["route_id"],
                "begin": here["arc_length"].iloc[0],
                "end": here["arc_length"].iloc[-1],
                "length": here["length"].sum(),
                "places": len(here),
                "at": worst["arc_length"],
                **{name: worst[name] for name in ("x", "y", "before", "after", "why")},
            }
        )
    names = ["route_id", "begin", "end", "length", "places", "at", "x", "y"]
    found = pd.DataFrame(rows, columns=[*names, "before", "after", "why"])
    grown = (found["after"] - found["before"]).to_numpy(np.float64)
    return found.iloc[np.argsort(-grown, kind="stable")].reset_index(drop=True)


def _reasons(then: pd.DataFrame, now: pd.DataFrame, rows: np.ndarray) -> list[str]:
    """Why each of these places got worse: what the virtual drive does there now, and the factor of
    the map that changed most on the side on which estimates are larger.
    """
    if not rows.size:
        return []
    old, new = (with_derived(table.copy()) for table in (then, now))
    both = [name for name in PHRASES if name in old and name in new]
    causes = [name for name in both if not name.startswith("vd_")]
    a, b = (table[causes].to_numpy(np.float64) for table in (old, new))
    away = _weighed(b - a, b, new["estimate"].to_numpy(np.float64))
    parts = [name for name in AXES if name in both] or [name for name in PARTS if name in old]
    return [
        "; ".join(filter(None, [_part(parts, old, new, row), _cause(causes, a, b, away, row)]))
        or NOTHING
        for row in rows.tolist()
    ]


def _weighed(step: Float64, values: Float64, estimate: Float64) -> Float64:
    """(n, f) how far factors have moved [interquartile ranges] towards larger estimates, times how
    clearly the estimates of these places go with them; 0 where they do not go clearly.
    """
    weights = np.zeros(step.shape)
    for k in range(step.shape[1]):
        good = np.isfinite(values[:, k]) & np.isfinite(estimate)
        spread = np.subtract(*np.percentile(values[good, k], [75, 25])) if good.any() else 0.0
        if good.sum() < FEWEST or spread <= 0.0:
            continue
        ranks, errors = rankdata(values[good, k]), rankdata(estimate[good])
        rho = np.corrcoef(ranks, errors)[0, 1] if np.ptp(errors) else 0.0
        weights[:, k] = step[:, k] / spread * (rho if abs(rho) >= CLEAR else 0.0)
    return np.where(np.isfinite(weights), weights, 0.0)


def _part(names: list[str], old: pd.DataFrame, new: pd.DataFrame, row: int) -> str:
    """The part of the error that grew most; empty: none did."""
    grown = {name: float(new[name].iloc[row] - old[name].iloc[row]) for name in names}
    grown = {name: step for name, step in grown.items() if step > 0.0}
    if not grown:
        return ""
    name = max(grown, key=lambda part: grown[part])
    words = AXES.get(name, f"{name} grew")
    values = (float(table[name].iloc[row]) for table in (new, old))
    return f"{words} ({told_beside(name, 'm', *values, word='before')})"


def _cause(names: list[str], old: Float64, new: Float64, away: Float64, row: int) -> str:
    """The factor that moved most towards larger estimates; empty: none did, noticeably."""
    for k in np.argsort(-away[row], kind="stable").tolist():
        before, after = float(old[row, k]), float(new[row, k])
        if away[row, k] <= 0.0:
            return ""
        phrase = phrase_of(names[k], after > before)
        if phrase in REASSURING or abs(after - before) < NOTICEABLE * abs(before):
            continue
        unit = UNITS.get(names[k], "1")
        return f"{phrase} ({told_beside(names[k], unit, after, before, word='before')})"
    return ""
