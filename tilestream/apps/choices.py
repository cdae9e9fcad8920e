"""What may be compared: lidars, their ranges and blind sectors, resolutions of map and scan."""

import itertools
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from tilestream.errors import UsageError
from tilestream.factors.rows import Samples
from tilestream.files import place_of
from tilestream.grid import MM_PER_M, TileKey, whole_mm
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.engine.plan import paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.along_routes import plan_observe
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import Observing, observe
from tilestream.sensor import Carrier
from tilestream.settings import VirtualSettings
from tilestream.store import TileStore

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

    def observing(self, base: Observing) -> Observing:
        """What it is observed with; all that it does not decide as in `base`."""
        return replace(
            base,
            sensor=self.sensor,
            seeing=self.seeing(base.seeing),
            registration=self.matcher(base.registration),
            cell_size=self.cell_size,
        )

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


def choice_tasks(
    map_plan: MapPlan,
    samples: Mapping[TileKey, Samples],
    out: str | os.PathLike[str],
    choices: Sequence[Choice],
    base: Observing,
    memory: int,
) -> list[Task]:
    """The virtual drive at sample points as each of several choices: a table per choice and tile.

    Args:
        map_plan: the map.
        samples: by the tile that holds them.
        out: folder of the tables, `<choice>/observability/<tile>.parquet`.
        choices: no two of one name.
        base: what they are observed with, but for what a choice decides.
        memory: what a task may use [bytes].
    """
    tasks: list[Task] = []
    for choice in choices:
        folder, observing = f"{place_of(out)}/{choice.name}", choice.observing(base)
        planned = plan_observe(map_plan, samples, folder, observing, memory, group=choice.name)
        tasks += planned.outputs(observe.name)
    return tasks


def tables_by_choice(tasks: Iterable[Task]) -> dict[str, list[str]]:
    """The tables that such tasks write, by the name of their choice."""
    tables: dict[str, list[str]] = {}
    for path in paths_of(tasks):
        tables.setdefault(path.rsplit("/", 3)[1], []).append(path)
    return tables


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
