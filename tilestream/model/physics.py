"""Physics: the virtual drive and one number (definitions, section 4.5)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd

from tilestream.errors import ModelError
from tilestream.factors.along_route import WIDTH, WIDTHS
from tilestream.model.dataset import LENGTHS, Dataset
from tilestream.model.features import observed
from tilestream.model.regressor import Kind, Regressor
from tilestream.model.splits import block_splits
from tilestream.records import Column, Float64

VIRTUAL = {
    "error_mean": "vd_mean",
    "p_fail": "vd_p_fail",
    "error_floor": "vd_floor",
    "error_tail": "vd_tail",
    "along_mean": "vd_along",
    "across_mean": "vd_across",
    "up_mean": "vd_up",
}
"""What the virtual drive says of each target."""
SCANS_ADD = ("error_mean", "error_floor")
"""Targets to which a real scan adds the offset of a model that is not trained."""


@dataclass(frozen=True, eq=False)
class Physics(Regressor):
    """The virtual drive plus one number, the median of what real scans add to it."""

    name = "physics"
    words = "the virtual drive plus one number"
    kind: ClassVar[Kind] = "ours"
    types = frozenset()
    defaults: ClassVar[Mapping[str, Any]] = {}

    factors: tuple[str, ...]
    settings: Mapping[str, Any]
    target: str
    """What it estimates."""
    added: float
    """Median of label - virtual drive over the training places [the unit of the target]."""
    middle: float
    """Median of the virtual drive over them [the same]."""

    @classmethod
    def as_it_is(cls, target: str, offset: float) -> Self:
        """Of a virtual drive without training.

        Args:
            target: what it estimates.
            offset: what a real scan adds to the mean error and to its floor [m].
        """
        added = offset if target in SCANS_ADD else 0.0
        return cls(tuple(VIRTUAL.values()), {}, target, added, 0.0)

    @classmethod
    def features(cls, columns: Sequence[Column]) -> Sequence[Column]:
        """Observability, which the domain is made of; it reads the virtual drive alone.

        Raises:
            ModelError: the virtual drive is not among them.
        """
        found = observed(columns)
        if not any(column.name in VIRTUAL.values() for column in found):
            raise ModelError("no virtual drive among the factors: observe the places first")
        return found

    @classmethod
    def fit(
        cls,
        dataset: Dataset,
        target: str,
        seed: int = 0,  # noqa: ARG003
        settings: Mapping[str, Any] | None = None,  # noqa: ARG003
        n_jobs: int | None = 1,  # noqa: ARG003
    ) -> Self:
        """As `Regressor.fit`; needs the virtual drive among the factors."""
        names = tuple(column.name for column in cls.features(dataset.columns))
        if not set(_read(target)) <= set(names):
            raise ModelError(
                f"no virtual drive of {target} among the factors: observe the places first"
            )
        seen = dataset.rows[VIRTUAL[target]].to_numpy(np.float64)
        added = float(np.median(dataset.label(target) - seen))
        return cls(names, cls.defaults, target, added, float(np.median(seen)))

    def raw(self, places: pd.DataFrame) -> Float64:
        """(n,) virtual drive + added, possible or not."""
        return places[VIRTUAL[self.target]].to_numpy(np.float64) + self.added

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) estimates."""
        return possible(self.target, self.raw(places), places)

    def contributions(self, places: pd.DataFrame) -> Float64:
        """(n, f) by how much the virtual drive is above that of a typical training place."""
        added = np.zeros((len(places), len(self.factors)))
        seen = places[VIRTUAL[self.target]].to_numpy(np.float64)
        added[:, self.factors.index(VIRTUAL[self.target])] = seen - self.middle
        return added

    def importances(self) -> Float64:
        """(f,) 0: one number was learnt, and of no factor."""
        return np.zeros(len(self.factors))

    def learnt(self) -> Mapping[str, float]:
        """What a real scan adds."""
        return {"offset": self.added}

    def save(self) -> dict[str, Any]:
        """Its factors and its two numbers."""
        return {"factors": list(self.factors), "numbers": np.array([self.added, self.middle])}

    @classmethod
    def load(
        cls, saved: Any, target: str, factors: tuple[str, ...], settings: Mapping[str, Any]
    ) -> Self:
        """As `Regressor.load`."""
        numbers = saved.get("numbers") if isinstance(saved, dict) else None
        if not isinstance(numbers, np.ndarray) or numbers.dtype != np.float64:
            raise ModelError("a damaged model file: no numbers of physics")
        if numbers.shape != (2,) or not np.isfinite(numbers).all():
            raise ModelError("a damaged model file: physics has not two numbers")
        if list(factors) != saved["factors"] or not set(_read(target)) <= set(factors):
            raise ModelError("a damaged model file: physics is not of its factors")
        return cls(factors, {name: settings[name] for name in cls.defaults}, target, *numbers)


def _read(target: str) -> tuple[str, ...]:
    """The factors that are read to estimate a target."""
    tail = (VIRTUAL["error_floor"],) if target == "error_tail" else ()
    return (VIRTUAL[target], *tail) if target in VIRTUAL else (f"virtual drive of {target}",)


def possible(target: str, values: Float64, places: pd.DataFrame) -> Float64:
    """(n,) values as near as a target can be: lengths at least 0, a share from 0 to 1; a tail at
    least -vd_floor, so that with the virtual floor it adds up to no negative error.
    """
    if target in LENGTHS:
        return np.maximum(values, 0.0)
    if target == "error_tail":
        least: Float64 = -places[VIRTUAL["error_floor"]].to_numpy(np.float64)
        return np.maximum(values, least)
    share: Float64 = np.clip(values, 0.0, 1.0)
    return share


def at_each_width(dataset: Dataset) -> Float64:
    """(n, k) what the virtual drive says of `error_mean`, averaged with each of the k `WIDTHS`;
    (n, 0) where there is no virtual drive.
    """
    column = VIRTUAL["error_mean"]
    if dataset.virtual_drives.empty or column not in dataset.rows:
        return np.empty((len(dataset), 0))
    return np.column_stack([dataset.averaged(width).rows[column] for width in WIDTHS])


def width_of(dataset: Dataset, seen: Float64) -> float:
    """The kernel along the route with which physics estimates held-out blocks best [m].

    The candidate with the least mean absolute error of `error_mean`, of equals the narrowest;
    `WIDTH` where no block can be held out, or where there is no virtual drive.

    Args:
        dataset: labelled places.
        seen: (n, k) their rows of `at_each_width`: found once where parts of a dataset train.
    """
    if not seen.size:
        return WIDTH
    try:
        splits = block_splits(dataset)
    except ModelError:
        return WIDTH
    label = dataset.label("error_mean")
    errors = []
    for virtual in seen.T:
        off = np.empty(len(label))
        for split in splits:
            added = np.median((label - virtual)[split.train])
            off[split.test] = np.maximum(virtual[split.test] + added, 0.0) - label[split.test]
        errors.append(np.abs(off).mean())
    return WIDTHS[int(np.argmin(errors))]
