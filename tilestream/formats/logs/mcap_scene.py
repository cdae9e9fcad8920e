"""A scene out: point clouds and markers that stand still, as a ROS 2 MCAP file for Foxglove, rviz
and `ros2 bag play`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from mcap.well_known import SchemaEncoding
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic
from numpy.typing import NDArray

from tilestream.files import Files
from tilestream.formats.logs.mcap_write import (
    CHUNK_BYTES,
    FLOAT32,
    MAP_FRAME,
    POINT_CLOUD_SCHEMA,
)
from tilestream.records import Float64

STAMP_NS = 1_000_000_000
"""Time of everything: one second, since 0 means no time to ROS [ns]."""
LATCHED = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
"""How ros2 bag offers a topic: whoever comes later gets it too (transient local)."""
KINDS = {"line": 4, "cubes": 6, "spheres": 7, "text": 9}
"""visualization_msgs/Marker of each kind: LINE_STRIP, CUBE_LIST, SPHERE_LIST, TEXT_VIEW_FACING."""

_RULER = "=" * 80
_COMMON = f"""\
{_RULER}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULER}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{_RULER}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_RULER}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
MARKERS_SCHEMA = f"""\
visualization_msgs/Marker[] markers
{_RULER}
MSG: visualization_msgs/Marker
std_msgs/Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
builtin_interfaces/Duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string texture_resource
sensor_msgs/CompressedImage texture
visualization_msgs/UVCoordinate[] uv_coordinates
string text
string mesh_resource
visualization_msgs/MeshFile mesh_file
bool mesh_use_embedded_materials
{_RULER}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_RULER}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_RULER}
MSG: std_msgs/ColorRGBA
float32 r
float32 g
float32 b
float32 a
{_RULER}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
{_RULER}
MSG: sensor_msgs/CompressedImage
std_msgs/Header header
string format
uint8[] data
{_RULER}
MSG: visualization_msgs/UVCoordinate
float32 u
float32 v
{_RULER}
MSG: visualization_msgs/MeshFile
string filename
uint8[] data
{_COMMON}"""
"""visualization_msgs/MarkerArray as of ROS 2 Humble and later."""
TRANSFORMS_SCHEMA = f"""\
geometry_msgs/TransformStamped[] transforms
{_RULER}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_RULER}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_COMMON}"""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Coloured points."""

    points: Float64
    """(n, 3) positions [m, frame of the scene]; stored as float32."""
    rgb: NDArray[np.uint8]
    """(n, 3) their colours."""
    values: Mapping[str, Float64] = field(default_factory=dict)
    """(n,) what else is known of each, by name; stored as float32."""


@dataclass(frozen=True, eq=False)
class Marker:
    """Shapes of one kind and size."""

    kind: Literal["line", "cubes", "spheres", "text"]
    """A line through the points, a shape at each, or a text at the first."""
    group: str
    """What a viewer shows or hides together (`ns`)."""
    points: Float64
    """(n, 3) positions [m, frame of the scene]."""
    rgb: NDArray[np.uint8]
    """(n, 3) a colour for each."""
    size: float
    """Width of a line, edge or diameter of a shape, height of letters [m]."""
    text: str = ""
    """What a text says."""


def write_scene(
    file: Files,
    topics: Mapping[str, Cloud | Iterable[Marker]],
    *,
    parent: str,
    origin: tuple[float, float, float],
    about: Mapping[str, str],
) -> None:
    """Write clouds and markers of the frame `map` as one message per topic, all of the same time,
    compressed. The same scene gives the same bytes.

    Args:
        file: where to.
        topics: what is on each topic.
        parent: the frame that `map` is in (a static transform).
        origin: x, y and z of `map` in it [m].
        about: what is told of the file: its metadata record `tilestream`.
    """
    with file.writing() as stream:
        scene = _Scene(Writer(stream, chunk_size=CHUNK_BYTES))
        scene.about(about)
        scene.put("/tf_static", "tf2_msgs/msg/TFMessage", TRANSFORMS_SCHEMA, _tf(parent, origin))
        for topic, content in topics.items():
            if isinstance(content, Cloud):
                message = _cloud(content)
                scene.put(topic, "sensor_msgs/msg/PointCloud2", POINT_CLOUD_SCHEMA, message)
            else:
                message = {"markers": [_marker(n, each) for n, each in enumerate(content)]}
                scene.put(topic, "visualization_msgs/msg/MarkerArray", MARKERS_SCHEMA, message)
        scene.finish()


class _Scene:
    """A file of latched topics; mcap_ros2's own writer cannot say that they are."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._writer.start(profile="ros2", library="tilestream")
        self._schemas: dict[str, tuple[int, Any]] = {}

    def about(self, told: Mapping[str, str]) -> None:
        self._writer.add_metadata("tilestream", dict(told))

    def put(self, topic: str, kind: str, schema: str, message: Mapping[str, Any]) -> None:
        """Write the one message of a topic."""
        if kind not in self._schemas:
            number = self._writer.register_schema(kind, SchemaEncoding.ROS2, schema.encode())
            self._schemas[kind] = number, serialize_dynamic(kind, schema)[kind]
        number, encode = self._schemas[kind]
        channel = self._writer.register_channel(
            topic, "cdr", number, {"offered_qos_profiles": LATCHED}
        )
        self._writer.add_message(channel, STAMP_NS, encode(message), STAMP_NS)

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call] # of the library


def _header(frame: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(STAMP_NS, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def _tf(parent: str, origin: tuple[float, float, float]) -> dict[str, Any]:
    transform = {
        "header": _header(parent),
        "child_frame_id": MAP_FRAME,
        "transform": {
            "translation": dict(zip("xyz", origin, strict=True)),
            "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }
    return {"transforms": [transform]}


def _cloud(cloud: Cloud) -> dict[str, Any]:
    """A PointCloud2 of float32, colours packed as PCL does it."""
    rgb = cloud.rgb.astype(np.uint32)
    packed = ((rgb[:, 0] << 16) | (rgb[:, 1] << 8) | rgb[:, 2]).view(np.float32)
    columns = {**dict(zip("xyz", cloud.points.T, strict=True)), "rgb": packed, **cloud.values}
    rows = np.empty(len(cloud.points), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return {
        "header": _header(MAP_FRAME),
        "height": 1,
        "width": len(rows),
        "fields": [
            {"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1}
            for k, name in enumerate(columns)
        ],
        "is_bigendian": False,
        "point_step": rows.itemsize,
        "row_step": rows.nbytes,
        "data": rows.tobytes(),
        "is_dense": bool(np.isfinite(cloud.points).all()),
    }


def _marker(number: int, marker: Marker) -> dict[str, Any]:
    at = [dict(zip("xyz", xyz, strict=True)) for xyz in marker.points.tolist()]
    colours = [{"r": r, "g": g, "b": b, "a": 1.0} for r, g, b in (marker.rgb / 255.0).tolist()]
    text = marker.kind == "text"
    return {
        "header": _header(MAP_FRAME),
        "ns": marker.group,
        "id": number,
        "type": KINDS[marker.kind],
        "pose": {
            "position": at[0] if text else dict.fromkeys("xyz", 0.0),
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
        "scale": dict.fromkeys("xyz", marker.size),
        "color": colours[0],
        "points": [] if text else at,
        "colors": [] if text else colours,
        "text": marker.text,
    }
