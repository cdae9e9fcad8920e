"""Logs out: scans and poses as a ROS 2 MCAP file that rviz, Foxglove and `open_log` read."""

import math
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap_ros2.writer import Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import UsageError
from tilestream.files import Files
from tilestream.records import Float64, Scan, Trajectory

CHUNK_BYTES = 2 * 2**20
"""Chunks are closed when they reach this size: about three scans of a VLP-16 [bytes]."""
POINTS_TOPIC, POSE_TOPIC, TRUTH_TOPIC = "/points", "/odometry", "/ground_truth"
MAP_FRAME, LIDAR_FRAME = "map", "lidar"
FLOAT32, UINT16 = 7, 4
"""Datatypes of sensor_msgs/PointField."""

_HEADER = """\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_QUATERNION = """\
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_VECTOR3 = """\
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
POINT_CLOUD_SCHEMA = (
    """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
    + _HEADER
)
ODOMETRY_SCHEMA = (
    """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
================================================================================
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
================================================================================
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
"""
    + _VECTOR3
    + _QUATERNION
    + _HEADER
)


class _Messages:
    """The messages of a log that is being written, in order of time.

    Args:
        stream: the file, open for writing.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES)
        self._clouds = self._writer.register_msgdef(
            "sensor_msgs/msg/PointCloud2", POINT_CLOUD_SCHEMA
        )
        self._odometry = self._writer.register_msgdef("nav_msgs/msg/Odometry", ODOMETRY_SCHEMA)

    def finish(self) -> None:
        """Write the end; without it a file reads as cut short, never as whole."""
        self._writer.finish()  # type: ignore[no-untyped-call] # of the library

    def scan(self, scan: Scan) -> None:
        """Write the points of a scan as float32 x, y, z with what else it has: intensity (float32),
        ring (uint16), time (float32, seconds after the stamp). Its pose is not written.
        """
        rows, fields = _packed(scan)
        message = {
            "header": _header(scan.stamp_ns, LIDAR_FRAME),
            "height": 1,
            "width": len(rows),
            "fields": fields,
            "is_bigendian": False,
            "point_step": rows.itemsize,
            "row_step": rows.nbytes,
            "data": rows.tobytes(),
            "is_dense": True,
        }
        self._writer.write_message(
            POINTS_TOPIC, self._clouds, message, scan.stamp_ns, scan.stamp_ns
        )

    def odometry(self, stamp_ns: int, T_map_lidar: Float64, topic: str) -> None:
        """Write a pose of the lidar, (4, 4), on a topic."""
        x, y, z = T_map_lidar[:3, 3].tolist()
        quaternion = Rotation.from_matrix(T_map_lidar[:3, :3]).as_quat(canonical=True).tolist()
        pose = {
            "position": {"x": x, "y": y, "z": z},
            "orientation": dict(zip("xyzw", quaternion, strict=True)),
        }
        message = {
            "header": _header(stamp_ns, MAP_FRAME),
            "child_frame_id": LIDAR_FRAME,
            "pose": {"pose": pose},
        }
        self._writer.write_message(topic, self._odometry, message, stamp_ns, stamp_ns)


def write_log(
    path: str | Path, scans: Iterable[Scan], poses: Trajectory, *, truth: Trajectory | None = None
) -> None:
    """Write scans and poses as one log, merged in order of time, one scan in memory at a time. The
    same scans and poses give the same bytes. If `scans` raises an error, the file stays without its
    end and reads as cut short.

    Args:
        path: the file to make; one that is there is replaced.
        scans: in order of their stamps; a pose of the same time goes before its scan.
        poses: of the lidar in the map: what a reader takes as the lidar's poses.
        truth: the true poses, where they are known and differ; on a topic of their own.

    Raises:
        UsageError: a scan is older than the one before it.
    """
    tracks = [(POSE_TOPIC, poses)] + ([(TRUTH_TOPIC, truth)] if truth is not None else [])
    moments = deque(
        sorted(
            (int(stamp), order, i)
            for order, (_, track) in enumerate(tracks)
            for i, stamp in enumerate(track.stamps_ns)
        )
    )
    with Files.at(path).writing() as stream:
        log = _Messages(stream)

        def write_poses(until_ns: float) -> None:
            while moments and moments[0][0] <= until_ns:
                stamp, order, i = moments.popleft()
                topic, track = tracks[order]
                log.odometry(stamp, track.T_map_lidar[i], topic)

        last = -math.inf
        for scan in scans:
            if scan.stamp_ns < last:
                raise UsageError(f"{path}: a scan of {scan.stamp_ns} ns after one of {last} ns")
            last = scan.stamp_ns
            write_poses(last)
            log.scan(scan)
        write_poses(math.inf)
        log.finish()


def _header(stamp_ns: int, frame: str) -> dict[str, object]:
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def _packed(
    scan: Scan,
) -> tuple[NDArray[np.void], list[dict[str, object]]]:
    columns: list[tuple[str, str, int, NDArray[np.generic]]] = [
        (name, "<f4", FLOAT32, scan.points[:, axis]) for axis, name in enumerate("xyz")
    ]
    if scan.intensity is not None:
        columns.append(("intensity", "<f4", FLOAT32, scan.intensity))
    if scan.ring is not None:
        columns.append(("ring", "<u2", UINT16, scan.ring))
    if scan.time_offset is not None:
        columns.append(("time", "<f4", FLOAT32, scan.time_offset))
    rows = np.empty(len(scan.points), dtype=[(name, kind) for name, kind, _, _ in columns])
    fields: list[dict[str, object]] = []
    for name, _, datatype, values in columns:
        rows[name] = values
        offset = rows.dtype.fields[name][1] if rows.dtype.fields else 0
        fields.append({"name": name, "offset": offset, "datatype": datatype, "count": 1})
    return rows, fields
