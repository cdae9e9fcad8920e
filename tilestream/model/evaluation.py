"""How good estimates are: Table IV and what stands beside it, on every protocol."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.figures import FIGURES, difference, with_spans
from tilestream.model.physics import at_each_width, width_of
from tilestream.model.registry import COMPETITORS
from tilestream.model.regressor import Regressor
from tilestream.model.splits import Split, block_splits, protocols_of
from tilestream.records import Column

CRITERIA = ("FS", "RQ", "LY", "LS")
"""The paper's four criteria, in the order in which Table IV adds them."""
REPEATS = 5
"""Permutations of a criterion."""
PAPER_TABLE = pd.DataFrame(
    {
        "factors": ["FS", "FS+RQ", "FS+RQ+LY", "FS+RQ+LY+LS"],
        "rmse": [0.0575, 0.0540, 0.0493, 0.0483],
        "mae": [0.0339, 0.0314, 0.0292, 0.0283],
        "within_25mm": [0.594, 0.601, 0.636, 0.641],
        "within_50mm": [0.818, 0.839, 0.847, 0.857],
    }
)
"""The paper's own Table IV [m, shares], its random split."""


def held_out(
    dataset: Dataset,
    splits: Sequence[Split],
    competitor: str,
    target: str = "error_mean",
    seed: int = 0,
) -> pd.DataFrame:
    """What a competitor estimates for points that it has not seen.

    Returns:
        A row per held-out point: `row` of the dataset, `fold`, `group`, `path` and `block` (of
        several runs `Dataset.streets` and `pieces`: what must not calibrate itself), `arc_length`
        [m], `actual`, `estimate`, `median` (of the training part).
    """
    seen = at_each_width(dataset)
    parts = []
    for split in splits:
        # The width too is chosen on what trains.
        width = width_of(dataset.take(split.train), seen[split.train])
        averaged = dataset.averaged(width)
        train, test = averaged.take(split.train), averaged.take(split.test)
        part = test.rows[["group", "path", "block", "arc_length"]].assign(
            path=test.streets,
            block=test.pieces,
            row=split.test,
            fold=split.name,
            actual=test.label(target),
            estimate=COMPETITORS[competitor].fit(train, target, seed).predict(test.rows),
            median=float(np.median(train.label(target))),
        )
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def factor_sets(columns: Sequence[Column]) -> dict[str, tuple[Column, ...]]:
    """The columns of Table IV: the criteria added one by one; then, where there, the robust twins,
    observability alone, and all together. The last set has all columns.
    """
    faithful = [c for c in columns if c.factor_set == "faithful"]
    observed = tuple(c for c in columns if c.factor_set == "observability")
    sets = {
        "+".join(CRITERIA[: k + 1]): tuple(c for c in faithful if c.criterion in CRITERIA[: k + 1])
        for k in range(len(CRITERIA))
    }
    if len(faithful) + len(observed) < len(columns):
        sets["all + robust"] = tuple(c for c in columns if c not in observed)
    if observed:
        sets["observability"] = observed
        sets["all + observability"] = (*faithful, *observed)
        sets["all + robust + observability"] = tuple(columns)
    return {name: chosen for name, chosen in sets.items() if chosen}


def cross_validate(
    dataset: Dataset, competitor: str, target: str = "error_mean", seed: int = 0
) -> dict[str, pd.DataFrame | str]:
    """What a competitor estimates for points that it has not seen, by the name of the protocol.

    Returns:
        The points of each protocol (`held_out`), or why it cannot be followed on this dataset.
    """
    found: dict[str, pd.DataFrame | str] = {}
    for protocol in protocols_of(dataset):
        try:
            splits = protocol.splits(dataset, seed)
        except ModelError as error:
            found[protocol.name] = str(error)
        else:
            found[protocol.name] = held_out(dataset, splits, competitor, target, seed)
    return found


def figures_by_protocol(found: Mapping[str, pd.DataFrame | str], model: str) -> pd.DataFrame:
    """What `cross_validate` found as figures.

    Returns:
        A row per protocol: `protocol`, `model`, the columns of `FIGURES`, `reason` (why a protocol
        cannot be followed on this dataset; its figures are then NaN).
    """
    rows: list[dict[str, object]] = []
    for protocol, points in found.items():
        row: dict[str, object] = {"protocol": protocol, "model": model}
        if isinstance(points, str):
            rows.append(row | {"reason": points})
        else:
            rows.append(row | with_spans(points) | {"reason": ""})
    return pd.DataFrame(rows).reindex(columns=["protocol", "model", *FIGURES, "reason"])


def differences_by_protocol(
    found: Mapping[str, pd.DataFrame | str], others: Mapping[str, pd.DataFrame | str]
) -> pd.DataFrame:
    """How much better one competitor is than another on the same held-out points.

    Args:
        found: what `cross_validate` found of it.
        others: and of the other.

    Returns:
        A row per protocol that both could follow: `protocol`, and the fields of `difference`.
    """
    rows = []
    for protocol, points in found.items():
        against = others.get(protocol, "")
        if not isinstance(points, str) and not isinstance(against, str):
            rows.append({"protocol": protocol, **difference(points, against)})
    return pd.DataFrame(rows)


def importances_of(regressor: Regressor, columns: Sequence[Column]) -> pd.DataFrame:
    """A regressor's own importances, as in Table IV.

    Args:
        regressor: a fitted one.
        columns: the factors that it was fitted on, in its order.

    Returns:
        A row per factor: `factor`, `criterion`, `importance` (they sum to 1).
    """
    return pd.DataFrame(
        {
            "factor": [column.name for column in columns],
            "criterion": [column.criterion for column in columns],
            "importance": regressor.importances(),
        }
    )


def criterion_importances(
    dataset: Dataset,
    regressor: type[Regressor],
    settings: Mapping[str, Any] | None = None,
    target: str = "error_mean",
    seed: int = 0,
) -> pd.DataFrame:
    """How much worse held-out blocks are estimated when a criterion's factors are permuted.

    All factors of a criterion move together, so what one of them knows cannot hide in another.

    Args:
        dataset: labelled places.
        regressor: what is fitted without the held-out blocks.
        settings: with which settings; None: tuned anew on each training part.
        target: which label.
        seed: of fits and permutations.

    Returns:
        A row per criterion: `criterion`, `factors` (how many), `increase` of the mean absolute
        error [unit of the target], `spread` (its standard deviation over the repeats).
    """
    splits = block_splits(dataset)
    criteria = list(dict.fromkeys(column.criterion for column in dataset.columns))
    of = {c: [col.name for col in dataset.columns if col.criterion == c] for c in criteria}
    rng = np.random.default_rng(seed)
    increase = {criterion: np.zeros(REPEATS) for criterion in criteria}
    for split in splits:
        test = dataset.take(split.test)
        fitted = regressor.fit(dataset.take(split.train), target, seed, settings)
        places, actual = test.rows[test.names], test.label(target)
        plain = np.abs(fitted.predict(places) - actual).sum()
        for criterion in criteria:
            for repeat in range(REPEATS):
                order = rng.permutation(len(places))
                moved = places.assign(**{n: places[n].to_numpy()[order] for n in of[criterion]})
                worse = np.abs(fitted.predict(moved) - actual).sum() - plain
                increase[criterion][repeat] += worse / len(dataset)
    return pd.DataFrame(
        [
            {
                "criterion": criterion,
                "factors": len(of[criterion]),
                "increase": float(increase[criterion].mean()),
                "spread": float(increase[criterion].std()),
            }
            for criterion in criteria
        ]
    )
