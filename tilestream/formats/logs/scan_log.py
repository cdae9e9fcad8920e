"""The scans of a log with the pose of the lidar at each, whatever the format."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import (
    CorruptSourceError,
    PoseError,
    SourceNotFoundError,
    foreign_errors,
)
from tilestream.formats.base import SourceInfo
from tilestream.formats.logs.base import RecordedScan, Recording
from tilestream.formats.logs.drivers import (
    FULL_TURN_DEG,
    TIME_FIELDS,
    TURN_S,
    returned,
    span_deg,
    ticks_of,
    time_offsets,
)
from tilestream.formats.logs.poses import PoseStatus, interpolate, jumps
from tilestream.formats.motion import along, jumped
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64, Int64, Scan
from tilestream.settings import LogOptions

_BYTES_PER_POINT = 80
"""What the columns of a scan that is read take [bytes per point]."""
LOOKED_AT = 5
"""So many scans tell how much of a turn they span, and the unit of the points' times."""


SKIPPED = {
    PoseStatus.BEFORE: "before the first pose",
    PoseStatus.AFTER: "after the last pose",
    PoseStatus.GAP: "where poses are too far apart in time",
    PoseStatus.JUMP: "where poses jump faster than any vehicle drives",
}
"""Why a scan has no pose, in words."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanLog(Recording):
    """The scans of a log and where the lidar was, opened by `open_log`. A value: it holds no open
    file and can be sent to another process, which then need not read the log through again.
    """

    T_map_lidar: Float64
    """(k, 4, 4) pose of the lidar at each scan's stamp; NaN where it has none."""
    pose_status: NDArray[np.int8]
    """(k,) `PoseStatus`: POSED, or why the scan is skipped."""
    left_out: Mapping[str, int] = field(default_factory=dict)
    """How many scans of the topic are not among these, by reason."""
    time_ticks: int | None = None
    """How many of the unit of the points' times are a second; None where they cannot be used."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(k,) which scans have a pose."""
        return np.equal(self.pose_status, PoseStatus.POSED)

    def length_m(self, indices: Int64) -> float:
        """How far the lidar went over some scans, those with a pose [m]; jumps of poses are none of
        it.
        """
        used = indices[self.posed[indices]]
        places = self.T_map_lidar[used, :3, 3]
        steps, seconds = norms(np.diff(places, axis=0)), np.diff(self.stamps_ns[used]) / 1e9
        parts = np.split(places, np.flatnonzero(jumped(steps, seconds)) + 1)
        return float(sum(along(part)[-1] for part in parts if len(part)))

    def unposed(self, indices: Int64) -> dict[str, int]:
        """How many of some scans have no pose, by reason."""
        status = self.pose_status[indices]
        counts = {why: int((status == code).sum()) for code, why in SKIPPED.items()}
        return {why: count for why, count in counts.items() if count}

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The posed scans of a slice of the log, by index in order of their stamps.

        Scans without a pose are left out (`pose_status` says why); points that are no returns are
        left out and counted in `Scan.dropped`.

        Raises:
            CorruptSourceError: the log is damaged, or is not the one that was opened.
            SourceNotFoundError: it is no longer there.
        """
        return self.scans_at(np.arange(len(self))[start:stop:step])

    def scans_at(self, indices: Iterable[int] | Int64) -> Iterator[Scan]:
        """As `scans`, for any scans by index, e.g. of a `ScanSelection`."""
        wanted = [int(i) for i in indices if self.pose_status[i] == PoseStatus.POSED]
        for index, recorded in zip(wanted, self.recorded_at(wanted), strict=True):
            yield _scan(recorded, self.T_map_lidar[index], self.time_ticks)

    def recorded_at(self, indices: list[int]) -> Iterator[RecordedScan]:
        """Some scans as they were recorded, posed or not; errors as for `scans`."""
        changed = f"{self.path}: has changed since it was opened; open it again"
        try:
            with foreign_errors(
                CorruptSourceError, f"{self.path}: cannot be read as {self.format}"
            ):
                for index, recorded in zip(indices, self.reader.read(indices), strict=True):
                    if recorded.stamp_ns != self.stamps_ns[index]:
                        raise CorruptSourceError(changed)
                    yield recorded
        except FileNotFoundError as error:
            raise SourceNotFoundError(f"{changed} ({error})") from error

    def info(self, indices: Int64 | None = None) -> SourceInfo:
        """What is in the log; of the scans, those given by index (default: all)."""
        used = np.arange(len(self)) if indices is None else indices
        posed = used[self.posed[used]]
        path_m = self.length_m(used)
        stamps = self.stamps_ns[used]
        duration_s = (stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0
        largest_scan = int(self.point_counts[used].max(initial=0))
        return SourceInfo(
            path=self.path,
            format=self.format,
            size_bytes=self.size_bytes,
            points=int(self.point_counts[posed].sum()),
            fields=self.fields,
            resident_bytes=int(self.held_bytes[used].max(initial=0))
            + _BYTES_PER_POINT * largest_scan,
            contents=(
                *self.contents,
                (
                    f"{len(used)} scans of {self.points_topic} over {duration_s:.1f} s, "
                    f"{len(posed)} with a pose from {self.pose_topic}, along {path_m:.1f} m"
                ),
            ),
            notes=self.notes,
        )


def with_poses(found: Recording, options: LogOptions) -> ScanLog:
    """The scans of a log with their poses, interpolated as the options allow, and the unit of the
    points' times. Scans without a pose are noted, so are jumps, and times of no use.

    Raises:
        PoseError: no scan has a pose.
    """
    T_map_lidar, status = interpolate(
        found.trajectory, found.stamps_ns, options.max_gap_s, options.max_speed_mps
    )
    notes = (*found.notes, *_skipped(found, status, options), *_jumps(found, options))
    known = {**vars(found), "notes": notes}
    return _looked_at(ScanLog(**known, T_map_lidar=T_map_lidar, pose_status=status))


def _looked_at(log: ScanLog) -> ScanLog:
    """With what a few scans tell: how far round they look, and the unit of the points' times."""
    few = np.unique(np.linspace(0, len(log) - 1, LOOKED_AT).round().astype(int))
    scans = list(log.recorded_at(few.tolist()))
    turn = float(np.median([span_deg(scan.points[returned(scan.points)]) for scan in scans]))
    if turn < FULL_TURN_DEG:
        log = replace(log, notes=(*log.notes, f"scans span {turn:.0f} degrees, not a full turn"))
    return _with_times(log, scans)


def _with_times(log: ScanLog, scans: list[RecordedScan]) -> ScanLog:
    """With the unit of the points' times: the one in which the middle of the spans of a few scans
    is a turn of a lidar.
    """
    if not any(name in TIME_FIELDS for name, _ in log.fields):
        return log
    spans = [_span(recorded) for recorded in scans]
    span = float(np.median([span for span in spans if span > 0] or [0.0]))
    ticks = ticks_of(span)
    if ticks is None and span > 0:
        note = (
            f"times of points are not used: they span {span:g} in a scan, which in no unit from "
            f"seconds to nanoseconds is a turn of a lidar ({TURN_S[0]:g} to {TURN_S[1]:g} s)"
        )
        return replace(log, notes=(*log.notes, note))
    return replace(log, time_ticks=ticks)


def _span(recorded: RecordedScan) -> float:
    """From the first to the last time of a scan's returns, in the driver's unit."""
    if recorded.time is None:
        return 0.0
    times = recorded.time[returned(recorded.points)]
    times = times[np.isfinite(times)]
    return float(np.ptp(times)) if len(times) else 0.0


def _jumps(found: Recording, options: LogOptions) -> list[str]:
    """A note on poses that jump."""
    at = np.flatnonzero(jumps(found.trajectory, options.max_speed_mps))
    if not len(at):
        return []
    a, b = found.trajectory.T_map_lidar[[at[0], at[0] + 1], :3, 3]
    seconds = found.trajectory.stamps_ns[at[0]] / 1e9
    first = f"first by {math.dist(a, b):.1f} m after {seconds:.3f} s"
    steps = len(found.trajectory.stamps_ns) - 1
    fastest = f"{options.max_speed_mps:g} m/s"
    return [f"poses jump faster than {fastest} at {len(at)} of {steps} steps, {first}"]


def _skipped(found: Recording, status: NDArray[np.int8], options: LogOptions) -> list[str]:
    """A note for each reason for which scans have no pose."""
    reasons = SKIPPED | {
        PoseStatus.GAP: f"where poses are more than {options.max_gap_s:g} s apart",
        PoseStatus.JUMP: f"where poses jump faster than {options.max_speed_mps:g} m/s",
    }
    if not (status == PoseStatus.POSED).any():
        scans, poses = found.stamps_ns / 1e9, found.trajectory.stamps_ns / 1e9
        raise PoseError(
            f"{found.path}: none of the {len(scans)} scans has a pose: scans are from "
            f"{scans[0]:.3f} to {scans[-1]:.3f} s, poses from {poses[0]:.3f} to {poses[-1]:.3f} s, "
            f"and none is interpolated over more than {options.max_gap_s:g} s or a jump faster "
            f"than {options.max_speed_mps:g} m/s; are these the same clock?"
        )
    counts = {why: int((status == code).sum()) for code, why in reasons.items()}
    return [f"{n} of {len(status)} scans skipped: {why}" for why, n in counts.items() if n]


def _scan(recorded: RecordedScan, T_map_lidar: Float64, ticks: int | None) -> Scan:
    """The returns of a recorded scan, in the types that every scan has."""
    keep = kept(returned(recorded.points))
    points, time = recorded.points[keep], recorded.time
    return Scan(
        stamp_ns=recorded.stamp_ns,
        points=points,
        T_map_lidar=T_map_lidar,
        intensity=(
            None if recorded.intensity is None else recorded.intensity[keep].astype(np.float32)
        ),
        ring=None if recorded.ring is None else recorded.ring[keep].astype(np.int32),
        time_offset=(
            None
            if time is None or ticks is None
            else time_offsets(_native(time[keep]), recorded.stamp_ns, ticks)
        ),
        dropped=len(recorded.points) - len(points),
    )


def kept(keep: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """What to index with: a slice, which copies nothing, where all points stay."""
    return slice(None) if keep.all() else keep


def _native(values: NDArray[np.generic]) -> NDArray[np.generic]:
    return values.astype(values.dtype.newbyteorder("="))
