"""Factors: what the map looks like from the sample points of a tile."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache

import pandas as pd

from tilestream.factors.catalogue import COLUMNS, Which
from tilestream.factors.own import OWN, OwnFactors, own_table
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS, Samples, sample_rows, with_places
from tilestream.factors.table import TermsCache
from tilestream.factors.table import factors as factors_of
from tilestream.grid import Box, TileKey, whole_mm
from tilestream.marks import canonical
from tilestream.pipeline.engine.outputs import Made, Parquet
from tilestream.pipeline.engine.stage import Stage, Task, stage
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.records import RouteZ
from tilestream.sensor import Sensor
from tilestream.store import open_store

CACHE_BYTES = 300_000_000
"""Memory for the terms of the tiles in sight, kept for the tasks that follow."""
FIXED_BYTES = CACHE_BYTES + 300_000_000
"""Memory of the task besides what it reads: the kept terms, the sums of some sample points."""
BYTES_PER_POINT = 40
"""Memory per map point in sight, of which the terms of one tile are made at a time."""
BYTES_AROUND = 200
"""Memory per map point that factors of one's own look at, with its order: those of all places of a
tile at once."""


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
    """Height of the lidar above the road [m]."""
    route_z: RouteZ = "ground"
    """What is made of z of the route."""


@stage(
    "factors",
    version=3,
    memory=lambda counts: (
        FIXED_BYTES + BYTES_PER_POINT * counts["largest"] + BYTES_AROUND * counts.get("around", 0)
    ),
    seconds=0.002,
    columns=(*PLACE_COLUMNS, *COLUMNS, *STATUS_COLUMNS),
)
def factors(
    map_part: MapPart, samples: Samples, looking: Looking, own: Sequence[OwnFactors] = ()
) -> Made:
    """The factors of sample points, a row each; those of one's own behind the others."""
    store = map_part.store
    places, why = sample_rows(samples, store, looking.sensor_height, looking.route_z)
    positions = places[["x", "y", "z"]].to_numpy()
    cache = _cache(map_part.store_url, looking.cell_size, map_part.state)
    found = factors_of(store, positions, looking.sensor, looking.cell_size, looking.which, cache)
    facts = {"data_set": canonical(looking), "store": store.url}
    if not own:
        return Made(with_places(found, places, why), facts)
    looked = places[["x", "y", "z", "heading"]].assign(status=found["status"])
    more = own_table(own, store, looked, looking.cell_size)
    columns = tuple(column for one in own for column in one.columns)
    told = {OWN: [asdict(column) for column in columns]}
    rows = with_places(pd.concat([more, found], axis=1), places, why)
    order = [name for name in rows if name not in more and name not in ("status", "reason")]
    return Made(rows[[*order, *more, "status", "reason"]], facts | told, columns)


@stage(
    "factors_drive",
    version=factors.version,
    memory=factors.memory,
    seconds=factors.seconds,
    columns=factors.columns,
)
def factors_drive(
    map_part: MapPart, samples: Samples, looking: Looking, own: Sequence[OwnFactors] = ()
) -> Made:
    """The same at the places of the scans of a drive: what its labels are joined with."""
    made: Made = factors.function(map_part, samples, looking, own)
    return made


@lru_cache(maxsize=1)
def _cache(url: str, cell_size: float, state: str) -> TermsCache:  # noqa: ARG001 - part of the key
    """The terms that this process holds for the tasks that follow."""
    return TermsCache(open_store(url), cell_size, CACHE_BYTES)


def factors_task(
    plan: MapPlan,
    tile: TileKey,
    samples: Samples,
    looking: Looking,
    folder: str,
    group: str,
    applies: Stage,
    own: Sequence[OwnFactors],
) -> Task:
    """The factors of the sample points of a tile, from the terms of the tiles in sight.

    Args:
        plan: the map.
        tile: the tile that holds the sample points.
        samples: the sample points.
        looking: what the factors are made with.
        folder: of the tables.
        group: of which drive, where one plan has several.
        applies: `factors`, or `factors_drive`.
        own: factors of one's own.
    """
    cell_mm = whole_mm(looking.cell_size, "cell_size")
    reach = max((one.reach for one in own), default=0.0)
    around = plan.over(Box.around(samples.places, reach)) if own else []
    seen = plan.over(Box.around(samples.places, max(looking.sensor.range_max, reach)))
    return Task(
        applies,
        "-".join(part for part in (group, str(tile)) if part),
        Parquet(f"{folder}/factors/{tile}.parquet"),
        takes={"samples": samples, "looking": looking} | ({"own": tuple(own)} if own else {}),
        reads={"map_part": plan.part(seen, [plan.terms(key, cell_mm) for key in seen])},
        work=len(samples),
        counts={"points": plan.count(seen), "largest": plan.largest(seen)}
        | ({"around": plan.count(around)} if own else {}),
        tile=tile,
    )
