"""Random forests: the paper's, and ours, whose size of leaf is chosen on held-out blocks."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd
from sklearn.ensemble import RandomForestRegressor

from tilestream.errors import ModelError
from tilestream.model.dataset import LEAST, LENGTHS, Dataset
from tilestream.model.features import observed
from tilestream.model.regressor import Kind, Regressor, held_out_estimates
from tilestream.model.splits import block_splits
from tilestream.model.trees import (
    TREE_TYPES,
    added_by_factors,
    float32_of,
    leads_somewhere,
    sum_of,
)
from tilestream.records import Column, Float64


@dataclass(frozen=True)
class Growth:
    """How a forest is grown."""

    trees: int = 100
    """Number of trees."""
    leaf: int = 1
    """Least number of points in a leaf."""
    share: float = 1.0
    """Share of the factors tried at a split."""
    log: bool = False
    """Whether it learns the logarithm of lengths: its estimate is then near the median error
    instead of the mean, which a few lost places pull up."""


CAUTIOUS = Growth(leaf=8, share=1.0 / 3.0, log=True)
"""The default forest where there are no blocks to choose on."""
CANDIDATES = (Growth(leaf=2, log=True), CAUTIOUS, replace(CAUTIOUS, leaf=32))
"""Forests among which the default is chosen: for factors that explain much, some, or little."""


@dataclass(frozen=True, eq=False)
class Forest(Regressor):
    """A random forest that has been grown.

    For the few places of a tile `predict` of scikit-learn's forest takes three times as long as
    those of its trees, so these are called one after the other and summed in the same order.
    """

    kind: ClassVar[Kind] = "ours"
    types = TREE_TYPES | {"sklearn.ensemble._forest.RandomForestRegressor"}

    factors: tuple[str, ...]
    settings: Mapping[str, Any]
    """The fields of `Growth`."""
    trees: RandomForestRegressor
    """scikit-learn's forest."""
    log: bool
    """Whether its trees estimate logarithms."""

    @classmethod
    def fit(
        cls,
        dataset: Dataset,
        target: str,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
        n_jobs: int | None = 1,
    ) -> Self:
        """As `Regressor.fit`."""
        dataset = dataset.with_columns(cls.features(dataset.columns))
        if settings is None:
            settings = cls.tuned(dataset, target, seed, n_jobs)
        growth, label = Growth(**settings), dataset.label(target)
        log = _of_logarithms(growth.log, target)
        trees = RandomForestRegressor(
            n_estimators=growth.trees,
            min_samples_leaf=growth.leaf,
            max_features=growth.share,
            random_state=seed,
            n_jobs=n_jobs,
        )
        trees.fit(dataset.matrix(), np.log(np.maximum(label, LEAST)) if log else label)
        # Threads would add up the trees in the order in which they end.
        return cls(tuple(dataset.names), dict(settings), trees.set_params(n_jobs=1), log)

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) estimates."""
        trees = self.trees.estimators_
        raw = sum_of(trees, float32_of(places, self.factors)) / len(trees)
        estimates: Float64 = np.exp(raw) if self.log else raw
        return estimates

    def contributions(self, places: pd.DataFrame) -> Float64:
        """(n, f) what each factor adds along the paths through the trees: its sum over the factors,
        plus the mean over the roots, is the estimate in the trees' own unit.
        """
        added: Float64 = added_by_factors(self.trees.estimators_, float32_of(places, self.factors))
        return added / len(self.trees.estimators_)

    def importances(self) -> Float64:
        """(f,) decrease of impurity: biased, since the counts are all correlated."""
        found: Float64 = self.trees.feature_importances_
        return found

    def save(self) -> RandomForestRegressor:
        """scikit-learn's forest; the rest follows from target and settings."""
        return self.trees

    @classmethod
    def load(
        cls, saved: Any, target: str, factors: tuple[str, ...], settings: Mapping[str, Any]
    ) -> Self:
        """As `Regressor.load`: scikit-learn walks trees without checking, so each is checked."""
        if not isinstance(saved, RandomForestRegressor) or saved.n_features_in_ != len(factors):
            raise ModelError("a damaged model file: its forest is not of its factors")
        if not all(
            leads_somewhere(estimator.tree_, len(factors)) for estimator in saved.estimators_
        ):
            raise ModelError("a damaged model file: a tree leads nowhere")
        own = {part.name: settings[part.name] for part in fields(Growth)}
        log = _of_logarithms(bool(own["log"]), target)
        return cls(factors, own, saved.set_params(n_jobs=1), log)


def _of_logarithms(log: bool, target: str) -> bool:
    """Whether the trees for a target learn logarithms: shares may be 0."""
    return log and target in LENGTHS


class PaperForest(Forest):
    """The forest as the paper grows it: scikit-learn's defaults."""

    name = "paper"
    words = "forest, the paper's setting"
    defaults = asdict(Growth())


class TunedForest(Forest):
    """Ours."""

    name = "forest"
    words = "forest, tuned on held-out blocks"
    defaults = asdict(CAUTIOUS)

    @classmethod
    def features(cls, columns: Sequence[Column]) -> Sequence[Column]:
        """Observability alone where the dataset has it, else all: the others mostly identify a
        street, which is of no use on a street never driven (benchmarks/RESULTS.md).
        """
        return observed(columns) or columns

    @classmethod
    def tuned(
        cls, dataset: Dataset, target: str, seed: int = 0, n_jobs: int | None = 1
    ) -> Mapping[str, Any]:
        """The candidate with the least mean error on held-out blocks of the dataset.

        Within a training part it sees nothing of what is held out. Where there are too few blocks,
        `CAUTIOUS`.
        """
        try:
            splits = block_splits(dataset, folds=3)
        except ModelError:
            return cls.defaults
        rows = np.concatenate([split.test for split in splits])
        errors = []
        for growth in CANDIDATES:
            quick = asdict(replace(growth, trees=growth.trees // 2))  # the ranks are the same
            fit = partial(cls.fit, target=target, seed=seed, settings=quick, n_jobs=n_jobs)
            off = held_out_estimates(dataset, splits, fit) - dataset.label(target)
            errors.append(np.abs(off[rows]).mean())
        return asdict(CANDIDATES[int(np.argmin(errors))])
