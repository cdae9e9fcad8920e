"""The map from above: the highest point of each pixel, as a pyramid of ever larger pixels."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.grid import MM_PER_M, Box, TileKey
from tilestream.records import Float64, Int64
from tilestream.store import POINTS, TileStore, TileTable

ABOVE_VERSION = 1
"""Raise it when the picture of the same points changes."""
FINEST_MM = 250
"""Edge of the smallest pixels [mm]; those of the next level are twice as wide."""
LEVELS = 8
"""Levels of the pyramid: the last one has pixels of 32 m."""


@dataclass(frozen=True)
class FromAbove:
    """What a map looks like from above, north (map y) up."""

    height: Float64
    """(rows, columns) highest point of each pixel [m], the lowest y first; NaN: no point."""
    corner: tuple[float, float]
    """x and y of the lower left corner [m]."""
    pixel: float
    """Edge of a pixel [m]."""


def above_table() -> TileTable:
    """The pixels of a tile that hold a point: `level`, `column` and `row` (on the lattice of the
    level, from the pixel that holds the tile's corner), `height` of the highest point [mm].

    A pixel across the edge of a tile is in both tables: the higher one counts.
    """
    return TileTable(
        name="above",
        stage="above",
        version=ABOVE_VERSION,
        takes={},
        reach_mm=0,
        make=lambda store, key: _columns(store, key),
    )


def _columns(store: TileStore, key: TileKey) -> dict[str, NDArray[Any]]:
    points = store.tile(key).points_mm()
    x, y, _ = store.grid.origin_mm(key)
    parts: list[tuple[Int64, Int64, Int64]] = []
    column, row, height = points[:, 0] // FINEST_MM, points[:, 1] // FINEST_MM, points[:, 2]
    for _ in range(LEVELS):
        parts.append(_highest(column, row, height))
        column, row, height = parts[-1][0] // 2, parts[-1][1] // 2, parts[-1][2]
    level = np.repeat(np.arange(LEVELS, dtype=np.uint8), [len(part[0]) for part in parts])
    edge = FINEST_MM << level.astype(np.int64)
    column, row, height = (np.concatenate(of) for of in zip(*parts, strict=True))
    return {
        "level": level,
        "column": (column - x // edge).astype(np.int32),
        "row": (row - y // edge).astype(np.int32),
        "height": height.astype(np.int32),
    }


def _highest(column: Int64, row: Int64, height: Int64) -> tuple[Int64, Int64, Int64]:
    """Each pixel once, by row and column, with its greatest height."""
    order = np.lexsort((-height, column, row))
    column, row, height = column[order], row[order], height[order]
    first = np.ones(len(order), np.bool_)
    first[1:] = (column[1:] != column[:-1]) | (row[1:] != row[:-1])
    return column[first], row[first], height[first]


def tiles_around(store: TileStore, tiles: Iterable[TileKey], reach: float) -> list[TileKey]:
    """The tiles that a reach [m] around some tiles touches, sorted; the map may lack some."""
    grown = (store.grid.core(key).grown(round(reach * MM_PER_M)) for key in tiles)
    return sorted({key for box in grown for key in store.grid.keys_over(box)})


def seen_from_above(
    store: TileStore, tiles: Iterable[TileKey], box: Box, most_pixels: int
) -> FromAbove | None:
    """A part of a map from above.

    Args:
        store: the map.
        tiles: its tiles that are shown; those that are not done or not there are empty.
        box: what the picture spans.
        most_pixels: it has the smallest pixels of which no more are needed, at most 32 m.

    Returns:
        The picture; None: no point lies there.
    """
    level, edge = 0, FINEST_MM
    while level < LEVELS - 1 and _size(box, edge)[0] * _size(box, edge)[1] > most_pixels:
        level, edge = level + 1, 2 * edge
    rows, columns = _size(box, edge)
    left, low = box.x_lo // edge, box.y_lo // edge
    height = np.full((rows, columns), np.nan)
    for key, mark in store.marks(POINTS, tiles).items():
        if mark.status != "done":
            continue
        table = store.tile(key).derived(above_table())
        x, y, _ = store.grid.origin_mm(key)
        column, row = table["column"] + x // edge - left, table["row"] + y // edge - low
        shown = (table["level"] == level) & (row >= 0) & (row < rows)
        shown &= (column >= 0) & (column < columns)
        at = row[shown], column[shown]
        height[at] = np.fmax(height[at], table["height"][shown] / MM_PER_M)
    if np.isnan(height).all():
        return None
    return FromAbove(height, (left * edge / MM_PER_M, low * edge / MM_PER_M), edge / MM_PER_M)


def _size(box: Box, edge: int) -> tuple[int, int]:
    """Rows and columns of pixels that a box touches."""
    return (
        (box.y_hi - 1) // edge - box.y_lo // edge + 1,
        (box.x_hi - 1) // edge - box.x_lo // edge + 1,
    )
