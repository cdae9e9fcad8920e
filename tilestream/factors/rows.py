"""Columns that every table of sample points has: the place first, status and reason last."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.factors.sample_points import raised
from tilestream.formats.routes import resample
from tilestream.grid import MM_PER_M, TileGrid, TileKey
from tilestream.records import Column, Float64, Int64, Route, RouteZ
from tilestream.store import TileStore

PLACE_COLUMNS = (
    Column("route_id", "place", "", "Name of the route.", "", dtype="str"),
    Column("sample", "place", "1", "Number of the sample point on its route.", "", dtype="int64"),
    Column("arc_length", "place", "m", "Length of the route up to here.", ""),
    Column("heading", "place", "rad", "Direction of travel, from the map's x axis.", ""),
    Column("x", "place", "m", "Place of the lidar.", "definitions, section 2"),
    Column("y", "place", "m", "Place of the lidar.", "definitions, section 2"),
    Column(
        "z",
        "place",
        "m",
        "Place of the lidar: ground or route, plus its height.",
        "definitions, section 2",
    ),
    Column(
        "above_ground",
        "place",
        "m",
        "z of the route - ground of the map; NaN: either is not known.",
        "definitions, section 2",
    ),
)
STATUS_COLUMNS = (
    Column("status", "place", "", "done, missing or failed.", "", dtype="str"),
    Column("reason", "place", "", "Why it is not done.", "", dtype="str"),
)

ROW = np.dtype(
    [
        ("route", np.int32),  # its index in `route_ids`
        ("sample", np.int32),  # its number on the route
        ("arc_length", np.float64),  # of the route up to it [m]
        ("heading", np.float64),  # direction of travel [rad, from the map's x axis]
        ("x", np.float64),  # place on the road [m, map frame]
        ("y", np.float64),
        ("z", np.float64),  # height of the route [m, map frame]; NaN where it has none
    ]
)


@dataclass(frozen=True, eq=False)
class Samples:
    """The sample points of one tile, on the road: 48 bytes each, so that a plan can hold a city."""

    route_ids: tuple[str, ...]
    """Names of the routes, or of the drives, that they lie on."""
    rows: NDArray[np.void]
    """(k,) of type `ROW`, route by route and along each."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def places(self) -> Float64:
        """(k, 2) x and y [m, map frame]."""
        return np.column_stack([self.rows["x"], self.rows["y"]])

    def facts(self) -> list[Any]:
        """The content as JSON values: part of the identity of tables that are made from it."""
        return [self.route_ids, self.rows.tolist()]


def samples_by_tile(
    grid: TileGrid, routes: Sequence[Route], spacing: float
) -> dict[TileKey, Samples]:
    """The sample points of all routes by the tile that holds them, sorted by tile.

    Args:
        grid: the tiles.
        routes: where; each with a name of its own.
        spacing: arc length between sample points [m].

    Raises:
        UsageError: no routes, two of one name, a place that is not finite; as `resample`.
    """
    names = [route.route_id for route in routes]
    if not names or len(set(names)) < len(names):
        raise UsageError(
            f"routes are named {', '.join(names) or 'nothing'}: give each its own name"
        )
    return _by_tile(grid, ((each.route_id, _rows_of(resample(each, spacing))) for each in routes))


def samples_of_drive(
    grid: TileGrid, name: str, numbers: Int64, arc_length: Float64, T_map_lidar: Float64
) -> dict[TileKey, Samples]:
    """The places of the scans of a drive, as sample points by the tile that holds them.

    Their z is that of the lidar (`RouteZ`), their heading that of its x axis.

    Args:
        grid: the tiles.
        name: of the drive, in place of a route's.
        numbers: (k,) of the sample points along the drive.
        arc_length: (k,) length of the drive up to them [m].
        T_map_lidar: (k, 4, 4) their poses.
    """
    rows = np.zeros(len(numbers), ROW)
    rows["sample"], rows["arc_length"] = numbers, arc_length
    rows["heading"] = np.arctan2(T_map_lidar[:, 1, 0], T_map_lidar[:, 0, 0])
    rows["x"], rows["y"], rows["z"] = T_map_lidar[:, :3, 3].T
    return _by_tile(grid, [(name, rows)])


def samples_of_places(grid: TileGrid, places: pd.DataFrame) -> dict[TileKey, Samples]:
    """Sample points that a table has, by the tile that holds them; their z is that of the lidar
    (`RouteZ`).

    Args:
        grid: the tiles.
        places: a row each, along each route: `PLACE_COLUMNS`, but for `above_ground`.
    """
    named = []
    for name, part in places.groupby("route_id", sort=False):
        rows = np.zeros(len(part), ROW)
        for column in ("sample", "arc_length", "heading", "x", "y", "z"):
            rows[column] = part[column]
        named.append((str(name), rows))
    return _by_tile(grid, named)


def _by_tile(
    grid: TileGrid, named: Iterable[tuple[str, NDArray[np.void]]]
) -> dict[TileKey, Samples]:
    """The rows of several routes by the tile that holds them, sorted by tile."""
    pieces: dict[TileKey, list[tuple[str, NDArray[np.void]]]] = {}
    for name, rows in named:
        keys = _keys_of(grid, rows, name)
        turns = np.flatnonzero((keys[1:] != keys[:-1]).any(axis=1)) + 1
        for key, piece in zip(keys[[0, *turns]].tolist(), np.split(rows, turns), strict=True):
            pieces.setdefault(TileKey(*key), []).append((name, piece))
    return {key: _samples_of(pieces.pop(key)) for key in sorted(pieces)}


def _rows_of(points: Route) -> NDArray[np.void]:
    rows = np.zeros(len(points.arc_length), ROW)
    rows["sample"] = np.arange(len(rows))
    rows["arc_length"], rows["heading"] = points.arc_length, points.heading
    rows["x"], rows["y"], rows["z"] = points.positions.T
    return rows


def _keys_of(grid: TileGrid, rows: NDArray[np.void], route_id: str) -> Int64:
    """(k, 2) the tiles of sample points: `TileGrid.key_at` of each."""
    mm = np.rint(np.column_stack([rows["x"], rows["y"]]) * MM_PER_M)
    if not np.isfinite(mm).all():
        raise UsageError(f"route {route_id} has a place that is not finite: give metres")
    keys: Int64 = mm.astype(np.int64) // grid.tile_mm
    return keys


def _samples_of(pieces: Sequence[tuple[str, NDArray[np.void]]]) -> Samples:
    """The pieces of routes that lie in one tile."""
    number = {name: index for index, name in enumerate(dict.fromkeys(name for name, _ in pieces))}
    rows = np.empty(sum(len(piece) for _, piece in pieces), ROW)  # else it has a type of its own
    np.concatenate([piece for _, piece in pieces], out=rows)
    rows["route"] = np.repeat([number[n] for n, _ in pieces], [len(p) for _, p in pieces])
    return Samples(tuple(number), rows)


def in_route_order(rows: pd.DataFrame, route_ids: Sequence[str]) -> pd.DataFrame:
    """Rows of sample points in the order of these routes and along each."""
    order = {route_id: number for number, route_id in enumerate(route_ids)}
    rows = rows.sort_values(["route_id", "sample"], key=lambda c: c.map(order).fillna(c))
    return rows.reset_index(drop=True)


def sample_rows(
    samples: Samples, store: TileStore, sensor_height: float, route_z: RouteZ
) -> tuple[pd.DataFrame, NDArray[np.object_]]:
    """Sample points as rows of `PLACE_COLUMNS`, at the height of the lidar.

    Args:
        samples: the sample points, on the route.
        store: the map; it gives the ground.
        sensor_height: height of the lidar above the road [m].
        route_z: what is made of z of the route.

    Returns:
        The rows, and of each why it is not taken (`Raised.why`).

    Raises:
        UsageError: a height that is not finite.
    """
    frame = pd.DataFrame.from_records(samples.rows)
    frame["route_id"] = [samples.route_ids[number] for number in frame.pop("route")]
    at = frame[["x", "y", "z"]].to_numpy()
    found = raised(at, store, sensor_height, route_z)
    frame["z"], frame["above_ground"] = found.lidar[:, 2], found.above_ground
    types = {column.name: column.dtype for column in PLACE_COLUMNS}
    return frame[list(types)].astype(types), found.why


def with_places(
    found: pd.DataFrame, places: pd.DataFrame, why: NDArray[np.object_]
) -> pd.DataFrame:
    """What was found at sample points, behind their places; one that is not taken says why.

    Args:
        found: a row per place, with `status` and `reason`.
        places: the rows of `sample_rows`.
        why: why they are not taken, likewise.
    """
    numbers = [name for name in found if name not in ("status", "reason")]
    table = pd.concat([places, found], axis=1)
    table.loc[why != "", numbers] = np.nan
    table.loc[why != "", "status"] = "failed"
    table["reason"] = np.where(why != "", why, table["reason"])
    return table
