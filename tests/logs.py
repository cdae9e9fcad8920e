"""Made logs: ROS 2 messages written by the libraries, not by the code under test."""

from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer as PlainWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from tilestream.formats.logs.mcap_write import ODOMETRY_SCHEMA, POINT_CLOUD_SCHEMA

DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
POSE_PARTS = ODOMETRY_SCHEMA[ODOMETRY_SCHEMA.index("=====") :]
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
    + POSE_PARTS
)
SCHEMAS = {
    "sensor_msgs/msg/PointCloud2": POINT_CLOUD_SCHEMA,
    "nav_msgs/msg/Odometry": ODOMETRY_SCHEMA,
    "tf2_msgs/msg/TFMessage": TF_SCHEMA,
    "geometry_msgs/msg/PoseStamped": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n" + POSE_PARTS
    ),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n" + POSE_PARTS
    ),
    "std_msgs/msg/String": "string data\n",
}
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = x, y, z
    return T


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {
        "stamp": {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND},
        "frame_id": frame,
    }


def pose_fields(T: np.ndarray) -> dict[str, Any]:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }


def odometry(stamp_ns: int, T: np.ndarray, child: str = "lidar", frame: str = "map") -> Any:
    return {
        "header": header(stamp_ns, frame),
        "child_frame_id": child,
        "pose": {"pose": pose_fields(T)},
    }


def pose_stamped(stamp_ns: int, T: np.ndarray, frame: str = "map") -> Any:
    return {"header": header(stamp_ns, frame), "pose": pose_fields(T)}


def pose_with_covariance(stamp_ns: int, T: np.ndarray, frame: str = "map") -> Any:
    return {"header": header(stamp_ns, frame), "pose": {"pose": pose_fields(T)}}


def transform(stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
    parts = pose_fields(T)
    moved = {"translation": parts["position"], "rotation": parts["orientation"]}
    stamped = {"header": header(stamp_ns, parent), "child_frame_id": child, "transform": moved}
    return {"transforms": [stamped]}


def cloud(stamp_ns: int, rows: np.ndarray, frame: str = "lidar", **changes: Any) -> Any:
    """A PointCloud2 of a structured array, (n,) or organised (height, width)."""
    assert rows.dtype.fields is not None
    rows = np.atleast_2d(rows)
    kinds = {name: np.dtype(kind) for name, (kind, *_) in rows.dtype.fields.items()}
    message = {
        "header": header(stamp_ns, frame),
        "height": rows.shape[0],
        "width": rows.shape[1],
        "fields": [
            {
                "name": name,
                "offset": rows.dtype.fields[name][1],
                "datatype": DATATYPES[kind.str[1:]],
                "count": 1,
            }
            for name, kind in kinds.items()
        ],
        "is_bigendian": any(kind.str[0] == ">" for kind in kinds.values()),
        "point_step": rows.dtype.itemsize,
        "row_step": rows.shape[1] * rows.dtype.itemsize,
        "data": rows.tobytes(),
        "is_dense": True,
    }
    return {**message, **changes}


def xyz_rows(points: np.ndarray, kind: str = "<f4", **more: np.ndarray) -> np.ndarray:
    columns = {name: points[:, axis].astype(kind) for axis, name in enumerate("xyz")} | more
    rows = np.empty(len(points), dtype=[(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


Message = tuple[int, str, str, Any]
"""Time of recording, topic, type, fields."""


STREET = np.random.default_rng(0).uniform([-30, -20, -2], [30, 20, 6], (200, 3)).astype("<f4")
"""Points around a lidar, where it does not matter which."""


def cloud_at(
    stamp_ns: int, points: np.ndarray = STREET, topic: str = "/points", **kwargs: Any
) -> Message:
    rows = xyz_rows(points)
    return stamp_ns, topic, "sensor_msgs/msg/PointCloud2", cloud(stamp_ns, rows, **kwargs)


def odometry_at(stamp_ns: int, T: np.ndarray, topic: str = "/odometry", **kw: Any) -> Message:
    return stamp_ns, topic, "nav_msgs/msg/Odometry", odometry(stamp_ns, T, **kw)


def tf_at(stamp_ns: int, parent: str, child: str, T: np.ndarray, topic: str = "/tf") -> Message:
    return stamp_ns, topic, "tf2_msgs/msg/TFMessage", transform(stamp_ns, parent, child, T)


def static_tf(parent: str, child: str, T: np.ndarray) -> Message:
    return START, "/tf_static", "tf2_msgs/msg/TFMessage", transform(0, parent, child, T)


def write(path: Path, messages: list[Message], chunk_size: int = 4096) -> Path:
    with path.open("wb") as stream, Writer(stream, chunk_size=chunk_size) as writer:
        schemas = {}
        for log_time, topic, kind, fields in messages:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, SCHEMAS[kind])
            writer.write_message(topic, schemas[kind], fields, log_time, log_time)
    return path


def rewrite(source: Path, target: Path, **options: Any) -> Path:
    """The same messages in another make of file: `options` are those of mcap's Writer."""
    with source.open("rb") as read, target.open("wb") as stream:
        writer = PlainWriter(stream, **options)
        writer.start(profile="ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(read).iter_messages(log_time_order=False):
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def street_points(rng: np.random.Generator, count: int = 200) -> np.ndarray:
    return rng.uniform([-30, -20, -2], [30, 20, 6], (count, 3)).astype("<f4").astype(float)


def street_log(path: Path, scans: int = 12, seed: int = 5, **kwargs: Any) -> Path:
    """Scans at 10 Hz from a lidar that drives 1 m per scan along x and turns, a pose each."""
    rng = np.random.default_rng(seed)
    messages: list[Message] = []
    for i in range(scans):
        stamp = START + i * SECOND // 10
        messages.append(odometry_at(stamp, pose(x=float(i), yaw=0.02 * i)))
        messages.append(cloud_at(stamp, street_points(rng)))
    return write(path, messages, **kwargs)


def decode(path: Path, topic: str) -> list[Any]:
    """Messages of a topic as the ROS library decodes them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [message.decoded_message for message in reader.iter_decoded_messages([topic])]
