"""Geometry of tiles: keys, core and halo boxes, tile-local origins, all in whole millimetres.

A tile is a square column of the map: its core box [ix, ix + 1) x [iy, iy + 1) times the tile size,
without limits in z. The lattice origin is the map's origin (0, 0, 0), so that a voxel index is the
floor division of millimetres by the edge, the same for any tiling (definitions, section 1).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import UsageError

MM_PER_M = 1000
MAX_XY_MM = 100_000_000 * MM_PER_M
"""Largest |x| or |y| of a map point [mm]: 100,000 km, beyond any projected CRS."""
MAX_Z_MM = 1_000_000 * MM_PER_M
"""Largest |z| of a map point [mm]: 1,000 km, so that z fits an int32 of millimetres."""
MAX_TILE_MM = 1_000_000 * MM_PER_M
"""Largest tile size [mm]: 1,000 km, so that a point in a tile or its halo fits an int32."""


def whole_mm(length_m: float, name: str) -> int:
    """The length in millimetres, exactly.

    Args:
        length_m: a length [m].
        name: what the length is called in the error message.

    Raises:
        UsageError: it is not a whole number of millimetres, or not finite.
    """
    try:
        mm = round(length_m * MM_PER_M)
    except (OverflowError, ValueError):
        raise UsageError(f"{name} is {length_m!r}: give a finite length in metres") from None
    if abs(mm - length_m * MM_PER_M) > 1e-6:
        raise UsageError(
            f"{name} is {length_m!r} m: give whole millimetres, e.g. {mm / MM_PER_M:g} m"
        )
    return mm


class TileKey(NamedTuple):
    """Address of a tile: its column and row on the lattice of tiles. Prints as `12_-3`."""

    ix: int
    iy: int

    def __str__(self) -> str:
        return f"{self.ix}_{self.iy}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """The key that prints as `text`.

        Raises:
            UsageError: `text` is not of the form `12_-3`.
        """
        try:
            ix, iy = (int(part) for part in text.split("_"))
        except ValueError:
            raise UsageError(f"{text!r} is no tile key: expected a form like 12_-3") from None
        key = cls(ix, iy)
        if str(key) != text:
            raise UsageError(f"{text!r} is no tile key: expected a form like {key}")
        return key


@dataclass(frozen=True)
class Box:
    """A half-open box in the map's xy plane: lo <= (x, y) < hi, in whole millimetres."""

    x_lo: int
    y_lo: int
    x_hi: int
    y_hi: int

    @classmethod
    def around(cls, places: NDArray[np.float64], reach: float) -> Self:
        """The smallest box with all (k, 2 or 3) places and `reach` metres around each, rim included
        [m].
        """
        low = np.floor((places[:, :2].min(axis=0) - reach) * MM_PER_M).astype(int)
        high = np.ceil((places[:, :2].max(axis=0) + reach) * MM_PER_M).astype(int) + 1
        return cls(*low.tolist(), *high.tolist())

    def holds(self, points_mm: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(n,) which of the (n, 2 or 3) points lie in it [mm]."""
        x, y = points_mm[:, 0], points_mm[:, 1]
        inside: NDArray[np.bool_] = (
            (x >= self.x_lo) & (x < self.x_hi) & (y >= self.y_lo) & (y < self.y_hi)
        )
        return inside

    def grown(self, margin_mm: int) -> "Box":
        """The box with `margin_mm` added on each side."""
        return Box(
            self.x_lo - margin_mm,
            self.y_lo - margin_mm,
            self.x_hi + margin_mm,
            self.y_hi + margin_mm,
        )


@dataclass(frozen=True)
class TileGrid:
    """The lattice of tiles of one store."""

    tile_mm: int
    """Edge of a tile [mm]."""
    halo_mm: int
    """Width of the map around a tile that tasks read too [mm]."""

    def __post_init__(self) -> None:
        if not 0 < self.tile_mm <= MAX_TILE_MM:
            raise UsageError(
                f"tile_size is {self.tile_mm / MM_PER_M:g} m: "
                f"give more than 0 and at most {MAX_TILE_MM // MM_PER_M} m"
            )
        if not 0 <= self.halo_mm <= MAX_TILE_MM:
            raise UsageError(
                f"halo is {self.halo_mm / MM_PER_M:g} m: "
                f"give at least 0 and at most {MAX_TILE_MM // MM_PER_M} m"
            )

    @classmethod
    def of(cls, tile_size: float, halo: float) -> Self:
        """The grid for a tile size and a halo in metres (whole millimetres both)."""
        return cls(whole_mm(tile_size, "tile_size"), whole_mm(halo, "halo"))

    def key_at(self, x: float, y: float) -> TileKey:
        """The tile whose core holds the point (x, y) [m, map frame], rounded to 1 mm.

        Raises:
            UsageError: a coordinate is not finite.
        """
        try:
            x_mm, y_mm = round(x * MM_PER_M), round(y * MM_PER_M)
        except (OverflowError, ValueError):
            raise UsageError(f"({x!r}, {y!r}) is no place in the map: give finite metres") from None
        return TileKey(x_mm // self.tile_mm, y_mm // self.tile_mm)

    def origin_mm(self, key: TileKey) -> tuple[int, int, int]:
        """The tile-local origin [mm, map frame]: the core's lower corner at z = 0."""
        return key.ix * self.tile_mm, key.iy * self.tile_mm, 0

    def core(self, key: TileKey) -> Box:
        """The box [mm, map frame] of the points that belong to the tile."""
        x, y, _ = self.origin_mm(key)
        return Box(x, y, x + self.tile_mm, y + self.tile_mm)

    def halo_box(self, key: TileKey) -> Box:
        """The core with the halo around it."""
        return self.core(key).grown(self.halo_mm)

    def keys_over(self, box: Box) -> Iterator[TileKey]:
        """The tiles whose cores the box touches, x slowest; none for an empty box."""
        if box.x_lo >= box.x_hi or box.y_lo >= box.y_hi:
            return
        for ix in range(box.x_lo // self.tile_mm, (box.x_hi - 1) // self.tile_mm + 1):
            for iy in range(box.y_lo // self.tile_mm, (box.y_hi - 1) // self.tile_mm + 1):
                yield TileKey(ix, iy)

    def require_cell_size(self, cell_mm: int) -> None:
        """Check that the tile size is an integer multiple of a cell size [mm].

        Raises:
            UsageError: names the nearest tile sizes and cell sizes that work.
        """
        if cell_mm <= 0:
            raise UsageError(f"cell_size is {cell_mm / MM_PER_M:g} m: give more than 0")
        if self.tile_mm % cell_mm == 0:
            return
        below, above = (self.tile_mm // cell_mm) * cell_mm, (self.tile_mm // cell_mm + 1) * cell_mm
        tiles = " or ".join(f"{t / MM_PER_M:g} m" for t in (below, above) if t > 0)
        divisors = sorted(
            {
                d
                for i in range(1, int(self.tile_mm**0.5) + 1)
                if self.tile_mm % i == 0
                for d in (i, self.tile_mm // i)
            },
            key=lambda d: (abs(d - cell_mm), d),
        )
        cells = " or ".join(f"{d / MM_PER_M:g} m" for d in sorted(divisors[:2]))
        raise UsageError(
            f"cell_size {cell_mm / MM_PER_M:g} m does not divide the tile size "
            f"{self.tile_mm / MM_PER_M:g} m: use a cell size of {cells}, "
            f"or a store with tiles of {tiles}"
        )
