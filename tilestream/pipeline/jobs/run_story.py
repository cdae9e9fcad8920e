"""The main job as it goes on: what is known after each part decides what the next one is."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import joblib

from tilestream.errors import PlanError
from tilestream.files import Files
from tilestream.model.shipped import SHIPPED
from tilestream.notes import noticed
from tilestream.pipeline.engine.attempt import Outcome, found
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.engine.late_client import client_for
from tilestream.pipeline.engine.plan import Plan, paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.estimator import (
    LABELS,
    OTHER_LIDAR,
    UNFIT,
    Estimator,
    estimator_of,
)
from tilestream.pipeline.jobs.inventory import announce, withdraw
from tilestream.pipeline.jobs.map_reading import GONE, Reading
from tilestream.pipeline.jobs.map_update import Update
from tilestream.pipeline.jobs.rounds import Rounds, first_round, remove_rounds
from tilestream.pipeline.jobs.run_before import keep_before, update_of
from tilestream.pipeline.jobs.run_book import Book
from tilestream.pipeline.jobs.run_inputs import Inputs, read_map, seen_otherwise
from tilestream.pipeline.jobs.run_notes import with_logs
from tilestream.pipeline.jobs.run_plan import places_to_train, plan_estimate, plan_measure
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.unfit import unfit_drives
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.store import TileStore, open_store

LARGE = 50_000
"""Measured places from which on a forest is grown by all workers together."""


class Story:
    """The job as it goes on.

    Where nothing is to be trained, a place is estimated as soon as its tile and those around it are
    looked from. Else the labels are joined first: only then is it known whether they suffice.
    """

    def __init__(self, settings: RunSettings, inputs: Inputs, book: Book) -> None:
        self.settings = settings
        self.book = book
        self.reading: Reading | None = read_map(settings, inputs)
        self.store: TileStore = (
            self.reading.store if self.reading else open_store(settings.store_url)
        )
        found = self.reading.found if self.reading else None
        sources = self.store.sources() if found is None else [source.record for source in found]
        logs = with_logs(settings, inputs, sources)
        gone = {path: [GONE] for path in (self.reading.gone if self.reading else ())}
        self.inputs = replace(logs, notes=noticed(logs.notes, gone))
        self.measure = Plan((), settings.memory)
        self.estimator = Estimator()
        """What makes the estimates, as far as it is known by now."""
        self.map_plan = MapPlan(self.store, {})
        """The map, as soon as its tiles are known."""
        self.update: Update | None = None
        """What is new in it since the last report, by then; None: nothing, or none was there."""
        self.large: Plan | None = None
        """What is left to be run by all workers together, when all else is done."""
        self.rounds: Rounds | None = None
        """Those of a coarse run; None: all places are evaluated."""
        self.otherwise = seen_otherwise(settings, self.inputs.drives)
        """The drives that are read as another lidar than the vehicle's, and so train nothing."""
        self.unfit: dict[str, str] = {}
        """Those that do not fit the map and train nothing either, and why: known when measured."""
        self._tiles: set[str] = set()
        self._open: set[str] = set()
        self._early = _Early((), set())
        self._given: set[str] = set()
        self._joining: str | None = None
        self._all_planned = False
        self._ahead: tuple[Task, ...] | None = None

    @property
    def places(self) -> int:
        """How many sample points the routes have."""
        return sum(task.work for task in self.measure.outputs("factors"))

    @property
    def aside(self) -> dict[str, str]:
        """The drives that train nothing, and why, in words."""
        return dict.fromkeys(self.otherwise, OTHER_LIDAR) | dict.fromkeys(self.unfit, UNFIT)

    @property
    def files(self) -> list[str]:
        """The files that tasks read: sources of the map, logs of drives, a model in use."""
        sources = self.reading.inputs if self.reading else []
        use = self.settings.model.use
        model = [] if use in (None, SHIPPED) else [str(use)]
        return [*sources, *(drive.log for drive in self.inputs.drives), *model]

    def first(self) -> Plan:
        """What to run first: read the sources, or measure on the map that is there."""
        tasks = self.reading.first().tasks if self.reading else ()
        if not tasks:
            self._close_map()
            partial = self.settings.map.partial
            tasks = self._measured(MapPlan.of_store(self.store, partial=partial))
        return Plan(self._known(tasks), self.settings.memory)

    def grown(self, outcome: Outcome) -> tuple[Task, ...]:
        """What is to be done now that a task has ended."""
        more = self.reading.grown(outcome) if self.reading else None
        if self.reading is not None and more is not None:
            if not self.reading.sorted_out:  # what else is to be read of the tiles that differ
                return self._known(more)
            self._tiles = {task.key for task in more}
            if not more:
                self._close_map()  # which refuses sources without points
            return self._known((*more, *self._measured(self.reading.map_plan)))
        if outcome.key in self._tiles:
            self._tiles.remove(outcome.key)
            if not self._tiles:
                self._close_map()
        self._open.discard(outcome.key)
        if not self.measure.tasks or self._all_planned:
            return ()
        if self._joining is not None:
            return self._known(self._joined(outcome) if outcome.key == self._joining else ())
        if self._open or self._tiles:
            early = self._early.after(outcome)
            self._given |= {task.key for task in early}
            return self._known(early)
        return self._known(self._next_round() or self._estimated())

    def ahead(self) -> tuple[Task, ...] | None:
        """What is expected to follow what is measured; None: that is not known yet."""
        if self._ahead is None and self.measure.tasks:
            with suppress(PlanError):  # raised when it comes to that, if it does
                self._ahead = self._expected().tasks
        return self._ahead

    def _next_round(self) -> tuple[Task, ...]:
        """What a coarse run does next; nothing: all that is to be evaluated is."""
        if self.rounds is None:
            return ()
        more = self.rounds.after({outcome.key for outcome in self.book.outcomes if outcome.ok})
        self.measure = replace(self.measure, tasks=(*self.measure.tasks, *more))
        self._open = {task.key for task in more}
        announce(more)
        if not more:
            self.rounds.remove_others()
            self.book.facts["coarse"] = self.rounds.told.plain()
        return more

    def _estimated(self) -> tuple[Task, ...]:
        """What is to be done when all is measured."""
        good = {outcome.key for outcome in self.book.outcomes if outcome.ok}
        labels = [task for task in self.measure.outputs("label") if task.key in good]
        self.unfit = unfit_drives(labels)
        for name, why in self.unfit.items():
            self.book.failures[f"drive {name}"] = f"{why} Nothing is learnt from it or judged by it"
        self._decide(places_to_train(labels, self.aside))
        planned = self._plan(self.book.outcomes)
        joined = planned.outputs("samples")
        if not (self.estimator.trained and joined):
            return self._rest(planned)
        announce(joined)
        self._joining = joined[0].key
        self._given = {self._joining}
        return joined

    def _joined(self, outcome: Outcome) -> tuple[Task, ...]:
        """What is to be done when it is known how many labels there are to train on."""
        self._decide(self._labelled() if outcome.ok else 0)
        return self._rest(self._plan(self.book.outcomes))

    def _labelled(self) -> int:
        """How many places are joined that a model may learn from."""
        joined = next(task for task in self.book.tasks if task.key == self._joining)
        groups = joined.writes.read().rows["group"]
        return int((~groups.isin(list(self.aside))).sum())

    def _decide(self, labelled: int) -> None:
        """What makes the estimates, with so many places to learn from."""
        self.estimator = estimator_of(self.settings, labelled, self.aside)

    def _rest(self, planned: Plan) -> tuple[Task, ...]:
        """What of the whole plan has not been given out."""
        announce(planned.tasks, begun=bool(self._given))
        self._all_planned, self._ahead = True, ()
        if self.estimator.few:
            self.book.failures[LABELS] = self.estimator.few
        tasks = tuple(task for task in planned.tasks if task.key not in self._given)
        if _is_large(planned):
            self.large = Plan(self._known(tasks), planned.memory)
            return ()
        return tasks

    def _expected(self) -> Plan:
        """What is learnt and estimated if all is measured well."""
        return self._plan([Outcome(task.key, task.stage) for task in self.measure.tasks])

    def _plan(self, outcomes: Sequence[Outcome]) -> Plan:
        """What is learnt and estimated from what was measured."""
        between = None if self.rounds is None else self.rounds.between()
        return plan_estimate(
            self.settings,
            self.store.grid,
            self.measure,
            outcomes,
            self.estimator,
            between,
            self.aside,
        )

    def _close_map(self) -> None:
        """Record what the map was made from, as soon as its last tile is written."""
        if self.reading is not None:
            self.book.failures |= self.reading.close(self.book.outcomes)

    def _measured(self, map_plan: MapPlan) -> tuple[Task, ...]:
        """The tasks that measure; tables of other settings are removed before, and what the last
        report says of another map is kept.
        """
        self.map_plan, self.update = map_plan, update_of(self.settings, map_plan)
        if self.update is not None:
            keep_before(self.settings)
        self.measure = plan_measure(self.settings, self.inputs, map_plan)
        self.book.failures |= self.measure.left_out
        self._decide(places_to_train(self.measure.outputs("label"), self.aside))
        self.rounds, self.measure = first_round(
            self.settings, map_plan, self.measure, self.estimator
        )
        announce(self.measure.tasks)
        _remove_other_groups(self.settings, self.measure)
        self._open = {task.key for task in self.measure.tasks}
        self._early = self._first_estimates()
        return self.measure.tasks

    def _first_estimates(self) -> "_Early":
        """The estimates that need not wait for all that is measured."""
        if self.estimator.trained or self.rounds is not None:
            return _Early((), set())
        tasks = self._expected().outputs("predict")
        announce(tasks)
        return _Early(tasks, self._open)

    def _known(self, tasks: Sequence[Task]) -> tuple[Task, ...]:
        self.book.tasks += tasks
        return tuple(tasks)


class _Early:
    """Tasks that may run once others have ended well; where one of these has failed, the end of
    all that is measured decides.
    """

    def __init__(self, tasks: Sequence[Task], open_: set[str]) -> None:
        self._needs = {task.key: open_ & set(task.needs) for task in tasks}
        self._tasks = {task.key: task for task in tasks}
        self._after: dict[str, list[str]] = {}
        for key, needs in self._needs.items():
            for need in needs:
                self._after.setdefault(need, []).append(key)

    def after(self, outcome: Outcome) -> list[Task]:
        """Those that may run now."""
        freed = []
        for key in self._after.pop(outcome.key, ()):
            if not outcome.ok:
                self._tasks.pop(key, None)
            self._needs[key].discard(outcome.key)
            if not self._needs[key] and key in self._tasks:
                freed.append(self._tasks.pop(key))
        return freed


def _remove_other_groups(settings: RunSettings, measure: Plan) -> None:
    """Remove the tables of drives of other settings, so that two jobs are never mixed.

    Those of a drive whose log cannot be read now are kept: they were hours of work, maybe.
    """
    kept = {name.removeprefix("drive ") for name in measure.left_out}
    if settings.coarse is None:
        remove_rounds(settings.out)
    own = {path.rsplit("/", 1)[0] for path in paths_of(measure.tasks)}
    for kind, below in (
        ("errors", ""),
        ("starts", ""),
        ("drives", "/factors"),
        ("drives", "/observability"),
    ):
        for group in Files.at(f"{settings.out}/tables/{kind}").names():
            folder = f"{settings.out}/tables/{kind}/{group}"
            if f"{folder}{below}" not in own and group not in kept:
                withdraw(f"{folder}{below}")
                Files.at(folder).remove_empty()


def _is_large(estimate: Plan) -> bool:
    """Whether so many places were measured that all workers grow the forest together."""
    places = sum(task.work for task in estimate.outputs("samples"))
    return places >= LARGE and bool(estimate.outputs("train"))


def estimate_large(plan: Plan, client: Any | None, watch: Watch) -> None:
    """Estimate with a forest that all workers grow together, through joblib: the same trees."""
    trains = Plan(plan.outputs("train"), plan.memory)
    if client is None or all(found(task) for task in trains.tasks):
        outcomes = execute(trains, None, watch)
    else:
        with client_for(client, LARGE).as_current(), joblib.parallel_config(backend="dask"):
            outcomes = execute(trains, None, watch)
    if all(outcome.ok for outcome in outcomes):
        begun = {outcome.key for outcome in outcomes}
        rest = tuple(task for task in plan.tasks if task.key not in begun)
        execute(Plan(rest, plan.memory), client, watch)
