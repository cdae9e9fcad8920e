"""The stages that look at the map: terms (of a tile's cells), factors (of its sample points)."""

from dataclasses import dataclass, replace
from functools import lru_cache

import pandas as pd

from tilestream.dataflow.plan import BASE_BYTES
from tilestream.dataflow.tasks import perform
from tilestream.errors import TileNotReadyError
from tilestream.factors.catalogue import COLUMNS, Which
from tilestream.factors.rows import PLACE_COLUMNS as PLACE_COLUMNS  # noqa: PLC0414 - for others
from tilestream.factors.rows import STATUS_COLUMNS, Samples, sample_rows
from tilestream.factors.table import TermsCache, factors
from tilestream.factors.terms import TERMS_VERSION, terms_mark, terms_table, tile_terms
from tilestream.sensors import Sensor
from tilestream.store import Mark, open_store
from tilestream.tables import is_done, write_table
from tilestream.tiling import MM_PER_M, TileKey
from tilestream.version import VERSION

FACTORS_VERSION = 2
"""Raise it when the factors that are made from the same terms change."""
TERMS_BYTES = 600_000_000
"""Memory of a terms task beyond the interpreter: points of a tile, cells around it, pairs."""
CACHE_BYTES = 300_000_000
"""Memory for the terms of the tiles in sight of a factors task."""
FACTORS_BYTES = CACHE_BYTES + 300_000_000
"""Memory of a factors task beyond the interpreter: that, and the sums of some sample points."""


@dataclass(frozen=True)
class TermsTask:
    """Make the terms of one tile's cells."""

    store_url: str
    tile: TileKey
    cell_mm: int
    promised_bytes: int = BASE_BYTES + TERMS_BYTES
    needs: tuple[str, ...] = ()
    stage: str = "terms"
    work: int = 1

    @property
    def key(self) -> str:
        """`terms-<cell size in mm>-<tile>`."""
        return f"terms-{self.cell_mm}-{self.tile}"


@dataclass(frozen=True)
class Looking:
    """What factors are made with: the identity of a table of factors."""

    sensor: Sensor
    """What looks."""
    cell_size: float
    """Edge of a cell [m]."""
    which: Which
    """Which set of factors."""
    sensor_height: float
    """Height of the lidar above the ground or the route [m]."""


@dataclass(frozen=True)
class FactorsTask:
    """Make the factors of the sample points that lie in one tile."""

    store_url: str
    tile: TileKey
    looking: Looking
    samples: Samples
    """Its sample points."""
    map_state: str
    """Hash of the whole map: terms that a process holds are of this map only."""
    out: str
    identity: str
    """Hash of everything that the rows depend on."""
    needs: tuple[str, ...]
    promised_bytes: int = BASE_BYTES + FACTORS_BYTES
    stage: str = "factors"

    @property
    def work(self) -> int:
        """Sample points."""
        return len(self.samples)

    @property
    def key(self) -> str:
        """`factors-<tile>`."""
        return f"factors-{self.tile}"


@perform.register
def _terms(task: TermsTask) -> Mark:
    store = open_store(task.store_url)
    tile, name = store.tile(task.tile), terms_table(task.cell_mm)
    wanted = terms_mark(store, task.tile, task.cell_mm)
    known = tile.mark(name)
    if known.same_work(wanted):
        return known
    try:
        terms = tile_terms(store, task.tile, task.cell_mm / MM_PER_M)
    except TileNotReadyError as error:
        failed = replace(wanted, status="failed", reason=str(error))
        tile.write_reason(name, failed)  # the sample points that see it say so in their rows
        return failed
    made = replace(wanted, facts={"cells": len(terms.mean)})
    tile.write_table(name, terms.arrays(), made)
    return made


@perform.register
def _factors(task: FactorsTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    store, looking = open_store(task.store_url), task.looking
    frame = sample_rows(task.samples, store, looking.sensor_height)
    positions = frame[["x", "y", "z"]].to_numpy()
    cache = _cache(task.store_url, looking.cell_size, task.map_state)
    found = factors(store, positions, looking.sensor, looking.cell_size, looking.which, cache)
    frame = pd.concat([frame, found], axis=1)
    documented = (*PLACE_COLUMNS, *COLUMNS, *STATUS_COLUMNS)
    mark = {"identity": task.identity, "data_set": facts(looking), "store": store.address}
    write_table(task.out, frame, documented, mark)
    return len(frame)


@lru_cache(maxsize=1)
def _cache(url: str, cell_size: float, map_state: str) -> TermsCache:  # noqa: ARG001 - part of the key
    """The terms that this process holds for the tasks that follow."""
    return TermsCache(open_store(url), cell_size, CACHE_BYTES)


def facts(looking: Looking) -> dict[str, object]:
    """What is kept with every table of factors: two that differ in it are never mixed."""
    return {
        "sensor": looking.sensor.model_dump(),
        "cell_size": looking.cell_size,
        "which": looking.which,
        "sensor_height": looking.sensor_height,
        "versions": [TERMS_VERSION, FACTORS_VERSION, VERSION],
    }
