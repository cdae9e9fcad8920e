"""A drive as map points: the scans of a log, each moved into the map by its pose."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.errors import PoseError, UsageError
from tilestream.formats.base import Block, PointSource, SourceInfo, Span
from tilestream.formats.logs import LOG_FORMATS, open_log
from tilestream.formats.logs.drivers import returned
from tilestream.formats.logs.poses import transform
from tilestream.formats.logs.scan_log import ScanLog, kept
from tilestream.formats.logs.selection import ScanSelection
from tilestream.formats.points.rows import steps, whole_span
from tilestream.formats.registry import Format
from tilestream.records import Float64, Int64
from tilestream.settings import LogOptions


class DriveSource:
    """A `PointSource` made of a log, by `open_drive`: the posed scans of a selection, in order of
    their stamps. Points are counted as the log counts those of each scan, returns or not.
    """

    def __init__(self, log: ScanLog, scans: ScanSelection, range_max: float | None) -> None:
        self.log = log
        self._range_max = range_max
        self._selected = scans.indices(log.stamps_ns)
        self._used = self._selected[log.posed[self._selected]]
        self._ends = np.cumsum(log.point_counts[self._used])

    @property
    def path(self) -> str:
        """The log, as it was named."""
        return self.log.path

    @property
    def used(self) -> Int64:
        """(k,) the scans that become map points, by index in the log."""
        return self._used

    def info(self) -> SourceInfo:
        """What is in the drive; `points` counts those of the scans used."""
        return self.log.info(self._selected)

    def spans(self, points: int) -> list[Span]:
        """Ranges of whole scans of about `points` points each."""
        spans, start = [], 0
        for end, following in zip(self._ends, (*self._ends[1:], np.inf), strict=True):
            if end > start and following - start > points:
                spans.append(Span(start, int(end)))
                start = int(end)
        return spans

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in the map frame, a scan or a part of one in each block.

        `Block.dropped` counts what was no return: not finite, or at the lidar's own origin. Points
        beyond the drive's `range_max` are left out and not counted.
        """
        whole_span(span, int(self._ends[-1:].sum()), self.path)
        begins = self._ends - self.log.point_counts[self._used]
        touched = np.flatnonzero((self._ends > span.start) & (begins < span.stop))
        indices = self._used[touched].tolist()
        scans = self.log.recorded_at(indices)
        for begin, index, scan in zip(begins[touched].tolist(), indices, scans, strict=True):
            first = max(span.start - begin, 0)
            last = min(span.stop - begin, len(scan.points))
            for step in steps(Span(first, last), block_points):
                part = scan.points[step.start : step.stop]
                yield self._block(part, self.log.T_map_lidar[index])

    def _block(self, points: Float64, T_map_lidar: Float64) -> Block:
        keep = returned(points)
        dropped = len(points) - int(keep.sum())
        if self._range_max is not None:
            keep &= (points**2).sum(axis=1) <= self._range_max**2
        return Block(transform(T_map_lidar, points[kept(keep)]), dropped)


def open_drive(
    path: str | Path,
    *,
    scans: ScanSelection | None = None,
    range_max: float | None = None,
    **options: Any,
) -> DriveSource:
    """A log as a source of map points.

    Args:
        path: a log of any format.
        scans: which scans become the map; default: all.
        range_max: points farther than this from the lidar are left out [m]; default: none.
        options: fields of `LogOptions`: topics and frames, as for `open_log`.

    Raises:
        UsageError: `range_max` is not positive, or no such option.
        SourceError: as `open_log`.
        PoseError: as `open_log`, and if no scan of the selection has a pose.
    """
    if range_max is not None and not range_max > 0:
        raise UsageError(f"range_max = {range_max}: must be a positive length in metres")
    log = open_log(path, LogOptions(**options))
    scans = scans or ScanSelection()
    selected = scans.indices(log.stamps_ns)
    if not log.posed[selected].any():
        lasts = (log.stamps_ns[-1] - log.stamps_ns[0]) / 1e9 if len(log) else 0.0
        has = "has a pose, of those selected" if len(selected) else "is selected"
        raise PoseError(
            f"{path}: none of its {len(log)} scans, which last {lasts:.1f} s, {has} ({scans}): "
            "select others"
        )
    return DriveSource(log, scans, range_max)


DRIVES: tuple[Format[PointSource], ...] = tuple(
    Format(
        name=log.name,
        what=f"{log.what}: the map that the drive saw",
        open=open_drive,
        endings=log.endings,
        magic=log.magic,
        recognise=log.recognise,
        marker=log.marker,
        options=(*LogOptions.model_fields, "scans", "range_max"),
    )
    for log in LOG_FORMATS
)
"""Every format of logs, as one of points."""
