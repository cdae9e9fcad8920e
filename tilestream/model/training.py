"""A model for every place: train it on a dataset, apply it to a table of factors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tilestream.errors import ModelError, UsageError
from tilestream.factors.own import OWN
from tilestream.model.card import JUDGED, card_of
from tilestream.model.covariance import Calibration
from tilestream.model.covariance_training import calibration_of
from tilestream.model.dataset import TARGETS, Dataset, matrix
from tilestream.model.domain import WIDEST, Domain, domain_of
from tilestream.model.explain import PIECE, Typical, compared, in_words, typical_of
from tilestream.model.features import with_derived
from tilestream.model.intervals import (
    LEVEL,
    NOT_CALIBRATED,
    Interval,
    calibrate,
    stretch,
    wider_for_few,
)
from tilestream.model.making import Outside, check_own, outside, shared
from tilestream.model.physics import Physics, width_of
from tilestream.model.registry import DEFAULT, OF_VIRTUAL_DRIVES, REGRESSORS
from tilestream.model.regressor import Regressor, held_out_estimates
from tilestream.model.splits import block_splits, leave_lidar_out
from tilestream.records import Column, Float64

MAIN = "error_mean"
ESTIMATES = {
    "error_mean": "estimate",
    "p_fail": "p_fail",
    "error_floor": "floor",
    "error_tail": "tail",
    "along_mean": "along",
    "across_mean": "across",
    "up_mean": "up",
}
"""Name of each target's estimate."""
WIDER = "wider_outside"
"""Where a card says how many times longer an interval is outside of it."""
WORST = 0.75
"""Places whose estimate is above this quantile of the training labels are given a reason."""
PREDICTION_COLUMNS = (
    Column("estimate", "label", "m", "Estimated error_mean.", "definitions, section 6"),
    Column("low", "label", "m", "Lower end of its interval.", "calibrated by blocks"),
    Column("high", "label", "m", "Upper end of its interval.", "calibrated by blocks"),
    Column(
        "p_fail", "label", "1", "Estimated share of starts that fail.", "definitions, section 5"
    ),
    Column("floor", "label", "m", "Estimated error_floor.", "definitions, section 5"),
    Column("tail", "label", "m", "Estimated error_tail.", "definitions, section 5"),
    Column("along", "label", "m", "Estimated mean of abs(along).", "definitions, section 5"),
    Column("across", "label", "m", "Estimated mean of abs(across).", "definitions, section 5"),
    Column("up", "label", "m", "Estimated mean of abs(up).", "definitions, section 5"),
    Column(
        "domain_distance",
        "place",
        "1",
        "Distance from the training places; 1 is typical.",
        "robust Mahalanobis distance",
    ),
    Column(
        "in_domain",
        "place",
        "1",
        "Whether place, lidar and matcher are like those of the training places; empty: not known, "
        "nothing was trained.",
        "distance at most the 99 % quantile of held-out blocks",
        dtype="bool",
    ),
    Column(
        "status",
        "place",
        "",
        "done, interpolated (not evaluated), or missing: no estimate.",
        "",
        dtype="str",
    ),
    Column(
        "reason",
        "place",
        "",
        "Why the estimate is high, the place strange, or there is no estimate; else empty.",
        "contributions to the estimate; factors on their bad side",
        dtype="str",
    ),
)
"""What `predict` adds to a place."""


@dataclass(frozen=True, eq=False)
class Model:
    """All that is needed to estimate the error of any place of a map."""

    regressors: Mapping[str, Regressor]
    """The regressor of each target, all of one class."""
    domain: Domain
    """The training places, by the features."""
    typical: Typical
    """The same, by all factors of the dataset: for reasons."""
    interval: Interval
    """The interval round `error_mean`."""
    factors: tuple[str, ...]
    """The features, in order."""
    made_with: Mapping[str, Any]
    """What the factors were computed with: sensor, cell size, units, … (`check_making`)."""
    data_set: Mapping[str, Any]
    """Identity of the labels, as far as it is that of all: matcher, starts, true pose, cell size,
    sensor."""
    width: float
    """Over what virtual drives are averaged along the route (`averaged_along`) [m]."""
    worst: float
    """Estimates above this are given a reason [m]."""
    facts: Mapping[str, Any]
    """How it was trained: recipe, settings, seed, points, paths, targets left out and why."""
    card: Mapping[str, Any] = field(default_factory=dict)
    """What it was trained on, and over which lidars and matchers it holds (`card_of`); empty: of
    an older version, for one lidar."""

    covariance: Calibration | None = None
    """What real scans add to the covariances of the virtual drive; None: not known."""

    @property
    def wider_outside(self) -> float:
        """How many times longer an interval is for a lidar or a matcher outside of the card."""
        return float(self.card.get(WIDER, WIDEST))


def train(
    dataset: Dataset, *, recipe: str = DEFAULT, seed: int = 0, n_jobs: int | None = 1
) -> Model:
    """Train a model on all points of a dataset, and calibrate it on held-out blocks.

    Args:
        dataset: labelled places.
        recipe: name of the regressor (`REGRESSORS`).
        seed: of the random numbers; the same seed and rows give the same model, to the bit.
        n_jobs: threads or processes; None: what joblib's context says (Dask).

    Raises:
        ModelError: the dataset is too small, all alike, or mixed (`Dataset.check`).
        UsageError: an unknown recipe, or one that does not know the lidar, of several runs.
    """
    if recipe not in REGRESSORS:
        raise UsageError(f"no recipe {recipe!r}: choose from {', '.join(sorted(REGRESSORS))}")
    if dataset.makings and recipe not in OF_VIRTUAL_DRIVES:
        raise UsageError(
            f"recipe {recipe!r} does not know the lidar: over several runs choose from "
            f"{', '.join(OF_VIRTUAL_DRIVES)}"
        )
    regressor = REGRESSORS[recipe]
    dataset.check(MAIN)
    width = width_of(dataset)
    dataset = dataset.averaged(width)
    pieces = dataset.rows.groupby(["path", dataset.rows["arc_length"] // PIECE]).ngroups
    whole, dataset = dataset, dataset.with_columns(regressor.features(dataset.columns))
    rows = dataset.rows
    with threadpool_limits(1, "blas"):  # how many threads share a product shows in its last bits
        typical = typical_of(whole.matrix(), whole.label(MAIN), whole.columns, pieces)
        domain = domain_of(dataset.matrix(), dataset.pieces)
    settings = regressor.tuned(dataset, MAIN, seed, n_jobs)
    fit = partial(regressor.fit, target=MAIN, seed=seed, settings=settings, n_jobs=n_jobs)
    interval = _interval(dataset, fit)
    card = card_of(dataset)
    if card[JUDGED]:
        card[WIDER] = _wider_outside(dataset, interval)
    # An axis or a tail that is the same everywhere teaches nothing and is learnt as that constant.
    there = [target for target in TARGETS if target in dataset.rows]
    regressors = {t: regressor.fit(dataset, t, seed, settings, n_jobs) for t in there}
    learnt = {target: dict(one.learnt()) for target, one in regressors.items() if one.learnt()}
    return Model(
        regressors=regressors,
        domain=domain,
        typical=typical,
        interval=interval,
        factors=tuple(dataset.names),
        made_with=dataset.made_with,
        data_set=_common(list(dataset.data_sets.values())),
        width=width,
        worst=float(np.quantile(dataset.label(MAIN), WORST)),
        facts={
            "recipe": recipe,
            **settings,
            **({"learnt": learnt} if learnt else {}),
            "seed": seed,
            "points": len(dataset),
            "groups": sorted(set(rows["group"])),
            "paths": sorted(set(rows["path"])),
            "blocks": int(rows["block"].nunique()),
            **({"wider_for_few_blocks": wider_for_few(interval.blocks)} if interval.blocks else {}),
            "lost": dataset.losses,
        },
        card=card,
        covariance=calibration_of(whole),
    )


def _common(identities: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What is the same in all identities of labels: of several runs their matchers may differ."""
    first = next(iter(identities), {})
    return {k: v for k, v in first.items() if all(one.get(k) == v for one in identities)}


def _interval(dataset: Dataset, fit: Callable[[Dataset], Regressor]) -> Interval:
    """The interval, from estimates of blocks that the regressor has not seen.

    Settings and width were chosen on these blocks too, so the interval is a little narrower than
    one for which they had been chosen anew for each fold. The effect is small: a held-out block
    only had a part in choosing one of a few candidates.
    """
    try:
        splits = block_splits(dataset)
    except ModelError:
        return NOT_CALIBRATED
    estimate = held_out_estimates(dataset, splits, fit)
    return calibrate(dataset.label(MAIN), estimate, dataset.pieces, LEVEL)


def _wider_outside(dataset: Dataset, interval: Interval) -> float:
    """How many times longer an interval is for a lidar or a matcher outside of the card: as much as
    that of physics, on which every model of several lidars stands, has to be for lidars that are
    held out, the hardest of them counting twice; at least 1 and at most `WIDEST`, which it is where
    none can be held out.
    """
    try:
        splits = leave_lidar_out(dataset)
    except ModelError:
        return WIDEST
    if not interval.blocks:
        return WIDEST
    estimate = held_out_estimates(dataset, splits, partial(Physics.fit, target=MAIN))
    lidars = dataset.rows["lidar"].to_numpy(str)
    return float(np.clip(stretch(interval, dataset.label(MAIN), estimate, lidars), 1.0, WIDEST))


def predict(
    model: Model, factors: pd.DataFrame, made_with: Mapping[str, Any] | None = None
) -> pd.DataFrame:
    """Estimate the error of places; each row for itself, the same bits in any company and order.

    A row with a NaN among its factors has NaN estimates, status `missing` and a reason that names
    the factor; nothing is imputed. Count them by `status`.

    Args:
        model: a trained or loaded model.
        factors: a table with the model's factors; `heading` too where factors in map axes
            are turned into the route's (`dataset.IN_MAP_AXES`). Other factors of the dataset that
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


def check_making(model: Model, made_with: Mapping[str, Any]) -> list[Outside]:
    """Refuse factors that were computed otherwise than those that a model was trained on.

    A model of several lidars judges what its card says may differ (lidar, its height, matcher,
    usable range, blind sector) by the range that it was trained over, and refuses the rest.

    Args:
        model: a trained or loaded model.
        made_with: what the factors were computed with: `dataset.made_with`, and what else the job
            knows (height of the lidar, thinning of the map, how the virtual drive sees).

    Returns:
        The inputs outside of what the model was trained over, whose estimates are out of domain.

    Raises:
        ModelError: names what differs, and says what to do.
    """
    judged = model.card.get(JUDGED, [])
    strange = outside(model.card["inputs"], made_with) if judged else []
    made_with = shared(made_with, judged)
    if "seeing" in model.made_with and "seeing" not in made_with:
        raise ModelError("the model needs the virtual drive: give observe in the config")
    if "seeing" in made_with and "seeing" not in model.made_with:
        raise ModelError(
            "the model was trained without the virtual drive: give observe: null in the config"
        )
    check_own(model.made_with, made_with, model.factors)
    made_with = {name: value for name, value in made_with.items() if name != OWN}
    unsaid = sorted(set(made_with) - set(model.made_with))
    if unsaid:
        raise ModelError(
            f"the model does not say for which {' and '.join(unsaid)} it was trained, as those of "
            "older versions do not: train it again"
        )
    for name in sorted((set(model.made_with) | set(made_with)) - {OWN}):
        trained, given = model.made_with.get(name), made_with.get(name)
        if name == "units" and isinstance(trained, Mapping) and isinstance(given, Mapping):
            for factor in model.factors:
                if trained.get(factor) != given.get(factor):
                    raise ModelError(
                        f"{factor} is in {given.get(factor)!r} in the table and was in "
                        f"{trained.get(factor)!r} where the model was trained"
                    )
        elif trained != given and isinstance(trained, Mapping) and isinstance(given, Mapping):
            differ = sorted(k for k in {*trained, *given} if trained.get(k) != given.get(k))
            raise ModelError(
                f"{name} does not match in {', '.join(differ)}: the model was trained with "
                f"{_short(trained, differ)}, the table was made with {_short(given, differ)}: "
                "train a model for it"
            )
        elif trained != given:
            raise ModelError(
                f"{name} does not match: the model was trained with {trained!r}, the table was "
                f"made with {given!r}: train a model for it"
            )
    return strange


def _short(values: Mapping[str, Any], names: Sequence[str]) -> str:
    """The values of these names as text; of lists their length."""
    said = {k: values.get(k) for k in ("name", *names) if k in values}
    short = {k: f"{len(v)} values" if isinstance(v, list | tuple) else v for k, v in said.items()}
    return ", ".join(f"{name} {value}" for name, value in short.items())


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
