"""What the places of a vehicle say of its way: how far it went, and where it cannot have driven."""

import math

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64
from tilestream.settings import LogOptions

MOVED_M = 0.5
"""A vehicle has moved once it is so far from where it was [m]: more than poses shake by."""
REPEATED_M = 0.01
"""A point closer than this to another repeats it [m]."""
FASTEST = LogOptions().max_speed_mps
"""No vehicle drives faster, unless one is told to [m/s]."""


def vertices(points: Float64) -> list[int]:
    """The points that a path leads through, by index: the first, each that is `MOVED_M` or farther
    from the vertex before, and the last, unless it repeats the vertex before.

    So a vehicle that stands while its poses shake goes nowhere.

    Args:
        points: (n, 2) or (n, 3) points in order of travel [m].
    """
    kept: list[int] = []
    rows = points.tolist()
    for index, point in enumerate(rows):
        if not kept or math.dist(point, rows[kept[-1]]) >= MOVED_M:
            kept.append(index)
    if kept and math.dist(rows[-1], rows[kept[-1]]) >= REPEATED_M:
        kept.append(len(rows) - 1)
    return kept


def along(points: Float64) -> Float64:
    """(n,) how far along its path each point lies [m], not falling from 0: the length through the
    vertices before it, and its distance from the last of them. Points as for `vertices`.
    """
    kept = np.array(vertices(points), dtype=np.int64)
    at_vertices = np.concatenate([[0.0], np.cumsum(norms(np.diff(points[kept], axis=0)))])
    last = np.searchsorted(kept, np.arange(len(points)), side="right") - 1
    reached: Float64 = at_vertices[last] + norms(points - points[kept[last]])
    return np.maximum.accumulate(reached)


def jumped(steps: Float64, seconds: Float64, max_speed_mps: float = FASTEST) -> NDArray[np.bool_]:
    """Which steps [m] no vehicle drives in such a time [s]; no less than `MOVED_M`, since poses
    also shake, and none where time stands still.
    """
    faster = steps > max_speed_mps * seconds
    result: NDArray[np.bool_] = (steps > MOVED_M) & (seconds > 0) & faster
    return result
