"""A scene: the surfels around some places, indexed for ray casting (definitions, section 4.3)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.surfels import Surfels
from tilestream.kernels.surfels import NORMAL_ONE
from tilestream.kernels.virtual_scan import (
    BRICK,
    FREE,
    VOXELS,
    Bricks,
    bound_bricks,
    fill_bricks,
    mark_bricks,
)
from tilestream.records import Int64

COLUMN_MM = 10_000
"""Edge of the columns that tell where the map has anything [mm]."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The surfels around some places, indexed for ray casting."""

    bricks: Bricks
    """Index of the surfels by voxel."""
    mapped: NDArray[np.bool_]
    """(nx, ny) columns of 10 m that hold any of the map in view."""
    mapped_corner: Int64
    """(2,) their lowest corner [mm, map frame]."""
    column: NDArray[np.intp]
    """(n,) in which of these columns each surfel lies."""

    @classmethod
    def of(cls, surfels: Surfels, places_mm: Int64, edge_mm: int) -> "Scene":
        """The scene of surfels for scans from some places.

        Args:
            surfels: all that can be seen from the places; at least one.
            places_mm: (k, 3) the places [mm, map frame], k >= 1.
            edge_mm: edge of the voxels of the surfels [mm].
        """
        size = BRICK * edge_mm
        low = np.minimum(surfels.centre_mm.min(axis=0), places_mm.min(axis=0))
        high = np.maximum(surfels.centre_mm.max(axis=0), places_mm.max(axis=0))
        corner = (low // size - 1) * size
        shape = (high - corner) // size + 2
        table = np.zeros((len(surfels), 8), np.float32)
        table[:, :3] = surfels.centre_mm - corner
        table[:, 3:6] = surfels.normal / NORMAL_ONE
        table[:, 6] = surfels.radius_mm
        grid = np.full(tuple(shape), FREE, np.int32)
        voxels = np.full((mark_bricks(table, edge_mm, grid), VOXELS), FREE, np.int32)
        fill_bricks(table, edge_mm, grid, voxels)
        bounds = bound_bricks(edge_mm, grid, voxels)
        none = np.zeros(len(surfels), np.bool_)
        bricks = Bricks(edge_mm, corner, grid, voxels, bounds, table, none)
        column = surfels.centre_mm[:, :2] // COLUMN_MM
        mapped_low = column.min(axis=0)
        in_columns = tuple((column - mapped_low).T)
        mapped = np.zeros(tuple(column.max(axis=0) - mapped_low + 1), np.bool_)
        mapped[in_columns] = True
        flat = np.ravel_multi_index(in_columns, mapped.shape)
        return cls(bricks, mapped, mapped_low * COLUMN_MM, flat)

    def seen_from(self, in_view: NDArray[np.bool_]) -> "Scene":
        """The same scene for a place that has only some of its surfels (n,) in view: what is mapped
        there must not depend on the other places.
        """
        mapped = np.zeros_like(self.mapped)
        mapped.flat[self.column[in_view]] = True
        return replace(self, mapped=mapped)

    def without(self, gone: NDArray[np.bool_]) -> "Scene":
        """The same scene, some of its surfels (n,) left out."""
        return replace(self, bricks=self.bricks._replace(gone=gone))
