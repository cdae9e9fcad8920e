"""The poses of a topic as they come, and whether they are those of one publisher."""

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import PoseError
from tilestream.formats.logs import ros
from tilestream.formats.logs.poses import Edge, inverse, matrices, trajectory
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64, Int64, Trajectory

APART_M, APART_DEG = 0.1, 1.0
"""Two that give the poses of one frame at one time contradict each other beyond this [m, deg]."""
OFTEN = 0.05
"""Share of the poses that go back and forth, or are another at the same time, from which on there
are two publishers."""
HARDEST = (15.0, 2000.0)
"""No vehicle, nor a lidar that is carried, is turned round harder [m/s^2, deg/s^2]."""
AT_LEAST = 3
"""So many go back and forth at least."""


@dataclass
class PoseTrack:
    """The poses of one topic as they come, by pair of frames."""

    topic: str
    """Its name."""
    type: str
    """Its message type."""
    encoding: str = "cdr"
    """How its messages are written, one of `ros.ENCODINGS`."""
    stamps: dict[Edge, "array[int]"] = field(default_factory=dict)
    """Time of each pose [ns]."""
    numbers: dict[Edge, "array[float]"] = field(default_factory=dict)
    """x, y, z [m], qx, qy, qz, qw of each pose, one after the other."""

    def add(self, poses: list[ros.Pose]) -> None:
        """Take in the poses of one message."""
        for pose in poses:
            edge = (pose.parent, pose.child)
            self.stamps.setdefault(edge, array("q")).append(pose.stamp_ns)
            self.numbers.setdefault(edge, array("d")).extend(pose.numbers)

    @property
    def count(self) -> int:
        """Number of poses."""
        return sum(len(stamps) for stamps in self.stamps.values())

    @property
    def static(self) -> bool:
        """Whether its poses hold at all times."""
        return self.type == ros.TF and self.topic.rpartition("/")[2] == "tf_static"

    def recorded(self, edge: Edge) -> tuple[Int64, Float64]:
        """(k,) times [ns] and (k, 7) numbers of one pair of frames, as they came."""
        stamps: Int64 = np.frombuffer(self.stamps[edge], dtype=np.int64)
        numbers: Float64 = np.frombuffer(self.numbers[edge], dtype=np.float64)
        return stamps, numbers.reshape(-1, 7)

    def poses(self, path: str, edge: Edge, notes: list[str]) -> Trajectory:
        """The poses of one pair of frames in order of time; notes how many are unusable.

        Raises:
            PoseError: none is usable, or they contradict each other as those of two publishers do.
        """
        stamps, numbers = self.recorded(edge)
        name = f"{self.topic} ({edge[0]} -> {edge[1]})" if self.type == ros.TF else self.topic
        poses, unusable = trajectory(stamps, numbers, edge[1])
        if not len(poses.stamps_ns):
            raise PoseError(
                f"{path}: none of the {unusable} poses of {name} is usable (not finite, or no "
                "rotation)"
            )
        _check_one_publisher(
            path, f"{self.topic} has {edge[0]} -> {edge[1] or '?'}", stamps, numbers
        )
        if unusable:
            notes.append(f"{unusable} poses of {name} left out: not finite, or a time twice")
        return poses


def apart(T_a: Float64, T_b: Float64) -> tuple[Float64, Float64]:
    """(k,) how far poses are apart [m], and turned against each other [deg]; (k, 4, 4) each."""
    turned = np.full(len(T_a), np.nan)
    known = np.isfinite(T_a).all(axis=(1, 2)) & np.isfinite(T_b).all(axis=(1, 2))
    if known.any():
        between = (inverse(T_a[known]) @ T_b[known])[:, :3, :3]
        turned[known] = np.degrees(Rotation.from_matrix(between).magnitude())
    return norms(T_a[:, :3, 3] - T_b[:, :3, 3]), turned


def beyond(metres: Float64, degrees: Float64) -> NDArray[np.bool_]:
    """Which poses are farther apart than two that agree; False where it is not known."""
    with np.errstate(invalid="ignore"):
        found: NDArray[np.bool_] = (metres > APART_M) | (degrees > APART_DEG)
    return found


def _check_one_publisher(path: str, what: str, stamps_ns: Int64, numbers: Float64) -> None:
    """Refuse poses that go back and forth, or that are others at the same time.

    A vehicle does not leave by more than `APART_M` or `APART_DEG` and come back to half of it
    within two steps, at an acceleration beyond `HARDEST`; that often, the poses are those of two
    publishers in turn.
    """
    usable = np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, 3:]).sum(axis=1) > 1e-6)
    order = np.argsort(stamps_ns[usable], kind="stable")
    T, times = matrices(numbers[usable][order]), stamps_ns[usable][order]
    metres, degrees = apart(T[:-1], T[1:])
    twice = beyond(metres, degrees) & (np.diff(times) == 0)
    seconds = (times[2:] - times[:-2]) / 2e9
    back = np.zeros(len(seconds), dtype=bool)
    for steps, left, least, hardest in zip(
        (metres, degrees), apart(T[:-2], T[2:]), (APART_M, APART_DEG), HARDEST, strict=True
    ):
        there = np.minimum(steps[:-1], steps[1:])
        back |= (there > least) & (left < 0.5 * there) & (2.0 * there > hardest * seconds**2)
    many = OFTEN * len(T)
    if twice.sum() > many or back.sum() >= max(AT_LEAST, many):
        at = np.flatnonzero(twice)[0] if twice.sum() > many else np.flatnonzero(back)[0]
        raise PoseError(
            f"{path}: {what} of two publishers, it seems: it goes back and forth by "
            f"{metres[at]:.2f} m and {degrees[at]:.1f} deg, first at {times[at] / 1e9:.3f} s: "
            "give a pose_topic that does not need it, or record it of one"
        )
