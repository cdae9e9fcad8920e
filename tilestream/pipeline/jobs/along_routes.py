"""The jobs along routes: the factors, or the observability, of every sample point of them."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from tilestream.crs import require_same
from tilestream.errors import TileNotReadyError, require_all_done
from tilestream.factors.catalogue import Which
from tilestream.factors.own import OwnFactors
from tilestream.factors.rows import Samples, in_route_order, samples_by_tile
from tilestream.files import place_of
from tilestream.grid import MM_PER_M, TileGrid, TileKey, whole_mm
from tilestream.matcher import RegistrationSettings
from tilestream.notes import some_of
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.plan import Plan, paths_of
from tilestream.pipeline.engine.stage import Stage
from tilestream.pipeline.jobs.inventory import make_tables
from tilestream.pipeline.stages.factors import Looking, factors, factors_task
from tilestream.pipeline.stages.map_plan import MapPlan, apart
from tilestream.pipeline.stages.observe import Observing, observe, observe_task
from tilestream.records import Route, RouteZ
from tilestream.sensor import VLP16, Carrier, Sensor
from tilestream.settings import DEFAULT_MEMORY, LabelSettings, VirtualSettings
from tilestream.store import TileStore
from tilestream.tables import read_tables

REACH = 250.0
"""How far from a map a route is refused [m]: nothing of the map is in view of any lidar there."""
TOLD = 5
"""So many routes that are far from a map are named."""
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
    route_z: RouteZ = "ground",
    cell_size: float = 2.0,
    which: Which = "all",
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    partial: bool = False,
) -> pd.DataFrame:
    """The factors of sample points along routes, tile by tile, resumable, in parallel.

    Args:
        store: the map.
        routes: where; in the map's frame, each with a name of its own.
        out: folder of the tables, `factors/<tile>.parquet`, a local path or any fsspec URL; tables
            of an earlier, other job there are removed.
        spacing: distance between sample points [m].
        sensor: what looks.
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z of the routes.
        cell_size: edge of an NDT cell [m].
        which: `faithful` (the paper's 20), `robust` (their twins), or `all`.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        partial: go on with a map that is not whole; rows that could see what is missing say so.

    Returns:
        A row per sample point, route by route and along each; `status` and `reason` say where
        there are no factors.

    Raises:
        UsageError: no routes, two of one name, settings that cannot be.
        IncompleteError: the map is not whole, and not `partial`.
        LockedError: another process writes to the folder.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.

    Examples:
        >>> store, route = ts.open_store("map.zarr"), ts.read_route("route.csv")
        >>> table = ts.factors_along(store, [route], "factors", spacing=2.0)
        >>> table["arc_length"].tolist()
        [0.0, 2.0, 4.0, 6.0]
    """
    routes = list(routes)
    looking = Looking(sensor, cell_size, which, sensor_height, route_z)
    samples = samples_along(store, routes, spacing)
    plan = plan_factors(MapPlan.of_store(store, partial=partial), samples, out, looking, memory)
    return _tables_of(plan, factors.name, out, routes, client, watch)


def samples_along(
    store: TileStore, routes: Sequence[Route], spacing: float
) -> dict[TileKey, Samples]:
    """The sample points of routes by the tile of a map that holds them.

    Args:
        store: the map.
        routes: where; each with a name of its own.
        spacing: arc length between sample points [m].

    Raises:
        CrsError: a route in another CRS than the map.
        UsageError: as `samples_by_tile`.
    """
    for route in routes:
        where = f"{store.url}, the map,"
        require_same(f"route {route.route_id}", route.crs, where, store.settings.crs)
    return samples_by_tile(store.grid, routes, spacing)


def off_map(keys: Iterable[TileKey], grid: TileGrid, routes: Iterable[Route]) -> list[str]:
    """A note on the routes that do not come within `REACH` of a map; none: all do.

    Args:
        keys: the tiles of the map; none: it is not known yet where it lies.
        grid: their grid.
        routes: in the map's frame.
    """
    have, found = list(keys), []
    for route in routes if have else ():
        length, size = route.arc_length[-1], grid.tile_mm / MM_PER_M
        at = np.append(np.arange(0.0, length, size), length)
        x, y = (np.interp(at, route.arc_length, route.positions[:, axis]) for axis in (0, 1))
        wanted = [grid.key_at(*place) for place in zip(x.tolist(), y.tolist(), strict=True)]
        if not _near(have, wanted, grid):
            places = f"x {x.min():.0f} to {x.max():.0f}, y {y.min():.0f} to {y.max():.0f} m"
            found.append(f"{route.route_id} ({places})")
    if not found:
        return []
    told = f"no tile of the map is within {REACH:g} m of {some_of(found, TOLD)}"
    return [f"{told}: nothing is known there"]


def require_near(map_plan: MapPlan, samples: Mapping[TileKey, Samples]) -> None:
    """Refuse routes of which none comes within `REACH` of a map, before any work.

    Args:
        map_plan: the map; one without tiles is not known yet.
        samples: the sample points by tile.

    Raises:
        TileNotReadyError: where both are, and what to do.
    """
    have, wanted = list(map_plan.points), list(samples)
    if have and wanted and not _near(have, wanted, map_plan.store.grid):
        places = np.concatenate([some.places for some in samples.values()])
        raise TileNotReadyError(f"the route {apart(map_plan, places, REACH)}")


def _near(have: Sequence[TileKey], wanted: Sequence[TileKey], grid: TileGrid) -> bool:
    """Whether a tile that is wanted is within `REACH` of one that is there."""
    distances = np.asarray(cKDTree(np.array(have)).query(np.array(wanted), p=np.inf)[0])
    return bool(distances.min() <= np.ceil(REACH * MM_PER_M / grid.tile_mm))


def plan_factors(
    map_plan: MapPlan,
    samples: Mapping[TileKey, Samples],
    out: str | os.PathLike[str],
    looking: Looking,
    memory: int,
    group: str = "",
    applies: Stage = factors,
    own: Sequence[OwnFactors] = (),
) -> Plan:
    """What `factors_along` will run; other arguments and errors as there.

    Args:
        map_plan: the map.
        samples: the sample points by tile (`samples_by_tile`).
        out: folder of the tables.
        looking: what the factors are made with.
        memory: what a task may use [bytes].
        group: of which drive, where one plan has several.
        applies: `factors`, or `factors_drive`.
        own: factors of one's own.
    """
    map_plan.store.grid.require_cell_size(whole_mm(looking.cell_size, "cell_size"))
    require_near(map_plan, samples)
    folder = place_of(out)
    tasks = [
        factors_task(map_plan, key, some, looking, folder, group, applies, own)
        for key, some in samples.items()
    ]
    return Plan.of((*map_plan.tasks.values(), *tasks), memory)


def observe_along(
    store: TileStore,
    routes: Iterable[Route],
    out: str | os.PathLike[str],
    *,
    spacing: float = 1.0,
    sensor: Carrier = VLP16,
    seeing: VirtualSettings | None = None,
    registration: RegistrationSettings | None = None,
    sensor_height: float = SENSOR_HEIGHT,
    route_z: RouteZ = "ground",
    cell_size: float = 2.0,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    partial: bool = False,
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
        registration: the matcher of the vehicle; default `autoware`, as of all jobs.
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z of the routes.
        cell_size: edge of an NDT cell [m].
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        partial: go on with a map that is not whole; rows that could see what is missing say so.

    Returns:
        A row per sample point, route by route and along each: place, the columns of the criterion,
        `status` and `reason` (see `observability`).

    Raises:
        UsageError: no routes, two of one name, settings that cannot be.
        IncompleteError: the map is not whole, and not `partial`.
        LockedError: another process writes to the folder.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    routes = list(routes)
    observing = Observing(
        sensor,
        seeing or VirtualSettings(),
        registration or LabelSettings().registration,
        cell_size,
        sensor_height,
        route_z,
    )
    samples = samples_along(store, routes, spacing)
    plan = plan_observe(MapPlan.of_store(store, partial=partial), samples, out, observing, memory)
    return _tables_of(plan, observe.name, out, routes, client, watch)


def plan_observe(
    map_plan: MapPlan,
    samples: Mapping[TileKey, Samples],
    out: str | os.PathLike[str],
    observing: Observing,
    memory: int,
    group: str = "",
    applies: Stage = observe,
) -> Plan:
    """What `observe_along` will run; other arguments and errors as there.

    Args:
        map_plan: the map.
        samples: the sample points by tile (`samples_by_tile`).
        out: folder of the tables.
        observing: what is observed with.
        memory: what a task may use [bytes].
        group: of which drive, or as whose sensor, where one plan has several.
        applies: `observe`, or `observe_drive`.
    """
    observing.registration.require_cells(observing.cell_size)
    map_plan.store.grid.require_cell_size(whole_mm(observing.cell_size, "cell_size"))
    require_near(map_plan, samples)
    folder = place_of(out)
    tasks = [
        observe_task(map_plan, key, some, observing, folder, group, applies)
        for key, some in samples.items()
    ]
    return Plan.of((*map_plan.tasks.values(), *tasks), memory)


def _tables_of(
    plan: Plan,
    stage: str,
    out: str | os.PathLike[str],
    routes: Sequence[Route],
    client: Any | None,
    watch: Watch | None,
) -> pd.DataFrame:
    """Run a plan, and read the tables of a stage; others beside them are removed.

    Raises:
        PartialError: some of its tasks failed; lists them.
    """
    failed, own = make_tables(plan, out, client, watch), {task.key for task in plan.outputs(stage)}
    failures = {key: reason for key, reason in failed.items() if key in own}
    tables = paths_of(plan.outputs(stage))
    if failures:
        require_all_done(tables[0].rsplit("/", 1)[0], failures)
    return in_route_order(read_tables(tables), [route.route_id for route in routes])
