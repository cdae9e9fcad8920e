"""Physics, corrected by what observability says of its error, as far as that pays."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.tree import DecisionTreeRegressor

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.physics import Physics, possible
from tilestream.model.regressor import Kind, Regressor
from tilestream.model.splits import nested_splits
from tilestream.model.trees import TREE_TYPES, added_by_factors, float32_of, leads_somewhere, sum_of
from tilestream.records import Column, Float64

WEIGHTS = (0.25, 0.5, 0.75, 1.0)
"""Shares of the correction that are tried besides 0."""
NESTED = 4
"""Folds of paths, or of blocks, in which the share is chosen."""


@dataclass(frozen=True)
class Boosting:
    """How the correction is grown."""

    trees: int = 60
    """Number of trees."""
    rate: float = 0.1
    """Share of each tree that is added."""
    depth: int = 3
    """Most nodes from root to leaf."""
    leaf: int = 20
    """Least number of points in a leaf."""
    share: float = 1.0 / 3.0
    """Share of the factors tried at a split."""
    sampled: float = 0.5
    """Share of the points that a tree sees."""


@dataclass(frozen=True, eq=False)
class Corrected(Regressor):
    """Physics + weight x correction.

    The correction is gradient boosting on the absolute error of physics. Its weight is chosen for
    each target on paths held out of the training places, and is 0 unless it pays there.
    """

    name = "corrected"
    words = "the virtual drive plus one number, corrected where that pays"
    kind: ClassVar[Kind] = "ours"
    types = TREE_TYPES
    defaults: ClassVar[Mapping[str, Any]] = asdict(Boosting())

    factors: tuple[str, ...]
    settings: Mapping[str, Any]
    """The fields of `Boosting`."""
    physics: Physics
    """What is corrected."""
    weight: float
    """Share of the correction that is added."""
    trees: tuple[DecisionTreeRegressor, ...]
    """Whose sum times `rate` is the correction; none where `weight` is 0."""

    @classmethod
    def features(cls, columns: Sequence[Column]) -> Sequence[Column]:
        """Those of physics."""
        return Physics.features(columns)

    @classmethod
    def fit(
        cls,
        dataset: Dataset,
        target: str,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
        n_jobs: int | None = 1,  # noqa: ARG003
    ) -> Self:
        """As `Regressor.fit`; needs the virtual drive among the factors."""
        physics = Physics.fit(dataset, target, seed)
        dataset = dataset.with_columns(cls.features(dataset.columns))
        settings = dict(cls.defaults if settings is None else settings)
        boosting = Boosting(**settings)
        weight = _weight_that_pays(dataset, target, boosting, seed)
        trees = _boosted(dataset, physics, boosting, seed) if weight else ()
        return cls(physics.factors, settings, physics, weight, trees)

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) estimates."""
        if not self.weight:
            return self.physics.predict(places)
        step = self.weight * self.settings["rate"]
        corrected = self.physics.raw(places) + step * sum_of(
            self.trees, float32_of(places, self.factors)
        )
        return possible(self.physics.target, corrected, places)

    def contributions(self, places: pd.DataFrame) -> Float64:
        """(n, f) as physics, and what each factor adds along the paths through the trees."""
        added = self.physics.contributions(places)
        if self.weight:
            step = self.weight * self.settings["rate"]
            added += step * added_by_factors(self.trees, float32_of(places, self.factors))
        return added

    def importances(self) -> Float64:
        """(f,) mean decrease of impurity over the trees of the correction; 0 without one."""
        total = np.zeros(len(self.factors))
        for tree in self.trees:
            total += tree.tree_.compute_feature_importances(normalize=False)
        return total / total.sum() if total.any() else total

    def learnt(self) -> Mapping[str, float]:
        """What a real scan adds, and the share of the correction."""
        return {**self.physics.learnt(), "correction": self.weight}

    def save(self) -> dict[str, Any]:
        """Physics, the weight and the trees; the rest follows from the settings."""
        return {
            "physics": self.physics.save(),
            "weight": np.array([self.weight]),
            "trees": list(self.trees),
        }

    @classmethod
    def load(
        cls, saved: Any, target: str, factors: tuple[str, ...], settings: Mapping[str, Any]
    ) -> Self:
        """As `Regressor.load`: scikit-learn walks trees without checking, so each is checked."""
        if not isinstance(saved, dict) or set(saved) != {"physics", "weight", "trees"}:
            raise ModelError("a damaged model file: no physics with a correction")
        physics = Physics.load(saved["physics"], target, factors, settings)
        trees, weight = saved["trees"], saved["weight"]
        known = [[share] for share in (0.0, *WEIGHTS)]
        if not isinstance(weight, np.ndarray) or weight.tolist() not in known:
            raise ModelError("a damaged model file: its correction has no weight")
        if not isinstance(trees, list) or not all(
            isinstance(tree, DecisionTreeRegressor) and leads_somewhere(tree.tree_, len(factors))
            for tree in trees
        ):
            raise ModelError("a damaged model file: a tree leads nowhere")
        own = {name: settings[name] for name in cls.defaults}
        return cls(factors, own, physics, float(weight[0]), tuple(trees))


def _boosted(
    dataset: Dataset, physics: Physics, boosting: Boosting, seed: int
) -> tuple[DecisionTreeRegressor, ...]:
    """Trees whose sum times `rate` is what physics lacks at the places of a dataset."""
    grown = GradientBoostingRegressor(
        loss="absolute_error",
        init="zero",
        n_estimators=boosting.trees,
        learning_rate=boosting.rate,
        max_depth=boosting.depth,
        min_samples_leaf=boosting.leaf,
        max_features=boosting.share,
        subsample=boosting.sampled,
        random_state=seed,
    )
    grown.fit(dataset.matrix(), dataset.label(physics.target) - physics.raw(dataset.rows))
    trees = tuple(tree.set_params(random_state=None) for tree in grown.estimators_.ravel())
    for tree in trees:
        _fill_inner_nodes(tree.tree_)
    return trees


def _fill_inner_nodes(tree: Any) -> None:
    """Give each inner node the mean of its leaves: boosting leaves the mean sign of the error
    there, which is no length that a contribution could be read from.
    """
    value, points = tree.value[:, 0, 0], tree.weighted_n_node_samples
    for node in np.flatnonzero(tree.children_left >= 0)[::-1]:  # children come after their parent
        below = [tree.children_left[node], tree.children_right[node]]
        value[node] = points[below] @ value[below] / points[below].sum()


def _weight_that_pays(dataset: Dataset, target: str, boosting: Boosting, seed: int) -> float:
    """The share of the correction that lowers the error of held-out paths most, every block of them
    weighing the same; 0 where no share lowers it by more than one standard error over the blocks.
    """
    try:
        splits = nested_splits(dataset, NESTED)
    except ModelError:
        return 0.0
    label = dataset.label(target)
    gain = np.empty((len(label), len(WEIGHTS)))
    for split in splits:
        train, places = dataset.take(split.train), dataset.rows.iloc[split.test]
        physics = Physics.fit(train, target)
        X = float32_of(places, dataset.names)
        correction = boosting.rate * sum_of(_boosted(train, physics, boosting, seed), X)
        raw, actual = physics.raw(places), label[split.test]
        plain = np.abs(possible(target, raw, places) - actual)
        for k, weight in enumerate(WEIGHTS):
            corrected = possible(target, raw + weight * correction, places)
            gain[split.test, k] = plain - np.abs(corrected - actual)
    of_block = pd.DataFrame(gain).groupby(dataset.rows["block"].to_numpy(str)).mean().to_numpy()
    mean = of_block.mean(axis=0)
    error = of_block.std(axis=0, ddof=1) / np.sqrt(len(of_block))
    pays = np.where(mean > error, mean, 0.0)
    return WEIGHTS[int(np.argmax(pays))] if pays.any() else 0.0
