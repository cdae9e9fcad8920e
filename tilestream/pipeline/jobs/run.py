"""The main job: a map and some drives in, the estimated error of every sample point out.

```
simulate? -> scatter -> merge, cells, terms, factors, surfels, observe, register, label   (measure)
          -> samples -> train, evaluate -> importance, predict                            (estimate)
          -> report
```
"""

import json
import os
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from tilestream.errors import require_all_done
from tilestream.files import place_of
from tilestream.lock import only_writer
from tilestream.model.covariance import calibration_told
from tilestream.model.dataset import Dataset
from tilestream.model.file import load_model
from tilestream.model.shipped import file_of
from tilestream.notes import noticed
from tilestream.pipeline.engine.cluster import report_kept
from tilestream.pipeline.engine.costs import learn
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.jobs.estimator import Estimator
from tilestream.pipeline.jobs.inventory import settle
from tilestream.pipeline.jobs.run_before import say_other_map, tell
from tilestream.pipeline.jobs.run_book import (
    Book,
    checksums,
    machine,
    told_before,
)
from tilestream.pipeline.jobs.run_done import Done, without
from tilestream.pipeline.jobs.run_findings import findings_of
from tilestream.pipeline.jobs.run_inputs import JOB, Inputs, check_files, inputs_of
from tilestream.pipeline.jobs.run_lanes import lanelet_maps_of
from tilestream.pipeline.jobs.run_making import as_far_as_known, check_model
from tilestream.pipeline.jobs.run_names import CONFIG, DATASET, RECORD
from tilestream.pipeline.jobs.run_notes import (
    drives_measured,
    heights_told,
    log_poses_told,
    lost_labels,
    offset_told,
    run_notes,
)
from tilestream.pipeline.jobs.run_plan import places_to_train
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.pipeline.jobs.run_story import Story, estimate_large
from tilestream.pipeline.jobs.starts_of import starts_of
from tilestream.pipeline.stages.samples import DatasetFile
from tilestream.report import write_report
from tilestream.report.data import estimates
from tilestream.report.summary import by_reason, plain, reasons_told

ESTIMATES = "estimates"
"""What it is filed under that there are none."""


def run(
    config: RunSettings | str | os.PathLike[str],
    client: Any | None = None,
    watch: Watch | None = None,
) -> Path | str:
    """The whole job: measure errors on drives, learn what the map says of them, estimate all.

    Writes a run directory: `map.zarr/`, `tables/` (Parquet with documented columns: definitions,
    section 7), `model.skops`, `report/` (`index.html` and its data), `config.yaml` (the effective
    one), `run.json` (versions, times over all calls, counts, failures). A job that was killed
    continues when it is called again; what changed is redone with what depends on it. Where the map
    was updated, what the report said before it is kept in `before/` (`ts.diff(run_dir)`).

    Args:
        config: the settings, or a YAML file of them.
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The run directory; of one in an object store its URL.

    Raises:
        UsageError: settings that cannot be.
        SourceError, StoreError: an input that is not there or cannot be read.
        ModelError: a model in use that does not fit the job, before anything runs; says what
            differs.
        PlanError: a task does not fit `memory`.
        LockedError: another process writes to the run directory, or to the map that is made.
        IncompleteError: the map that is there is not whole, and not `map.partial`.
        PartialError: some tasks failed, or some sources, drives or routes cannot be used; the
            message lists them, the rest is done and reported.
    """
    settings = config if isinstance(config, RunSettings) else read_settings(config)
    check_files(settings)
    settings = as_far_as_known(settings)
    check_model(settings)
    inputs = None if settings.simulate is not None else inputs_of(settings, client, watch)
    with only_writer(settings.out), _map_alone(settings):
        _run(settings, inputs, client, watch)
    return Path(settings.out) if settings.folder.local else settings.out


def _map_alone(settings: RunSettings) -> AbstractContextManager[None]:
    """Be the only process that writes the map, of a job that makes one."""
    makes = settings.map.sources or settings.simulate is not None
    return only_writer(settings.store_url) if makes else nullcontext()


def _run(
    settings: RunSettings, inputs: Inputs | None, client: Any | None, watch: Watch | None
) -> None:
    """The whole job, of the one process that may write the run directory; a city is simulated
    first.
    """
    book = _begin(settings)
    with book.closed():
        book.write("running")  # in here: who reads it may stop the job at once
        with report_kept(client, settings.folder.under("dask-performance.html").address):
            inputs = inputs or inputs_of(settings, client, watch)
            book.failures |= inputs.failures
            story = Story(settings, inputs, book)
            inputs = story.inputs
            book.facts["notes"] = dict(inputs.notes)
            execute(
                story.first(),
                client,
                book.listening(watch),
                grow=story.grown,
                ahead=story.ahead,
                shared=[settings.out, story.store.url],
                inputs=story.files,
            )
            if story.large is not None:
                estimate_large(story.large, client, book.listening(watch))
        learn(book.tasks, book.outcomes)
        settle(book.tasks, book.failures)
        book.facts["notes"] = run_notes(settings, inputs, story.store)
        _report(settings, inputs, story, book)
    if story.update is not None:
        made = book.stages().get("predict", {"made": 0})["made"]
        book.facts["update"] = story.update.along(int(made), story.places)
    book.facts["files"] = checksums(settings.folder)
    for name in ("", "tables", "report", "report/figures", "before"):
        settings.folder.under(name).remove_parts()
    book.write("failed" if book.failures else "done")
    require_all_done(settings.out, book.failures)


def dataset(run_dir: str | os.PathLike[str]) -> pd.DataFrame:
    """The factors and errors of the same places, as a run has joined them: for models of one's own.

    Args:
        run_dir: a run directory.

    Returns:
        A row per labelled place and drive: `group` (log and sensor), `path`, `block`, `arc_length`
        [m], `x`, `y`, `z` [m, map frame], `heading` [rad], the factors and the labels, each of them
        explained by `ts.explain`. `attrs["features"]` names the factors that models learn from.

    Raises:
        SourceNotFoundError: no dataset there.

    Examples:
        >>> table = ts.dataset("my-run")  # doctest: +SKIP
        >>> X, y = table[table.attrs["features"]], table["error_mean"]  # doctest: +SKIP
    """
    found = dataset_of(run_dir)
    table = found.rows.copy()
    table.attrs["features"] = found.names
    return table


def dataset_of(run_dir: str | os.PathLike[str]) -> Dataset:
    """The same with all that is known of it; raises as `dataset`."""
    return DatasetFile(f"{place_of(run_dir)}/{DATASET}").read()


def _begin(settings: RunSettings) -> Book:
    """The run directory with the effective settings."""
    say_other_map(settings)
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    settings.folder.under(CONFIG).write(text.encode())
    return Book(settings.folder, told_before(settings.folder.under(RECORD)))


def _report(settings: RunSettings, inputs: Inputs, story: Story, book: Book) -> None:
    """Gather what is done and write the report; without a single factor table there is none."""
    good = {outcome.key for outcome in book.outcomes if outcome.ok}
    done = Done(tuple(task for task in book.tasks if task.key in good))
    measured = drives_measured(inputs, done)
    book.facts["drives"] = [drive.plain() for drive in measured]
    if not done.outputs("factors"):
        return
    by, otherwise = story.estimator, story.otherwise
    told = (
        {JOB: offset_told(places_to_train(done.outputs("label"), story.aside), settings, by)},
        heights_told(done, settings),
        log_poses_told(done),
    )
    book.facts["notes"] = noticed(book.facts["notes"], *told)
    known = without(done.dataset(), story.unfit)
    if story.unfit:
        book.facts["unfit"] = dict(story.unfit)
    if known is not None:
        book.facts |= {"labelled": len(known), "lost_labels": known.losses}
    found, evaluation = findings_of(
        done,
        story.store,
        known,
        _facts(settings, inputs, book, known, _model_facts(settings, done, by)),
        settings,
        by,
        otherwise,
        inputs.mapped,
    )
    found = replace(
        found,
        notes=book.facts["notes"],
        drives=measured,
        lost_labels=lost_labels(known),
        cell_size=settings.cell_size,
        ends=lambda group, sample: starts_of(settings.out, sample, group),
        lanelet_maps=lanelet_maps_of(settings, inputs),
    )
    if not np.isfinite(estimates(found.places)).any():
        book.failures[ESTIMATES] = (
            f"no place has one: {reasons_told(by_reason(found.places['reason']))}"
        )
    text = json.dumps(plain(evaluation), indent=1, allow_nan=False)
    settings.folder.under("tables/evaluation.json").write(f"{text}\n".encode())
    write_report(found, f"{settings.out}/report", threshold=settings.report.threshold)
    tell(settings, story.map_plan)
    book.facts["report"] = f"{settings.out}/report/index.html"


def _facts(
    settings: RunSettings,
    inputs: Inputs,
    book: Book,
    known: Dataset | None,
    model: Mapping[str, Any],
) -> dict[str, Any]:
    """What a reader of the report must know of the run, and what makes the same figures again."""
    stages = {name: f"{row['core_seconds']:.1f} s" for name, row in book.stages().items()}
    effective = settings.model_dump(mode="json", exclude={"drives", "out"})
    return {
        **machine(),
        "wall time, all calls [s]": book.seconds(),
        "calls": book.calls,
        "map": settings.store_url,
        "sensor": settings.vehicle.name,
        "labelled places": 0 if known is None else len(known),
        "model": model,
        **({"coarse": book.facts["coarse"]} if "coarse" in book.facts else {}),
        "matcher": {
            "name": settings.label.registration.told,
            **settings.label.registration.model_dump(),
        },
        "settings": effective,
        "drives": {d.group: d.model_dump(exclude_defaults=True) for d in inputs.drives},
        "core-seconds by stage, all calls": stages,
        "failures": dict(book.failures),
        "attributions": list(inputs.attributions),
    }


def _model_facts(settings: RunSettings, done: Done, by: Estimator) -> dict[str, Any]:
    """Where the model comes from, and how it and its covariances were made."""
    along = {"averaged along the route over [m]": done.width}
    if by.untrained:
        offset = settings.model.offset or 0.0
        found = {"from": "none: the virtual drive as it is", "offset [m]": offset, **along}
        return {**found, "covariances": calibration_told(None)}
    if by.use is None and not done.outputs("train"):
        return {"from": "none: it could not be trained", "recipe": settings.model.recipe}
    model = load_model(f"{settings.out}/model.skops" if by.use is None else file_of(by.use))
    told = {**along, "covariances": calibration_told(model.covariance)}
    return {"from": by.use or "trained here", **model.facts, **told}
