"""The map as a plan sees it: the tables of its tiles, those that are there and those to be made."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tilestream.factors.surfels import surfel_mm, surfels_table
from tilestream.factors.terms import terms_table
from tilestream.from_above import above_table
from tilestream.grid import Box, TileKey
from tilestream.marks import Mark, hash_of
from tilestream.pipeline.engine.outputs import TileArrays
from tilestream.pipeline.engine.stage import Stage, Task
from tilestream.pipeline.stages.above import above
from tilestream.pipeline.stages.cells import cells
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.pipeline.stages.surfels import surfels
from tilestream.pipeline.stages.terms import terms
from tilestream.records import Float64
from tilestream.store import TileStore, TileTable, cells_table

EXPECTED_DENSITY = 100
"""Points per square metre that a thinned tile is expected to keep, before it is merged: more than
any road at 0.2 m [1/m^2]. What a task really reads is checked when it runs."""


@dataclass(frozen=True, slots=True)
class TilePoints:
    """The points of a tile, as they are or will be."""

    identity: str
    maker: str
    """Key of the task that merges them; empty: they are there."""
    count: int
    """How many, or how many are expected."""


def apart(plan: "MapPlan", places: Float64, reach: float) -> str:
    """That a map has nothing within a reach [m] of (n, 2) places: where both are, what to do."""
    (left, low), (right, high) = places.min(axis=0), places.max(axis=0)
    extents = [(left, right, low, high), plan.extent()]
    here, there = ("x {:.0f} to {:.0f}, y {:.0f} to {:.0f} m".format(*one) for one in extents)
    return (
        f"lies at {here}, and the map {plan.store.url} at {there}: no tile within {reach:g} m; "
        "is it in another CRS, or in another frame than the map?"
    )


class MapPlan:
    """What a map's tiles have or will have, and the tasks that make it, each of them once."""

    def __init__(self, store: TileStore, points: Mapping[TileKey, TilePoints]) -> None:
        """A map.

        Args:
            store: where it is.
            points: the points of all its tiles.
        """
        self.store = store
        self.points = points
        self.tasks: dict[str, Task] = {}
        """By key, each after those that it needs."""
        self._own = {key: key for key in points}  # a plan of a city has each key a hundred times
        self._state = hash_of([(str(key), tile.identity) for key, tile in sorted(points.items())])

    @classmethod
    def of_store(cls, store: TileStore, *, partial: bool = False) -> "MapPlan":
        """A map that is there.

        Args:
            store: where it is.
            partial: also one that is half-made or has lost tiles; what could see those says so.

        Raises:
            IncompleteError: it is not whole, and not `partial`.
        """
        condition = store.condition()
        if not partial:
            condition.require_whole()
        done = {key: mark for key, mark in condition.marks.items() if mark.status == "done"}
        return cls.of_merges(store, (), done)

    @classmethod
    def of_merges(
        cls, store: TileStore, merges: Iterable[Task], written: Mapping[TileKey, Mark]
    ) -> "MapPlan":
        """A map some of whose tiles are merged by these tasks; the others are written."""
        area = (store.settings.tile_size) ** 2
        most = EXPECTED_DENSITY * area if store.settings.map_leaf else float("inf")
        points = {k: TilePoints(m.identity, "", m.facts["points"]) for k, m in written.items()}
        points |= {
            task.tile: TilePoints(task.identity, task.key, int(min(task.counts["points"], most)))
            for task in merges
            if task.tile is not None
        }
        return cls(store, points)

    def over(self, box: Box) -> list[TileKey]:
        """The tiles of the map that a box touches, sorted."""
        return [key for key in self.store.grid.keys_over(box) if key in self.points]

    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y of its tiles [m]; NaN: it has none."""
        if not self.points:
            return np.nan, np.nan, np.nan, np.nan
        keys, size = np.array(list(self.points)), self.store.settings.tile_size
        (left, low), (right, high) = keys.min(axis=0) * size, (keys.max(axis=0) + 1) * size
        return float(left), float(right), float(low), float(high)

    def cells(self, key: TileKey, cell_mm: int) -> Task:
        """The task that makes the cells of a tile."""
        return self._made(cells, cells_table(cell_mm), f"{cell_mm}-{key}", key)

    def terms(self, key: TileKey, cell_mm: int) -> Task:
        """The task that makes the terms of a tile's cells."""
        name, near = f"{cell_mm}-{key}", partial(self.cells, cell_mm=cell_mm)
        return self._made(terms, terms_table(cell_mm), name, key, near)

    def surfels(self, key: TileKey) -> Task:
        """The task that makes the surfels of a tile."""
        return self._made(surfels, surfels_table(surfel_mm(self.store)), str(key), key)

    def above(self, key: TileKey) -> Task:
        """The task that makes the picture of a tile from above."""
        return self._made(above, above_table(), str(key), key)

    def part(self, keys: Sequence[TileKey], made: Sequence[Task]) -> MapPart:
        """Some tiles as a task reads them.

        Args:
            keys: the tiles.
            made: the tasks that make what is read of them; none: their points are read.
        """
        points = [self.points[key] for key in keys]
        inputs = [(str(task.tile), task.identity) for task in made]
        inputs = inputs or [(str(k), p.identity) for k, p in zip(keys, points, strict=True)]
        makers = [task.key for task in made] or [p.maker for p in points if p.maker]
        own = tuple(self._own[key] for key in keys)
        return MapPart(self.store.url, own, hash_of(inputs), tuple(makers), self._state)

    def count(self, keys: Iterable[TileKey]) -> int:
        """The points of some tiles, as they are or are expected."""
        return sum(self.points[key].count for key in keys)

    def largest(self, keys: Iterable[TileKey]) -> int:
        """The points of the largest of some tiles."""
        return max((self.points[key].count for key in keys), default=0)

    def _made(
        self,
        stage: Stage,
        table: TileTable,
        name: str,
        key: TileKey,
        near: Callable[[TileKey], Task] | None = None,
    ) -> Task:
        """The task that makes a table of a tile, once.

        Args:
            stage: what makes it.
            table: which one.
            name: of the task.
            key: the tile.
            near: the task that makes what is read of a tile in reach; None: its points are read.
        """
        known = self.tasks.get(f"{stage.name}-{name}")
        if known is not None:
            return known
        keys = table.tiles(self.store.grid, key, self.points)
        part = self.part(keys, [] if near is None else [near(k) for k in keys])
        task = Task(
            stage,
            name,
            TileArrays(self.store.url, key, table.name),
            takes={**table.takes, "tile": key},
            reads={"map_part": replace(part, core=key)},
            counts={"points": self.count(keys), "core": self.points[key].count},
            tile=key,
        )
        self.tasks[task.key] = task
        return task
