"""Triangles with a material: what the city is built of."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.records import Float64, Int64


class Material(IntEnum):
    """What a surface is made of; the order is that of `REFLECTIVITY`."""

    GROUND = 0
    WALL = 1
    GLASS = 2
    METAL = 3
    FOLIAGE = 4
    CAR = 5
    PERSON = 6
    CONCRETE = 7


REFLECTIVITY = np.array([20.0, 45.0, 12.0, 70.0, 35.0, 30.0, 30.0, 40.0])
"""Share of the light that comes back, by material [%]."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles by their corners."""

    corners: Float64
    """(n, 3, 3) corners of each triangle [m]."""
    material: NDArray[np.uint8]
    """(n,) `Material` of each."""

    def __len__(self) -> int:
        return len(self.corners)

    def moved(self, offset: ArrayLike) -> "Mesh":
        """The same, shifted [m]."""
        return Mesh(self.corners + np.asarray(offset, np.float64), self.material)


EMPTY = Mesh(np.empty((0, 3, 3)), np.empty(0, np.uint8))


def joined(parts: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes."""
    if not parts:
        return EMPTY
    return Mesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.material for part in parts]),
    )


def quads(a: Float64, b: Float64, c: Float64, d: Float64, material: int | Int64) -> Mesh:
    """Two triangles for each of n quadrangles a-b-c-d, all (n, 3) [m]."""
    corners = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    kinds = np.broadcast_to(np.asarray(material, np.uint8), len(a))
    return Mesh(corners, np.concatenate([kinds, kinds]))


def walls(start: Float64, end: Float64, low: Float64, high: Float64, material: int | Int64) -> Mesh:
    """Upright rectangles over (n, 2) ground lines from `low` to `high` [m]."""
    return quads(
        np.column_stack([start, low]),
        np.column_stack([end, low]),
        np.column_stack([end, high]),
        np.column_stack([start, high]),
        material,
    )


def boxes(centre: Float64, size: Float64, yaw: Float64, material: int) -> Mesh:
    """Upright boxes.

    Args:
        centre: (n, 3) middle of each one's base [m].
        size: (n, 3) length along its heading, width, height [m].
        yaw: (n,) heading [rad].
        material: of all of them.
    """
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    local = signs[None] * size[:, None, :2]
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    xy = np.stack(
        [
            local[..., 0] * cosine - local[..., 1] * sine,
            local[..., 0] * sine + local[..., 1] * cosine,
        ],
        axis=-1,
    )
    base = np.concatenate([xy, np.zeros((len(xy), 4, 1))], axis=2) + centre[:, None]
    top = base + [0.0, 0.0, 1.0] * size[:, None, 2:]
    sides = [
        quads(base[:, i], base[:, j], top[:, j], top[:, i], material)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    lids = (quads(r[:, 0], r[:, 1], r[:, 2], r[:, 3], material) for r in (top, base))
    return joined([*sides, *lids])


def posts(foot: Float64, radius: Float64, height: Float64, material: int) -> Mesh:
    """Upright prisms of a regular hexagon, open at both ends: posts, trunks, bollards."""
    angle = np.arange(7) * 2 * np.pi / 6
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    xy = foot[:, None, :2] + radius[:, None, None] * ring
    low = np.repeat(foot[:, 2], 6)
    return walls(
        xy[:, :-1].reshape(-1, 2),
        xy[:, 1:].reshape(-1, 2),
        low,
        low + np.repeat(height, 6),
        material,
    )


def leaves(rng: np.random.Generator, centre: Float64, reach: Float64, size: float) -> Mesh:
    """Small triangles at random places within ellipsoids, turned at random: leafy crowns.

    Args:
        rng: the stream of this growth.
        centre: (n, 3) middle of the ellipsoid that each leaf hangs in [m].
        reach: (n, 3) half axes of it [m].
        size: edge of a leaf card [m].
    """
    direction = rng.normal(size=(len(centre), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    place = centre + direction * reach * rng.uniform(0.3, 1.0, (len(centre), 1)) ** 0.5
    corners = place[:, None] + rng.normal(0.0, 0.6 * size, (len(centre), 3, 3))
    return Mesh(corners, np.full(len(centre), Material.FOLIAGE, np.uint8))
