"""The virtual drives of a coarse run: in rounds, each where the one before it asks for more.

```
places that are evaluated next -> observe -> stations (their estimates) -+
    ^                                                                    |
    +--------------------------------------------------------------------+-> predict, the rest
                                                                             interpolated
```
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from tilestream.factors.along_route import WIDTH
from tilestream.factors.coarse import Coarse, Told
from tilestream.factors.rows import Samples
from tilestream.factors.stations import half_support
from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.pipeline.engine.plan import Plan, paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.along_routes import plan_observe
from tilestream.pipeline.jobs.estimator import Estimator
from tilestream.pipeline.jobs.inventory import withdraw
from tilestream.pipeline.jobs.prediction_tasks import model_there, neighbours, prediction_tasks
from tilestream.pipeline.jobs.run_inputs import observing_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.between import NAMES, Between
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import observe_task
from tilestream.pipeline.stages.predict import stations
from tilestream.pipeline.stages.train import ModelInUse
from tilestream.records import Int64
from tilestream.tables import read_tables

TABLES = ("observability", "stations")
"""What a round writes, in a folder of its own below each of these."""


class Rounds:
    """What a coarse run has evaluated so far, and what it evaluates next.

    Places are numbered along all routes, one route after the other.
    """

    def __init__(
        self, settings: RunSettings, map_plan: MapPlan, measure: Plan, model: ModelInUse | None
    ) -> None:
        """Before the first round.

        Args:
            settings: the job; with `coarse` and `observe`.
            map_plan: the map.
            measure: the factors of all places.
            model: what makes the estimates; None: the virtual drive as it is.

        Raises:
            PlanError: those of a tile would not fit the memory, if all its places are evaluated.
            UsageError, TileNotReadyError: as `plan_observe`.
        """
        assert settings.coarse is not None
        assert settings.observe is not None
        self._settings, self._map_plan, self._model = settings, map_plan, model
        self._observing = observing_of(settings, settings.observe)
        self._factors = {t.tile: t for t in measure.outputs("factors") if t.tile is not None}
        self._samples: dict[TileKey, Samples] = {
            key: task.takes["samples"] for key, task in self._factors.items()
        }
        plan_observe(map_plan, self._samples, settings.out, self._observing, settings.memory)
        self._routes = _counts(self._samples.values())
        self._numbers = _numbered(self._samples, self._routes)
        half = half_support(_width(model), settings.spacing)
        self._coarse = Coarse(self._routes, half, settings.coarse)
        self._values = np.full((sum(self._routes.values()), len(NAMES)), np.nan)
        self._observed: list[Task] = []
        self._given: list[Task] = []
        self._number = 0

    @property
    def told(self) -> Told:
        """What was done so far."""
        return self._coarse.told()

    @property
    def forecast(self) -> str:
        """What is known of it after the first round is planned."""
        told = self.told
        return (
            f"coarse: the first round takes {told.first:,} virtual drives, a run of all places "
            f"{told.places:,}; more follow where errors are high or change fast"
        )

    def next(self) -> tuple[Task, ...]:
        """The virtual drives of the next round; none: the rest is interpolated."""
        wanted = np.zeros(len(self._values), bool)
        wanted[self._coarse.next()] = True
        if not wanted.any():
            return ()
        self._number += 1
        name = f"round{self._number}"
        folder, self._given = f"{self._settings.out}/tables", []
        for tile, some in self._samples.items():
            rows = some.rows[wanted[self._numbers[tile]]]
            if len(rows):
                part, by = replace(some, rows=rows), self._observing
                task = observe_task(self._map_plan, tile, part, by, folder, name, below=f"{name}/")
                self._given.append(task)
        return tuple(self._given)

    def after(self, good: Collection[str]) -> tuple[Task, ...]:
        """What is to be done when all that was given has ended; nothing: the rest is interpolated.

        A tile of which something failed is left out from then on, as it is of any run.

        Args:
            good: keys of the tasks that are done.
        """
        ended = self._given
        needed = (*ended, *self._factors.values())
        lost = {task.tile for task in needed if task.key not in good}
        for tile in [tile for tile in self._factors if tile in lost]:
            self._coarse.lose(self._numbers[tile])
            del self._factors[tile]
        if ended and ended[0].stage == stations.name:
            self._learn([task for task in ended if task.key in good])
            return self.next()
        self._observed += [task for task in ended if task.key in good]
        self._given = self._estimated(task.tile for task in ended if task.tile is not None)
        return tuple(self._given) or self.next()

    def between(self) -> dict[TileKey, Between]:
        """By tile, where its places are interpolated."""
        ends, whole = self._coarse.between
        names, begins = list(self._routes), _begins(self._routes)
        found = {}
        for tile, numbers in self._numbers.items():
            last = np.searchsorted(ends[:, 0], numbers) - 1  # of those that begin before a place
            inside = (last >= 0) & (numbers <= np.append(ends[:, 1] - whole, -1)[last])
            rows = np.unique(last[inside])
            own = ends[rows]
            route = np.searchsorted(begins, own[:, 0], side="right") - 1
            route_ids = tuple(names[number] for number in route.tolist())
            at = own - begins[route, None]
            found[tile] = Between(route_ids, at, whole[rows], self._values[own])
        return found

    def remove_others(self) -> None:
        """Remove the tables of rounds of another job, or of a run of all places."""
        remove_rounds(self._settings.out, {f"round{k + 1}" for k in range(self._number)})
        withdraw(f"{self._settings.out}/tables/observability")

    def _estimated(self, tiles: Iterable[TileKey]) -> list[Task]:
        """The tasks that estimate the places that a round has evaluated, or may have changed."""
        grid, seen = self._map_plan.store.grid, {task.tile for task in self._observed}
        near = {key for tile in tiles for key in neighbours(grid, tile)}
        return prediction_tasks(
            self._settings,
            grid,
            [task for tile, task in self._factors.items() if tile in near & seen],
            self._observed,
            self._model,
            applies=stations,
            table=f"stations/round{self._number}",
        )

    def _learn(self, tasks: Iterable[Task]) -> None:
        """Read what was estimated."""
        begins = dict(zip(self._routes, _begins(self._routes).tolist(), strict=True))
        for task in tasks:
            rows = read_tables(paths_of([task]))
            numbers = rows["route_id"].map(begins) + rows["sample"]
            self._values[numbers] = rows[list(NAMES)].to_numpy(np.float64)
        self._coarse.learn(self._values[:, 0])


def first_round(
    settings: RunSettings, map_plan: MapPlan, measure: Plan, estimator: Estimator
) -> tuple[Rounds | None, Plan]:
    """The rounds of a coarse run, and what measures with the first of them; of another run None,
    and the plan as it is.

    Args:
        settings: the job.
        map_plan: the map.
        measure: what measures without the virtual drives along the routes of a coarse run.
        estimator: what makes the estimates.
    """
    if settings.coarse is None:
        return None, measure
    rounds = Rounds(settings, map_plan, measure, model_there(estimator))
    given = {task.key for task in measure.tasks}
    of_map = [task for key, task in map_plan.tasks.items() if key not in given]
    return rounds, replace(measure, tasks=(*measure.tasks, *of_map, *rounds.next()))


def remove_rounds(out: str, but: Collection[str] = ()) -> None:
    """Remove the tables of rounds of a run directory, but for some of them."""
    for table in TABLES:
        folder = f"{out}/tables/{table}"
        for name in Files.at(folder).names():
            if name.startswith("round") and name not in but:
                withdraw(f"{folder}/{name}")


def _width(model: ModelInUse | None) -> float:
    """Over what virtual drives are averaged, for estimates and covariances [m]."""
    if model is None:
        return WIDTH
    known = model.read()
    return max(known.width, 0.0 if known.covariance is None else known.covariance.width)


def _counts(samples: Iterable[Samples]) -> dict[str, int]:
    """How many places each route has."""
    found: Counter[str] = Counter()
    for some in samples:
        counts = np.bincount(some.rows["route"], minlength=len(some.route_ids))
        found.update(dict(zip(some.route_ids, counts.tolist(), strict=True)))
    return dict(sorted(found.items()))


def _begins(routes: Mapping[str, int]) -> Int64:
    """The number of the first place of each route."""
    return np.cumsum([0, *routes.values()])[:-1]


def _numbered(
    samples: Mapping[TileKey, Samples], routes: Mapping[str, int]
) -> dict[TileKey, Int64]:
    """The numbers of the places of each tile."""
    begins = dict(zip(routes, _begins(routes).tolist(), strict=True))
    return {
        tile: np.array([begins[name] for name in some.route_ids])[some.rows["route"]]
        + some.rows["sample"]
        for tile, some in samples.items()
    }
