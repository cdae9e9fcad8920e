"""The tasks of a run that are done, and what they made."""

from collections.abc import Collection
from dataclasses import dataclass

import pandas as pd

from tilestream.factors.along_route import WIDTH
from tilestream.model.dataset import Dataset
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.stages.evaluate import by_protocol


@dataclass(frozen=True)
class Done:
    """The tasks of a run that are done."""

    tasks: tuple[Task, ...]

    def outputs(self, stage: str) -> tuple[Task, ...]:
        """Those of a stage."""
        return tuple(task for task in self.tasks if task.stage == stage)

    def dataset(self) -> Dataset | None:
        """The joined dataset; None: nothing was measured, or it could not be joined."""
        joined = self.outputs("samples")
        return joined[0].writes.read() if joined else None

    def evaluations(self) -> dict[tuple[str, str, str], dict[str, pd.DataFrame | str]]:
        """What was evaluated, by (target, competitor, factor set; empty: all factors)."""
        return {
            (t.takes["target"], t.takes["competitor"], t.takes["factor_set"]): by_protocol(
                t.writes.read()
            )
            for t in self.outputs("evaluate")
        }

    @property
    def width(self) -> float:
        """Over what the virtual drives of the estimates are averaged along the route [m]."""
        for task in self.outputs("predict")[:1]:
            model = task.reads.get("model")
            if model is not None and not isinstance(model, tuple):
                return float(model.read().width)
        return WIDTH


def without(dataset: Dataset | None, groups: Collection[str]) -> Dataset | None:
    """The dataset without these groups; None: nothing is left."""
    if dataset is None or not groups:
        return dataset
    left = [name for name in dataset.rows["group"].unique() if name not in groups]
    return dataset.groups(left) if left else None
