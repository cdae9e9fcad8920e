"""What a regressor is: a class that says what it is, an instance that has learnt one target.

`Estimator` is what an evaluation compares. `Regressor` can be the model of a job too: it explains
its estimates and is kept in a file. `registry.py` lists them all.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
import pandas as pd

from tilestream.model.dataset import Dataset
from tilestream.model.splits import Split
from tilestream.records import Column, Float64

Kind = Literal["ours", "the paper's other models", "opponents"]
"""What the claim is made for, what the paper compares with, and what any claim must beat."""


class Estimator(ABC):
    """Estimates one target of places."""

    name: ClassVar[str]
    """In `model.recipe`, in tables and in the names of files."""
    words: ClassVar[str]
    """What it is, for the reader of a report."""
    kind: ClassVar[Kind]
    """What it stands for in a report."""

    @classmethod
    @abstractmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:
        """Learn a target from all rows of a dataset.

        Args:
            dataset: labelled places; `dataset.columns` are the factors that may be read.
            target: which label (`TARGETS`).
            seed: of the random numbers; the same seed and rows give the same bits.

        Raises:
            ModelError: the dataset has no such label, or lacks factors that this one needs.
        """

    @abstractmethod
    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) estimates in the unit of the target [m, or a share].

        Args:
            places: n places: the factors that it was fitted on, all finite. Those that are no
                `Regressor` may also read `path`, `arc_length` [m], and `x` and `y` [m, map frame].
        """


class Regressor(Estimator):
    """An estimator from factors alone, which can be the model of a job.

    Each place is estimated for itself: the same bits in any company and order.
    """

    types: ClassVar[frozenset[str]]
    """Every type beyond NumPy's arrays that skops may build to read one, `module.Name`."""

    defaults: ClassVar[Mapping[str, Any]]
    """The settings to fit with where none are tuned: plain values of JSON by name."""

    factors: tuple[str, ...]
    """What it was fitted on, in this order."""
    settings: Mapping[str, Any]
    """What `fit` was given, or what `tuned` has chosen."""

    @classmethod
    def features(cls, columns: Sequence[Column]) -> Sequence[Column]:
        """Which of the factors of a dataset it learns from; all, unless it says otherwise."""
        return columns

    @classmethod
    def tuned(
        cls,
        dataset: Dataset,  # noqa: ARG003
        target: str,  # noqa: ARG003
        seed: int = 0,  # noqa: ARG003
        n_jobs: int | None = 1,  # noqa: ARG003
    ) -> Mapping[str, Any]:
        """The settings to fit with, chosen on this dataset alone; `defaults` unless it chooses.

        The facts of a model hold them beside its `seed`, `points`, `paths` and so on.

        Args:
            dataset: labelled places.
            target: which label.
            seed: of the random numbers.
            n_jobs: threads or processes; None: what joblib's context says (Dask).
        """
        return cls.defaults

    @classmethod
    @abstractmethod
    def fit(
        cls,
        dataset: Dataset,
        target: str,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
        n_jobs: int | None = 1,
    ) -> Self:
        """As `Estimator.fit`, with `settings` as `tuned` gives them (None: it chooses them on this
        dataset) and `n_jobs` as there; the bits are the same for any.
        """

    @abstractmethod
    def contributions(self, places: pd.DataFrame) -> Float64:
        """(n, f) how much each of `factors` raises the estimate of each of n places.

        The unit may be the regressor's own (a logarithm): only signs and ranks are read.
        """

    @abstractmethod
    def importances(self) -> Float64:
        """(f,) how much each of `factors` matters in what was learnt; at least 0, their sum is 1,
        or 0 where nothing was learnt of them.
        """

    def learnt(self) -> Mapping[str, float]:
        """Numbers of it that a reader of the facts of a model asks for, by name."""
        return {}

    @abstractmethod
    def save(self) -> Any:
        """What a model file keeps of it, of `types`, arrays, lists and dictionaries."""

    @classmethod
    @abstractmethod
    def load(
        cls, saved: Any, target: str, factors: tuple[str, ...], settings: Mapping[str, Any]
    ) -> Self:
        """The regressor of a model file. Nothing that it holds is trusted.

        Args:
            saved: what `save` gave.
            target: what it estimates.
            factors: what it was fitted on.
            settings: its settings; other keys may be among them.

        Raises:
            ModelError: it is damaged: estimating with it could fail or read foreign memory.
        """


def held_out_estimates(
    dataset: Dataset, splits: Sequence[Split], fit: Callable[[Dataset], Estimator]
) -> Float64:
    """(n,) each row of a dataset as estimated without it; NaN where no split holds it out.

    Args:
        dataset: n labelled places.
        splits: what is held out, and what trains.
        fit: what is fitted on the training rows of a split.
    """
    estimate = np.full(len(dataset), np.nan)
    for split in splits:
        fitted = fit(dataset.take(split.train))
        estimate[split.test] = fitted.predict(dataset.take(split.test).rows)
    return estimate
