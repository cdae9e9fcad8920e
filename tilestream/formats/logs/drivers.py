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
TURN_S = (0.005, 2.0)
"""How long a turn of a lidar takes, at least and at most [s]: less apart than two units of time, so
that the span of a turn fits in one of them."""
FULL_TURN_DEG = 300.0
"""A scan that spans less is of a lidar that looks one way, or a part of a turn [deg]."""
TICKS = (1, 10**3, 10**6, 10**9)
"""How many of a unit are a second: the units in which drivers write times of points."""


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


def span_deg(points: Float64) -> float:
    """How far round (n, 3) returns lie [deg]: all but the largest gap between two azimuths."""
    if len(points) < 2:
        return 0.0
    azimuth = np.sort(np.degrees(np.arctan2(points[:, 1], points[:, 0])))
    gap = max(float(np.diff(azimuth).max()), 360.0 - float(azimuth[-1] - azimuth[0]))
    return 360.0 - gap


def ticks_of(span: float) -> int | None:
    """How many ticks are a second, of a clock that counted `span` of them in a turn of a lidar;
    None where that is no turn in any unit.
    """
    return next((t for t in TICKS if TURN_S[0] <= span / t <= TURN_S[1]), None)


def time_offsets(values: NDArray[np.generic], stamp_ns: int, ticks: int) -> Float64 | None:
    """Per-point times relative to the header [s], from a field as a driver wrote it.

    They are relative to the stamp (Ouster, Livox, Velodyne) or since the epoch (Hesai, Robosense):
    whichever puts every point within 2 s of the stamp.

    Args:
        values: (n,) the field.
        stamp_ns: time of the header [ns since the epoch].
        ticks: how many of the field's unit are a second.

    Returns:
        (n,) seconds; None where all are 0 (a driver that does not fill the field), some are not
        finite, or neither fits (another clock).
    """
    if not len(values) or not values.any() or not np.isfinite(values).all():
        return None
    seconds = values.astype(np.float64) / ticks
    since_epoch = seconds - stamp_ns / 1e9
    if np.issubdtype(values.dtype, np.integer) and _within(since_epoch):  # to the nanosecond
        since_epoch = (values.astype(np.int64) * (10**9 // ticks) - stamp_ns) / 1e9
    return next((times for times in (seconds, since_epoch) if _within(times)), None)


def _within(times: Float64) -> bool:
    return bool(np.abs(times).max() <= TURN_S[1])
