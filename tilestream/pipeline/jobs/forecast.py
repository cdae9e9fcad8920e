"""What the main job would run, from headers alone: before anything is read or written."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tilestream.counts import count_of
from tilestream.errors import StoreNotFoundError
from tilestream.notes import MATCHER, Notes, noticed
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.along_routes import off_map
from tilestream.pipeline.jobs.estimator import OTHER_LIDAR, estimator_of
from tilestream.pipeline.jobs.ingest import plan_ingest
from tilestream.pipeline.jobs.map_expected import tiles_to_read
from tilestream.pipeline.jobs.rounds import first_round
from tilestream.pipeline.jobs.run_before import update_of
from tilestream.pipeline.jobs.run_inputs import (
    Inputs,
    check_files,
    extent,
    inputs_of,
    is_simulated,
    map_scans,
    seen_otherwise,
    simulated_folder,
    simulations,
)
from tilestream.pipeline.jobs.run_making import as_far_as_known, check_model
from tilestream.pipeline.jobs.run_notes import with_logs
from tilestream.pipeline.jobs.run_plan import places_to_train, plan_estimate, plan_measure
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.simulate import plan_simulation
from tilestream.pipeline.jobs.sources import ingest_settings, map_notes
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.predict import predict
from tilestream.settings import SimulateSettings
from tilestream.store import open_store

PLAN = "plan"
"""What notes are filed under that are about the plan itself."""


@dataclass(frozen=True)
class Forecast:
    """What a job would do, told before it does anything."""

    tasks: tuple[Task, ...]
    """The tasks, each after those that it needs; of the map's tiles, those that there may be; of a
    city that is not simulated yet, those that make it."""
    notes: Notes
    """What was noticed of the inputs by source, and as `plan` what is not known before the job
    runs."""
    update: Mapping[str, Any] | None = None
    """Of a run whose map is updated: tiles that change, places that are recomputed, at most, and
    both in words (`told`); None: it is none."""


def forecast(settings: RunSettings) -> Forecast:
    """What the main job would run; nothing is read beyond headers, nothing is written.

    Raises:
        PlanError: a task does not fit `memory`.
        UsageError, SourceError, StoreError, ModelError: as the job itself.
    """
    check_files(settings)
    settings = as_far_as_known(settings)
    check_model(settings)
    if settings.simulate is not None and not is_simulated(settings):
        return _simulation_first(settings, settings.simulate)
    inputs = inputs_of(settings, None, None)
    map_plan, reading, notes, sources = _expected_map(settings, inputs)
    inputs = with_logs(settings, inputs, sources)
    measure = plan_measure(settings, inputs, map_plan)
    aside = dict.fromkeys(seen_otherwise(settings, inputs.drives), OTHER_LIDAR)
    labels = measure.outputs("label")
    by = estimator_of(settings, places_to_train(labels, aside), aside)
    rounds, measure = first_round(settings, map_plan, measure, by)
    done = [Outcome(task.key, task.stage) for task in measure.tasks]
    estimate = plan_estimate(settings, map_plan.store.grid, measure, done, by, aside=aside)
    tasks = (*reading, *measure.tasks, *estimate.tasks)
    far = {"routes": off_map(map_plan.points, map_plan.store.grid, inputs.routes)}
    lost = [f"{name} is left out: {reason}" for name, reason in measure.left_out.items()]
    few = [by.few] if by.few else []
    coarse = [] if rounds is None else [rounds.forecast]
    own = {PLAN: [*few, *lost, *coarse], MATCHER: settings.label.registration.notes}
    return Forecast(
        tasks, noticed(notes, inputs.notes, far, own), _update(settings, map_plan, tasks)
    )


def _update(
    settings: RunSettings, map_plan: MapPlan, tasks: Sequence[Task]
) -> dict[str, Any] | None:
    """What an update of the map reaches, at most; None: the map is as it was, or is new."""
    update = update_of(settings, map_plan)
    if update is None:
        return None
    places = [task for task in tasks if task.stage == predict.name]
    left = sum(task.work for task in to_do(places))
    return update.along(left, sum(task.work for task in places), at_most=True)


def to_do(tasks: Iterable[Task]) -> list[Task]:
    """Those of some tasks that are not done."""
    return [task for task in tasks if not _is_done(task)]


def _is_done(task: Task) -> bool:
    try:
        return task.writes.known(task.identity) is not None
    except StoreNotFoundError:
        return False


def _simulation_first(settings: RunSettings, wanted: SimulateSettings) -> Forecast:
    """What simulates the city, as far as it is not there."""
    folder = simulated_folder(settings)
    plans = [plan_simulation(drive, folder, **extent(wanted)) for drive in simulations(wanted)]
    missing = {
        task.writes: task for plan in plans for task in plan.tasks if not _is_done(task)
    }  # all drives have one survey
    note = f"first the city is simulated in {folder}; plan again to see what follows"
    return Forecast(tuple(missing.values()), {PLAN: [note]})


def _expected_map(
    settings: RunSettings, inputs: Inputs
) -> tuple[MapPlan, tuple[Task, ...], Notes, list[dict[str, Any]]]:
    """The map as it is, or as the bounds of its sources let expect it; its sources as recorded."""
    if not inputs.sources:
        store = open_store(settings.store_url)
        there = MapPlan.of_store(store, partial=settings.map.partial)
        return there, (), map_notes(store), store.sources()
    planned = plan_ingest(
        inputs.sources,
        settings.store_url,
        ingest_settings(settings.map),
        settings.memory,
        settings.map.log_options,
        map_scans(settings, inputs),
    )
    tiles, unknown = tiles_to_read(planned)
    expected = planned.expected(tiles)
    notes = [f"{path} is left out: {reason}" for path, reason in planned.left_out.items()]
    if tiles:
        count = len(expected.points)
        notes.append(
            f"at most {count_of(count, 'tile')}, by the bounds of the sources; reading tells which"
        )
    if unknown:
        notes.append(f"only reading tells where the points of {', '.join(unknown[:3])} are")
    sources = [source.record for source in planned.found]
    told = noticed({PLAN: notes}, planned.notes)
    return expected, planned.scatters.tasks, told, sources
