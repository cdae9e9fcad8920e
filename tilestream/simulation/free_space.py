"""The free space between buildings: how far the next one is, and routes through it."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.interpolate import CubicSpline
from scipy.sparse import csgraph

from tilestream.errors import UsageError
from tilestream.records import Float64
from tilestream.simulation.footprints import Footprints

MIN_CLEARANCE = 2.5
"""Least distance from a route to a building [m]."""
KEEP_CLEAR = (5.0, 14.0)
"""Distances from buildings between which routing is free of extra cost [m]."""
CELL = 0.5
"""Edge of a cell of the raster [m]."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Distance to the nearest building on a raster."""

    origin: tuple[float, float]
    """Centre of cell (0, 0) [m]."""
    cell: float
    """Edge of a cell [m]."""
    distance: NDArray[np.float32]
    """(nx, ny) distance of each cell's centre to the nearest building [m], 0 inside."""

    def at(self, xy: Float64) -> Float64:
        """(k,) distance to the nearest building [m], interpolated; the edge's value outside."""
        where = (np.asarray(xy) - self.origin).T / self.cell
        return np.asarray(
            ndimage.map_coordinates(self.distance, where, order=1, mode="nearest"), np.float64
        )


def free_space(footprints: Footprints) -> FreeSpace:
    """Rasterise footprints and measure the distance to them.

    A cell is inside where the signed crossings left of its centre do not cancel: the winding rule,
    so buildings that overlap count as one.
    """
    low = np.floor(footprints.start.min(axis=0)) + CELL / 2
    shape = np.ceil((footprints.start.max(axis=0) - low) / CELL).astype(int) + 1
    a, b = (footprints.start - low) / CELL, (footprints.end - low) / CELL
    first = np.ceil(np.minimum(a[:, 1], b[:, 1])).astype(np.int64)
    count = np.maximum(np.ceil(np.maximum(a[:, 1], b[:, 1])).astype(np.int64) - first, 0)
    edge = np.repeat(np.arange(len(a)), count)
    row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    slope = (b[edge, 0] - a[edge, 0]) / (b[edge, 1] - a[edge, 1])
    column = np.ceil(a[edge, 0] + (row - a[edge, 1]) * slope).astype(np.int64)
    within = (row >= 0) & (row < shape[1])
    where = np.clip(column, 0, shape[0])[within] * shape[1] + row[within]
    signs = np.sign(a[edge, 1] - b[edge, 1])[within]
    turns = np.bincount(where, signs, (shape[0] + 1) * shape[1]).reshape(shape[0] + 1, shape[1])
    inside = np.cumsum(turns, axis=0)[:-1] != 0
    distance = ndimage.distance_transform_edt(~inside, sampling=CELL)
    return FreeSpace((float(low[0]), float(low[1])), CELL, np.asarray(distance, np.float32))


def route_between(space: FreeSpace, waypoints: Float64, points: int | None) -> Float64:
    """A smooth route through waypoints that keeps clear of buildings, sampled every metre.

    Args:
        space: where buildings are.
        waypoints: (k, 2) places to pass near [m], k >= 2.
        points: how many sample points to keep; None: all.

    Raises:
        UsageError: no way through between two waypoints, or the route is shorter than `points`.
    """
    grid, pitch = space.distance, space.cell
    waypoints = np.array([_clearest(grid, pitch, space.origin, place) for place in waypoints])
    legs = [waypoints[:1]]
    for a, b in itertools.pairwise(waypoints):
        legs.append(_leg(grid, pitch, space.origin, a, b)[1:])
    line = np.concatenate(legs)
    line = ndimage.gaussian_filter1d(line, 5.0 / pitch, axis=0, mode="nearest")
    slope = [np.gradient(np.asarray(grid, np.float64), pitch, axis=axis) for axis in (0, 1)]
    for _ in range(40):
        where = (line - space.origin).T / pitch
        short = np.maximum(MIN_CLEARANCE + 0.8 - space.at(line), 0.0)
        away = np.stack([ndimage.map_coordinates(axis, where, order=1) for axis in slope], axis=1)
        line = ndimage.gaussian_filter1d(
            line + away * short[:, None], 1.0 / pitch, axis=0, mode="nearest"
        )
    route = resample(line)
    if points is not None and len(route) < points:
        raise UsageError(f"the route has {len(route)} sample points, asked for are {points}")
    return route[:points]


def _clearest(
    grid: NDArray[np.float32], pitch: float, origin: tuple[float, float], place: Float64
) -> Float64:
    """The place within 10 m that is clearest of buildings, up to `KEEP_CLEAR`."""
    cell = np.rint((np.asarray(place) - origin) / pitch).astype(int)
    reach = round(10.0 / pitch)
    low = np.maximum(cell - reach, 0)
    window = grid[low[0] : cell[0] + reach + 1, low[1] : cell[1] + reach + 1]
    offset = np.indices(window.shape) - (cell - low)[:, None, None]
    merit = np.minimum(window, KEEP_CLEAR[0]) - 0.05 * np.hypot(*offset)
    best = np.array(np.unravel_index(int(np.argmax(merit)), window.shape))
    return np.asarray((low + best) * pitch + origin, np.float64)


def _leg(
    grid: NDArray[np.float32], pitch: float, origin: tuple[float, float], a: Float64, b: Float64
) -> Float64:
    """The cheapest way over the cells of a window around two waypoints."""
    ends = np.rint((np.stack([a, b]) - origin) / pitch).astype(int)
    low = np.maximum(ends.min(axis=0) - round(40 / pitch), 0)
    high = np.minimum(ends.max(axis=0) + round(40 / pitch), grid.shape)
    window = grid[low[0] : high[0], low[1] : high[1]].astype(np.float64)
    near, far = KEEP_CLEAR
    cost = 1 + 3 * np.maximum(near - window, 0) ** 2 / near + np.maximum(window - far, 0) / far
    cost[window < MIN_CLEARANCE + 0.25] = np.inf
    number = np.arange(window.size, dtype=np.int32).reshape(window.shape)  # as csgraph counts
    rows, columns, weights = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here = (slice(0, -dx or None), slice(max(0, -dy), -dy if dy > 0 else None))
        there = (slice(dx, None), slice(max(0, dy), dy if dy < 0 else None))
        weight = (cost[here] + cost[there]) * np.hypot(dx, dy) / 2
        open_ = np.isfinite(weight)
        rows.append(number[here][open_])
        columns.append(number[there][open_])
        weights.append(weight[open_])
    graph = sparse.coo_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(window.size, window.size),
    ).tocsr()
    source, target = (int(number[tuple(np.clip(end - low, 0, high - low - 1))]) for end in ends)
    _, before = csgraph.dijkstra(
        graph, directed=False, indices=np.array(source), return_predecessors=True
    )
    if source != target and before[target] < 0:
        raise UsageError(f"no way of {MIN_CLEARANCE} m clearance from {a} to {b}: move a waypoint")
    cells = [target]
    while cells[-1] != source:
        cells.append(int(before[cells[-1]]))
    at = np.column_stack(np.unravel_index(cells[::-1], window.shape)) + low
    return np.asarray(at * pitch + origin, np.float64)


def resample(line: Float64) -> Float64:
    """Points of a polyline, 1 m of arc length apart, the first one its beginning."""
    line = np.asarray(line, np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    kept = np.concatenate([[True], np.diff(length) > 1e-9])
    curve = CubicSpline(length[kept], line[kept]) if kept.sum() > 3 else None
    for _ in range(3 if curve is not None else 0):
        assert curve is not None
        dense = curve(np.linspace(0.0, length[-1], int(length[-1] * 20) + 2))
        line, length = dense, np.concatenate([[0], np.cumsum(np.hypot(*np.diff(dense, axis=0).T))])
        curve = CubicSpline(length, dense)
    arc = np.arange(0.0, length[-1] + 1e-9)
    kept = np.concatenate([[True], np.diff(length) > 1e-9])
    return np.column_stack([np.interp(arc, length[kept], line[kept, axis]) for axis in (0, 1)])


def clearance(xy: Float64, footprints: Footprints) -> Float64:
    """(k,) exact distance to the nearest building [m], at most 150; 0 inside of one."""
    low, high = xy.min(axis=0) - 150.0, xy.max(axis=0) + 150.0
    footprints = footprints.within((low[0], low[1]), (high[0], high[1]))
    a, along = footprints.start, footprints.end - footprints.start
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    found = np.empty(len(xy))
    for row, place in enumerate(xy):
        near = (np.abs(a - place) < 150.0).all(axis=1)
        apart = place - a[near]
        share = np.clip((apart * along[near]).sum(axis=1) / squared[near], 0.0, 1.0)
        gap = np.hypot(*(apart - share[:, None] * along[near]).T)
        below, above = a[:, 1] - place[1], footprints.end[:, 1] - place[1]
        cut = np.flatnonzero((below <= 0) != (above <= 0))
        at = a[cut, 0] - below[cut] * along[cut, 0] / along[cut, 1]
        turns = np.sign(above[cut] - below[cut])[at < place[0]].sum()
        found[row] = 0.0 if turns else gap.min(initial=150.0)
    return found
