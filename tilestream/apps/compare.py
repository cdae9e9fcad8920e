"""The job that compares: which lidar, which range, which resolution of map and scan suffices.

All choices are one plan, observed side by side: what two of them need of the map is made once.
"""

import itertools
import os
from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

from tilestream.apps.choices import (
    Choice,
    choice_tasks,
    require_names,
    require_sizes,
    tables_by_choice,
)
from tilestream.errors import require_all_done
from tilestream.factors.rows import in_route_order
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.matcher import RegistrationSettings
from tilestream.model.card import CHECKED
from tilestream.model.file import load_model
from tilestream.model.shipped import SHIPPED, file_of, is_shipped
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.jobs.along_routes import SENSOR_HEIGHT, samples_along
from tilestream.pipeline.jobs.inventory import make_tables
from tilestream.pipeline.jobs.run_worth import REAL
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import Observing, observe
from tilestream.records import Route, RouteZ
from tilestream.report.comparison import CELL_COLUMNS, ROW_COLUMNS, Comparison
from tilestream.settings import DEFAULT_MEMORY, LabelSettings, VirtualSettings
from tilestream.store import TileStore, cells_table
from tilestream.tables import read_tables

SPACING = 5.0
"""Distance between sample points [m]: a comparison needs fewer than an estimate."""


def compare(
    store: TileStore,
    routes: Iterable[Route],
    out: str | os.PathLike[str],
    choices: Sequence[Choice],
    *,
    spacing: float = SPACING,
    registration: RegistrationSettings | None = None,
    sensor_height: float = SENSOR_HEIGHT,
    route_z: RouteZ = "ground",
    seeing: VirtualSettings | None = None,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    partial: bool = False,
) -> Comparison:
    """The virtual drive along routes as each of several choices, resumable, in parallel.

    Args:
        store: the map; it keeps the cells of every size that is compared, of all its tiles.
        routes: where; in the map's frame, each with a name of its own.
        out: folder of the tables, `<choice>/observability/<tile>.parquet`, a local path or any
            fsspec URL; other tables of these choices there are removed.
        choices: what is compared, at least one, no two of one name; of those that differ in the
            cell size only, the first is the baseline of the others.
        spacing: distance between sample points [m].
        registration: the matcher of the vehicle; default `autoware`, as of all jobs.
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z of the routes.
        seeing: drop-outs, starts, seed; its range and blind sector give way to each choice's.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        partial: go on with a map that is not whole; rows that could see what is missing say so.

    Returns:
        The rows of all choices and the cells of the map, the same to the bit on any number of
        workers.

    Raises:
        UsageError: no choices or two of one name, a cell size that the tiles are no multiple of,
            no routes, two of one name, settings that cannot be.
        IncompleteError: the map is not whole, and not `partial`.
        LockedError: another process writes to the folder.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    routes, registration = list(routes), registration or LabelSettings().registration
    seeing = seeing or VirtualSettings()
    plan = plan_compare(
        store,
        routes,
        out,
        choices,
        spacing,
        registration,
        sensor_height,
        route_z,
        seeing,
        memory,
        partial,
    )
    tables = tables_by_choice(plan.outputs(observe.name))
    require_all_done(out, make_tables(plan, out, client, watch))
    order = [route.route_id for route in routes]
    rows = pd.concat(
        [rows_of(choice, tables[choice.name], order, store) for choice in choices],
        ignore_index=True,
    )
    own = {"range_max", "blind_rear_deg"}
    leaf = {"scan_leaf"} if any(choice.scan_leaf is not None for choice in choices) else set()
    matcher = registration.model_dump(exclude=leaf)
    facts = {
        "map": store.url,
        "tile_size": store.settings.tile_size,
        "spacing": spacing,
        "sensor_height": sensor_height,
        "route_z": route_z,
        "matcher": registration.told,
        **{f"registration.{name}": value for name, value in matcher.items()},
        **{f"seeing.{name}": value for name, value in seeing.model_dump(exclude=own).items()},
    }
    table = choice_table(choices, registration)
    return Comparison(rows, table, cells_of_map(plan, store), facts, worth=worth_told())


def worth_told() -> tuple[str, ...]:
    """What the errors of virtual drives are worth, as sentences; what was checked on real drives
    is told by the card of the model that ships, which rests on them.
    """
    told = "These are errors of virtual drives as they are, from the map alone, without a model: "
    told += "they tell choices apart; how large the error is, is not checked here."
    if not is_shipped():
        return (told,)
    real = load_model(file_of(SHIPPED)).card.get(CHECKED, {}).get(REAL, {})
    if "spearman" not in real:
        return (told,)
    middle, low, high = real["spearman"]
    there = f"{real['places']} places, {real['drives']} drives"
    checked = f"On real drives elsewhere ({there}) estimates that rest on them had a rank "
    checked += f"correlation of {middle:.2f} ({low:.2f} to {high:.2f}) with what was measured."
    return told, checked


def plan_compare(
    store: TileStore,
    routes: Sequence[Route],
    out: str | os.PathLike[str],
    choices: Sequence[Choice],
    spacing: float,
    registration: RegistrationSettings,
    sensor_height: float,
    route_z: RouteZ,
    seeing: VirtualSettings,
    memory: int,
    partial: bool = False,
) -> Plan:
    """What `compare` will run; arguments and errors as there."""
    require_names(choices)
    sizes_mm = sorted({whole_mm(choice.cell_size, "cell_size") for choice in choices})
    require_sizes(store, sizes_mm)
    map_plan = MapPlan.of_store(store, partial=partial)
    samples = samples_along(store, routes, spacing)
    first = choices[0]
    base = Observing(first.sensor, seeing, registration, first.cell_size, sensor_height, route_z)
    tasks = choice_tasks(map_plan, samples, out, choices, base, memory)
    for key, size_mm in itertools.product(sorted(map_plan.points), sizes_mm):
        map_plan.cells(key, size_mm)  # also of tiles that no route sees: the map's size
    return Plan.of((*map_plan.tasks.values(), *tasks), memory)


def rows_of(
    choice: Choice, tables: Sequence[str], routes: Sequence[str], store: TileStore
) -> pd.DataFrame:
    """The sample points of a choice from its tables, route by route and along each."""
    rows = in_route_order(read_tables(tables), routes)
    rows["choice"] = choice.name
    places = zip(rows["x"], rows["y"], strict=True)
    rows["tile"] = [str(store.grid.key_at(x, y)) for x, y in places]
    return rows[list(ROW_COLUMNS)]


def cells_of_map(plan: Plan, store: TileStore) -> pd.DataFrame:
    """How many cells each tile has at each size, as the marks of the finished plan say."""
    sizes = sorted({task.takes["cell_mm"] for task in plan.outputs("cells")})
    rows = [
        (str(key), size / MM_PER_M, mark.facts["cells"])
        for size in sizes
        for key, mark in store.marks(cells_table(size).name).items()
        if mark.status == "done"
    ]
    table = pd.DataFrame(rows, columns=list(CELL_COLUMNS))
    return table.sort_values(["cell_size", "tile"], ignore_index=True)


def choice_table(choices: Sequence[Choice], registration: RegistrationSettings) -> pd.DataFrame:
    """The choices as a table: a row each; `registration` is their matcher but for the leaf."""
    return pd.DataFrame(
        {
            "choice": [choice.name for choice in choices],
            "vehicle": [choice.vehicle for choice in choices],
            "sensor": [choice.sensor.name for choice in choices],
            "range_max": [choice.range_max or choice.sensor.range_max for choice in choices],
            "blind_rear_deg": [choice.blind_rear_deg for choice in choices],
            "scan_leaf": [choice.matcher(registration).scan_leaf for choice in choices],
            "cell_size": [whole_mm(c.cell_size, "cell_size") / MM_PER_M for c in choices],
        }
    )
