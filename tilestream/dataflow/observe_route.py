"""The job that observes: routes in, observability and virtual drive of every sample point out."""

import os
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from tilestream.config import RegistrationSettings
from tilestream.dataflow.localize_tasks import CellsTask, box_around
from tilestream.dataflow.observe_tasks import ObserveTask, Observing, SurfelsTask
from tilestream.dataflow.plan import DEFAULT_MEMORY, Plan, Task
from tilestream.dataflow.run import Watch, execute
from tilestream.errors import PartialError
from tilestream.factors.observability import MARGIN
from tilestream.factors.rows import Samples, samples_by_tile
from tilestream.factors.surfels import around_tile, surfels_inputs
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.records import Route
from tilestream.sensors import VLP16, Sensor
from tilestream.store import TileStore, hash_of
from tilestream.tables import read_tables, remove_others
from tilestream.tiling import TileKey, whole_mm

SENSOR_HEIGHT = 2.0
"""Height of the lidar above the road [m] (the paper's vehicle)."""


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
    plan = plan_observe(store, samples_by_tile(store.grid, routes, spacing), out, observing, memory)
    tables = [task.out for task in plan.tasks if isinstance(task, ObserveTask)]
    remove_others(tables)
    outcomes = execute(plan.tasks, client, watch)
    failures = {o.key: o.reason for o in outcomes if not o.ok and o.stage == "observe"}
    if failures:
        raise PartialError(f"{out}: {len(failures)} tasks failed, the rest is done:", failures)
    rows = read_tables(tables)
    order = {route.route_id: number for number, route in enumerate(routes)}
    rows = rows.sort_values(["route_id", "sample"], key=lambda c: c.map(order).fillna(c))
    return rows.reset_index(drop=True)


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
