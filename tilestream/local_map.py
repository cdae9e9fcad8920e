"""The cells around some places, listed for a matcher: what all scans there are registered in."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import RegistrationError, UsageError
from tilestream.grid import MM_PER_M
from tilestream.kernels.density import magnusson_constants
from tilestream.kernels.fixed_order import norms
from tilestream.kernels.neighbour_lists import neighbour_lists
from tilestream.kernels.registration import LocalMap
from tilestream.matcher import RegistrationSettings
from tilestream.records import Cells, Float64, Int64

MAX_BUCKETS = 2**27
"""Most buckets of the dense grid around a scan: 4 bytes each, half a gigabyte."""
LISTED_BY = ("neighbours", "covariance", "outlier_ratio")
"""Settings of the matcher on which the lists depend."""


def reach_of(points: Float64, settings: RegistrationSettings, cell_size: float) -> float:
    """How far from a start its registration can look [m]: the radius of the scan, (n, 3) points in
    the lidar frame [m], and the longest path of a start.
    """
    steps = settings.iterations_max * max(settings.step_max, settings.epsilon)
    return float(norms(points).max()) + steps + 2.0 * cell_size


@dataclass(frozen=True, eq=False)
class LocalCells:
    """The cells of a box, on a dense grid. A registration in them has the same bits as in the cells
    of any other box that covers it.
    """

    cells: Cells
    """Those of the map that the box was cut from, and maybe more."""
    settings: RegistrationSettings
    """The matcher that they are listed for (`LISTED_BY`)."""
    low: Float64
    """(3,) lowest voxel of the box …"""
    high: Float64
    """… and highest, both inside."""
    lists: LocalMap
    """What the kernel reads."""
    origin: Int64
    """(3,) origin of the dense grid [buckets of the map's lattice]."""

    @cached_property
    def longest(self) -> int:
        """Most cells that a bucket lists."""
        return int(np.diff(self.lists.first).max())

    @classmethod
    def around(
        cls, cells: Cells, places: Float64, reach: float, settings: RegistrationSettings
    ) -> Self:
        """The cells that scans at some places can reach.

        Args:
            cells: the map around.
            places: (k, 3) where registrations start [m, map frame], k >= 1.
            reach: how far from there they can look [m], `reach_of` the largest scan.
            settings: the matcher.

        Raises:
            RegistrationError: no cell within reach, or a box that is too large.
        """
        low, high = _box(places, reach, cells.cell_size)
        near = _rows_in(cells, low, high)
        if not near.size:
            raise _nothing_near(places, reach)
        return cls(cells, settings, low, high, *_listed(cells, near, settings))

    def require(self, places: Float64, reach: float, settings: RegistrationSettings) -> None:
        """Refuse a registration that these cells are not for.

        Raises:
            UsageError: it can reach beyond the box, or another matcher; says which.
        """
        other = [n for n in LISTED_BY if getattr(settings, n) != getattr(self.settings, n)]
        if other:
            raise UsageError(f"the cells are listed for another matcher: {', '.join(other)} differ")
        low, high = _box(places, reach, self.cells.cell_size)
        if (low < self.low).any() or (high > self.high).any():
            raise UsageError(f"a registration can reach {reach:.0f} m, beyond the cells' box")

    def require_near(self, places: Float64, reach: float) -> None:
        """RegistrationError: no cell within reach of the places."""
        if not _rows_in(self.cells, *_box(places, reach, self.cells.cell_size)).size:
            raise _nothing_near(places, reach)


def _box(places: Float64, reach: float, size: float) -> tuple[Float64, Float64]:
    """Lowest and highest voxel within reach of places."""
    low, high = places.min(axis=0) - reach, places.max(axis=0) + reach
    return np.floor(low / size), np.floor(high / size)


def _rows_in(cells: Cells, low: Float64, high: Float64) -> NDArray[np.intp]:
    return np.flatnonzero(((cells.index >= low) & (cells.index <= high)).all(axis=1))


def _nothing_near(places: Float64, reach: float) -> RegistrationError:
    place = ", ".join(f"{c:.1f}" for c in places.mean(axis=0))
    return RegistrationError(
        f"no cells within {reach:.0f} m of the starts around ({place}): "
        "the scan lies outside the map, or its pose is in another frame"
    )


def _listed(
    cells: Cells, near: NDArray[np.intp], settings: RegistrationSettings
) -> tuple[LocalMap, Int64]:
    """The rows `near` of the cells on a dense grid, and its origin."""
    size = cells.cell_size
    halves, span = (2, 3) if settings.neighbours == "radius" else (1, 1)
    span = 0 if settings.neighbours == "direct1" else span
    index, mean = cells.index[near], cells.mean[near]
    low = index.min(axis=0) * halves - span - 1
    shape = index.max(axis=0) * halves - low + span + 2
    if math.prod(shape.tolist()) > MAX_BUCKETS:
        raise RegistrationError(
            f"the scan and its starts span {shape} voxels of {size / halves:g} m: "
            "register fewer starts at once, or use larger cells"
        )
    offset = mean - index * cells.cell_mm / MM_PER_M
    reach = size if settings.neighbours == "radius" else 0.0
    edge = size / halves
    d1, d2 = magnusson_constants(size, settings.outlier_ratio)
    inverse = _inverse_covariance(cells, near, settings) * (0.5 * d2 * math.log2(math.e))
    upper = np.triu_indices(3)
    table = np.column_stack([offset, inverse[:, upper[0], upper[1]]]).astype(np.float32)
    first, cell, shift = neighbour_lists(
        index * halves - low, offset / edge, shape, span, reach / edge
    )
    return LocalMap(shape, edge, first, cell, shift, table, reach, d1), low


def _inverse_covariance(
    cells: Cells, rows: NDArray[np.intp], settings: RegistrationSettings
) -> Float64:
    """(m, 3, 3) inverse covariances of the density [1/m^2]."""
    if settings.covariance == "regularised":
        return cells.precision[rows]
    seed = 1.0 / np.maximum(cells.count[rows] - 1, 1)
    values = cells.eigenvalues[rows] + seed[:, None]
    values = np.maximum(values, 0.01 * values[:, :1])
    vectors = cells.eigenvectors[rows]
    inverse: Float64 = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return inverse
