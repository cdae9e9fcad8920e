"""What evaluations compare with: the paper's other models, and opponents that know no factors."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, clone
from sklearn.decomposition import PCA
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LinearRegression, SGDRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR
from threadpoolctl import threadpool_limits

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset, matrix
from tilestream.model.forest import PaperForest
from tilestream.model.regressor import Estimator, Kind
from tilestream.records import Column, Float64

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


@dataclass(frozen=True, eq=False)
class Regression(Estimator):
    """A scikit-learn regressor behind a scaler, on labels in centimetres."""

    kind: ClassVar[Kind] = "the paper's other models"
    steps: ClassVar[tuple[BaseEstimator, ...]]
    """What follows the scaler: scikit-learn's defaults wherever nothing is said."""

    factors: tuple[str, ...]
    """What it was fitted on."""
    pipeline: Pipeline
    """Scaler and regressor, fitted."""

    @classmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:
        """As `Estimator.fit`, on all factors."""
        pipeline = clone(make_pipeline(StandardScaler(), *cls.steps))
        seeds = [name for name in pipeline.get_params() if name.endswith("__random_state")]
        pipeline.set_params(**dict.fromkeys(seeds, seed))
        # How many threads share a product shows in the perceptron's last bits.
        with threadpool_limits(1, "blas"), warnings.catch_warnings():
            # Whether the paper's perceptron has converged shows in its figures.
            warnings.simplefilter("ignore", ConvergenceWarning)
            pipeline.fit(dataset.matrix(), dataset.label(target) * CM_PER_M)
        return cls(tuple(dataset.names), pipeline)

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) estimates."""
        with threadpool_limits(1, "blas"):
            estimates: Float64 = self.pipeline.predict(matrix(places, self.factors)) / CM_PER_M
        return estimates


class PrincipalComponents(Regression):
    """Linear regression on the principal components that hold 95 % of the variance."""

    name = "pcr"
    words = "principal component regression"
    steps = PCA(n_components=0.95), LinearRegression()


class Perceptron(Regression):
    """A multi-layer perceptron."""

    name = "mlp"
    words = "multi-layer perceptron"
    steps = (MLPRegressor(max_iter=1000, tol=1e-3),)


class SupportVectors(Regression):
    """A support vector machine."""

    name = "svr"
    words = "support vector regression"
    steps = (SVR(),)


class GradientDescent(Regression):
    """A linear model."""

    name = "sgd"
    words = "linear, stochastic gradient descent"
    steps = (SGDRegressor(),)


@dataclass(frozen=True, eq=False)
class Median(Estimator):
    """The training median, everywhere."""

    name = "training median"
    words = "the training median everywhere"
    kind = "opponents"

    median: float
    """Of the training labels."""

    @classmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:  # noqa: ARG003
        """As `Estimator.fit`; reads no factor."""
        return cls(float(np.median(dataset.label(target))))

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) the median."""
        return np.full(len(places), self.median)


@dataclass(frozen=True, eq=False)
class PathMedian(Estimator):
    """The median of the training places of the same path; of all where there are none."""

    name = "path median"
    words = "the median of the same path"
    kind = "opponents"

    medians: "pd.Series[float]"
    """By path."""
    median: float
    """Of all."""

    @classmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:  # noqa: ARG003
        """As `Estimator.fit`; reads no factor."""
        medians = dataset.rows.groupby("path")[target].median()
        return cls(medians, float(np.median(dataset.label(target))))

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) the medians of the paths of the places."""
        here = places["path"].map(self.medians).to_numpy(np.float64)
        return np.where(np.isfinite(here), here, self.median)


@dataclass(frozen=True, eq=False)
class Nearest(Estimator):
    """The nearest training place along the route; across the map where the path has none."""

    name = "nearest training point"
    words = "the nearest training point"
    kind = "opponents"

    rows: pd.DataFrame
    """The training places."""
    label: Float64
    """(m,) their labels."""

    @classmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:  # noqa: ARG003
        """As `Estimator.fit`; reads no factor."""
        return cls(dataset.rows, dataset.label(target))

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) the labels of the nearest."""
        paths, arc = self.rows["path"].to_numpy(str), self.rows["arc_length"].to_numpy()
        at = self.rows[["x", "y"]].to_numpy(np.float64)
        _, across = cKDTree(at - at[0]).query(places[["x", "y"]].to_numpy(np.float64) - at[0])
        nearest = np.asarray(across, np.int64)
        other_paths, arcs = places["path"].to_numpy(str), places["arc_length"].to_numpy()
        for path in np.unique(other_paths):
            same, here = np.flatnonzero(paths == path), np.flatnonzero(other_paths == path)
            if same.size:
                order = same[np.argsort(arc[same], kind="stable")]
                after = np.clip(np.searchsorted(arc[order], arcs[here]), 1, max(order.size - 1, 1))
                before, after = order[after - 1], order[np.minimum(after, order.size - 1)]
                nearer = np.abs(arc[before] - arcs[here]) <= np.abs(arc[after] - arcs[here])
                nearest[here] = np.where(nearer, before, after)
        return self.label[nearest]


class FootprintForest(PaperForest):
    """The paper's forest on the seven factors that a plan of the streets gives."""

    name = "footprint forest"
    words = "forest on seven 2-D factors: directions of walls, azimuths"
    kind = "opponents"

    @classmethod
    def features(cls, columns: Sequence[Column]) -> Sequence[Column]:
        """The seven.

        Raises:
            ModelError: some are not there; names them.
        """
        absent = sorted(set(FOOTPRINT) - {column.name for column in columns})
        if absent:
            raise ModelError(f"the footprint forest needs the robust factors {', '.join(absent)}")
        return [column for column in columns if column.name in FOOTPRINT]


PAPERS_OTHERS: tuple[type[Estimator], ...] = (
    PrincipalComponents,
    Perceptron,
    SupportVectors,
    GradientDescent,
)
"""What the paper compares with; scikit-learn's defaults."""
OPPONENTS: tuple[type[Estimator], ...] = (Median, PathMedian, Nearest, FootprintForest)
"""What any claim must beat."""
