"""What passes between the rooms: frozen values, a line under every field, frames in names."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a lidar, in its own frame."""

    stamp_ns: int
    """Time of the scan's header [ns since the epoch]."""
    points: Float64
    """(n, 3) points in the lidar frame [m]; all finite."""
    T_map_lidar: Float64 | None = None
    """(4, 4) pose of the lidar in the map at `stamp_ns`; None where the log has none."""
    intensity: NDArray[np.float32] | None = None
    """(n,) intensity as recorded, no unit; None where the log has none."""
    ring: NDArray[np.int32] | None = None
    """(n,) index of the beam, as recorded; None where the log has none."""
    time_offset: Float64 | None = None
    """(n,) time of each point minus `stamp_ns` [s]; None where the log has none."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time."""

    stamps_ns: Int64
    """(k,) times, strictly rising [ns since the epoch]."""
    T_map_lidar: Float64
    """(k, 4, 4) poses at these times."""
    frame: str = ""
    """Name of the frame that moves, as recorded."""
