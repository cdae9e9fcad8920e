"""Physics: the virtual drive as it is (definitions, section 4.5)."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.regressor import Estimator
from tilestream.records import Float64

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


@dataclass(frozen=True)
class Physics(Estimator):
    """The virtual drive plus one number, the median of what real scans add to it."""

    name = "physics"
    words = "the virtual drive in the map, without a forest"
    kind = "ours"

    column: str
    """The factor that says it."""
    added: float
    """Median of label - virtual drive over the training places [the unit of the target]."""

    @classmethod
    def fit(cls, dataset: Dataset, target: str, seed: int = 0) -> Self:  # noqa: ARG003
        """As `Estimator.fit`; needs the virtual drive among the columns of the rows."""
        column = VIRTUAL.get(target, "")
        if column not in dataset.rows:
            raise ModelError(
                f"no virtual drive of {target} in the dataset: observe its places first"
            )
        seen = dataset.rows[column].to_numpy(np.float64)
        return cls(column, float(np.median(dataset.label(target) - seen)))

    def predict(self, places: pd.DataFrame) -> Float64:
        """(n,) virtual drive + added, at least 0."""
        return np.maximum(places[self.column].to_numpy(np.float64) + self.added, 0.0)
