"""The distortion of a scan taken in motion, and its removal."""

from dataclasses import dataclass, replace

import numpy as np

from tilestream.errors import PoseError, UsageError
from tilestream.formats.logs.poses import PoseStatus, interpolate
from tilestream.formats.motion import FASTEST
from tilestream.kernels.fixed_order import turned
from tilestream.records import Float64, Scan, Trajectory


@dataclass(frozen=True)
class Sweep:
    """How a lidar turns, for logs that do not record the time of each point."""

    duration_s: float
    """Time of one turn [s]."""
    clockwise: bool = True
    """Direction of the turn seen from above (Velodyne: clockwise)."""
    start_deg: float = 180.0
    """Azimuth at which a turn begins [deg, from x towards y]."""
    stamp_at: float = 0.0
    """What part of the turn is done at the header stamp: 0 its beginning, 1 its end."""

    def time_offsets(self, points: Float64) -> Float64:
        """(n,) time of each point (n, 3) after the header stamp [s], from its azimuth."""
        turned = np.arctan2(points[:, 1], points[:, 0]) - np.radians(self.start_deg)
        share: Float64 = np.mod(-turned if self.clockwise else turned, 2 * np.pi) / (2 * np.pi)
        return self.duration_s * (share - self.stamp_at)


def deskew(
    scan: Scan,
    poses: Trajectory,
    *,
    sweep: Sweep | None = None,
    max_gap_s: float = 1.0,
    max_speed_mps: float = FASTEST,
) -> Scan:
    """The scan as if all its points had been taken at its stamp.

    A point p seen at time t goes to T_map_lidar(stamp)^-1 T_map_lidar(t) p, with constant velocity
    and rate of turn between two poses.

    Args:
        scan: a scan with the time of each point, or without and `sweep` given.
        poses: of the lidar, around the scan.
        sweep: how the lidar turns; used only where the scan has no times.
        max_gap_s: longest time between two poses to interpolate over [s].
        max_speed_mps: fastest that the vehicle drives [m/s].

    Returns:
        The scan with moved points and all time offsets 0.

    Raises:
        UsageError: the scan has no times and no `sweep` is given.
        PoseError: the poses do not cover the time of the stamp and of every point.
    """
    if scan.time_offset is None and sweep is None:
        raise UsageError(
            f"the scan at {scan.stamp_ns} ns has no time per point that can be used (the notes of "
            "its log may say why); give a sweep to use azimuths"
        )
    if not len(scan.points):
        return scan
    offsets = scan.time_offset
    if offsets is None and sweep is not None:
        offsets = sweep.time_offsets(scan.points)
    assert offsets is not None
    offsets_ns = np.round(offsets * 1e9).astype(np.int64)
    times, which = np.unique(np.append(offsets_ns, 0), return_inverse=True)
    T, status = interpolate(poses, scan.stamp_ns + times, max_gap_s, max_speed_mps)
    if not (status == PoseStatus.POSED).all():
        lacking = times[status != PoseStatus.POSED] / 1e9
        raise PoseError(
            f"the scan at {scan.stamp_ns} ns cannot be de-skewed: it has points at times without "
            f"poses, from {lacking.min():.3f} to {lacking.max():.3f} s after its stamp"
        )
    T_stamp, T_point = T[which[-1]], T[which[:-1]]
    in_map = turned(T_point[:, :3, :3], scan.points) + (T_point[:, :3, 3] - T_stamp[:3, 3])
    points = turned(T_stamp[:3, :3].T, in_map)
    return replace(scan, points=points, time_offset=np.zeros(len(scan.points)))
