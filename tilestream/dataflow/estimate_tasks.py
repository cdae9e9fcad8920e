"""The stages after measuring: join (to a dataset), judge, weigh, train, predict (a tile)."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tilestream.dataflow.localize_tasks import ERROR_COLUMNS
from tilestream.dataflow.plan import BASE_BYTES
from tilestream.dataflow.tasks import perform
from tilestream.errors import ModelError, SourceNotFoundError, TaskError
from tilestream.factors import catalogue, observability
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.factors.virtual_drive import averaged_along, physics
from tilestream.forest.dataset import Dataset, features_of, join
from tilestream.forest.evaluation import (
    criterion_importances,
    factor_sets,
    importances,
    importances_of,
    judge,
)
from tilestream.forest.model_file import load_model, save_model
from tilestream.forest.protocols import PROTOCOLS
from tilestream.forest.reasons import without_training
from tilestream.forest.training import MAIN, PREDICTION_COLUMNS, Model, predict, train
from tilestream.records import Column
from tilestream.store import hash_of
from tilestream.tables import is_done, read_mark, read_tables, write_table
from tilestream.tiling import TileKey
from tilestream.version import VERSION

JOIN_VERSION = 3
"""Raise it when the dataset that is joined from the same tables changes."""
TRAIN_VERSION = 3
"""Raise it when the model or the judgement that is made from the same dataset changes."""
FOREST_BYTES = 600_000_000
"""Memory of a task that grows forests, beyond the interpreter, for some thousand places."""

LARGE_ERROR = 0.10
"""Without training: an estimate above this has a reason [m] (the least error of the paper's
Table I)."""
MAY_BE_NAN = ("ob_cov_along", "ob_cov_across", "ob_cov_up", "ob_cov_yaw", "vd_median")
"""What observability has no number for at a place that is lost: the others tell how lost it is."""
COLUMNS = (
    *catalogue.COLUMNS,
    *(column for column in observability.COLUMNS if column.name not in MAY_BE_NAN),
)
"""All factors that a model may learn from."""
DATASET_COLUMNS = (
    Column("group", "place", "", "Which drive, as whose sensor.", "", dtype="str"),
    Column("path", "place", "", "The route that the place lies on.", "", dtype="str"),
    Column("block", "place", "", "Piece of the path that is held out as one.", "", dtype="str"),
    Column("distance", "place", "m", "Between the scan and the sample point.", ""),
)
JUDGED_COLUMNS = (
    *DATASET_COLUMNS,
    Column(
        "protocol", "place", "", "Who trains and who judges.", "definitions, section 6", dtype="str"
    ),
    Column("row", "place", "1", "Row of the dataset that is judged.", "", dtype="int64"),
    Column("fold", "place", "", "What was held out.", "", dtype="str"),
    Column("arc_length", "place", "m", "Length of the route up to here.", ""),
    Column("actual", "label", "", "What was measured, in the unit of the target.", ""),
    Column("estimate", "label", "", "By a model that had not seen it.", "definitions, section 6"),
    Column("median", "label", "", "Of what that model was trained on.", "definitions, section 6"),
)
LOST_COLUMNS = (
    *DATASET_COLUMNS,
    Column("sample", "place", "1", "Number of the sample point of the drive.", "", dtype="int64"),
    Column("reason", "place", "", "Why the label is not in the dataset.", "", dtype="str"),
    Column("detail", "place", "", "More of it.", "", dtype="str"),
)
WEIGHT_COLUMNS = (
    Column("model", "place", "", "`used`: the model's own forest; `paper`.", "", dtype="str"),
    Column("factor", "place", "", "The factor; empty: its whole criterion.", "", dtype="str"),
    Column("criterion", "place", "", "Its criterion.", "Table IV", dtype="str"),
    Column("importance", "label", "1", "The forest's own: they sum to 1.", "impurity decrease"),
    Column("factors", "label", "1", "Factors of the criterion.", ""),
    Column("increase", "label", "m", "Of the error when the criterion is permuted.", "held out"),
    Column("spread", "label", "m", "Standard deviation of that over repeats.", ""),
)


@dataclass(frozen=True)
class JoinTask:
    """Join the factors and the errors of the same places to one dataset."""

    factors: tuple[str, ...]
    """The factor tables."""
    observed: tuple[str, ...]
    """The tables of observability; empty: the job has none."""
    labels: tuple[tuple[str, tuple[str, ...]], ...]
    """(group, its error tables)."""
    made_with: tuple[tuple[str, Any], ...]
    """What the factors were computed with, as items."""
    out: str
    """Where the dataset goes; what is lost goes to `lost.parquet` beside it."""
    identity: str
    places: int
    """Places that were measured."""
    needs: tuple[str, ...] = ()
    promised_bytes: int = BASE_BYTES + FOREST_BYTES
    stage: str = "join"
    work: int = 1

    @property
    def key(self) -> str:
        """`join-dataset`."""
        return "join-dataset"


@dataclass(frozen=True, kw_only=True)
class _OnDataset:
    """Something that is made of the joined dataset."""

    dataset: str
    """Its file."""
    seed: int
    """Of what is random in it."""
    out: str
    identity: str
    needs: tuple[str, ...] = ("join-dataset",)
    promised_bytes: int = BASE_BYTES + FOREST_BYTES
    work: int = 1


@dataclass(frozen=True, kw_only=True)
class JudgeTask(_OnDataset):
    """Let one competitor estimate what it has not seen, on every protocol."""

    competitor: str
    target: str
    factor_set: str
    """Name of the factors it may use (`evaluation.factor_sets`); empty: all."""
    stage: str = "judge"

    @property
    def key(self) -> str:
        """`judge-<target>-<competitor>-<factors>`."""
        name = f"judge-{self.target}-{self.competitor}-{self.factor_set or 'all'}"
        return name.replace(" ", "_")


@dataclass(frozen=True, kw_only=True)
class WeighTask(_OnDataset):
    """How much each factor and each criterion matters to the model, and to the paper's forest."""

    model: str
    """The model's file."""
    needs: tuple[str, ...] = ("train-model",)
    stage: str = "weigh"

    @property
    def key(self) -> str:
        """`weigh-factors`."""
        return "weigh-factors"


@dataclass(frozen=True, kw_only=True)
class TrainTask(_OnDataset):
    """Train the model on all of the dataset."""

    recipe: str
    stage: str = "train"

    @property
    def key(self) -> str:
        """`train-model`."""
        return "train-model"


@dataclass(frozen=True)
class PredictTask:
    """Estimate the error of the sample points of one tile."""

    model: str
    """The model file; empty: none, the virtual drive as it is."""
    model_state: str
    """Hash of what the model was made from: a process keeps the model of the tile before."""
    factors: str
    """The tile's factor table."""
    observed: tuple[str, ...]
    """The tables of observability of this tile and of those around it; empty: the job has none."""
    tile: TileKey
    made_with: tuple[tuple[str, Any], ...]
    out: str
    identity: str
    points: int
    offset: float = 0.0
    """Without a model: what a real scan adds to the error of a virtual one [m]."""
    needs: tuple[str, ...] = ("train-model",)
    promised_bytes: int = BASE_BYTES + FOREST_BYTES
    stage: str = "predict"

    @property
    def work(self) -> int:
        """Sample points."""
        return self.points

    @property
    def key(self) -> str:
        """`predict-<tile>`."""
        return f"predict-{self.tile}"


@perform.register
def _join(task: JoinTask) -> int:
    """Rows of the dataset; 0 where it was there."""
    if is_done(task.out, task.identity):
        return 0
    labels = {group: read_tables(paths) for group, paths in task.labels}
    marks = {group: read_mark(paths[0]) or {} for group, paths in task.labels}
    joined = join(
        places_with_factors(task.factors, task.observed),
        labels,
        COLUMNS,
        made_with=dict(task.made_with),
        data_sets={group: mark["data_set"] for group, mark in marks.items()},
    )
    write_dataset(joined, task.out, task.identity)
    return len(joined)


def places_with_factors(factors: Sequence[str], observed: Sequence[str]) -> pd.DataFrame:
    """Every sample point of the factor tables with all its factors.

    A place that has the factors and could not be observed has NaN there, and says why. Virtual
    drives are averaged along the route (`averaged_along`), so the tables of observability of the
    tiles around have to be given too.
    """
    places = read_tables(factors)
    if not observed:
        return places
    keys = ["route_id", "sample"]
    names = [column.name for column in observability.COLUMNS]
    seen = averaged_along(read_tables(observed))[[*keys, *names, "status", "reason"]]
    seen = seen.rename(columns={"status": "seen", "reason": "why"})
    joined = places.merge(seen, on=keys, how="left", validate="one_to_one")
    blind = (joined["status"] == "done") & (joined["seen"] != "done")
    joined.loc[blind, "status"] = joined.loc[blind, "seen"].fillna("failed")
    joined.loc[blind, "reason"] = joined.loc[blind, "why"].fillna("its task failed")
    return joined.drop(columns=["seen", "why"])


def write_dataset(dataset: Dataset, path: str, identity: str) -> None:
    """Write a dataset as a table, and what it lost as `lost.parquet` beside it; the table last."""
    mark = {
        "identity": identity,
        "features": dataset.names,
        "made_with": dict(dataset.made_with),
        "data_sets": {name: dict(facts) for name, facts in dataset.data_sets.items()},
    }
    lost = f"{path.rsplit('/', 1)[0]}/lost.parquet"
    frame = dataset.lost.astype({"sample": np.int64})
    write_table(lost, frame.assign(detail=frame["detail"].astype(str)), LOST_COLUMNS, {})
    features = features_of(COLUMNS)
    kept = (*DATASET_COLUMNS, *PLACE_COLUMNS, *ERROR_COLUMNS, *features)
    names = {column.name for column in kept}
    rows = dataset.rows[[name for name in dataset.rows if name in names]]
    write_table(path, rows, kept, mark)


def read_dataset(path: str) -> Dataset:
    """The dataset that `write_dataset` wrote.

    Raises:
        SourceNotFoundError: there is none.
    """
    mark = read_mark(path)
    if mark is None:
        raise SourceNotFoundError(f"{path}: no dataset; the job that joins it has not run here")
    known = {column.name: column for column in features_of(COLUMNS)}
    lost = read_tables([f"{path.rsplit('/', 1)[0]}/lost.parquet"])
    columns = tuple(known[name] for name in mark["features"])
    return Dataset(read_tables([path]), columns, lost, mark["made_with"], mark["data_sets"])


@lru_cache(maxsize=1)
def _dataset(path: str, identity: str) -> Dataset:
    """The dataset as models are judged on it: every place once."""
    mark = read_mark(path)
    if mark is None or mark["identity"] != identity:
        raise TaskError(f"{path} is gone or of another run: run the same command again")
    return read_dataset(path).first_drives()


@perform.register
def _judge(task: JudgeTask) -> int:
    """Protocols followed."""
    if is_done(task.out, task.identity):
        return 0
    dataset = _dataset(task.dataset, _dataset_identity(task.dataset))
    if task.factor_set:
        dataset = dataset.with_columns(factor_sets(dataset.columns)[task.factor_set])
    try:
        dataset.check(task.target)
    except ModelError as error:  # told beside the figures; the train task fails for it
        judged: dict[str, pd.DataFrame | str] = {p.name: str(error) for p in PROTOCOLS}
    else:
        judged = judge(dataset, task.competitor, task.target, task.seed)
    parts = [p.assign(protocol=name) for name, p in judged.items() if not isinstance(p, str)]
    reasons = {name: found for name, found in judged.items() if isinstance(found, str)}
    frame = pd.concat(parts, ignore_index=True) if parts else _NOTHING_JUDGED
    mark = {"identity": task.identity, "reasons": reasons, "competitor": task.competitor}
    write_table(task.out, frame, JUDGED_COLUMNS, mark)
    return len(parts)


_NOTHING_JUDGED = pd.DataFrame(
    {
        column.name: pd.Series(dtype=column.dtype)
        for column in JUDGED_COLUMNS
        if column.name != "distance"
    }
)


def read_judged(path: str) -> dict[str, pd.DataFrame | str]:
    """What a judge task found, as `evaluation.judge` gives it."""
    mark, points = read_mark(path), read_tables([path])
    assert mark is not None  # `read_tables` has read it
    found: dict[str, pd.DataFrame | str] = dict(mark["reasons"])
    for name, part in points.groupby("protocol", sort=False):
        found[str(name)] = part.drop(columns="protocol").reset_index(drop=True)
    return found


def _dataset_identity(path: str) -> str:
    mark = read_mark(path)
    return str(mark["identity"]) if mark else ""


@perform.register
def _weigh(task: WeighTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    dataset = _dataset(task.dataset, _dataset_identity(task.dataset))
    dataset.check()
    model = load_model(task.model)
    used = dataset.with_columns([c for c in dataset.columns if c.name in model.factors])
    papers = dataset.with_columns([c for c in dataset.columns if c.factor_set == "faithful"])
    tables = [
        importances_of(model.forests[MAIN], used.columns).assign(model="used"),
        importances(papers, seed=task.seed).assign(model="paper"),
    ]
    mark = {"identity": task.identity, "reason": ""}
    try:
        permuted = [
            criterion_importances(used, recipe=model.recipe, seed=task.seed).assign(model="used"),
            criterion_importances(dataset, seed=task.seed).assign(model="paper"),
        ]
    except ModelError as error:
        mark["reason"] = str(error)
    else:
        tables += [table.assign(factor="") for table in permuted]
    frame = pd.concat(tables, ignore_index=True)
    write_table(task.out, frame, WEIGHT_COLUMNS, mark)
    return len(frame)


@perform.register
def _train(task: TrainTask) -> int:
    """Points trained on; 0 where the model was there."""
    if model_identity(task.out) == task.identity:
        return 0
    dataset = read_dataset(task.dataset)
    model = train(dataset, recipe=task.recipe, seed=task.seed, n_jobs=None)
    save_model(replace(model, facts={**model.facts, "identity": task.identity}), task.out)
    return len(dataset)


def model_identity(path: str) -> str | None:
    """What the model in a file was made from; None where there is none that can be used."""
    try:
        return str(load_model(path).facts.get("identity", ""))
    except (ModelError, SourceNotFoundError):
        return None


def file_hash(path: str) -> str:
    """Hash of a file's bytes."""
    return hashlib.blake2b(Path(path).read_bytes(), digest_size=16).hexdigest()


@lru_cache(maxsize=1)
def _model(path: str, state: str) -> Model:  # noqa: ARG001 - a model of another making is another
    return load_model(path)


@perform.register
def _predict(task: PredictTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    factors = places_with_factors([task.factors], task.observed)
    if task.model:
        model = _model(task.model, task.model_state)
        found = predict(model, factors, dict(task.made_with))
    else:
        found = physical(factors, task.offset)
    places = factors[[column.name for column in PLACE_COLUMNS]]
    frame = pd.concat([places, found], axis=1)
    write_table(task.out, frame, (*PLACE_COLUMNS, *PREDICTION_COLUMNS), {"identity": task.identity})
    return len(frame)


def physical(places: pd.DataFrame, offset: float) -> pd.DataFrame:
    """What the virtual drive says of places, in the columns of a model's estimates.

    There is no interval, and no training place to be like: `low`, `high`, `domain_distance` and
    `in_domain` are empty. Estimates above `LARGE_ERROR` have a reason.
    """
    good = places["status"] == "done"
    error = physics(places["vd_mean"].to_numpy(), offset)
    values: dict[str, Any] = {
        "estimate": error,
        "p_fail": places["vd_p_fail"],
        "floor": physics(places["vd_floor"].to_numpy(), offset),
        "tail": places["vd_tail"],
        "along": places["vd_along"],
        "across": places["vd_across"],
        "up": places["vd_up"],
    }
    blank = {c.name: np.nan for c in PREDICTION_COLUMNS if c.dtype == "float64"}
    frame = pd.DataFrame({**blank, **values}, index=places.index)
    frame.loc[~good, list(values)] = np.nan
    reason = places["reason"].astype(object)
    large = good & (error > LARGE_ERROR)
    reason[large] = without_training(places[large])
    unknown = pd.array([None] * len(places), dtype="boolean")
    words: dict[str, Any] = {"in_domain": unknown, "status": places["status"], "reason": reason}
    return frame.assign(**words)[[column.name for column in PREDICTION_COLUMNS]]


def train_identity(dataset: str, recipe: str, seed: int) -> str:
    """What a model depends on: the dataset, how it is trained, and the code."""
    return hash_of(dataset, recipe, seed, TRAIN_VERSION, VERSION)


def predictions_identity(
    model_state: str, factors: Sequence[str], made_with: Mapping[str, Any]
) -> str:
    """What the estimates of a tile depend on."""
    return hash_of(model_state, list(factors), dict(made_with), TRAIN_VERSION, VERSION)
