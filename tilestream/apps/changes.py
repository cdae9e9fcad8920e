"""Places whose estimate a map update changed: by how much, over how much road, and why."""

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
from tilestream.report.data import interpolated
from tilestream.report.diff.data import ENDS, OTHERS, Changes

SAME_PLACE = 0.5
"""Sample points this near to each other are compared [m]: half their spacing."""
NOWHERE_NEAR = 5.0
"""An older place that is farther than this from all that are compared is left behind [m]."""
FEWEST = 8
"""Places from which on a rank correlation says on which side of a factor errors are larger."""
UNITS = {column.name: column.unit for column in (*catalogue.COLUMNS, *observability.COLUMNS)}
"""Units of the factors."""
PARTS = {name: name for target, name in ESTIMATES.items() if target != MAIN}
"""The parts of an estimate, where nothing is known of the virtual drive."""
NOTHING = "its factors are as they were: the model is another one"
"""Why an estimate changed where no factor did …"""
BETWEEN = "its factors are as they were: an estimate of it is interpolated, not evaluated"
"""… and where one of the two was not evaluated."""
AT = ["route_id", "sample", "arc_length", "x", "y", "z"]
COMPARED = ["before", "after", "why", "reason", "interpolated_before", "interpolated_after"]
LEFT = ["route_id", "arc_length", "x", "y", "before"]


def changes(old: pd.DataFrame | None, new: pd.DataFrame | None, limit: float) -> Changes:
    """Compare the estimates of the same places.

    Args:
        old: places with estimates, and the factors as far as they are known; None: there are none.
        new: likewise.
        limit: what counts as worse or better [m].
    """
    if old is None or new is None or old.empty or new.empty:
        return Changes(pd.DataFrame(columns=[*AT, *COMPARED]), pd.DataFrame(columns=LEFT), limit)
    now = new.sort_values(["route_id", "sample"], kind="stable").reset_index(drop=True)
    then = _beside(old, now)
    before, after = (table["estimate"].to_numpy(np.float64) for table in (then, now))
    others = {
        f"{name}_{when}": table[name].to_numpy(np.float64) if name in table else np.nan
        for name in (*OTHERS, *ENDS)
        for when, table in (("before", then), ("after", now))
    }
    others |= {
        f"interpolated_{when}": interpolated(table) & table["estimate"].notna()
        for when, table in (("before", then), ("after", now))
    }
    reason = now["reason"].fillna("").astype(str) if "reason" in now else ""
    places = now[AT].assign(before=before, after=after, why="", reason=reason, **others)
    found = Changes(places, _left(old, then), limit)
    worse = found.rows("worse")
    places.loc[worse, "why"] = _reasons(then, now, worse)
    return found


def _left(old: pd.DataFrame, then: pd.DataFrame) -> pd.DataFrame:
    """The older places with an estimate that are near none of those that are compared."""
    had = old[np.isfinite(old["estimate"].to_numpy(np.float64))]
    at, taken = (table[["x", "y"]].to_numpy(np.float64) for table in (had, then))
    taken = taken[np.isfinite(taken).all(axis=1)]
    away = np.isfinite(at).all(axis=1)
    if away.any() and len(taken):
        distance, _ = cKDTree(taken - taken[0]).query(at[away] - taken[0])
        away[away] = np.asarray(distance) > NOWHERE_NEAR
    left: pd.DataFrame = had[away].rename(columns={"estimate": "before"})[LEFT]
    return left.sort_values(["route_id", "arc_length"], kind="stable", ignore_index=True)


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


def _reasons(then: pd.DataFrame, now: pd.DataFrame, rows: np.ndarray) -> list[str]:
    """Why each of these places got worse: what the virtual drive does there now, and the factor of
    the map that changed most on the side on which estimates are larger.
    """
    if not rows.size:
        return []
    old, new = (with_derived(table.copy()) for table in (then, now))
    between = interpolated(then) | interpolated(now)
    both = [name for name in PHRASES if name in old and name in new]
    causes = [name for name in both if not name.startswith("vd_")]
    a, b = (table[causes].to_numpy(np.float64) for table in (old, new))
    away = _weighed(b - a, b, new["estimate"].to_numpy(np.float64))
    parts = [name for name in AXES if name in both] or [name for name in PARTS if name in old]
    had, has = (table[parts].to_numpy(np.float64) for table in (old, new))
    return [
        "; ".join(filter(None, [_part(parts, had, has, row), _cause(causes, a, b, away, row)]))
        or (BETWEEN if between[row] else NOTHING)
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


def _part(names: list[str], old: Float64, new: Float64, row: int) -> str:
    """The part of the error that grew most; empty: none did."""
    step = np.nan_to_num(new[row] - old[row])
    if not (step > 0.0).any():
        return ""
    k = int(step.argmax())
    words = AXES.get(names[k], f"{names[k]} grew")
    values = float(new[row, k]), float(old[row, k])
    return f"{words} ({told_beside(names[k], 'm', *values, word='before')})"


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
