"""The ground: gentle slopes, a crown on the road, pavements behind curbs."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import ndimage

from tilestream.records import Float64
from tilestream.simulation.free_space import FreeSpace
from tilestream.simulation.mesh import Material, Mesh, joined, quads
from tilestream.simulation.settings import SimulationSettings, stream
from tilestream.simulation.streets import Street

CURB = 0.15
"""Height of a pavement above the road [m]."""
CROWN = 0.02
"""Fall of the road from its middle to the curb, m per m."""
BLOCK, FINE = 4.0, 0.5
"""Edges of the ground's triangles where it is even, and where a curb runs [m]."""
BARE_HALF_WIDTH = 6.0
"""Half width of the strip along routes that has no curb in a tunnel [m]."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Height of the ground at any place."""

    space: FreeSpace
    """Distance to buildings."""
    pavement: Float64
    """(nx, ny) width of the pavement before the nearest building [m], on the raster of `space`."""
    waves: Float64
    """(k, 4) amplitude [m], wave numbers in x and y [1/m], phase of the slopes."""

    @classmethod
    def of(
        cls, space: FreeSpace, streets: tuple[Street, ...], settings: SimulationSettings
    ) -> Self:
        """The ground of a city: no pavement in streets less than 8 m wide, else up to 4.5 m."""
        step = 8
        coarse = space.distance[::step, ::step]
        width = ndimage.maximum_filter(coarse, size=round(28.0 / (step * space.cell)) | 1)
        half = np.kron(width, np.ones((step, step), np.float32))
        half = half[: space.distance.shape[0], : space.distance.shape[1]]
        pavement = np.where(half < 4.0, 0.0, np.clip(0.3 * half, 1.2, 4.5))
        for street in streets:
            for spot in street.spots_of("tunnel"):
                xy = street.at(np.arange(spot.begin - 2, spot.end + 3, 1.0))
                for row, column in np.rint((xy - space.origin) / space.cell).astype(int):
                    reach = round(BARE_HALF_WIDTH / space.cell)
                    pavement[
                        max(row - reach, 0) : row + reach + 1,
                        max(column - reach, 0) : column + reach + 1,
                    ] = 0.0
        rng = stream(settings.seed, "slope")
        length = rng.uniform(400.0, 1200.0, 4)
        angle, phase = rng.uniform(0.0, 2 * np.pi, (2, 4))
        number = 2 * np.pi / length
        amplitude = settings.city.slope / 4 / number
        waves = np.column_stack([amplitude, number * np.cos(angle), number * np.sin(angle), phase])
        return cls(space, np.asarray(pavement, np.float64), waves)

    def slope(self, xy: Float64) -> Float64:
        """(k,) height of the land without road and pavement [m]."""
        height = np.zeros(len(xy))
        for amplitude, kx, ky, phase in self.waves:
            height += amplitude * np.sin(xy[:, 0] * kx + xy[:, 1] * ky + phase)
        return height

    def at(self, xy: Float64) -> Float64:
        """(k,) height of the ground [m]: land, crown of the road, curb."""
        xy = np.asarray(xy, np.float64)
        gap = self.space.at(xy)
        cell = np.rint((xy - self.space.origin) / self.space.cell).astype(int)
        limit = np.array(self.pavement.shape) - 1
        width = self.pavement[tuple(np.clip(cell, 0, limit).T)]
        on_pavement = gap < width
        crown = CROWN * np.clip(gap - width, 0.0, 5.0)
        return self.slope(xy) + np.where(on_pavement, CURB, crown)

    def mesh(self, low: Float64, high: Float64) -> Mesh:
        """The ground of a box: coarse where it is even, fine where a curb or crown runs."""
        corner = np.floor(low / BLOCK) * BLOCK
        count = np.ceil((high - corner) / BLOCK).astype(int)
        index = np.indices(tuple(count)).reshape(2, -1).T
        base = corner + index * BLOCK
        gap = self.space.at(base + BLOCK / 2)
        open_ = gap > 0.0
        fine = open_ & (gap < 20.0)
        parts = [self._patches(base[~fine & (gap > 0)], BLOCK)]
        steps = np.arange(0.0, BLOCK, FINE)
        offset = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        # Blocks whose centre is inside a building still need ground where their edge is a street.
        border = ~open_ & (self.space.at(base) + self.space.at(base + BLOCK) > 0)
        cells = (base[fine | border][:, None] + offset).reshape(-1, 2)
        parts.append(self._patches(cells[self.space.at(cells + FINE / 2) > 0], FINE))
        return joined(parts)

    def _patches(self, base: Float64, edge: float) -> Mesh:
        at = [base + np.array(c) * edge for c in ((0, 0), (1, 0), (1, 1), (0, 1))]
        ring = [np.column_stack([xy, self.at(xy)]) for xy in at]
        return quads(ring[0], ring[1], ring[2], ring[3], Material.GROUND)
