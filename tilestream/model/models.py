"""What estimates the error: the forests, the paper's other models, and the opponents to beat."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from sklearn.decomposition import PCA
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LinearRegression, SGDRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR
from threadpoolctl import threadpool_limits

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.protocols import Split, block_splits
from tilestream.records import Float64

LENGTHS = ("error_mean", "error_floor", "along_mean", "across_mean", "up_mean")
"""Targets that are positive lengths, whose logarithm a forest may learn."""
LEAST = 1e-4
"""Errors below this count as this, before a logarithm [m]."""
CM_PER_M = 100.0
FOOTPRINT = (
    "wall_major",
    "wall_minor",
    "wall_balance",
    "wall_H",
    "weak_along",
    "angular_H",
    "empty_sector",
)
"""Seven factors that a plan gives, in the manner of Wong et al. (2019), who take theirs from
building outlines: how much wall stands around, by the direction that it fixes (counts); how those
directions and the azimuths of what stands there are spread; what they leave open. Azimuths and
horizontal normals alone; only a high wall counts more often than a low one, a cell per storey."""


@dataclass(frozen=True)
class Recipe:
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


PAPER = Recipe()
"""scikit-learn's defaults: the paper's forest."""
CAUTIOUS = Recipe(leaf=8, share=1.0 / 3.0, log=True)
"""The default forest where there are no blocks to choose on."""
CANDIDATES = (Recipe(leaf=2, log=True), CAUTIOUS, replace(CAUTIOUS, leaf=32))
"""Forests among which the default is chosen: for factors that tell much, some, or little."""


@dataclass(frozen=True, eq=False)
class Forest:
    """A random forest that has been grown."""

    trees: RandomForestRegressor
    """scikit-learn's forest."""
    log: bool
    """Whether its trees speak of logarithms."""

    def estimate(self, X: Float64) -> Float64:
        """(n,) estimates for (n, f) factors, all finite; each row for itself, to the bit.

        The trees are asked one after the other, as scikit-learn's `predict` does it with one job;
        its own way to them costs more than the answers for a tile's places.
        """
        X32 = np.ascontiguousarray(X, np.float32)
        raw = np.zeros(len(X))
        for tree in self.trees.estimators_:
            raw += tree.tree_.predict(X32)[:, 0]
        raw /= len(self.trees.estimators_)
        estimates: Float64 = np.exp(raw) if self.log else raw
        return estimates


def grow(
    dataset: Dataset, target: str, recipe: Recipe, seed: int = 0, n_jobs: int | None = 1
) -> Forest:
    """Grow a forest on all rows of a dataset.

    Args:
        dataset: what to learn from.
        target: which label.
        recipe: how.
        seed: of the random numbers; the same seed gives the same forest, to the bit.
        n_jobs: processes or threads while growing; None: what joblib's context says (Dask).
    """
    log = recipe.log and target in LENGTHS
    label = dataset.label(target)
    trees = RandomForestRegressor(
        n_estimators=recipe.trees,
        min_samples_leaf=recipe.leaf,
        max_features=recipe.share,
        random_state=seed,
        n_jobs=n_jobs,
    )
    trees.fit(dataset.matrix(), np.log(np.maximum(label, LEAST)) if log else label)
    # Threads would add up the trees in the order in which they end.
    return Forest(trees.set_params(n_jobs=1), log)


def tuned(
    dataset: Dataset, target: str = "error_mean", seed: int = 0, n_jobs: int | None = 1
) -> Recipe:
    """The default forest: the candidate with the least mean error on held-out blocks.

    The blocks are of `dataset` alone, so tuning within a training part sees nothing of what judges
    it. Where there are too few blocks, `CAUTIOUS`.
    """
    try:
        splits = block_splits(dataset, folds=3)
    except ModelError:
        return CAUTIOUS
    errors = [_held_out_error(dataset, splits, target, r, seed, n_jobs) for r in CANDIDATES]
    return CANDIDATES[int(np.argmin(errors))]


def _held_out_error(
    dataset: Dataset,
    splits: list[Split],
    target: str,
    recipe: Recipe,
    seed: int,
    n_jobs: int | None,
) -> float:
    """Mean absolute error on the held-out rows [m], with half the trees: ranks are the same."""
    quick = replace(recipe, trees=recipe.trees // 2)
    errors = []
    for split in splits:
        forest = grow(dataset.take(split.train), target, quick, seed, n_jobs)
        judged = dataset.take(split.test)
        errors.append(np.abs(forest.estimate(judged.matrix()) - judged.label(target)))
    return float(np.concatenate(errors).mean())


Competitor = Callable[[Dataset, Dataset, str, int], Float64]
"""(what trains, what is judged, target, seed) -> (n,) estimates; the labels of what is judged are
not looked at."""


def _paper(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:
    return grow(train, target, PAPER, seed).estimate(judged.matrix())


def telling(dataset: Dataset) -> Dataset:
    """The dataset with the factors that the default forest learns from: observability alone where
    it is there, since all others mostly tell one street from another, which is of no use on a
    street never driven (benchmarks/RESULTS.md); else all.
    """
    observed = [column for column in dataset.columns if column.factor_set == "observability"]
    return dataset.with_columns(observed) if observed else dataset


def _default(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:
    train, judged = telling(train), telling(judged)
    return grow(train, target, tuned(train, target, seed), seed).estimate(judged.matrix())


def _footprint(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:
    seven = [column for column in train.columns if column.name in FOOTPRINT]
    if len(seven) < len(FOOTPRINT):
        absent = sorted(set(FOOTPRINT) - {column.name for column in seven})
        raise ModelError(f"the footprint forest needs the robust factors {', '.join(absent)}")
    return _paper(train.with_columns(seven), judged.with_columns(seven), target, seed)


def _regression(make: Callable[[int], list[Any]]) -> Competitor:
    """A scikit-learn regressor behind a scaler, on labels in centimetres."""

    def estimate(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:
        pipeline = make_pipeline(StandardScaler(), *make(seed))
        # How many threads share a product shows in the perceptron's last bits.
        with threadpool_limits(1, "blas"), warnings.catch_warnings():
            # Whether the paper's perceptron has converged shows in its figures.
            warnings.simplefilter("ignore", ConvergenceWarning)
            pipeline.fit(train.matrix(), train.label(target) * CM_PER_M)
            estimates: Float64 = pipeline.predict(judged.matrix()) / CM_PER_M
        return estimates

    return estimate


def _median(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:  # noqa: ARG001
    return np.full(len(judged), np.median(train.label(target)))


def _path_median(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:
    """The median of the training points of the same path; of all where there are none."""
    medians = train.rows.groupby("path")[target].median()
    here = judged.rows["path"].map(medians).to_numpy(np.float64)
    return np.where(np.isfinite(here), here, _median(train, judged, target, seed))


def _nearest(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:  # noqa: ARG001
    """The nearest training point along the route; across the map where the path has none."""
    label, paths = train.label(target), train.rows["path"].to_numpy(str)
    at = train.rows[["x", "y"]].to_numpy(np.float64)
    _, across = cKDTree(at - at[0]).query(judged.rows[["x", "y"]].to_numpy(np.float64) - at[0])
    nearest = np.asarray(across, np.int64)
    arc, arcs = train.rows["arc_length"].to_numpy(), judged.rows["arc_length"].to_numpy()
    judged_paths = judged.rows["path"].to_numpy(str)
    for path in np.unique(judged_paths):
        same, here = np.flatnonzero(paths == path), np.flatnonzero(judged_paths == path)
        if same.size:
            order = same[np.argsort(arc[same], kind="stable")]
            after = np.clip(np.searchsorted(arc[order], arcs[here]), 1, max(order.size - 1, 1))
            before, after = order[after - 1], order[np.minimum(after, order.size - 1)]
            nearer = np.abs(arc[before] - arcs[here]) <= np.abs(arc[after] - arcs[here])
            nearest[here] = np.where(nearer, before, after)
    return label[nearest]


FORESTS: dict[str, Competitor] = {"paper": _paper, "default": _default}
"""The forest as the paper grows it, and ours."""
OTHERS: dict[str, Competitor] = {
    "pcr": _regression(lambda _: [PCA(n_components=0.95), LinearRegression()]),
    "mlp": _regression(lambda seed: [MLPRegressor(max_iter=1000, tol=1e-3, random_state=seed)]),
    "svr": _regression(lambda _: [SVR()]),
    "sgd": _regression(lambda seed: [SGDRegressor(random_state=seed)]),
}
"""What the paper compares with: principal component regression (95 % of the variance), multi-layer
perceptron, support vector machine, stochastic gradient descent; scikit-learn's defaults."""
OPPONENTS: dict[str, Competitor] = {
    "training median": _median,
    "path median": _path_median,
    "nearest training point": _nearest,
    "footprint forest": _footprint,
}
"""What any claim must beat."""


def _physics(train: Dataset, judged: Dataset, target: str, seed: int) -> Float64:  # noqa: ARG001
    """The virtual drive as it is, plus one number: the median of what real scans add to it."""
    seen = VIRTUAL.get(target, "")
    if seen not in train.rows:
        raise ModelError(f"no virtual drive of {target} in the dataset: observe its places first")
    added = float(np.median(train.label(target) - train.rows[seen].to_numpy(np.float64)))
    return np.maximum(judged.rows[seen].to_numpy(np.float64) + added, 0.0)


VIRTUAL = {
    "error_mean": "vd_mean",
    "error_tail": "vd_tail",
    "error_floor": "vd_floor",
    "along_mean": "vd_along",
    "across_mean": "vd_across",
    "up_mean": "vd_up",
    "p_fail": "vd_p_fail",
}
"""What the virtual drive says of each target."""
PHYSICS: dict[str, Competitor] = {"physics": _physics}
"""An estimate without a forest, for datasets with the observability factors."""
COMPETITORS = FORESTS | OTHERS | OPPONENTS | PHYSICS
