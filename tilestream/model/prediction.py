"""A model applied to a table of factors: estimates, intervals, domain and reasons of places."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import ModelError
from tilestream.model.applicability import check_making
from tilestream.model.dataset import matrix
from tilestream.model.explain import compared, in_words
from tilestream.model.features import with_derived
from tilestream.model.making import Outside
from tilestream.model.training import ESTIMATES, MAIN, PREDICTION_COLUMNS, Model
from tilestream.records import Float64


def predict(
    model: Model, factors: pd.DataFrame, made_with: Mapping[str, Any] | None = None
) -> pd.DataFrame:
    """Estimate the error of places; each row for itself, the same bits in any company and order.

    A row with a NaN among its factors has NaN estimates, status `missing` and a reason that names
    the factor; nothing is imputed. Count them by `status`.

    Args:
        model: a trained or loaded model.
        factors: a table with the model's factors; `heading` too where factors in map axes
            are turned into the route's (`features.IN_MAP_AXES`). Other factors of the dataset that
            the model was trained on (`model.typical`) serve the reasons, as far as they are there.
        made_with: what these factors were computed with; compared with the model's
            (`check_making`). None: the caller vouches for it.

    Returns:
        `PREDICTION_COLUMNS` on the index of `factors`; targets without labels are NaN.

    Raises:
        ModelError: a factor that the table lacks or that is no number, or factors of another
            making; says which.
    """
    strange = [] if made_with is None else check_making(model, made_with)
    table = with_derived(factors)
    X = _matrix(model, table)
    good = np.asarray(np.isfinite(X).all(axis=1))
    out = {c.name: np.full(len(X), np.nan) for c in PREDICTION_COLUMNS if c.dtype == "float64"}
    if good.any():
        places = pd.DataFrame(X[good], columns=list(model.factors))
        for target, regressor in model.regressors.items():
            out[ESTIMATES[target]][good] = regressor.predict(places)
        out["domain_distance"][good] = model.domain.distance(X[good])
    widen = model.domain.widen(out["domain_distance"]) * (model.wider_outside if strange else 1.0)
    out["low"], out["high"] = model.interval.around(out["estimate"], widen)
    in_domain = good & (out["domain_distance"] <= model.domain.threshold) & (not strange)
    columns: dict[str, Any] = {
        **out,
        "in_domain": in_domain,
        "status": np.where(good, "done", "missing").astype(object),
        "reason": _reasons(model, table, X, out, good, strange),
    }
    return pd.DataFrame({c.name: columns[c.name] for c in PREDICTION_COLUMNS}, index=factors.index)


def _matrix(model: Model, table: pd.DataFrame) -> Float64:
    absent = [name for name in model.factors if name not in table]
    if absent:
        raise ModelError(f"the table lacks factors that the model needs: {', '.join(absent)}")
    wrong = [name for name in model.factors if table[name].dtype.kind not in "iufb"]
    if wrong:
        raise ModelError(f"factors that are no numbers: {', '.join(wrong)}")
    return matrix(table, model.factors)


def _reasons(
    model: Model,
    table: pd.DataFrame,
    X: Float64,
    out: Mapping[str, Float64],
    good: NDArray[np.bool_],
    strange: Sequence[Outside],
) -> list[str]:
    """(n,) words for the worst places, those outside the domain and those without an estimate; else
    empty.
    """
    words = np.full(len(X), "", dtype=object)
    worst = np.flatnonzero(good & (out["estimate"] > model.worst))
    if worst.size:
        places = pd.DataFrame(X[worst], columns=list(model.factors))
        added = model.regressors[MAIN].contributions(places)
        values = _values(table.iloc[worst], model.typical.names)
        words[worst] = in_words(added, model.factors, values, model.typical)
    distance = out["domain_distance"]
    unlike = np.flatnonzero(good & (distance > model.domain.threshold))
    wider = model.domain.widen(distance[unlike])
    for row, k, times in zip(unlike, model.domain.farthest(X[unlike]), wider, strict=True):
        which = model.typical.names.index(model.factors[k])
        figures = compared(which, X[row, k], model.typical, named=True)
        told = f"unlike the training places ({figures})"
        told += "" if np.isnan(model.interval.level) else f", its interval {times:.2g} times wider"
        words[row] = f"{words[row]}; {told}" if words[row] else told
    if strange:
        otherwise = f"seen otherwise than where the model was trained ({_listed(strange)})"
        if not np.isnan(model.interval.level):
            otherwise += f", its interval {model.wider_outside:.2g} times wider"
        for row in np.flatnonzero(good):
            words[row] = f"{words[row]}; {otherwise}" if words[row] else otherwise
    given = table["reason"].fillna("").astype(str).to_numpy() if "reason" in table else None
    for row in np.flatnonzero(~good):
        bad = [name for name, x in zip(model.factors, X[row], strict=True) if not np.isfinite(x)]
        why = f"no estimate: {bad[0]} is not a number"
        words[row] = f"{why}: {given[row]}" if given is not None and given[row] else why
    return [str(word) for word in words]


def _listed(strange: Sequence[Outside]) -> str:
    return "; ".join(map(str, strange))


def _values(table: pd.DataFrame, names: Sequence[str]) -> Float64:
    """(n, f) factors for reasons; NaN where the table has none of that name, or no numbers."""
    values = np.full((len(table), len(names)), np.nan)
    for k, name in enumerate(names):
        if name in table and table[name].dtype.kind in "iufb":
            values[:, k] = table[name].to_numpy(np.float64)
    return values
