"""What every table of sample points begins and ends with: which place, and whether it is done."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from tilestream.factors.sample_points import raised
from tilestream.formats.routes import resample
from tilestream.records import Column, Route
from tilestream.store import TileStore
from tilestream.tiling import TileKey

PLACE_COLUMNS = (
    Column("route_id", "place", "", "Name of the route.", "", dtype="str"),
    Column("sample", "place", "1", "Number of the sample point on its route.", "", dtype="int64"),
    Column("arc_length", "place", "m", "Length of the route up to here.", ""),
    Column("heading", "place", "rad", "Direction of travel, from the map's x axis.", ""),
    Column("x", "place", "m", "Place of the lidar.", "definitions, section 2"),
    Column("y", "place", "m", "Place of the lidar.", "definitions, section 2"),
    Column("z", "place", "m", "Place of the lidar: route or ground, plus its height.", "section 2"),
)
STATUS_COLUMNS = (
    Column("status", "place", "", "done, missing or failed.", "", dtype="str"),
    Column("reason", "place", "", "Why it is not done.", "", dtype="str"),
)


class Sample(NamedTuple):
    """A sample point of one of several routes, on the road."""

    route: int
    """Number of its route."""
    sample: int
    """Its number on the route."""
    arc_length: float
    """Length of the route up to it [m]."""
    heading: float
    """Direction of travel [rad, from the map's x axis]."""
    x: float
    """Place on the road [m, map frame]."""
    y: float
    """Place on the road [m, map frame]."""
    z: float
    """Height of the route [m, map frame]; NaN where it has none."""


def samples_by_tile(
    store: TileStore, routes: Iterable[Route], spacing: float
) -> dict[TileKey, list[Sample]]:
    """The sample points of all routes by the tile that holds them.

    Args:
        store: the map.
        routes: where.
        spacing: arc length between sample points [m].

    Raises:
        UsageError: as `resample`.
    """
    found: dict[TileKey, list[Sample]] = {}
    for number, route in enumerate(routes):
        points = resample(route, spacing)
        columns = np.column_stack([points.arc_length, points.heading, points.positions])
        for sample, row in enumerate(columns.tolist()):
            key = store.grid.key_at(row[2], row[3])
            found.setdefault(key, []).append(Sample(number, sample, *row))
    return found


def sample_rows(
    samples: Sequence[Sample], route_ids: Sequence[str], store: TileStore, sensor_height: float
) -> pd.DataFrame:
    """Sample points as rows of `PLACE_COLUMNS`, raised to the lidar.

    Args:
        samples: on the road.
        route_ids: names of their routes.
        store: the map, which tells the ground where a route has no z.
        sensor_height: height of the lidar above the road [m].

    Raises:
        UsageError: a height that is not finite.
        TileNotReadyError: a tile under the sample points failed or was skipped.
    """
    frame = pd.DataFrame(samples, columns=Sample._fields)
    frame["route_id"] = [route_ids[number] for number in frame.pop("route")]
    frame["z"] = raised(frame[["x", "y", "z"]].to_numpy(), store, sensor_height)[:, 2]
    return frame[[column.name for column in PLACE_COLUMNS]]
