"""Which surfels beams can meet from places near one another."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Int64 = NDArray[np.int64]


class Field(NamedTuple):
    """What beams from some places can reach: a ring in plan, open upwards and downwards with it."""

    middle: tuple[float, float, float]
    """Of the places [m, map frame]."""
    around: float
    """How far from there in plan a beam may start [m]."""
    reach: float
    """How far in plan a beam goes [m]."""
    bottom: float
    """Lowest start of a beam above the middle [m] …"""
    top: float
    """… and highest."""
    low: float
    """Slope of the lowest beam …"""
    high: float
    """… and of the highest."""


@njit(nogil=True, error_model="numpy", boundscheck=False)
def can_be_met(centre_mm: Int64, field: Field) -> NDArray[np.bool_]:
    """(n,) whether a centre (n, 3) [mm, map frame], contiguous, lies in the field."""
    numbers, met = centre_mm.reshape(-1), np.empty(len(centre_mm), np.bool_)
    mx, my, mz = field.middle
    for i in range(np.uint64(met.size)):
        j = np.uint64(3) * np.uint64(i)  # unsigned: no index from the end, which would be a branch
        x = numbers[j] / 1000.0 - mx
        y = numbers[j + np.uint64(1)] / 1000.0 - my
        z = numbers[j + np.uint64(2)] / 1000.0 - mz
        away = math.sqrt(x * x + y * y)
        near, far = max(away - field.around, 0.0), away + field.around
        floor = field.bottom + field.low * (far if field.low < 0.0 else near)
        ceiling = field.top + field.high * (far if field.high > 0.0 else near)
        met[i] = (near <= field.reach) & (z >= floor) & (z <= ceiling)
    return met
