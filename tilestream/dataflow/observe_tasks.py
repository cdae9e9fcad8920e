"""The stages that look from the map itself: surfels (of a tile), observe (its sample points)."""

from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from tilestream.config import RegistrationSettings
from tilestream.dataflow.plan import BASE_BYTES
from tilestream.dataflow.tasks import perform
from tilestream.errors import TileNotReadyError
from tilestream.factors.observability import COLUMNS, observability
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS, Samples, sample_rows
from tilestream.factors.surfels import (
    SURFELS_VERSION,
    surfel_columns,
    surfel_mm,
    surfels_mark,
    surfels_table,
    tile_surfels,
)
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.sensors import Sensor
from tilestream.store import Mark, open_store
from tilestream.tables import is_done, write_table
from tilestream.tiling import TileKey
from tilestream.version import VERSION

OBSERVE_VERSION = 3
"""Raise it when what is observed from the same surfels and cells changes."""
SURFELS_BYTES = 400_000_000
"""Memory of a surfels task beyond the interpreter: the points of a tile, some of their planes."""
OBSERVE_BYTES = 1_000_000_000
"""Memory of an observe task beyond the interpreter: surfels and cells in sight, a scene, and the
terms that factors tasks keep in the same process."""


@dataclass(frozen=True)
class SurfelsTask:
    """Make the surfels of one tile."""

    store_url: str
    tile: TileKey
    needs: tuple[str, ...] = ()
    """The points of the tile and of those around it, where the same plan makes them."""
    promised_bytes: int = BASE_BYTES + SURFELS_BYTES
    stage: str = "surfels"
    work: int = 1

    @property
    def key(self) -> str:
        """`surfels-<tile>`."""
        return f"surfels-{self.tile}"


@dataclass(frozen=True)
class Observing:
    """What is observed with: the identity of a table of observability."""

    sensor: Sensor
    """What looks."""
    seeing: VirtualSettings
    """How it sees, and where the virtual drive starts."""
    registration: RegistrationSettings
    """The matcher of the vehicle."""
    cell_size: float
    """Edge of a cell [m]."""
    sensor_height: float
    """Height of the lidar above the ground or the route [m]."""

    @property
    def range_max(self) -> float:
        """How far it sees [m]."""
        usable = self.seeing.range_max
        return self.sensor.range_max if usable is None else min(usable, self.sensor.range_max)

    def facts(self) -> dict[str, Any]:
        """What is kept with every table: two that differ in it are never mixed."""
        return {
            "sensor": self.sensor.model_dump(),
            "seeing": self.seeing.model_dump(),
            "registration": self.registration.model_dump(),
            "cell_size": self.cell_size,
            "sensor_height": self.sensor_height,
            "versions": [SURFELS_VERSION, OBSERVE_VERSION, VERSION],
        }


@dataclass(frozen=True)
class ObserveTask:
    """Observe from the sample points that lie in one tile."""

    store_url: str
    tile: TileKey
    observing: Observing
    samples: Samples
    """Its sample points."""
    out: str
    identity: str
    """Hash of everything that the rows depend on."""
    needs: tuple[str, ...]
    group: str = ""
    """As whose sensor; empty where a job has one only."""
    promised_bytes: int = BASE_BYTES + OBSERVE_BYTES
    stage: str = "observe"

    @property
    def work(self) -> int:
        """Sample points."""
        return len(self.samples)

    @property
    def key(self) -> str:
        """`observe-<group>-<tile>`."""
        return "-".join(part for part in ("observe", self.group, str(self.tile)) if part)


@perform.register
def _surfels(task: SurfelsTask) -> Mark:
    store = open_store(task.store_url)
    tile, name = store.tile(task.tile), surfels_table(surfel_mm(store))
    wanted = surfels_mark(store, task.tile)
    known = tile.mark(name)
    if known.same_work(wanted):
        return known
    try:
        surfels = tile_surfels(store, task.tile)
    except TileNotReadyError as error:
        failed = replace(wanted, status="failed", reason=str(error))
        tile.write_reason(name, failed)  # the sample points that see it say so in their rows
        return failed
    made = replace(wanted, facts={"surfels": len(surfels)})
    tile.write_table(name, surfel_columns(store, task.tile, surfels), made)
    return made


@perform.register
def _observe(task: ObserveTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    store, how = open_store(task.store_url), task.observing
    frame = sample_rows(task.samples, store, how.sensor_height)
    found = observability(
        store,
        frame[["x", "y", "z"]].to_numpy(),
        frame["heading"].to_numpy(),
        how.sensor,
        how.seeing,
        how.registration,
        how.cell_size,
    )
    frame = pd.concat([frame, found], axis=1)
    documented = (*PLACE_COLUMNS, *COLUMNS, *STATUS_COLUMNS)
    write_table(task.out, frame, documented, {"identity": task.identity, "data_set": how.facts()})
    return len(frame)
