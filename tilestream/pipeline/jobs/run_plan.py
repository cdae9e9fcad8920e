"""What the main job runs: tiles, factors and errors; then what is learnt of them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np

from tilestream.errors import SourceError, SourceNotFoundError, TileNotReadyError
from tilestream.factors import catalogue
from tilestream.factors.rows import Samples
from tilestream.factors.virtual_drive import NEIGHBOURS
from tilestream.grid import MM_PER_M, TileGrid, TileKey
from tilestream.model.baselines import Median
from tilestream.model.dataset import TARGETS
from tilestream.model.evaluation import factor_sets
from tilestream.model.features import features_of
from tilestream.model.forest import PaperForest
from tilestream.model.join import TOLERANCE
from tilestream.model.registry import COMPETITORS, REGRESSORS, UNTRAINED
from tilestream.model.training import MAIN
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Readable, Task
from tilestream.pipeline.jobs.along_routes import plan_factors, plan_observe, samples_along
from tilestream.pipeline.jobs.localize import labelled_places, plan_localize
from tilestream.pipeline.jobs.run_inputs import (
    Inputs,
    degraded_drives,
    making_of,
    observing_of,
    reading_of,
    scans_of,
)
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.evaluate import evaluate
from tilestream.pipeline.stages.factors import Looking
from tilestream.pipeline.stages.importance import importance
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import observe_drive
from tilestream.pipeline.stages.predict import predict
from tilestream.pipeline.stages.samples import COLUMNS, DatasetFile, samples
from tilestream.pipeline.stages.train import ModelFile, ModelInUse, train
from tilestream.settings import DriveSettings

OPPONENT = Median.name
"""What the estimates of a part of the error are compared with: the others know no more of unseen
paths."""
NEIGHBOURS_MM = round(NEIGHBOURS * MM_PER_M) + 1
"""How far from a tile a sample point of it may have neighbours, rounding included [mm]."""
BESIDE = TOLERANCE + NEIGHBOURS + 1.0
"""How far from a labelled place sample points may matter [m]: the one that it takes its factors
from, that one's neighbours, and what a refined true pose moves."""


def plan_measure(settings: RunSettings, inputs: Inputs, map_plan: MapPlan) -> Plan:
    """Factors and errors: every task needs only the tiles around it.

    Args:
        settings: the job.
        inputs: its files.
        map_plan: the map, as far as it is there or will be.

    Returns:
        The plan; a drive whose log cannot be read is left out, as long as another can.

    Raises:
        SourceNotFoundError: there is no such log.
        SourceError, TileNotReadyError: no drive can be measured; says why the first cannot.
    """
    tables = f"{settings.out}/tables"
    looking = Looking(settings.looking_sensor, settings.cell_size, "all", settings.sensor_height)
    places = samples_along(map_plan.store, inputs.routes, settings.spacing)
    memory = settings.memory
    localized, left_out = _localized(settings, inputs, map_plan, tables)
    good = [drive for drive in inputs.drives if drive.group in localized]
    plans = [plan_factors(map_plan, places, tables, looking, memory)]
    if settings.observe is not None:
        observing = observing_of(settings, settings.observe)
        plans.append(plan_observe(map_plan, places, tables, observing, memory))
        plans += _observed_drives(settings, good, map_plan, places)
    plans += localized.values()
    measured = Plan.of((task for plan in plans for task in plan.tasks), memory)
    return replace(measured, left_out=left_out)


def _localized(
    settings: RunSettings, inputs: Inputs, map_plan: MapPlan, tables: str
) -> tuple[dict[str, Plan], dict[str, str]]:
    """What measures each drive, by its name, and why others cannot be measured."""
    plans: dict[str, Plan] = {}
    errors: dict[str, SourceError | TileNotReadyError | OSError] = {}
    for drive in inputs.drives:
        try:
            plans[drive.group] = plan_localize(
                map_plan,
                reading_of(drive),
                tables,
                cell_size=settings.cell_size,
                spacing=settings.spacing,
                registration=settings.label.registration,
                starts=settings.label.starts,
                true_pose=settings.label.true_pose,
                scans=scans_of(drive),
                starts_per_task=None,
                memory=settings.memory,
                group=drive.group,
            )
        except SourceNotFoundError:
            raise
        except (SourceError, TileNotReadyError, OSError) as error:
            errors[f"drive {drive.group}"] = error
    if errors and not plans:
        raise next(iter(errors.values()))
    return plans, {name: str(error) for name, error in errors.items()}


def _observed_drives(
    settings: RunSettings,
    drives: Sequence[DriveSettings],
    map_plan: MapPlan,
    places: Mapping[TileKey, Samples],
) -> Iterator[Plan]:
    """The labelled places of drives that are read as another lidar than the vehicle's, as seen by
    that one.
    """
    for name, observing in degraded_drives(settings, drives).items():
        labelled = np.concatenate(
            [
                labelled_places(reading_of(drive), scans_of(drive), settings.spacing)
                for drive in drives
                if drive.degraded == name
            ]
        )
        near = {key: samples.near(labelled, BESIDE) for key, samples in places.items()}
        yield plan_observe(
            map_plan,
            {key: samples for key, samples in near.items() if len(samples)},
            f"{settings.out}/tables/drives/{name}",
            observing,
            settings.memory,
            name,
            observe_drive,
        )


def plan_estimate(
    settings: RunSettings, grid: TileGrid, measure: Plan, outcomes: Sequence[Outcome]
) -> Plan:
    """Samples, evaluate, train, predict: from what was measured.

    What failed is left out here and listed by the run, so that a tile that cannot be read does not
    keep the rest of the city from its estimates. A tile whose virtual drive failed is left out too:
    nothing is learnt or estimated without it where it was asked for.
    """
    done = {outcome.key for outcome in outcomes if outcome.ok}
    factors, observed, labels = (
        [task for task in measure.outputs(stage) if task.key in done]
        for stage in ("factors", "observe", "label")
    )
    if settings.observe is not None:
        seen = {task.tile for task in observed}
        factors = [task for task in factors if task.tile in seen]
    own = _observed_of_drives(settings, measure, done)
    labels = [task for task in labels if own.get(_group(task), True)]
    tasks: list[Task] = []
    known, model = _model_there(settings)
    if labels and factors:
        joined = _samples(settings, factors, observed, labels, own)
        tasks.append(joined)
        if not known:
            training = _training(settings, joined)
            known, model = True, training.product
            tasks += [training, *_evaluations(settings, joined, bool(observed))]
            tasks.append(_importance(settings, joined, training))
    if known:
        tasks += _predictions(settings, grid, factors, observed, model)
    return Plan.of(tasks, settings.memory)


def _observed_of_drives(
    settings: RunSettings, measure: Plan, done: Set[str]
) -> dict[str, tuple[Task, ...]]:
    """What is done of the virtual drives of each drive that is read as another lidar than the
    vehicle's, by the group of its labels.
    """
    found = {}
    for drive in settings.drives:
        folder = f"{settings.out}/tables/drives/{drive.degraded}/"
        tasks = [
            task
            for task in measure.outputs(observe_drive.name)
            if isinstance(task.writes, Parquet) and task.writes.path.startswith(folder)
        ]
        if tasks:
            found[drive.group] = tuple(task for task in tasks if task.key in done)
    return found


def _model_there(settings: RunSettings) -> tuple[bool, Readable | None]:
    """Whether nothing has to be trained, and the model in use; None: the virtual drive as it is."""
    if settings.model.untrained:
        return True, None
    if settings.model.use is None:
        return False, None
    return True, ModelInUse.of(settings.model.use)


def _samples(
    settings: RunSettings,
    factors: Sequence[Task],
    observed: Sequence[Task],
    labels: Sequence[Task],
    own: Mapping[str, Sequence[Task]],
) -> Task:
    takes: dict[str, Any] = {
        "groups": tuple(_group(task) for task in labels),
        "making": making_of(settings),
    }
    reads = {
        "factors": _products(factors),
        "observed": _products(observed),
        "labels": _products(labels),
    }
    tables = list(dict.fromkeys(task for tasks in own.values() for task in tasks))
    if tables:
        reads["own"] = _products(tables)
        takes["own_of"] = {
            group: [tables.index(task) for task in tasks] for group, tasks in own.items() if tasks
        }
    return Task(
        samples,
        "dataset",
        DatasetFile(f"{settings.out}/tables/samples/dataset.parquet"),
        takes=takes,
        reads=reads,
        work=sum(task.work for task in labels),
        counts={"places": sum(task.work for task in (*factors, *labels))},
    )


def _group(label: Task) -> str:
    """Of which drive, as whose sensor, a label task is: the folder of its table."""
    assert isinstance(label.writes, Parquet)
    return label.writes.path.rsplit("/", 2)[1]


def _products(tasks: Iterable[Task]) -> tuple[Readable, ...]:
    return tuple(task.product for task in tasks)


def _training(settings: RunSettings, joined: Task) -> Task:
    return Task(
        train,
        "model",
        ModelFile(f"{settings.out}/model.skops"),
        takes={"recipe": settings.model.recipe, "seed": settings.model.seed},
        reads={"dataset": joined.product},
        counts=joined.counts,
    )


def _evaluations(settings: RunSettings, joined: Task, observed: bool) -> list[Task]:
    """Every model and opponent on all factors; the paper's forest on each set of Table IV, the
    other regressors on those with all four criteria; the parts of the error by the regressor in
    use, the virtual drive and the training median.
    """
    folder, model = f"{settings.out}/tables/judged", settings.model
    columns = features_of(COLUMNS if observed else catalogue.COLUMNS)
    *sets, _ = factor_sets(columns)  # the last has all factors, as the competitors have
    virtual = [UNTRAINED] if observed else []
    wanted = [(MAIN, name, "") for name in COMPETITORS if observed or name != UNTRAINED]
    wanted += [(MAIN, PaperForest.name, name) for name in sets]
    whole = [name for name in sets if "LS" in name and "ob" not in name]
    others = [name for name in REGRESSORS if name != PaperForest.name]
    wanted += [(MAIN, other, name) for other in others for name in whole]
    of_parts = [model.recipe, *virtual, OPPONENT]
    wanted += [(target, name, "") for target in TARGETS if target != MAIN for name in of_parts]
    tasks = []
    for target, competitor, factor_set in wanted:
        name = f"{target}-{competitor}-{factor_set or 'all'}".replace(" ", "_")
        takes = {"target": target, "competitor": competitor, "factor_set": factor_set}
        tasks.append(
            Task(
                evaluate,
                name,
                Parquet(f"{folder}/{name}.parquet"),
                takes={**takes, "seed": model.seed},
                reads={"dataset": joined.product},
                counts=joined.counts,
            )
        )
    return tasks


def _importance(settings: RunSettings, joined: Task, training: Task) -> Task:
    return Task(
        importance,
        "factors",
        Parquet(f"{settings.out}/tables/judged/weights.parquet"),
        takes={"seed": settings.model.seed},
        reads={"dataset": joined.product, "model": training.product},
        counts=joined.counts,
    )


def _predictions(
    settings: RunSettings,
    grid: TileGrid,
    factors: Sequence[Task],
    observed: Sequence[Task],
    model: Readable | None,
) -> list[Task]:
    """A task per tile, which reads the observability of the neighbours of its sample points too."""
    of_tile = {task.tile: task for task in observed}
    making = making_of(settings)
    reads: dict[str, Any] = {} if model is None else {"model": model}
    tasks = []
    for task in factors:
        assert task.tile is not None
        near = [of_tile[key] for key in _around(grid, task.tile) if key in of_tile]
        tasks.append(
            Task(
                predict,
                str(task.tile),
                Parquet(f"{settings.out}/tables/predictions/{task.tile}.parquet"),
                takes={"making": making, "offset": settings.model.offset},
                reads={**reads, "factors": task.product, "observed": _products(near)},
                work=task.work,
                counts={"places": sum(one.work for one in (task, *near))},
                tile=task.tile,
            )
        )
    return tasks


def _around(grid: TileGrid, tile: TileKey) -> Iterable[TileKey]:
    """The tiles whose sample points may be neighbours of a tile's."""
    return grid.keys_over(grid.core(tile).grown(NEIGHBOURS_MM))
