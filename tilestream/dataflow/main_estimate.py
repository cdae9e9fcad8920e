"""What the main job estimates from what was measured: join, judge, train, predict."""

from collections.abc import Mapping, Sequence

from tilestream.dataflow.estimate_tasks import (
    COLUMNS,
    JOIN_VERSION,
    TRAIN_VERSION,
    JoinTask,
    JudgeTask,
    PredictTask,
    TrainTask,
    WeighTask,
    file_hash,
    predictions_identity,
    train_identity,
)
from tilestream.dataflow.factors_tasks import FactorsTask
from tilestream.dataflow.localize_tasks import LabelTask
from tilestream.dataflow.main_plan import making_of
from tilestream.dataflow.observe_tasks import ObserveTask
from tilestream.dataflow.plan import Plan, Task
from tilestream.dataflow.run_settings import ModelSettings, RunSettings
from tilestream.dataflow.tasks import Outcome
from tilestream.factors import catalogue
from tilestream.factors.virtual_drive import NEIGHBOURS
from tilestream.forest.dataset import TARGETS, features_of
from tilestream.forest.evaluation import factor_sets
from tilestream.forest.models import COMPETITORS, PHYSICS
from tilestream.forest.training import MAIN
from tilestream.store import hash_of
from tilestream.tiling import MM_PER_M, TileGrid, TileKey
from tilestream.version import VERSION

OPPONENT = "training median"
"""Whom a part of the error is judged against: the others know no more of unseen paths."""
NEIGHBOURS_MM = round(NEIGHBOURS * MM_PER_M) + 1
"""How far from a tile a sample point of it may have neighbours, rounding included [mm]."""
Observed = Mapping[TileKey, ObserveTask]
"""What observes from the sample points of a tile; empty: the job has no virtual drive."""


def plan_estimate(
    settings: RunSettings, grid: TileGrid, measure: Plan, outcomes: Sequence[Outcome]
) -> Plan:
    """Join, judge, train, predict: from what was measured.

    What failed is left out here and listed by the run, so that a tile that cannot be read does not
    keep the rest of the city from its estimates. A tile whose virtual drive failed is left out too:
    nothing is learnt or estimated without it where it was asked for.
    """
    done = {outcome.key for outcome in outcomes if outcome.ok}
    factors = [t for t in measure.tasks if isinstance(t, FactorsTask) and t.key in done]
    labels = [t for t in measure.tasks if isinstance(t, LabelTask) and t.key in done]
    observed = {t.tile: t for t in measure.tasks if isinstance(t, ObserveTask) and t.key in done}
    if settings.observe is not None:
        factors = [task for task in factors if task.tile in observed]
    tasks: list[Task] = []
    model, state = _model_there(settings.model)
    if labels and factors:
        join = _join(settings, factors, observed, labels)
        tasks.append(join)
        if not state:
            training = _training(settings, join)
            model, state = training.out, training.identity
            tasks += [training, *_judges(settings, join, bool(observed))]
            tasks.append(_weighing(settings, training))
    if state:
        tasks += _predictions(settings, grid, factors, observed, model, state)
    return Plan(tuple(tasks), settings.memory).check()


def _model_there(model: ModelSettings) -> tuple[str, str]:
    """The file of a model that needs no training, and what it is made from; both may be empty."""
    if model.recipe == "physics":
        return "", f"physics {model.offset}"
    return ("", "") if model.use is None else (model.use, file_hash(model.use))


def _join(
    settings: RunSettings,
    factors: Sequence[FactorsTask],
    observed: Observed,
    labels: Sequence[LabelTask],
) -> JoinTask:
    making = making_of(settings)
    groups: dict[str, list[str]] = {}
    for label in labels:
        groups.setdefault(label.group, []).append(label.out)
    identity = hash_of(
        [task.identity for task in factors],
        [task.identity for task in observed.values()],
        [task.identity for task in labels],
        making,
        JOIN_VERSION,
        VERSION,
    )
    return JoinTask(
        tuple(task.out for task in factors),
        tuple(task.out for task in observed.values()),
        tuple((group, tuple(paths)) for group, paths in groups.items()),
        tuple(making.items()),
        f"{settings.out}/tables/samples/dataset.parquet",
        identity,
        sum(task.work for task in labels),
    )


def _training(settings: RunSettings, join: JoinTask) -> TrainTask:
    model = settings.model
    return TrainTask(
        dataset=join.out,
        recipe=model.recipe,
        seed=model.seed,
        out=str(settings.folder / "model.skops"),
        identity=train_identity(join.identity, model.recipe, model.seed),
    )


def _judges(settings: RunSettings, join: JoinTask, observed: bool) -> list[Task]:
    """Every model and opponent on all factors, the forests on each set of Table IV; the parts of
    the error by the forest in use, the virtual drive and the training median.
    """
    folder, model = f"{settings.out}/tables/judged", settings.model
    columns = features_of(COLUMNS if observed else catalogue.COLUMNS)
    *sets, _ = factor_sets(columns)  # the last has all factors, as the competitors have
    known = [name for name in COMPETITORS if observed or name not in PHYSICS]
    wanted = [(MAIN, competitor, "") for competitor in known]
    wanted += [(MAIN, "paper", name) for name in sets]
    wanted += [(MAIN, "default", name) for name in sets if "LS" in name and "ob" not in name]
    of_parts = [model.recipe, *(name for name in known if name in PHYSICS), OPPONENT]
    wanted += [(target, name, "") for target in TARGETS if target != MAIN for name in of_parts]
    return [
        JudgeTask(
            dataset=join.out,
            competitor=competitor,
            target=target,
            factor_set=factor_set,
            seed=model.seed,
            out=f"{folder}/{target}-{competitor}-{factor_set or 'all'}.parquet".replace(" ", "_"),
            identity=hash_of(
                join.identity, target, competitor, factor_set, model.seed, TRAIN_VERSION, VERSION
            ),
        )
        for target, competitor, factor_set in wanted
    ]


def _weighing(settings: RunSettings, training: TrainTask) -> WeighTask:
    return WeighTask(
        dataset=training.dataset,
        model=training.out,
        seed=training.seed,
        out=f"{settings.out}/tables/judged/weights.parquet",
        identity=hash_of("weigh", training.identity),
    )


def _predictions(
    settings: RunSettings,
    grid: TileGrid,
    factors: Sequence[FactorsTask],
    observed: Observed,
    model: str,
    state: str,
) -> list[Task]:
    """A task per tile, which reads the observability of the neighbours of its sample points too."""
    making = making_of(settings)
    tasks: list[Task] = []
    for task in factors:
        near = grid.core(task.tile).grown(NEIGHBOURS_MM)
        seen = [observed[key] for key in grid.keys_over(near) if key in observed]
        inputs = [task.identity, *(one.identity for one in seen)]
        tasks.append(
            PredictTask(
                model,
                state,
                task.out,
                tuple(one.out for one in seen),
                task.tile,
                tuple(making.items()),
                f"{settings.out}/tables/predictions/{task.tile}.parquet",
                predictions_identity(state, inputs, making),
                task.work,
                settings.model.offset,
            )
        )
    return tasks
