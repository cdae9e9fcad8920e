"""A model for every place: what it is, and how it is trained on a dataset."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tilestream.errors import ModelError, UsageError
from tilestream.model.card import JUDGED, card_of
from tilestream.model.covariance import Calibration
from tilestream.model.covariance_training import calibration_of
from tilestream.model.dataset import TARGETS, Dataset
from tilestream.model.domain import WIDEST, Domain, domain_of
from tilestream.model.explain import PIECE, Typical, typical_of
from tilestream.model.intervals import (
    LEVEL,
    NOT_CALIBRATED,
    Interval,
    calibrate,
    stretch,
    wider_for_few,
)
from tilestream.model.physics import Physics, at_each_width, width_of
from tilestream.model.registry import DEFAULT, OF_VIRTUAL_DRIVES, REGRESSORS
from tilestream.model.regressor import Regressor, held_out_estimates
from tilestream.model.splits import block_splits, leave_lidar_out
from tilestream.records import Column

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
"""What a model says of a place (`prediction.predict`)."""


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
    width = width_of(dataset, at_each_width(dataset))
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
