"""Which points train and which are held out: the paper's random split, and the honest ones."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.records import Int64

BUFFER = 100.0
"""Training points this near to a held-out one are left out [m]: the range of the paper's
vicinity."""
FOLDS = 5
"""Parts that the blocks are dealt into."""
APART = 1e8
"""How far districts are from each other, whatever their coordinates [m]."""
TRAIN_MIN = 20
"""Fewest training points of a split."""


@dataclass(frozen=True, eq=False)
class Split:
    """One division of the rows of a dataset."""

    name: str
    """What is held out."""
    train: Int64
    """Rows that train, ascending."""
    test: Int64
    """Rows that are held out, ascending."""


@dataclass(frozen=True)
class Protocol:
    """A way to divide, and what its figures mean."""

    name: str
    """Its name in tables."""
    meaning: str
    """A sentence for the reader of its figures."""
    splits: Callable[[Dataset, int], list[Split]]
    """The splits of a dataset, with a seed."""


def random_split(dataset: Dataset, seed: int = 0) -> list[Split]:
    """The paper's: a random quarter of the points is held out, each path as one drive has it. It
    leaks at a spacing of 1 m.
    """
    rows = dataset.rows_of_one_drive()
    order = rows[np.random.default_rng(seed).permutation(len(rows))]
    cut = len(rows) - round(0.25 * len(rows))
    return [Split("random quarter", np.sort(order[:cut]), np.sort(order[cut:]))]


def leave_path_out(dataset: Dataset) -> list[Split]:
    """Each path is estimated from the others, without their points within `BUFFER` of it.

    Raises:
        ModelError: a single path, or too few points left to train.
    """
    paths = dataset.streets
    names = np.unique(paths)
    if len(names) < 2:
        raise ModelError(f"one path only ({names[0]}): leaving it out leaves nothing to train on")
    return [_held_out(dataset, f"path {name}", paths == name) for name in names]


def block_splits(dataset: Dataset, folds: int = FOLDS) -> list[Split]:
    """The blocks are dealt in turn into folds; each fold is estimated from points beyond `BUFFER`.

    Raises:
        ModelError: a single block, or too few points left to train.
    """
    blocks = dataset.pieces
    names = np.unique(blocks)
    if len(names) < 2:
        raise ModelError(f"one block only ({names[0]}): the drive is too short to be divided")
    return _dealt(dataset, blocks, folds)


def nested_splits(dataset: Dataset, folds: int) -> list[Split]:
    """Splits of what trains: whole paths dealt in turn into folds, as an unseen street is what has
    to be estimated; of fewer than three paths, blocks.

    Raises:
        ModelError: a single block, or too few points left to train.
    """
    paths = dataset.streets
    if len(np.unique(paths)) < 3:
        return block_splits(dataset, folds)
    return _dealt(dataset, paths, folds)


def leave_lidar_out(dataset: Dataset) -> list[Split]:
    """Each lidar is estimated on some streets from the other lidars on other streets, dealt into
    folds: the same street with another lidar does not train.

    Raises:
        ModelError: a single lidar, or too few points left to train.
    """
    lidars = _of_several(dataset, "lidar")
    names, streets = np.unique(dataset.streets, return_inverse=True)
    folds = min(FOLDS, len(names))
    found = []
    for lidar in np.unique(lidars):
        own = lidars == lidar
        for k in range(folds):
            test = own & (streets % folds == k)
            if test.any():
                found.append(_held_out(dataset, f"{lidar}, fold {k}", test, ~own))
    return found


def leave_district_out(dataset: Dataset) -> list[Split]:
    """Each district is estimated from the others.

    Raises:
        ModelError: a single district, or too few points left to train.
    """
    districts = _of_several(dataset, "district")
    return [
        _held_out(dataset, f"district {name}", districts == name) for name in np.unique(districts)
    ]


def _of_several(dataset: Dataset, name: str) -> NDArray[np.str_]:
    """(n,) the lidar or the district of each row.

    Raises:
        ModelError: there is one only.
    """
    there = dataset.rows[name].to_numpy(str) if dataset.makings else np.array(["of this run"])
    if len(np.unique(there)) < 2:
        raise ModelError(f"one {name} only ({there[0]}): leaving it out leaves nothing to train on")
    return there


def _dealt(dataset: Dataset, units: NDArray[np.str_], folds: int) -> list[Split]:
    """Units, by (n,) names, dealt in turn into folds."""
    names = np.unique(units)
    folds = min(folds, len(names))
    fold = np.searchsorted(names, units) % folds
    return [_held_out(dataset, f"fold {k}", fold == k) for k in range(folds)]


def _held_out(
    dataset: Dataset,
    name: str,
    test: NDArray[np.bool_],
    may_train: NDArray[np.bool_] | None = None,
) -> Split:
    """A split; of what is not held out, what may train and lies beyond `BUFFER` in its district."""
    at = dataset.rows[["x", "y"]].to_numpy(np.float64)
    at = at - at[0]
    if dataset.makings:  # each district has a frame of its own
        _, district = np.unique(dataset.rows["district"].to_numpy(str), return_inverse=True)
        at = np.column_stack([at, APART * district])
    distance, _ = cKDTree(at[test]).query(at)
    there = ~test if may_train is None else ~test & may_train
    train = np.flatnonzero(there & (distance > BUFFER))
    if len(train) < TRAIN_MIN:
        raise ModelError(
            f"{name}: {len(train)} points lie beyond {BUFFER:g} m of it, too few to train on: "
            "drive more, or farther apart"
        )
    return Split(name, train, np.flatnonzero(test))


PROTOCOLS = (
    Protocol(
        "paper",
        "A random quarter of the points, 1 m from points that trained: factors with no relation to "
        "the error at all score as well here, so these figures prove nothing.",
        random_split,
    ),
    Protocol(
        "path",
        "Each path is estimated by a model that has seen only the other paths, none of it within "
        "100 m: how well a street never driven is estimated.",
        lambda dataset, _: leave_path_out(dataset),
    ),
    Protocol(
        "blocks",
        "Blocks of at least 200 m are estimated by a model that has seen nothing within 100 m of "
        "them: how well the gaps between driven streets are estimated.",
        lambda dataset, _: block_splits(dataset),
    ),
)
OVER_RUNS = (
    Protocol(
        "lidar",
        "Each lidar is estimated by a model that has seen only the other lidars, and no street "
        "that it estimates, none of it within 100 m: how well a lidar never trained with is "
        "estimated.",
        lambda dataset, _: leave_lidar_out(dataset),
    ),
    Protocol(
        "district",
        "Each district is estimated by a model that has seen only the others: how well a city "
        "never driven is estimated.",
        lambda dataset, _: leave_district_out(dataset),
    ),
)
"""What a dataset of several runs allows besides."""


def protocols_of(dataset: Dataset) -> tuple[Protocol, ...]:
    """How a dataset is divided: `PROTOCOLS`, and `OVER_RUNS` where it is of several runs."""
    return (*PROTOCOLS, *OVER_RUNS) if dataset.makings else PROTOCOLS
