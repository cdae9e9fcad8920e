"""The main job: a map and some drives in, the estimated error of every sample point out.

```
simulate? -> read sources -> merge, cells, terms, factors, register, label     (measure)
          -> join -> judge, train -> weigh, predict                            (estimate)
          -> report
```
"""

import json
import os
import platform
import resource
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import yaml

from tilestream.dataflow.calibration import learn
from tilestream.dataflow.estimate_tasks import (
    JoinTask,
    JudgeTask,
    PredictTask,
    TrainTask,
    read_dataset,
)
from tilestream.dataflow.factors_tasks import FactorsTask
from tilestream.dataflow.ingest_map import SourcesRead
from tilestream.dataflow.localize_tasks import LabelTask, RegisterTask
from tilestream.dataflow.main_estimate import plan_estimate
from tilestream.dataflow.main_findings import Done, findings_of
from tilestream.dataflow.main_plan import (
    Inputs,
    check_model,
    inputs_of,
    plan_measure,
    read_map,
)
from tilestream.dataflow.observe_tasks import ObserveTask
from tilestream.dataflow.plan import Plan, Task
from tilestream.dataflow.run import Watch, execute, report_kept
from tilestream.dataflow.run_settings import RunSettings, read_settings
from tilestream.dataflow.tasks import Outcome
from tilestream.errors import PartialError, UsageError
from tilestream.forest.dataset import Dataset
from tilestream.forest.model_file import load_model
from tilestream.report import write_report
from tilestream.report.summary import plain
from tilestream.tables import remove_others
from tilestream.version import VERSION

WRITE_EVERY = 30.0
"""How often `run.json` is written while tasks end [s]."""
LARGE = 50_000
"""Measured places from which on a forest is grown by all workers together."""


@dataclass
class _Book:
    """What a run did so far; `run.json` is made from it."""

    folder: Path
    earlier: Mapping[str, Any] = field(default_factory=dict)
    """What it said after the calls before this one."""
    began: float = field(default_factory=time.time)
    written: float = 0.0
    tasks: list[Task] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def listening(self, tasks: Iterable[Task], watch: Watch | None) -> Watch:
        """What enters the outcomes of these tasks as they end, and tells `watch` of them.

        It is written now and then, so that a call that is killed has told what it cost.
        """
        self.tasks += tasks

        def hear(outcome: Outcome, ended: int, total: int) -> None:
            self.outcomes.append(outcome)
            if not outcome.ok:
                self.failures[outcome.key] = outcome.reason
            if time.time() - self.written > WRITE_EVERY:
                self.write("running")
            if watch is not None:
                watch(outcome, ended, total)

        return hear

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Where the job ends early, by an error or Ctrl-C, that is written, and why."""
        try:
            yield
        except BaseException as error:
            self.facts["stopped_by"] = str(error) or type(error).__name__
            with suppress(OSError):  # on a full disk the reason itself matters more
                self.write("stopped")
            raise

    def write(self, state: str) -> dict[str, Any]:
        """Write `run.json`: whole, or as it was."""
        content = {
            "state": state,
            "tilestream": VERSION,
            **machine(),
            "began": datetime.fromtimestamp(self.began, UTC).isoformat(timespec="seconds"),
            "seconds": round(time.time() - self.began, 1),
            "calls": self.calls,
            "seconds_of_all_calls": self.seconds(),
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000,
            "stages": self.stages(),
            "failures": self.failures,
            **self.facts,
        }
        _write_text(self.folder / "run.json", json.dumps(content, indent=2, default=str) + "\n")
        self.written = time.time()
        return content

    @property
    def calls(self) -> int:
        """How often the job was called on this run directory, this call included."""
        return int(self.earlier.get("calls", 0)) + 1

    def seconds(self) -> float:
        """How long all calls took [s]."""
        before = float(self.earlier.get("seconds_of_all_calls", 0.0))
        return round(before + time.time() - self.began, 1)

    def stages(self) -> dict[str, dict[str, float]]:
        """Tasks, failures and work of each stage in this call; its core-seconds in all calls."""
        work = {task.key: task.work for task in self.tasks}
        nothing = {"tasks": 0, "failed": 0, "work": 0, "core_seconds": 0.0}
        before: dict[str, Any] = self.earlier.get("stages", {})
        order = dict.fromkeys([*before, *(task.stage for task in self.tasks)])
        table = {
            stage: nothing | {"core_seconds": before.get(stage, nothing)["core_seconds"]}
            for stage in order
        }
        for outcome in self.outcomes:
            row = table[outcome.stage]
            row["tasks"] += 1
            row["failed"] += not outcome.ok
            row["work"] += work[outcome.key]
            row["core_seconds"] = round(row["core_seconds"] + outcome.seconds, 3)
        return table


def run(
    config: RunSettings | str | os.PathLike[str],
    client: Any | None = None,
    watch: Watch | None = None,
) -> Path:
    """The whole job: measure errors on drives, learn what the map says of them, estimate all.

    Writes a run directory: `map.zarr/`, `tables/` (Parquet with documented columns: `factors`,
    `observability`, `starts`, `errors`, `samples`, `judged`, `predictions`), `model.skops`,
    `report/` (`index.html` and its data), `config.yaml` (the effective one), `run.json` (versions,
    times over all calls, counts, failures). A job that was killed continues when it is called
    again; what changed is redone with what depends on it.

    Args:
        config: the settings, or a YAML file of them.
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The run directory.

    Raises:
        UsageError: settings that cannot be.
        SourceError, StoreError: an input that is not there or cannot be read.
        ModelError: a model in use that does not fit the job, before anything runs; says what
            differs.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done and reported.
    """
    settings = config if isinstance(config, RunSettings) else read_settings(config)
    check_model(settings)
    book = _begin(settings)
    with book.closed():
        with report_kept(client, settings.folder / "dask-performance.html"):
            inputs = inputs_of(settings, client, watch)
            read = read_map(settings, inputs, client, watch)
            merges, identities = read.merges.tasks, read.identities
            measure = plan_measure(settings, inputs, read.store, merges, identities)
            _forget_others(settings, measure)
            measured = _measure(read, measure, client, watch, book)
            estimate = plan_estimate(settings, read.store.grid, measure, measured)
            _estimate(estimate, client, book.listening(estimate.tasks, watch))
        learn(book.tasks, book.outcomes)
        _report(settings, inputs, read, measure, estimate, book)
    book.write("failed" if book.failures else "done")
    if book.failures:
        raise PartialError(
            f"{settings.out}: {len(book.failures)} tasks failed, the rest is done:", book.failures
        )
    return settings.folder


def dataset(run_dir: str | os.PathLike[str]) -> Dataset:
    """The factors and errors of the same places, as a run has joined them.

    Args:
        run_dir: a run directory.

    Returns:
        The dataset: `rows` (a pandas table: place, factors, labels), `columns` (the features),
        `lost` (labels without a place, with reasons).

    Raises:
        SourceNotFoundError: no dataset there.
    """
    return read_dataset(f"{os.fspath(run_dir)}/tables/samples/dataset.parquet")


def _begin(settings: RunSettings) -> _Book:
    """The run directory with the effective settings."""
    try:
        settings.folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(
            f"{settings.out} is a file, or below one: name another run directory"
        ) from None
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    _write_text(settings.folder / "config.yaml", text)
    book = _Book(settings.folder, _told_before(settings.folder / "run.json"))
    book.write("running")
    return book


def _told_before(path: Path) -> dict[str, Any]:
    """The book of earlier calls; empty where there is none, or none of this kind."""
    try:
        told = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) and "calls" in told else {}


def _write_text(path: Path, text: str) -> None:
    part = path.with_name(f"{path.name}.part")
    part.write_text(text)
    part.replace(path)


def _forget_others(settings: RunSettings, measure: Plan) -> None:
    """Remove the tables of other settings, so that two jobs are never mixed in one directory."""
    by_folder: dict[str, list[str]] = {}
    for task in measure.tasks:
        if isinstance(task, FactorsTask | ObserveTask | RegisterTask | LabelTask):
            by_folder.setdefault(task.out.rsplit("/", 1)[0], []).append(task.out)
    for paths in by_folder.values():
        remove_others(paths)
    for kind in ("errors", "starts"):
        for folder in (settings.folder / "tables" / kind).glob("*/"):
            if f"{settings.out}/tables/{kind}/{folder.name}" not in by_folder:
                shutil.rmtree(folder)


def _measure(
    read: SourcesRead, plan: Plan, client: Any | None, watch: Watch | None, book: _Book
) -> list[Outcome]:
    """Run the tasks up to the labels; the map is closed as soon as its last tile is written."""
    open_tiles = {task.key for task in read.merges.tasks}
    written: list[Outcome] = []
    told = book.listening(plan.tasks, watch)

    def watching(outcome: Outcome, ended: int, total: int) -> None:
        if outcome.key in open_tiles:
            written.append(outcome)
            if len(written) == len(open_tiles):
                order = {task.key: n for n, task in enumerate(read.merges.tasks)}
                failures = read.close(sorted(written, key=lambda o: order[o.key]))
                book.failures |= failures
        told(outcome, ended, total)

    if not open_tiles:
        book.failures |= read.close([])
    return execute(plan.tasks, client, watching)


def _estimate(plan: Plan, client: Any | None, watch: Watch) -> list[Outcome]:
    """Run the tasks from the dataset to the estimates.

    A forest of very many places is grown by all workers together, through joblib: the same trees.
    """
    trains = [task for task in plan.tasks if isinstance(task, TrainTask)]
    joins = [task for task in plan.tasks if isinstance(task, JoinTask)]
    if client is None or not trains or sum(join.places for join in joins) < LARGE:
        return execute(plan.tasks, client, watch)
    outcomes = execute(joins, client, watch)
    with client.as_current(), joblib.parallel_config(backend="dask"):
        outcomes += execute(trains, None, watch)
    if any(not outcome.ok for outcome in outcomes):
        return outcomes
    rest = [task for task in plan.tasks if task not in (*joins, *trains)]
    return [*outcomes, *execute(rest, client, watch)]


def _report(
    settings: RunSettings,
    inputs: Inputs,
    read: SourcesRead,
    measure: Plan,
    estimate: Plan,
    book: _Book,
) -> None:
    """Gather what is done and write the report; without a single factor table there is none."""
    good = {outcome.key for outcome in book.outcomes if outcome.ok}
    factors = [t.out for t in measure.tasks if isinstance(t, FactorsTask) and t.key in good]
    observed = [t.out for t in measure.tasks if isinstance(t, ObserveTask) and t.key in good]
    if not factors:
        return
    finished = tuple(task for task in estimate.tasks if task.key in good)
    remove_unknown(finished)
    joined = [task.out for task in finished if isinstance(task, JoinTask)]
    known = read_dataset(joined[0]) if joined else None
    if known is not None:
        book.facts |= {"labelled": len(known), "lost_labels": known.losses}
    facts = _facts(settings, inputs, book, known)
    found, evaluation = findings_of(
        settings.report.title or settings.folder.name,
        Done(tuple(factors), tuple(observed), finished, joined[0] if joined else None),
        read.store,
        known,
        facts,
        model=settings.model,
    )
    text = json.dumps(plain(evaluation), indent=1, allow_nan=False)
    _write_text(settings.folder / "tables" / "evaluation.json", text + "\n")
    write_report(found, settings.folder / "report", threshold=settings.report.threshold)
    book.facts["report"] = str(settings.folder / "report" / "index.html")


def remove_unknown(finished: Sequence[Task]) -> None:
    """Remove the judgements and estimates of other settings."""
    for kind in (JudgeTask, PredictTask):
        paths = [task.out for task in finished if isinstance(task, kind)]
        if paths:
            keep = [f"{paths[0].rsplit('/', 1)[0]}/weights.parquet"] if kind is JudgeTask else []
            remove_others([*paths, *keep])


def _facts(
    settings: RunSettings, inputs: Inputs, book: _Book, known: Dataset | None
) -> dict[str, Any]:
    """What a reader of the report must know of the run, and what makes the same figures again."""
    stages = {name: f"{row['core_seconds']:.1f} s" for name, row in book.stages().items()}
    effective = settings.model_dump(mode="json", exclude={"drives", "out"})
    return {
        **machine(),
        "wall time, all calls [s]": book.seconds(),
        "calls": book.calls,
        "map": settings.store_url,
        "sensor": settings.looking_sensor.name,
        "labelled places": 0 if known is None else len(known),
        "lost labels": {} if known is None else known.losses,
        "model": _model_facts(settings, book),
        "matcher": settings.label.registration.model_dump(),
        "settings": effective,
        "drives": {d.group: d.model_dump(exclude_defaults=True) for d in inputs.drives},
        "core-seconds by stage, all calls": stages,
        "failures": dict(book.failures),
        "notes": list(inputs.notes),
        "attributions": list(inputs.attributions),
    }


def machine() -> dict[str, Any]:
    """What the figures were computed with."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scikit-learn": version("scikit-learn"),
        "cores": os.cpu_count(),
    }


def _model_facts(settings: RunSettings, book: _Book) -> dict[str, Any]:
    """Where the model comes from, and how it was grown."""
    if settings.model.recipe == "physics":
        return {"from": "none: the virtual drive as it is", "offset [m]": settings.model.offset}
    if settings.model.use is not None:
        return {"from": settings.model.use, **load_model(settings.model.use).facts}
    if not any(outcome.stage == TrainTask.stage and outcome.ok for outcome in book.outcomes):
        return {"from": "none: it could not be trained", "recipe": settings.model.recipe}
    return {"from": "trained here", **load_model(settings.folder / "model.skops").facts}
