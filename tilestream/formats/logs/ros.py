"""ROS messages as bytes and back to numbers: clouds and poses.

Only the five types that carry scans and poses, whose layout ROS fixes; so a log's own schema
texts (or IDL, or none) do not matter. ROS 2 writes them as CDR, ROS 1 without gaps.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError

POINT_CLOUD = "sensor_msgs/PointCloud2"
ODOMETRY = "nav_msgs/Odometry"
POSE = "geometry_msgs/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/PoseWithCovarianceStamped"
TF = "tf2_msgs/TFMessage"
POSE_TYPES = (ODOMETRY, POSE, POSE_COVARIANCE)
OTHER_NAMES = {"tf/tfMessage": TF}
"""Types that ROS 1 had another name for."""

POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField's datatype -> NumPy type, byte order aside."""


class Cdr:
    """The fields of a CDR message, taken one after the other (OMG CDR, version 1)."""

    def __init__(self, data: memoryview) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise CorruptSourceError("not a CDR message of version 1")
        self.order = "<" if data[1] else ">"
        self.data = data
        self.at = 4

    def take(self, kind: str, count: int = 1) -> tuple[float, ...]:
        """`count` numbers of one `struct` code, aligned to their size."""
        self.at += -(self.at - 4) % struct.calcsize("=" + kind)
        return self._next(kind, count)

    def _next(self, kind: str, count: int) -> tuple[float, ...]:
        code = f"{self.order}{count}{kind}"
        values = struct.unpack_from(code, self.data, self.at)
        self.at += struct.calcsize(code)
        return values

    def integer(self, kind: str = "I") -> int:
        """One integer."""
        return int(self.take(kind)[0])

    def text(self) -> str:
        """One string, its closing NUL taken off."""
        length = self.integer()
        return bytes(self.bytes(length)).rstrip(b"\0").decode("utf-8", errors="replace")

    def bytes(self, length: int) -> memoryview:
        """The next bytes as they are."""
        if self.at + length > len(self.data):
            raise struct.error(f"{length} bytes claimed, {len(self.data) - self.at} left")
        self.at += length
        return self.data[self.at - length : self.at]

    def header(self) -> tuple[int, str]:
        """std_msgs/Header: stamp [ns] and frame, a leading slash taken off."""
        seconds = self.integer("i")
        nanoseconds = self.integer()
        return seconds * 1_000_000_000 + nanoseconds, self.text().lstrip("/")


class Ros1(Cdr):
    """The fields of a ROS 1 message: little-endian, no gaps, a number in each header."""

    def __init__(self, data: memoryview) -> None:
        self.order = "<"
        self.data = data
        self.at = 0

    def take(self, kind: str, count: int = 1) -> tuple[float, ...]:
        """`count` numbers of one `struct` code."""
        return self._next(kind, count)

    def header(self) -> tuple[int, str]:
        """std_msgs/Header: stamp [ns] and frame, a leading slash taken off."""
        _, seconds, nanoseconds = self.take("I", 3)
        return int(seconds) * 1_000_000_000 + int(nanoseconds), self.text().lstrip("/")


ENCODINGS = {"cdr": Cdr, "ros1": Ros1}
"""How messages are written, by the name that MCAP has for it."""


@dataclass(frozen=True)
class Pose:
    """A pose at a time: where the frame `child` is in the frame `parent`."""

    stamp_ns: int
    """Time [ns since the epoch]."""
    parent: str
    """Frame in which the pose is given."""
    child: str
    """Frame whose pose it is; empty where the message type does not tell."""
    numbers: tuple[float, ...]
    """x, y, z [m], qx, qy, qz, qw."""


def read_poses(message_type: str, data: memoryview, encoding: str) -> list[Pose]:
    """The poses in a message of one of the four types that carry them, in one of `ENCODINGS`.

    Raises:
        CorruptSourceError: the message is shorter than its type.
    """
    try:
        cdr = ENCODINGS[encoding](data)
        if message_type == TF:
            return [_transform(cdr) for _ in range(cdr.integer())]
        stamp, parent = cdr.header()
        child = cdr.text().lstrip("/") if message_type == ODOMETRY else ""
        return [Pose(stamp, parent, child, cdr.take("d", 7))]
    except struct.error as error:
        raise CorruptSourceError(f"a {message_type} that is too short ({error})") from error


def _transform(cdr: Cdr) -> Pose:
    stamp, parent = cdr.header()
    return Pose(stamp, parent, cdr.text().lstrip("/"), cdr.take("d", 7))


@dataclass(frozen=True, eq=False)
class Cloud:
    """A sensor_msgs/PointCloud2, its points still packed."""

    stamp_ns: int
    """Time of the header [ns since the epoch]."""
    frame: str
    """Frame of the points."""
    height: int
    """Rows; 1 for a cloud that is not organised."""
    width: int
    """Points per row."""
    fields: tuple[tuple[str, str], ...]
    """Name and NumPy type of each field."""
    dtype: np.dtype[np.void]
    """One point."""
    row_step: int
    """Bytes from row to row."""
    data: memoryview
    """The packed points."""

    @property
    def points(self) -> int:
        """Number of points, finite or not."""
        return self.height * self.width

    def rows(self) -> NDArray[np.void]:
        """(height * width,) points as a structured array."""
        strides = (self.row_step, self.dtype.itemsize)
        shape = (self.height, self.width)
        return np.ndarray(shape, self.dtype, buffer=self.data, strides=strides).reshape(-1)


def read_cloud(data: memoryview, encoding: str) -> Cloud:
    """The layout of a cloud, checked against its bytes; the points stay packed.

    Args:
        data: the message.
        encoding: one of `ENCODINGS`.

    Raises:
        CorruptSourceError: x, y or z is missing or not a float, a field has an unknown type or
            lies outside of the point, or the data is shorter than height, width and steps say.
    """
    try:
        cdr = ENCODINGS[encoding](data)
        stamp, frame = cdr.header()
        height, width = cdr.integer(), cdr.integer()
        fields = [
            (cdr.text(), cdr.integer(), cdr.integer("B"), cdr.integer())
            for _ in range(cdr.integer())
        ]
        order = ">" if cdr.integer("B") else "<"
        point_step, row_step = cdr.integer(), cdr.integer()
        packed = cdr.bytes(cdr.integer())
    except struct.error as error:
        raise CorruptSourceError(f"a {POINT_CLOUD} that is too short ({error})") from error
    dtype = _point_type(fields, order, point_step)
    if height <= 1 or len(packed) == height * width * point_step:  # whatever row_step says
        row_step = width * point_step
    elif row_step < width * point_step:
        raise CorruptSourceError(
            f"row_step is {row_step}, but {width} points of {point_step} bytes need more"
        )
    needed = max(height - 1, 0) * row_step + width * point_step
    if len(packed) < needed and height * width:
        raise CorruptSourceError(
            f"data has {len(packed)} bytes, but {height} x {width} points of {point_step} bytes "
            f"need {needed}"
        )
    kinds = tuple((name, np.dtype(POINT_FIELD_TYPES[kind]).name) for name, _, kind, _ in fields)
    return Cloud(stamp, frame, height, width, kinds, dtype, row_step, packed)


def _point_type(
    fields: list[tuple[str, int, int, int]], order: str, point_step: int
) -> np.dtype[np.void]:
    formats, offsets = {}, {}
    for name, offset, kind, count in fields:
        if kind not in POINT_FIELD_TYPES:
            raise CorruptSourceError(f"field {name!r} has the unknown datatype {kind}")
        if offset + np.dtype(POINT_FIELD_TYPES[kind]).itemsize * max(count, 1) > point_step:
            raise CorruptSourceError(
                f"field {name!r} lies outside of its point ({point_step} bytes)"
            )
        formats[name] = order + POINT_FIELD_TYPES[kind]
        offsets[name] = offset
    for name in ("x", "y", "z"):
        if formats.get(name, "")[1:] not in ("f4", "f8"):
            found = ", ".join(formats) or "none"
            raise CorruptSourceError(f"no field {name!r} of type float32 or float64 (has: {found})")
    return np.dtype(
        {
            "names": list(formats),
            "formats": list(formats.values()),
            "offsets": list(offsets.values()),
            "itemsize": point_step,
        }
    )
