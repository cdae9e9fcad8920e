"""What drivers of lidars write: names of fields, pulses that did not come back, times of points.

No format of logs fixes these, so every format reads them alike.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.formats.logs.base import RecordedScan
from tilestream.records import Float64

INTENSITY_FIELDS = ("intensity",)
RING_FIELDS = ("ring", "channel")
TIME_FIELDS = ("time", "t", "timestamp", "offset_time", "time_stamp")
LONGEST_SCAN_S = 2.0
"""The time of a point is at most this far from the stamp of its scan [s]."""


def recorded_scan(stamp_ns: int, rows: NDArray[np.void]) -> RecordedScan:
    """A scan of which (n,) structured rows were recorded: fields x, y, z [m], and others by the
    names that drivers give them.
    """
    points = np.empty((len(rows), 3))
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        for axis, name in enumerate("xyz"):
            points[:, axis] = rows[name]
    return RecordedScan(
        stamp_ns,
        points,
        intensity=_field(rows, INTENSITY_FIELDS),
        ring=_field(rows, RING_FIELDS),
        time=_field(rows, TIME_FIELDS),
    )


def _field(rows: NDArray[np.void], names: Sequence[str]) -> NDArray[Any] | None:
    """The first of some fields that the rows have, not copied."""
    found = next((name for name in names if name in (rows.dtype.names or ())), None)
    return None if found is None else rows[found]


def returned(points: Float64) -> NDArray[np.bool_]:
    """(n,) which points (n, 3) are true returns: finite, and not at the lidar's own origin, where
    several drivers put the pulses that never came back.
    """
    sums = points[:, 0] + points[:, 1] + points[:, 2]
    keep: NDArray[np.bool_] = np.isfinite(sums)
    maybe_origin = np.flatnonzero(sums == 0.0)
    keep[maybe_origin] = points[maybe_origin].any(axis=1)
    return keep


def time_offsets(values: NDArray[np.generic], stamp_ns: int) -> Float64 | None:
    """Per-point times relative to the header [s], from a field as a driver wrote it.

    The rule: the first reading that puts every point within 2 s of the header stamp. Relative to
    the stamp: integers in ns (Ouster, Livox, Autoware), floats in s (Velodyne). Then since the
    epoch: s (Hesai, Robosense), ms, us, ns (Livox).

    Returns:
        (n,) seconds; None where all are 0 (a driver that does not fill the field), some are not
        finite, or no reading fits (another clock or unit).
    """
    if not len(values) or not values.any() or not np.isfinite(values).all():
        return None
    integers = np.issubdtype(values.dtype, np.integer)
    since_stamp = values.astype(np.float64) / (1e9 if integers else 1.0)
    readings = [since_stamp]
    readings += [values.astype(np.float64) / unit - stamp_ns / 1e9 for unit in (1.0, 1e3, 1e6)]
    readings += [(values.astype(np.int64) - stamp_ns) / 1e9] if integers else []
    readings += [values.astype(np.float64) / 1e9 - stamp_ns / 1e9]
    return next((r for r in readings if np.abs(r).max() < LONGEST_SCAN_S), None)
