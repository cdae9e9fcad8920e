"""Large streets for the benchmarks and pictures, composed of the surfaces of tests/scenes.py."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from scenes import (
    PLACES,
    Floats,
    facade,
    ground,
    hedge,
    in_map,
    pole,
    tree,
    turned,
)

TILE = 100.0
"""Edge of a street tile [m]."""
SECTION = 100.0
"""Length of each section of the drive [m]."""
SECTIONS = ("canyon", "crossing", "tunnel", "park", "empty_lot", "canyon")
"""What the drive passes, in its order."""


def street_tile(seed: int, spacing: float, column: int = 0) -> Floats:
    """A built-up tile, x and y in [0, 100) m plus `column` tiles in x.

    A street along x crossed by another in the middle, blocks of 55 m height with courtyards,
    lamps, trees and hedges. Sampled at 0.13 m and thinned to 0.2 m it holds about a million points.
    """
    rng = np.random.default_rng([seed, column])
    half, height = TILE / 2, 55.0
    parts = [ground(rng, TILE, 2 * half, spacing)]
    for side in range(2):
        quarter = [
            facade(rng, (0.5, 11.0), (half - 11.0, 11.0), height, spacing),
            facade(rng, (half - 11.0, 11.0), (half - 11.0, half - 1.0), height, spacing, bay=4.0),
            facade(rng, (half + 11.0, half - 1.0), (half + 11.0, 11.0), height, spacing),
            facade(rng, (half + 11.0, 11.0), (TILE - 0.5, 11.0), height, spacing, bay=2.5),
            facade(rng, (1.0, half - 8.0), (half - 11.0, half - 8.0), height / 2, spacing),
            facade(rng, (half + 11.0, half - 8.0), (TILE - 1.0, half - 8.0), height / 2, spacing),
        ]
        quarter += [pole(rng, x, 5.5, 7.0, spacing) for x in np.arange(6.0, TILE, 22.0)]
        quarter += [tree(rng, x, 7.5, spacing) for x in np.arange(14.0, TILE, 18.0)]
        quarter.append(hedge(rng, (20.0, 9.0), 15.0, spacing))
        parts.append(turned(np.vstack(quarter), side * np.pi, (half, 0.0)))
    points = in_map(np.vstack(parts), (column * TILE, half, 0.0))
    low = np.array([column * TILE, 0.0])
    inside = (points[:, :2] >= low).all(axis=1) & (points[:, :2] < low + TILE).all(axis=1)
    return points[inside]


def long_street(tiles: int, seed: int, spacing: float) -> Iterator[Floats]:
    """The points of a street of that many tiles along x, a tile at a time."""
    for column in range(tiles):
        yield street_tile(seed, spacing, column)


def section(place: str, seed: int, spacing: float, number: int = 0) -> Floats:
    """A place of tests/scenes.py, 100 m long, as a section of the drive, centred on y = 50 m."""
    points = PLACES[place](np.random.default_rng([seed, number]), SECTION, spacing)
    return in_map(points, (number * SECTION, 50.0, 0.0))


def drive(seed: int, spacing: float) -> Floats:
    """A street along x through all the SECTIONS."""
    return np.vstack([section(name, seed, spacing, k) for k, name in enumerate(SECTIONS)])
