"""The jobs along routes: the factors, or the observability, of every sample point of them."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from tilestream.config import RegistrationSettings
from tilestream.dataflow.factors_tasks import FactorsTask, Looking, TermsTask, facts
from tilestream.dataflow.localize_tasks import CellsTask, box_around
from tilestream.dataflow.observe_tasks import ObserveTask, Observing, SurfelsTask
from tilestream.dataflow.plan import DEFAULT_MEMORY, Plan, Task
from tilestream.dataflow.run import Watch, execute
from tilestream.errors import PartialError
from tilestream.factors.catalogue import Which
from tilestream.factors.observability import MARGIN
from tilestream.factors.rows import Samples, in_route_order, samples_by_tile
from tilestream.factors.surfels import around_tile, surfels_inputs
from tilestream.factors.terms import reach_mm, terms_inputs
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.records import Route
from tilestream.sensors import VLP16, Sensor
from tilestream.store import TileStore, hash_of
from tilestream.tables import read_tables, remove_others
from tilestream.tiling import TileKey, whole_mm

SENSOR_HEIGHT = 2.0
"""Height of the lidar above the road [m] (the paper's vehicle)."""


def factors_along(
    store: TileStore,
    routes: Iterable[Route],
    out: str | os.PathLike[str],
    *,
    spacing: float = 1.0,
    sensor: Sensor = VLP16,
    sensor_height: float = SENSOR_HEIGHT,
    cell_size: float = 2.0,
    which: Which = "all",
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
) -> pd.DataFrame:
    """The factors of sample points along routes, tile by tile, resumable, in parallel.

    Args:
        store: the map.
        routes: where; in the map's frame, each with a name of its own.
        out: folder of the tables, `factors/<tile>.parquet`, a local path or any fsspec URL; tables
            of an earlier, other job there are removed.
        spacing: distance between sample points [m].
        sensor: what looks.
        sensor_height: height of the lidar above the route, or above the ground where the route
            has no z [m].
        cell_size: edge of an NDT cell [m].
        which: `faithful` (the paper's 20), `robust` (their twins), or `all`.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.

    Returns:
        A row per sample point, route by route and along each; `status` and `reason` say where
        there are no factors.

    Raises:
        UsageError: no routes, two of one name, settings that cannot be.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    routes = list(routes)
    looking = Looking(sensor, cell_size, which, sensor_height)
    samples = samples_by_tile(store.grid, routes, spacing)
    plan = plan_factors(store, samples, out, looking, memory)
    return _tables_of(plan, FactorsTask, routes, client, watch)


def plan_factors(
    store: TileStore,
    samples: Mapping[TileKey, Samples],
    out: str | os.PathLike[str],
    looking: Looking,
    memory: int,
    have: Mapping[TileKey, str] | None = None,
) -> Plan:
    """What `factors_along` will run; other arguments and errors as there.

    Args:
        store: the map.
        samples: the sample points by tile (`samples_by_tile`).
        out: folder of the tables.
        looking: what the factors are made with.
        memory: what a task may use [bytes].
        have: the identity of the points of each tile of the map; None: as the store has them.
    """
    cell_mm = whole_mm(looking.cell_size, "cell_size")
    store.grid.require_cell_size(cell_mm)
    have = store.identities() if have is None else have
    map_state = hash_of(list(have.values()))
    cells: dict[TileKey, Task] = {}
    terms: dict[TileKey, Task] = {}
    inputs: dict[TileKey, str] = {}
    tasks: list[Task] = []
    for tile, points in samples.items():
        reach = looking.sensor.range_max
        seen = [k for k in store.grid.keys_over(box_around(points.places, reach)) if k in have]
        for key in seen:
            if key not in terms:
                near = store.grid.keys_over(store.grid.core(key).grown(reach_mm(cell_mm)))
                around = [k for k in near if k in have]
                cells |= {k: CellsTask(store.url, k, cell_mm) for k in around if k not in cells}
                needs = tuple(cells[k].key for k in around)
                terms[key] = TermsTask(store.url, key, cell_mm, needs=needs)
                inputs[key] = terms_inputs(store, key, cell_mm, have)
        tasks.append(
            FactorsTask(
                store.url,
                tile,
                looking,
                points,
                map_state,
                f"{os.fspath(out)}/factors/{tile}.parquet",
                hash_of(facts(looking), *points.facts(), [inputs[key] for key in seen]),
                tuple(terms[key].key for key in seen),
            )
        )
    return Plan((*cells.values(), *terms.values(), *tasks), memory).check()


def observe_along(
    store: TileStore,
    routes: Iterable[Route],
    out: str | os.PathLike[str],
    *,
    spacing: float = 1.0,
    sensor: Sensor = VLP16,
    seeing: VirtualSettings | None = None,
    registration: RegistrationSettings | None = None,
    sensor_height: float = SENSOR_HEIGHT,
    cell_size: float = 2.0,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
) -> pd.DataFrame:
    """Observability of sample points along routes, tile by tile, resumable, in parallel.

    Args:
        store: the map.
        routes: where; in the map's frame, each with a name of its own.
        out: folder of the tables, `observability/<tile>.parquet`, a local path or any fsspec URL;
            tables of an earlier, other job there are removed.
        spacing: distance between sample points [m].
        sensor: what looks.
        seeing: usable range, blind sector, drop-outs, starts; default `VirtualSettings()`.
        registration: the matcher of the vehicle; default `RegistrationSettings()`.
        sensor_height: height of the lidar above the route, or above the ground where the route
            has no z [m].
        cell_size: edge of an NDT cell [m].
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.

    Returns:
        A row per sample point, route by route and along each: place, the columns of the criterion,
        `status` and `reason` (see `observability`).

    Raises:
        UsageError: no routes, two of one name, settings that cannot be.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    routes = list(routes)
    observing = Observing(
        sensor,
        seeing or VirtualSettings(),
        registration or RegistrationSettings(),
        cell_size,
        sensor_height,
    )
    samples = samples_by_tile(store.grid, routes, spacing)
    plan = plan_observe(store, samples, out, observing, memory)
    return _tables_of(plan, ObserveTask, routes, client, watch)


def plan_observe(
    store: TileStore,
    samples: Mapping[TileKey, Samples],
    out: str | os.PathLike[str],
    observing: Observing,
    memory: int,
    have: Mapping[TileKey, str] | None = None,
    group: str = "",
) -> Plan:
    """What `observe_along` will run; other arguments and errors as there.

    Args:
        store: the map.
        samples: the sample points by tile (`samples_by_tile`).
        out: folder of the tables.
        observing: what is observed with.
        memory: what a task may use [bytes].
        have: the identity of the points of each tile of the map; None: as the store has them.
        group: as whose sensor, where one plan observes with several.
    """
    cell_mm = whole_mm(observing.cell_size, "cell_size")
    store.grid.require_cell_size(cell_mm)
    have = store.identities() if have is None else have
    made: dict[str, Task] = {}
    inputs: dict[TileKey, str] = {}
    tasks: list[Task] = []
    for tile, points in samples.items():
        box = box_around(points.places, observing.range_max + MARGIN)
        seen = [key for key in store.grid.keys_over(box) if key in have]
        needs: list[str] = []
        for key in seen:
            near = [k for k in store.grid.keys_over(around_tile(store, key)) if k in have]
            merged = tuple(f"merge-{k}" for k in near)
            for task in (CellsTask(store.url, key, cell_mm), SurfelsTask(store.url, key, merged)):
                made.setdefault(task.key, task)
                needs.append(task.key)
            if key not in inputs:
                inputs[key] = surfels_inputs(store, key, have)
        state = [(str(key), have[key], inputs[key]) for key in seen]
        tasks.append(
            ObserveTask(
                store.url,
                tile,
                observing,
                points,
                f"{os.fspath(out)}/observability/{tile}.parquet",
                hash_of(observing.facts(), *points.facts(), state),
                tuple(needs),
                group,
            )
        )
    return Plan((*made.values(), *tasks), memory).check()


def _tables_of(
    plan: Plan,
    kind: type[FactorsTask] | type[ObserveTask],
    routes: Sequence[Route],
    client: Any | None,
    watch: Watch | None,
) -> pd.DataFrame:
    """Run a plan, and read the tables of its tasks of one kind; others beside them are removed.

    Raises:
        PartialError: some of these tasks failed; lists them.
    """
    tables = [task.out for task in plan.tasks if isinstance(task, kind)]
    remove_others(tables)
    outcomes = execute(plan.tasks, client, watch)
    failures = {o.key: o.reason for o in outcomes if not o.ok and o.stage == kind.stage}
    if failures:
        folder = tables[0].rsplit("/", 1)[0]
        raise PartialError(f"{folder}: {len(failures)} tasks failed, the rest is done:", failures)
    return in_route_order(read_tables(tables), [route.route_id for route in routes])
