"""What the main job runs: tiles, factors and errors; then what is learnt of them."""

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from tilestream.errors import SourceError, SourceNotFoundError, TileNotReadyError
from tilestream.factors import catalogue
from tilestream.factors.own import own_factors
from tilestream.from_above import tiles_around
from tilestream.grid import TileGrid, TileKey
from tilestream.model.baselines import Median
from tilestream.model.dataset import TARGETS, WITHOUT_DRIVES
from tilestream.model.evaluation import factor_sets
from tilestream.model.features import features_of
from tilestream.model.forest import PaperForest
from tilestream.model.registry import COMPETITORS, OF_VIRTUAL_DRIVES, REGRESSORS, UNTRAINED
from tilestream.model.training import MAIN
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Readable, Task
from tilestream.pipeline.jobs.along_routes import plan_factors, plan_observe, samples_along
from tilestream.pipeline.jobs.estimator import NONE_ASIDE, Estimator, estimator_of
from tilestream.pipeline.jobs.localize import labelled_places, plan_localize
from tilestream.pipeline.jobs.prediction_tasks import model_there, prediction_tasks, products
from tilestream.pipeline.jobs.run_inputs import Inputs, observing_drive, observing_of, reading_of
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_names import DATASET
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.sources import scans_of
from tilestream.pipeline.stages.between import Between
from tilestream.pipeline.stages.evaluate import evaluate
from tilestream.pipeline.stages.factors import Looking, factors_drive
from tilestream.pipeline.stages.importance import importance
from tilestream.pipeline.stages.label import label
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import observe_drive
from tilestream.pipeline.stages.samples import COLUMNS, DatasetFile, DrivesOf, PlacesOf, samples
from tilestream.pipeline.stages.train import ModelFile, train
from tilestream.report.data import BESIDE
from tilestream.settings import DriveSettings

OF_DRIVES = (factors_drive.name, observe_drive.name)
"""The stages that look from the places of scans."""
OPPONENT = Median.name
"""What the estimates of a part of the error are compared with: the others know no more of unseen
paths."""


def plan_measure(settings: RunSettings, inputs: Inputs, map_plan: MapPlan) -> Plan:
    """Factors and errors: every task needs only the tiles around it. The virtual drives of a coarse
    run are planned in rounds (`Rounds`).

    Args:
        settings: the job.
        inputs: its files.
        map_plan: the map, as far as it is there or will be.

    Returns:
        The plan; a drive whose log cannot be read is left out, as long as another can.

    Raises:
        SourceNotFoundError: there is no such log.
        SourceError, TileNotReadyError: no drive can be measured; says why the first cannot, and
            what needs none.
    """
    tables = f"{settings.out}/tables"
    places = samples_along(map_plan.store, inputs.routes, settings.spacing)
    memory = settings.memory
    localized, left_out = _localized(settings, inputs, map_plan, tables)
    good = [drive for drive in inputs.drives if drive.group in localized]
    own = own_factors(settings.factors)
    plans = [plan_factors(map_plan, places, tables, looking_of(settings), memory, own=own)]
    if settings.observe is not None and settings.coarse is None:
        observing = observing_of(settings, settings.observe)
        plans.append(plan_observe(map_plan, places, tables, observing, memory))
    plans += _plans_of_drives(settings, good, map_plan)
    plans += localized.values()
    pictures = [
        map_plan.above(key)
        for key in tiles_around(map_plan.store, places, BESIDE)
        if key in map_plan.points
    ]
    tasks = itertools.chain(*(plan.tasks for plan in plans), pictures)
    measured = Plan.of(tasks, memory)
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
                scans_per_point=settings.label.scans_per_point,
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
        first = next(iter(errors.values()))
        kind = SourceError if isinstance(first, OSError) else type(first)
        raise kind(f"{first}; no drive is left to learn from: {WITHOUT_DRIVES}") from first
    return plans, {name: str(error) for name, error in errors.items()}


def _plans_of_drives(
    settings: RunSettings, drives: Sequence[DriveSettings], map_plan: MapPlan
) -> Iterator[Plan]:
    """The factors and the virtual drives at the places of the scans that are labelled; as the lidar
    that the drive is read as.
    """
    for drive in drives:
        grid, reading, scans = map_plan.store.grid, reading_of(drive), scans_of(drive)
        places = labelled_places(grid, reading, scans, settings.spacing, drive.group)
        folder, memory = f"{settings.out}/tables/drives/{drive.group}", settings.memory
        looking, own = replace(looking_of(settings), route_z="lidar"), own_factors(settings.factors)
        yield plan_factors(
            map_plan, places, folder, looking, memory, drive.group, factors_drive, own
        )
        if settings.observe is not None:
            observing = observing_drive(settings, settings.observe, drive)
            observing = replace(observing, route_z="lidar")
            yield plan_observe(
                map_plan, places, folder, observing, memory, drive.group, observe_drive
            )


def looking_of(settings: RunSettings) -> Looking:
    """What the factors are made with."""
    return Looking(
        settings.looking_sensor,
        settings.cell_size,
        "all",
        settings.sensor_height,
        settings.route_z,
    )


def plan_estimate(
    settings: RunSettings,
    grid: TileGrid,
    measure: Plan,
    outcomes: Sequence[Outcome],
    estimator: Estimator | None = None,
    between: Mapping[TileKey, Between] | None = None,
    aside: Mapping[str, str] = NONE_ASIDE,
) -> Plan:
    """Samples, evaluate, train, predict: from what was measured.

    What failed is left out here and listed by the run, so that a tile that cannot be read does not
    keep the rest of the city from its estimates. A tile whose virtual drive failed is left out too:
    nothing is learnt or estimated without it where it was asked for.

    Args:
        settings: the job.
        grid: of the map.
        measure: what measures.
        outcomes: what became of it.
        estimator: what makes the estimates; None: by how many places were measured.
        between: by tile, where a coarse run interpolates.
        aside: the drives that are measured and train nothing, and why, in words.
    """
    done = {outcome.key for outcome in outcomes if outcome.ok}
    factors, observed, labels = (
        [task for task in measure.outputs(stage) if task.key in done]
        for stage in ("factors", "observe", "label")
    )
    blind = {task.tile for task in measure.outputs("observe") if task.key not in done}
    factors = [task for task in factors if task.tile not in blind]
    tasks: list[Task] = []
    estimator = estimator or estimator_of(settings, places_to_train(labels, aside), aside)
    known = not estimator.trained
    model: Readable | None = model_there(estimator)
    if labels and factors:
        of_drives = [task for task in measure.tasks if task.stage in OF_DRIVES and task.key in done]
        joined = _samples(settings, factors, of_drives, labels)
        tasks.append(joined)
        if not known:
            learns = _learnt_from(joined, labels, aside)
            training = _training(settings, joined, learns)
            known, model = True, training.product
            tasks += [training, *_evaluations(settings, joined, learns, bool(observed))]
            tasks.append(_importance(settings, joined, learns, training))
    if known:
        tasks += prediction_tasks(settings, grid, factors, observed, model, between)
    return Plan.of(tasks, settings.memory)


def _samples(
    settings: RunSettings,
    routes: Sequence[Task],
    of_drives: Sequence[Task],
    labels: Sequence[Task],
) -> Task:
    """The task that joins labels with the factors of their places.

    Args:
        settings: the job.
        routes: the factors along the routes.
        of_drives: the factors and virtual drives at the places of scans.
        labels: the errors.
    """
    parts = {
        "factors": [task for task in of_drives if task.stage == factors_drive.name],
        "observed": [task for task in of_drives if task.stage == observe_drive.name],
        "labels": labels,
    }
    return Task(
        samples,
        "dataset",
        DatasetFile(f"{settings.out}/{DATASET}"),
        takes={
            "groups": {name: tuple(map(_group, tasks)) for name, tasks in parts.items()},
            "making": making_of(settings),
        },
        reads={"routes": tuple(PlacesOf(t.product, t.takes["samples"]) for t in routes)}
        | {name: products(tasks) for name, tasks in parts.items()},
        work=sum(task.work for task in labels),
        counts={"places": sum(task.work for task in (*routes, *of_drives, *labels))},
    )


def places_to_train(labels: Iterable[Task], aside: Collection[str]) -> int:
    """How many places these tasks measure, without drives that train nothing."""
    return sum(task.work for task in labels if _group(task) not in aside)


def _learnt_from(joined: Task, labels: Sequence[Task], aside: Collection[str]) -> Readable:
    """What is learnt from: of the joined dataset the drives that are not aside."""
    if not aside:
        return joined.product
    groups = dict.fromkeys(map(_group, labels))
    return DrivesOf(joined.product, tuple(name for name in groups if name not in aside))


def _group(task: Task) -> str:
    """Of which drive, as whose sensor, a task is: `errors/<group>/…`, `drives/<group>/…/…`."""
    assert isinstance(task.writes, Parquet)
    parts = task.writes.path.split("/")
    return parts[-2] if task.stage == label.name else parts[-3]


def _training(settings: RunSettings, joined: Task, learns: Readable) -> Task:
    return Task(
        train,
        "model",
        ModelFile(f"{settings.out}/model.skops"),
        takes={"recipe": settings.model.recipe, "seed": settings.model.seed},
        reads={"dataset": learns},
        counts=joined.counts,
    )


def _evaluations(
    settings: RunSettings, joined: Task, learns: Readable, observed: bool
) -> list[Task]:
    """Every model and opponent on all factors; the paper's forest on each set of Table IV, the
    other regressors on those with all four criteria; the parts of the error by the regressor in
    use, the virtual drive and the training median.
    """
    folder, model = f"{settings.out}/tables/judged", settings.model
    columns = features_of(COLUMNS if observed else catalogue.COLUMNS)
    *sets, _ = factor_sets(columns)  # the last has all factors, as the competitors have
    virtual = [UNTRAINED] if observed else []
    wanted = [(MAIN, name, "") for name in COMPETITORS if observed or name not in OF_VIRTUAL_DRIVES]
    wanted += [(MAIN, PaperForest.name, name) for name in sets]
    whole = [name for name in sets if "LS" in name and "ob" not in name]
    others = [name for name in REGRESSORS if name not in (PaperForest.name, *OF_VIRTUAL_DRIVES)]
    wanted += [(MAIN, other, name) for other in others for name in whole]
    of_parts = dict.fromkeys([model.recipe, *virtual, OPPONENT])
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
                reads={"dataset": learns},
                counts=joined.counts,
            )
        )
    return tasks


def _importance(settings: RunSettings, joined: Task, learns: Readable, training: Task) -> Task:
    return Task(
        importance,
        "factors",
        Parquet(f"{settings.out}/tables/judged/weights.parquet"),
        takes={"seed": settings.model.seed},
        reads={"dataset": learns, "model": training.product},
        counts=joined.counts,
    )
