"""The job that compares: which lidar, which range, which resolution of map and scan suffices.

All choices are one plan, observed side by side: what two of them need of the map is made once.
"""

import itertools
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from tilestream.errors import PartialError, UsageError, counted
from tilestream.factors.rows import in_route_order
from tilestream.files import place_of
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.plan import DEFAULT_MEMORY, Plan, paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.along_routes import SENSOR_HEIGHT, plan_observe, samples_along
from tilestream.pipeline.jobs.inventory import make_tables
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import Observing, observe
from tilestream.records import Route, RouteZ
from tilestream.report.comparison import CELL_COLUMNS, ROW_COLUMNS, Comparison
from tilestream.sensor import Carrier
from tilestream.settings import LabelSettings, VirtualSettings
from tilestream.store import TileStore, cells_table
from tilestream.tables import read_tables

SPACING = 5.0
"""Distance between sample points [m]: a comparison needs fewer than an estimate."""
MOST_NAME = 60
"""Characters of a sensor's name that go into the name of a choice."""
FITTING = (200, 10_000)
"""Cell sizes that are proposed where one does not fit [mm]."""


@dataclass(frozen=True)
class Choice:
    """A lidar on a vehicle, how its scans are thinned, and the resolution of the map that they are
    matched with.

    Raises:
        UsageError: a range beyond the sensor's, a blind sector, a cell size or a leaf that cannot
            be.
    """

    sensor: Carrier
    """What looks."""
    range_max: float | None = None
    """Usable range [m]; None: the sensor's."""
    blind_rear_deg: float = 0.0
    """Sector to the rear that the vehicle hides [deg]."""
    cell_size: float = 2.0
    """Edge of an NDT cell [m], whole millimetres."""
    scan_leaf: float | None = None
    """Scans are thinned by voxels of this edge [m], 0: not at all; None: as the matcher does."""

    def __post_init__(self) -> None:
        self.seeing(VirtualSettings())
        self.matcher(RegistrationSettings())
        if self.range_max is not None and self.range_max > self.sensor.range_max:
            raise UsageError(
                f"{self.sensor.name} sees {self.sensor.range_max:g} m: "
                f"a range of {self.range_max:g} m is beyond that"
            )
        if whole_mm(self.cell_size, "cell_size") <= 0:
            raise UsageError(f"cell_size is {self.cell_size:g} m: give more than 0")

    @property
    def vehicle(self) -> str:
        """The choice but for the cell size, e.g. `VLP16-60m-rear120`; safe as a folder's name."""
        name = re.sub(r"[^A-Za-z0-9_+.-]", "_", self.sensor.name)[:MOST_NAME].lstrip(".")
        parts = [
            name or "sensor",
            "" if self.range_max is None else f"{self.range_max:g}m",
            f"rear{self.blind_rear_deg:g}" if self.blind_rear_deg else "",
            "" if self.scan_leaf is None else f"leaf{self.scan_leaf:g}m",
        ]
        return "-".join(part for part in parts if part)

    @property
    def name(self) -> str:
        """What to call it, e.g. `VLP16-60m-cell2m`; safe as a folder's name."""
        return f"{self.vehicle}-cell{self.cell_size:g}m"

    def seeing(self, base: VirtualSettings) -> VirtualSettings:
        """How it sees: its range and blind sector, the rest as in `base`."""
        own = {"range_max": self.range_max, "blind_rear_deg": self.blind_rear_deg}
        return VirtualSettings(**(base.model_dump() | own))

    def matcher(self, base: RegistrationSettings) -> RegistrationSettings:
        """What its scans are registered with: thinned by its leaf, the rest as in `base`."""
        if self.scan_leaf is None:
            return base
        return RegistrationSettings(**(base.model_dump() | {"scan_leaf": self.scan_leaf}))


def choices_of(
    sensors: Sequence[Carrier],
    ranges: Sequence[float | None],
    blind_rears_deg: Sequence[float],
    cell_sizes: Sequence[float],
    scan_leaves: Sequence[float | None] = (None,),
) -> tuple[Choice, ...]:
    """Every sensor at every range, blind sector, leaf of its scans and cell size, the last changing
    fastest.

    Raises:
        UsageError: as `Choice`.

    Examples:
        >>> choices = ts.choices_of([ts.VLP16], [30.0, 60.0], [0.0], [2.0])
        >>> [choice.name for choice in choices]
        ['VLP16-30m-cell2m', 'VLP16-60m-cell2m']
    """
    product = itertools.product(sensors, ranges, blind_rears_deg, scan_leaves, cell_sizes)
    return tuple(
        Choice(sensor, range_max, blind_rear, cell_size, leaf)
        for sensor, range_max, blind_rear, leaf, cell_size in product
    )


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
    tables: dict[str, list[str]] = {choice.name: [] for choice in choices}
    for path in paths_of(plan.outputs(observe.name)):
        tables[path.rsplit("/", 3)[1]].append(path)
    failures = make_tables(plan, out, client, watch)
    if failures:
        raise PartialError(f"{out}: {counted(failures, 'tasks')}, the rest is done:", failures)
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
    return Comparison(rows, table, cells_of_map(plan, store), facts)


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
    tasks: list[Task] = []
    samples = samples_along(store, routes, spacing)
    for choice in choices:
        observing = Observing(
            choice.sensor,
            choice.seeing(seeing),
            choice.matcher(registration),
            choice.cell_size,
            sensor_height,
            route_z,
        )
        folder = f"{place_of(out)}/{choice.name}"
        planned = plan_observe(map_plan, samples, folder, observing, memory, group=choice.name)
        tasks += planned.outputs(observe.name)
    for key, size_mm in itertools.product(sorted(map_plan.points), sizes_mm):
        map_plan.cells(key, size_mm)  # also of tiles that no route sees: the map's size
    return Plan.of((*map_plan.tasks.values(), *tasks), memory)


def require_names(choices: Sequence[Choice]) -> None:
    """Refuse choices whose folders or lines could not be told apart.

    Raises:
        UsageError: none, or two of one name (upper and lower case are one).
    """
    if not choices:
        raise UsageError("nothing to compare: give at least one choice")
    names = [choice.name.lower() for choice in choices]
    for choice, name in zip(choices, names, strict=True):
        if names.count(name) > 1:
            raise UsageError(
                f"two choices are named {choice.name}: give each once, and each sensor a name of "
                "its own"
            )


def require_sizes(store: TileStore, sizes_mm: Sequence[int]) -> None:
    """Refuse cell sizes of which the tile size is no multiple.

    Raises:
        UsageError: says which sizes fit this store, and which tiles would fit all of these.
    """
    tile_mm = store.grid.tile_mm
    wrong = [size for size in sizes_mm if tile_mm % size]
    if not wrong:
        return
    low, high = FITTING
    fitting = [size for size in range(low, high + 1, 50) if tile_mm % size == 0] or [tile_mm]
    common = math.lcm(*sizes_mm)
    raise UsageError(
        f"cell size {_metres(wrong)} does not divide the tiles of {store.url}, "
        f"{_metres([tile_mm])}: sizes that fit are {_metres(fitting)}; all of "
        f"{_metres(sizes_mm)} fit tiles of {_metres([common * max(1, round(tile_mm / common))])}"
    )


def _metres(sizes_mm: Iterable[int]) -> str:
    return ", ".join(f"{size / MM_PER_M:g}" for size in sizes_mm) + " m"


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
