"""What is drawn of a run on the map of the dashboard: its relief and its estimates, within bounds.

Plain state without Dask or Bokeh: the client sends it, the scheduler keeps it, pages show it.
"""

import zlib
from array import array
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.grid import MM_PER_M
from tilestream.records import Float64, Int64

MOST_MARKS = 4_000
"""Places that are kept and drawn: a browser stays swift, and a screen has no room for more."""
FINEST = 1.0
"""Edge of the squares of the ground of which the worst place is kept, at first [m]; it doubles
until no more than `MOST_MARKS` are left."""
BLOCK = 128
"""Pixels of an edge of the squares that the relief is drawn in: a browser is slow to begin with ten
thousand pictures of tiles, and has a few dozen of these at once."""


@dataclass(frozen=True)
class Patch:
    """The relief of a tile."""

    x: float
    """Lower left corner [m, map frame], on the lattice of pixels."""
    y: float
    pixel: float
    """Edge of a pixel [m]."""
    shades: NDArray[np.uint8]
    """(rows, columns) how opaque the grey of `report.relief` is, the lowest y first."""

    def message(self) -> list[Any]:
        """As it is sent."""
        packed = zlib.compress(self.shades.tobytes())
        return [self.x, self.y, self.pixel, *self.shades.shape, packed]

    @classmethod
    def of(cls, message: list[Any]) -> Self:
        """As it was sent."""
        x, y, pixel, rows, columns, packed = message
        shades = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(rows, columns)
        return cls(x, y, pixel, shades)


@dataclass
class MapView:
    """The map of a run as it is drawn."""

    tile_mm: int | None = None
    """Edge of a tile [mm]; None: not known, and the tiles are drawn by their numbers."""
    crs: str | None = None
    """Name of its CRS; None: a local frame."""
    blocks: list[Patch] = field(default_factory=list)
    """The relief, in squares of `BLOCK` pixels; clear (zero) where none is known."""
    changes: "array[int]" = field(default_factory=lambda: array("q"))
    """Places in `blocks` of those that changed, as they did."""
    relief_tiles: int = 0
    """How many tiles have a relief."""
    marks: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    """(n, 3) x and y [m] and the estimate [m] of places, NaN where there is none."""
    square: float = FINEST
    """Edge of the squares of which the worst place is kept [m]."""
    places: int = 0
    """How many places have been estimated, or cannot be."""
    _blocks: dict[tuple[float, int, int], int] = field(default_factory=dict)

    def draw(self, message: dict[str, Any]) -> None:
        """Take what a client has sent of a tile: its `patch`, or its `marks` and how many `places`
        it has.
        """
        if "patch" in message:
            self._paste(Patch.of(message["patch"]))
        else:
            fresh = np.frombuffer(message["marks"], np.float64).reshape(-1, 3)
            whole = np.concatenate([self.marks, fresh])
            self.marks, self.square = thinned(whole, MOST_MARKS, self.square)
            self.places += message["places"]

    def box(self, tile: tuple[int, int]) -> tuple[float, float, float]:
        """Centre of a tile, x and y, and its edge [m; without a map its number, and 1]."""
        edge = 1.0 if self.tile_mm is None else self.tile_mm / MM_PER_M
        return (tile[0] + 0.5) * edge, (tile[1] + 0.5) * edge, edge

    def facts(self) -> dict[str, Any]:
        """The map for machines."""
        return {
            "tile_m": None if self.tile_mm is None else self.tile_mm / MM_PER_M,
            "crs": self.crs,
            "relief_tiles": self.relief_tiles,
            "places": self.places,
            "places_kept": len(self.marks),
            "worst_of_squares_m": self.square,
        }

    def _paste(self, patch: Patch) -> None:
        """Take a patch into the blocks that it touches."""
        self.relief_tiles += 1
        column, row = round(patch.x / patch.pixel), round(patch.y / patch.pixel)
        rows, columns = patch.shades.shape
        for down in range(row // BLOCK, (row + rows - 1) // BLOCK + 1):
            for across in range(column // BLOCK, (column + columns - 1) // BLOCK + 1):
                low, left = down * BLOCK - row, across * BLOCK - column  # of the block in the patch
                part = patch.shades[max(0, low) : low + BLOCK, max(0, left) : left + BLOCK]
                number = self._block(patch.pixel, across, down)
                top, right = max(0, -low) + part.shape[0], max(0, -left) + part.shape[1]
                self.blocks[number].shades[max(0, -low) : top, max(0, -left) : right] = part
                self.changes.append(number)

    def _block(self, pixel: float, across: int, down: int) -> int:
        """Number of a block, which is clear at first."""
        key = pixel, across, down
        if key not in self._blocks:
            self._blocks[key] = len(self.blocks)
            edge, clear = BLOCK * pixel, np.zeros((BLOCK, BLOCK), np.uint8)
            self.blocks.append(Patch(across * edge, down * edge, pixel, clear))
        return self._blocks[key]

    def mark_facts(self) -> list[dict[str, float | None]]:
        """The places that are drawn."""
        return [
            {"x": x, "y": y, "estimate": None if np.isnan(error) else error}
            for x, y, error in self.marks.tolist()
        ]


def thinned(places: Float64, most: int, square: float) -> tuple[Float64, float]:
    """At most so many places: of those in one square of the ground the worst.

    Args:
        places: (n, 3) x, y and an error [m]; NaN, none, is less than any.
        most: how many may be left.
        square: edge of the squares to begin with [m]; it doubles as long as too many are left.

    Returns:
        The places that are left, and the edge that it took [m].
    """
    while len(places) > most:
        kept = places[worst_of_squares(places, square)]
        if len(kept) <= most:
            return kept, square
        places, square = kept, 2.0 * square
    return places, square


def worst_of_squares(places: Float64, square: float) -> Int64:
    """Rows of the place with the largest error of each square of the ground, ascending; arguments
    as of `thinned`.
    """
    column, row = places[:, :2].T // square
    order = np.lexsort((-np.nan_to_num(places[:, 2], nan=-1.0), row, column))
    first = np.ones(len(order), np.bool_)
    first[1:] = (np.diff(column[order]) != 0) | (np.diff(row[order]) != 0)
    return np.sort(order[first])
