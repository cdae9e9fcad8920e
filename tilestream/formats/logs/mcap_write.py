"""Logs out: scans and poses as a ROS 2 MCAP file that rviz, Foxglove and `mcap.open_log` read."""

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from mcap_ros2.writer import Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import UsageError
from tilestream.records import Float64, Scan, Trajectory

CHUNK_BYTES = 2 * 2**20
"""Chunks are closed when they reach this size: about three scans of a VLP-16 [bytes]."""
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
TF_SCHEMA = (
    """\
geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
"""
    + _VECTOR3
    + _QUATERNION
    + _HEADER
)


class LogWriter:
    """A log that is being written, as a context manager; messages go in as they come, in order of
    time. The same messages give the same bytes. If the block is left by an error, the file stays
    without its end and reads as cut short, never as whole.

    Args:
        path: the file to make; one that is there is replaced.
        points_topic: topic of the scans.
        pose_topic: topic of the poses, where `odometry` names no other.
        map_frame: frame of the poses.
        lidar_frame: frame of the points, and the one that the poses move.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        points_topic: str = "/points",
        pose_topic: str = "/odometry",
        map_frame: str = "map",
        lidar_frame: str = "lidar",
    ) -> None:
        self.points_topic, self.pose_topic = points_topic, pose_topic
        self.map_frame, self.lidar_frame = map_frame, lidar_frame
        self._stream = Path(path).open("wb")  # noqa: SIM115 - __exit__ closes it
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES)
        self._clouds = self._writer.register_msgdef(
            "sensor_msgs/msg/PointCloud2", POINT_CLOUD_SCHEMA
        )
        self._odometry = self._writer.register_msgdef("nav_msgs/msg/Odometry", ODOMETRY_SCHEMA)
        self._tf = self._writer.register_msgdef("tf2_msgs/msg/TFMessage", TF_SCHEMA)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call] # of the library
        finally:
            self._stream.close()

    def scan(self, scan: Scan) -> None:
        """Write the points of a scan as float32 x, y, z with what else it has: intensity (float32),
        ring (uint16), time (float32, seconds after the stamp). Its pose is not written.
        """
        rows, fields = _packed(scan)
        message = {
            "header": self._header(scan.stamp_ns, self.lidar_frame),
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
            self.points_topic, self._clouds, message, scan.stamp_ns, scan.stamp_ns
        )

    def odometry(self, stamp_ns: int, T_map_lidar: Float64, topic: str | None = None) -> None:
        """Write a pose of the lidar, (4, 4), on the log's pose topic or on another one, e.g. one
        for the ground truth.
        """
        position, orientation = _parts(T_map_lidar)
        message = {
            "header": self._header(stamp_ns, self.map_frame),
            "child_frame_id": self.lidar_frame,
            "pose": {"pose": {"position": position, "orientation": orientation}},
        }
        self._writer.write_message(
            topic or self.pose_topic, self._odometry, message, stamp_ns, stamp_ns
        )

    def transform(
        self, stamp_ns: int, parent: str, child: str, T_parent_child: Float64, *, static: bool
    ) -> None:
        """Write a transform between two frames on /tf, or on /tf_static where it never changes."""
        translation, rotation = _parts(T_parent_child)
        message = {
            "transforms": [
                {
                    "header": self._header(stamp_ns, parent),
                    "child_frame_id": child,
                    "transform": {"translation": translation, "rotation": rotation},
                }
            ]
        }
        topic = "/tf_static" if static else "/tf"
        self._writer.write_message(topic, self._tf, message, stamp_ns, stamp_ns)

    def _header(self, stamp_ns: int, frame: str) -> dict[str, object]:
        seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
        return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def write_log(
    path: str | Path,
    scans: Iterable[Scan],
    poses: Trajectory,
    *,
    truth: Trajectory | None = None,
    truth_topic: str = "/ground_truth",
    points_topic: str = "/points",
    pose_topic: str = "/odometry",
    map_frame: str = "map",
    lidar_frame: str = "lidar",
) -> None:
    """Write scans and poses as one log, merged in order of time, one scan in memory at a time.

    Args:
        path: the file to make; one that is there is replaced.
        scans: in order of their stamps; a pose of the same time goes before its scan.
        poses: of the lidar in the map: what a reader takes as the lidar's poses.
        truth: the true poses, where they are known and differ.
        truth_topic: topic of the true poses.
        points_topic: topic of the scans.
        pose_topic: topic of the poses.
        map_frame: frame of the poses.
        lidar_frame: frame of the points.

    Raises:
        UsageError: a scan is older than the one before it.
    """
    topics = [(pose_topic, poses)] + ([(truth_topic, truth)] if truth is not None else [])
    moments = sorted(
        (int(stamp), order, i)
        for order, (_, track) in enumerate(topics)
        for i, stamp in enumerate(track.stamps_ns)
    )
    with LogWriter(
        path,
        points_topic=points_topic,
        pose_topic=pose_topic,
        map_frame=map_frame,
        lidar_frame=lidar_frame,
    ) as log:

        def write_poses(due: int) -> None:
            stamp, order, i = moments[due]
            topic, track = topics[order]
            log.odometry(stamp, track.T_map_lidar[i], topic)

        due, last = 0, None
        for scan in scans:
            if last is not None and scan.stamp_ns < last:
                raise UsageError(f"{path}: a scan of {scan.stamp_ns} ns after one of {last} ns")
            last = scan.stamp_ns
            while due < len(moments) and moments[due][0] <= scan.stamp_ns:
                write_poses(due)
                due += 1
            log.scan(scan)
        for rest in range(due, len(moments)):
            write_poses(rest)


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


def _parts(T: Float64) -> tuple[dict[str, float], dict[str, float]]:
    x, y, z = (float(value) for value in T[:3, 3])
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return {"x": x, "y": y, "z": z}, dict(zip("xyzw", map(float, quaternion), strict=True))
