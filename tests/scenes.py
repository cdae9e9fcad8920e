"""Seeded street scenes: (n, 3) float64 points in whole millimetres, a sampled surface at a time.

Every surface is sampled on a jittered grid with a centimetre of noise, as a mobile mapping system
leaves it, so that no scene owes its figures to a lattice.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rng = np.random.Generator

NOISE = 0.01
UTM = (370_000.0, 3_950_000.0, 0.0)
"""An offset of the size of UTM coordinates [m]; a multiple of every lattice in use."""


# --- Surfaces


def jittered(rng: Rng, length: float, width: float, spacing: float) -> tuple[Floats, Floats]:
    """Coordinates (a, b) over length x width, about one per `spacing` squared."""
    rows, columns = (max(1, round(side / spacing)) for side in (length, width))
    a, b = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    jitter = rng.uniform(0.05, 0.95, (2, rows, columns))
    return ((a + jitter[0]) * length / rows).ravel(), ((b + jitter[1]) * width / columns).ravel()


def noisy(rng: Rng, points: Floats) -> Floats:
    return points + rng.normal(0.0, NOISE, points.shape)


def ground(rng: Rng, length: float, width: float, spacing: float, road: float = 8.0) -> Floats:
    """A street along x from 0, centred on y = 0: a crown of 2 %, curbs of 15 cm, sidewalks."""
    x, y = jittered(rng, length, width, spacing)
    y -= width / 2
    off_crown = np.minimum(np.abs(y), road / 2)
    z = 0.02 * (road / 2 - off_crown) + np.where(np.abs(y) > road / 2, 0.15, 0.0)
    return noisy(rng, np.column_stack([x, y, z]))


def facade(
    rng: Rng,
    start: tuple[float, float],
    end: tuple[float, float],
    height: float,
    spacing: float,
    bay: float = 3.0,
) -> Floats:
    """A wall from start to end: windows set back 25 cm in every bay and storey, a cornice."""
    along = np.subtract(end, start)
    length = float(np.hypot(*along))
    along = along / length
    inward = np.array([-along[1], along[0]])
    a, z = jittered(rng, length, height, spacing)
    window = (np.abs(a % bay - bay / 2) < bay / 5) & (np.abs(z % 3.0 - 1.6) < 0.7)
    depth = np.where(window, 0.25, 0.0) - np.where(height - z < 0.6, 0.4, 0.0)
    xy = np.array(start) + a[:, None] * along + depth[:, None] * inward
    return noisy(rng, np.column_stack([xy, z]))


def pole(
    rng: Rng, x: float, y: float, height: float, spacing: float, radius: float = 0.1
) -> Floats:
    """A lamp post; at least four points a ring, so that even a coarse map has cells of it."""
    count = max(4, round(2 * np.pi * radius / spacing)) * max(1, round(height / spacing))
    turn, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, height, count)
    return noisy(rng, np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn), z]))


def ball(rng: Rng, centre: Floats, radius: float, spacing: float) -> Floats:
    """Foliage: a ball filled evenly."""
    count = round(4 / 3 * np.pi * radius**3 / spacing**3)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return centre + direction * radius * rng.uniform(0, 1, (count, 1)) ** (1 / 3)


def tree(rng: Rng, x: float, y: float, spacing: float, crown: float = 1.6) -> Floats:
    """A trunk and a crown."""
    foliage = ball(rng, np.array([x, y, 2.0 + crown]), crown, 1.6 * spacing)
    return np.vstack([pole(rng, x, y, 2.2, spacing, 0.15), foliage])


def hedge(rng: Rng, start: tuple[float, float], length: float, spacing: float) -> Floats:
    """A hedge along x, 0.8 m wide and 1.2 m high, filled."""
    count = round(length * 0.8 * 1.2 / (1.4 * spacing) ** 3)
    low, high = (*start, 0.1), (start[0] + length, start[1] + 0.8, 1.3)
    return rng.uniform(low, high, (count, 3))


def vault(rng: Rng, length: float, spacing: float, half_width: float = 4.5) -> Floats:
    """The inside of a tunnel along x from 0: walls of 3 m under half a cylinder."""
    wall, arc = 3.0, np.pi * half_width
    x, s = jittered(rng, length, 2 * wall + arc, spacing)
    turn = np.clip((s - wall) / half_width, 0.0, np.pi)
    z = np.where(s < wall, s, np.where(s > wall + arc, 2 * wall + arc - s, wall))
    y = half_width * np.cos(turn)
    return noisy(rng, np.column_stack([x, y, z + half_width * np.sin(turn)]))


def turned(points: Floats, angle: float, about: tuple[float, float]) -> Floats:
    """The points turned about a vertical axis."""
    c, s = np.cos(angle), np.sin(angle)
    centre = np.array([*about, 0.0])
    return (points - centre) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + centre


# --- Places: each about size x size, from x = 0, centred on y = 0


def canyon(rng: Rng, size: float, spacing: float) -> Floats:
    """A street between facades, with lamp posts."""
    half, height = min(8.0, size / 2), size / 2
    parts = [
        ground(rng, size, 2 * half, spacing),
        facade(rng, (0, half), (size, half), height, spacing),
        facade(rng, (size, -half), (0, -half), 0.7 * height, spacing, bay=4.0),
    ]
    parts += [pole(rng, x, 5.0, 6.0, spacing) for x in np.arange(3.0, size, 9.0)]
    return np.vstack(parts)


def diagonal(rng: Rng, size: float, spacing: float) -> Floats:
    """The canyon at 45 degrees to the map's axes, where the sign of a normal is a tie."""
    return turned(canyon(rng, size, spacing), np.pi / 4, (size / 2, 0.0))


def crossing(rng: Rng, size: float, spacing: float) -> Floats:
    """A wide crossing: four corner buildings set far back, a traffic light at each."""
    far = 0.35 * size
    parts = [ground(rng, size, size, spacing)]
    for turn in range(4):
        corner = np.vstack(
            [
                facade(rng, (0, far), (size / 2 - far, far), size / 3, spacing),
                facade(rng, (size / 2 - far, far), (size / 2 - far, size / 2), size / 3, spacing),
                pole(rng, size / 2 - far, far - 1.0, 5.0, spacing),
            ]
        )
        parts.append(turned(corner, turn * np.pi / 2, (size / 2, 0.0)))
    return np.vstack(parts)


def tunnel(rng: Rng, size: float, spacing: float) -> Floats:
    """A tunnel without any feature along it."""
    return np.vstack([ground(rng, size, 9.0, spacing), vault(rng, size, spacing)])


def park(rng: Rng, size: float, spacing: float) -> Floats:
    """Trees and hedges along a path."""
    spots = rng.uniform([0, -size / 2], [size, size / 2], (round(size / 3), 2))
    parts = [ground(rng, size, size, spacing)]
    parts += [tree(rng, x, y, spacing) for x, y in spots]
    parts += [hedge(rng, (0.2 * size, y), 0.6 * size, spacing) for y in (-5.0, 4.2)]
    return np.vstack(parts)


def empty_lot(rng: Rng, size: float, spacing: float) -> Floats:
    """Flat ground and two posts."""
    x, y = jittered(rng, size, size, spacing)
    lot = noisy(rng, np.column_stack([x, y - size / 2, np.zeros(len(x))]))
    posts = [pole(rng, 0.3 * size, s * 0.4 * size, 4.0, spacing) for s in (-1, 1)]
    return np.vstack([lot, *posts])


def regular(rng: Rng, size: float, spacing: float) -> Floats:
    """A street without noise or chance: grids on exact planes, so that every tie rule is met."""
    steps = np.arange(0.0, size, spacing)
    across, up = np.arange(-8.0, 8.0, spacing), np.arange(0.0, size / 2, spacing)
    floor = np.stack(np.meshgrid(steps, across, [0.0]), axis=-1)
    walls = np.stack(np.meshgrid(steps, [-7.0, 7.0], up), axis=-1)
    end = np.stack(np.meshgrid([size - 1.0], across, up), axis=-1)
    slant = np.stack(np.meshgrid(steps[: len(steps) // 3], up), axis=-1).reshape(-1, 2)
    slanted = np.column_stack([slant[:, 0] + 2.0, slant[:, 0] - 2.0, slant[:, 1]])
    post = np.stack(np.meshgrid([5.0], [-3.0], np.arange(0.0, 6.0, spacing / 4)), axis=-1)
    parts = [floor, walls, end, slanted, post]
    return rng.permutation(np.vstack([part.reshape(-1, 3) for part in parts]))


PLACES: dict[str, Callable[[Rng, float, float], Floats]] = {
    place.__name__: place
    for place in (canyon, diagonal, crossing, tunnel, park, empty_lot, regular)
}


def in_map(points: Floats, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    """The points in whole millimetres, then moved by a whole-millimetre offset."""
    return (np.rint(points * 1000.0) + np.rint(np.multiply(offset, 1000.0))) / 1000.0


def scene(
    place: str,
    seed: int,
    size: float = 20.0,
    spacing: float = 0.4,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Floats:
    """A place by name. At the defaults: a few thousand points, a hundred or more cells of 2 m."""
    return in_map(PLACES[place](np.random.default_rng(seed), size, spacing), offset)


def rotated_scene(points: Floats, quarter_turns: int) -> Floats:
    """The scene turned by quarter turns about z through the origin: exact, lattice to lattice."""
    x, y, z = points.T
    for _ in range(quarter_turns % 4):
        x, y = -y, x
    return np.column_stack([x, y, z])
