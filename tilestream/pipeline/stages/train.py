"""Train: the model, on all of the dataset."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from tilestream.errors import ModelError, SourceNotFoundError
from tilestream.files import Files
from tilestream.model.dataset import Dataset
from tilestream.model.file import load_model, save_model
from tilestream.model.shipped import file_of
from tilestream.model.training import Model
from tilestream.model.training import train as trained
from tilestream.pipeline.engine.outputs import Facts, Made
from tilestream.pipeline.engine.stage import Counts, stage
from tilestream.pipeline.stages.samples import BYTES_PER_ROW, FOREST_BYTES
from tilestream.records import Column


@dataclass(frozen=True)
class ModelFile:
    """Where a model goes."""

    path: str

    def known(self, identity: str) -> Facts | None:
        """Whether a model that can be used is there, of this identity."""
        try:
            facts = load_model(self.path).facts
        except (ModelError, SourceNotFoundError):
            return None
        return {} if facts.get("identity") == identity else None

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """Write the model, which remembers its identity."""
        model: Model = made.value
        save_model(replace(model, facts={**model.facts, "identity": identity}), self.path)
        return made.facts

    def read(self) -> Model:
        """The model; a process keeps the last one."""
        return _model(self.path, file_hash(self.path))


@dataclass(frozen=True)
class ModelInUse:
    """A model that was trained elsewhere."""

    path: str
    """Its file, or `shipped`: the one of the installation that reads it."""
    identity: str
    makers: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: str) -> "ModelInUse":
        """The model in a file, or the one that ships, known by its bytes."""
        return cls(path, file_hash(file_of(path)))

    def read(self) -> Model:
        """The model; a process keeps the last one."""
        return _model(file_of(self.path), self.identity)

    def counts(self) -> Counts:
        """Nothing that memory depends on."""
        return {}


def file_hash(path: str) -> str:
    """Hash of a file's bytes."""
    return hashlib.blake2b(Files.at(path).read(), digest_size=16).hexdigest()


@lru_cache(maxsize=1)
def _model(path: str, state: str) -> Model:  # noqa: ARG001 - other bytes are another model
    return load_model(path)


@stage(
    "train",
    version=6,
    memory=lambda counts: FOREST_BYTES + BYTES_PER_ROW * counts["places"],
    seconds=80.0,
)
def train(dataset: Dataset, recipe: str, seed: int) -> Made:
    """The model, trained on every drive of every place.

    Args:
        dataset: what was measured.
        recipe: name of the regressor.
        seed: of what is random.

    Raises:
        ModelError: nothing can be learnt from this dataset; says why.
    """
    return Made(trained(dataset, recipe=recipe, seed=seed, n_jobs=None), {"rows": len(dataset)})
