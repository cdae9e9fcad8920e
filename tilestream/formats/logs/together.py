"""The scans of several lidars of one vehicle as one: in the frame of the first, at its time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import SourceError
from tilestream.formats.logs.base import RecordedScan, ScanReader
from tilestream.formats.logs.drivers import returned
from tilestream.formats.logs.poses import inverse, transform
from tilestream.formats.logs.scan_log import ScanLog
from tilestream.records import Float64, Int64

APART_NS = 60_000_000
"""Farthest in time that a scan may be from that of the first lidar with which it makes one [ns]:
half a turn at 10 Hz, and some."""


@dataclass(frozen=True, eq=False)
class ScansTogether:
    """Scans of several lidars, read as one each: a `ScanReader`."""

    readers: tuple[ScanReader, ...]
    """Of each lidar."""
    parts: Int64
    """(k, lidars) which scan of each lidar."""
    T_first_lidar: Float64
    """(k, lidars, 4, 4) pose of each lidar at its own time, in the frame of the first at its."""

    def read(self, indices: Sequence[int]) -> Iterator[RecordedScan]:
        """The scans with these indices; see `ScanReader.read`. Points that did not come back are
        NaN; beams and times of points are those of one lidar, and left out.
        """
        rows = self.parts[np.asarray(indices, dtype=np.int64)]
        streams = [reader.read(rows[:, n].tolist()) for n, reader in enumerate(self.readers)]
        for index, scans in zip(indices, zip(*streams, strict=True), strict=True):
            points = [
                np.where(returned(scan.points)[:, None], transform(T, scan.points), np.nan)
                for T, scan in zip(self.T_first_lidar[index], scans, strict=True)
            ]
            yield RecordedScan(scans[0].stamp_ns, np.concatenate(points))


def together(logs: Sequence[ScanLog]) -> ScanLog:
    """The scans that the lidars of a vehicle make together.

    Each scan of the first lidar gets the nearest in time of each other one. All have poses in the
    map, so that what the vehicle moved meanwhile is made up for. A scan of the first lidar for
    which one of the others has none within `APART_NS` is left out, and noted.

    Args:
        logs: the scans of each lidar, of one recording; the first gives frame and times.

    Raises:
        SourceError: no scan has partners, or a topic is named twice.
    """
    first, *others = logs
    topics = ", ".join(log.points_topic for log in logs)
    if len({log.points_topic for log in logs}) < len(logs):
        raise SourceError(f"{first.path}: {topics}: a lidar is named twice")
    parts, found = [np.arange(len(first))], first.posed
    for other in others:
        nearest, there = _nearest(first.stamps_ns, other)
        parts.append(nearest)
        found = found & there
    if not found.any():
        raise SourceError(
            f"{first.path}: no scans of {topics} with poses lie within {APART_NS / 1e9:g} s of "
            "each other: are they lidars of one vehicle, on one clock?"
        )
    rows = np.column_stack(parts)[found]
    T_map_first = first.T_map_lidar[found]
    T_map_lidars = [log.T_map_lidar[rows[:, n]] for n, log in enumerate(logs)]
    T_first_lidar = np.stack([inverse(T_map_first) @ T for T in T_map_lidars], axis=1)
    T_first_lidar[:, 0] = np.eye(4)
    left_out = first.unposed(np.arange(len(first)))
    notes = [f"scans of {topics} make one each, in the frame {first.frame or 'of the first'}"]
    if lost := int((first.posed & ~found).sum()):
        why = "not every lidar has one at that time"
        left_out[why] = lost
        notes.append(f"{lost} of {len(first)} scans left out: {why}")
    return replace(
        first,
        points_topic=topics,
        fields=tuple(field for field in first.fields if field[0] in ("x", "y", "z")),
        stamps_ns=first.stamps_ns[found],
        point_counts=_sums(logs, rows, "point_counts"),
        held_bytes=_sums(logs, rows, "held_bytes"),
        T_map_lidar=T_map_first,
        pose_status=first.pose_status[found],
        left_out=left_out,
        notes=(*dict.fromkeys(note for log in logs for note in log.notes), *notes),
        reader=ScansTogether(tuple(log.reader for log in logs), rows, T_first_lidar),
    )


def _nearest(stamps_ns: Int64, log: ScanLog) -> tuple[Int64, NDArray[np.bool_]]:
    """The posed scan of a log that is nearest to each of some times, and whether it is near."""
    posed = np.flatnonzero(log.posed)
    after = np.clip(np.searchsorted(log.stamps_ns[posed], stamps_ns), 1, max(len(posed) - 1, 1))
    pair = posed[np.minimum(np.stack([after - 1, after]), len(posed) - 1)]
    apart = np.abs(log.stamps_ns[pair] - stamps_ns)
    nearest = np.where(apart[0] <= apart[1], pair[0], pair[1])
    return nearest, apart.min(axis=0) <= APART_NS


def _sums(logs: Sequence[ScanLog], rows: Int64, name: str) -> Int64:
    """(k,) a number of each scan over all lidars."""
    total: Int64 = np.sum([getattr(log, name)[rows[:, n]] for n, log in enumerate(logs)], axis=0)
    return total
