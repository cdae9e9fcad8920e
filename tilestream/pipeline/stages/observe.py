"""Observe: the virtual drive from the sample points of a tile."""

from dataclasses import dataclass

from tilestream.factors.observability import COLUMNS, MARGIN, observability
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS, Samples, sample_rows, with_places
from tilestream.grid import Box, TileKey, whole_mm
from tilestream.marks import canonical
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.engine.outputs import Made, Parquet
from tilestream.pipeline.engine.stage import Stage, Task, stage
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.records import RouteZ
from tilestream.sensor import Carrier, rim_of
from tilestream.settings import VirtualSettings

FIXED_BYTES = 600_000_000
"""Memory of the task besides what it reads: a scene, the registrations, and the terms that factors
tasks keep in the same process."""
BYTES_PER_POINT = 65
"""Memory per map point in sight: its surfels and cells, those in view of a place once more …"""
BYTES_PER_DRAW = 1
"""… and which of them the beams of each draw pass by."""


@dataclass(frozen=True)
class Observing:
    """What is observed with: the identity of a table of observability."""

    sensor: Carrier
    """What looks."""
    seeing: VirtualSettings
    """How it sees, and where the virtual drive starts."""
    registration: RegistrationSettings
    """The matcher of the vehicle."""
    cell_size: float
    """Edge of a cell [m]."""
    sensor_height: float
    """Height of the lidar above the road [m]."""
    route_z: RouteZ = "ground"
    """What is made of z of the route."""

    @property
    def range_max(self) -> float:
        """How far it sees [m]."""
        usable = self.seeing.range_max
        return self.sensor.range_max if usable is None else min(usable, self.sensor.range_max)

    @property
    def reach(self) -> float:
        """How far from the sample point what it sees can be [m]."""
        return self.range_max + rim_of(self.sensor)


@stage(
    "observe",
    version=8,
    memory=lambda counts: (
        FIXED_BYTES + (BYTES_PER_POINT + BYTES_PER_DRAW * counts["draws"]) * counts["points"]
    ),
    seconds=0.27,
    columns=(*PLACE_COLUMNS, *COLUMNS, *STATUS_COLUMNS),
)
def observe(map_part: MapPart, samples: Samples, observing: Observing) -> Made:
    """The observability of sample points, a row each."""
    store = map_part.store
    places, why = sample_rows(samples, store, observing.sensor_height, observing.route_z)
    found = observability(
        store,
        places[["x", "y", "z"]].to_numpy(),
        places["heading"].to_numpy(),
        observing.sensor,
        observing.seeing,
        observing.registration,
        observing.cell_size,
    )
    rows = with_places(found, places, why)
    return Made(rows, {"data_set": canonical(observing)})


@stage(
    "observe_drive",
    version=observe.version,
    memory=observe.memory,
    seconds=observe.seconds,
    columns=observe.columns,
)
def observe_drive(map_part: MapPart, samples: Samples, observing: Observing) -> Made:
    """The same at the places of the scans of a drive, as the lidar sees that it is read as."""
    made: Made = observe.function(map_part, samples, observing)
    return made


def observe_task(
    plan: MapPlan,
    tile: TileKey,
    samples: Samples,
    observing: Observing,
    folder: str,
    group: str,
    applies: Stage = observe,
    below: str = "",
) -> Task:
    """The observability of the sample points of a tile, from surfels and cells of those in sight.

    Args:
        plan: the map.
        tile: the tile that holds the sample points.
        samples: the sample points.
        observing: what is observed with.
        folder: of the tables.
        group: of which drive, or as whose sensor, where one plan has several.
        applies: `observe`, or `observe_drive`.
        below: a folder in that of these tables, of which several plans write a part; with `/`.
    """
    cell_mm = whole_mm(observing.cell_size, "cell_size")
    seen = plan.over(Box.around(samples.places, observing.reach + MARGIN))
    made = [task for k in seen for task in (plan.cells(k, cell_mm), plan.surfels(k))]
    return Task(
        applies,
        "-".join(part for part in (group, str(tile)) if part),
        Parquet(f"{folder}/observability/{below}{tile}.parquet"),
        takes={"samples": samples, "observing": observing},
        reads={"map_part": plan.part(seen, made)},
        work=len(samples),
        counts={"points": plan.count(seen), "draws": observing.seeing.draws},
        tile=tile,
    )
