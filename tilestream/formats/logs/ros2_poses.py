"""Which of a log's poses are the lidar's, and through which frames they lead to it."""

from array import array
from dataclasses import dataclass, field

import numpy as np

from tilestream.errors import PoseError
from tilestream.formats.logs import ros2
from tilestream.formats.logs.poses import Edge, compose, trajectory
from tilestream.records import Float64, Int64, Trajectory
from tilestream.settings import LogOptions

POSE_TYPES = (ros2.ODOMETRY, ros2.POSE, ros2.POSE_COVARIANCE)


@dataclass
class PoseTrack:
    """The poses of one topic as they come, by pair of frames."""

    topic: str
    """Its name."""
    type: str
    """Its message type."""
    stamps: dict[Edge, "array[int]"] = field(default_factory=dict)
    """Time of each pose [ns]."""
    numbers: dict[Edge, "array[float]"] = field(default_factory=dict)
    """x, y, z [m], qx, qy, qz, qw of each pose, one after the other."""

    def add(self, poses: list[ros2.Pose]) -> None:
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
        return self.type == ros2.TF and self.topic.rpartition("/")[2] == "tf_static"

    def poses(self, edge: Edge) -> tuple[Trajectory, int]:
        """The poses of one pair of frames, and how many of them are unusable. Of a static pair the
        last one, which holds at all times.
        """
        stamps: Int64 = np.frombuffer(self.stamps[edge], dtype=np.int64)
        numbers: Float64 = np.frombuffer(self.numbers[edge], dtype=np.float64).reshape(-1, 7)
        if self.static:
            stamps, numbers = stamps[-1:], numbers[-1:]
        return trajectory(stamps, numbers, edge[1])


def choose_poses(
    path: str,
    tracks: list[PoseTrack],
    lidar_frame: str,
    options: LogOptions,
    notes: list[str],
) -> tuple[str, Trajectory]:
    """Topic and poses of the lidar; see `mcap.open_mcap` for the rules. Notes what was assumed.

    Raises:
        PoseError: no poses, several topics that are equally good, or no way to the lidar.
    """
    named, pose_frame = options.pose_topic, options.pose_frame
    topics = [t for t in tracks if t.type in POSE_TYPES and t.count]
    tf = [t for t in tracks if t.type == ros2.TF]
    if named is None and topics:
        topic = _best(path, topics, options.map_frame or "map", notes)
        return topic.topic, _from_topic(path, topic, tf, lidar_frame, pose_frame, notes)
    for topic in topics:
        if topic.topic == named:
            return named, _from_topic(path, topic, tf, lidar_frame, pose_frame, notes)
    moving = [t for t in tf if t.count and not t.static]
    if not moving:
        raise PoseError(
            f"{path}: no poses; a log needs {ros2.ODOMETRY}, {ros2.POSE}, {ros2.POSE_COVARIANCE} "
            f"or {ros2.TF} messages" + (f" on {named}" if named else "")
        )
    return named or moving[0].topic, _from_tf(path, tf, lidar_frame, options, notes)


def _best(path: str, topics: list[PoseTrack], map_frame: str, notes: list[str]) -> PoseTrack:
    in_map = [t for t in topics if any(parent == map_frame for parent, _ in t.stamps)]
    candidates = in_map or topics
    most = max(t.count for t in candidates)
    best = [t for t in candidates if t.count == most]
    if len(best) > 1:
        raise PoseError(
            f"{path}: several topics have {most} poses each: "
            f"{', '.join(t.topic for t in best)}; name one as pose_topic"
        )
    others = ", ".join(f"{t.topic} ({t.count})" for t in topics if t is not best[0])
    if others:
        notes.append(f"of several topics of poses took {best[0].topic} ({most}), not {others}")
    return best[0]


def _from_topic(
    path: str,
    track: PoseTrack,
    tf: list[PoseTrack],
    lidar_frame: str,
    pose_frame: str | None,
    notes: list[str],
) -> Trajectory:
    if len(track.stamps) > 1:
        pairs = ", ".join(f"{parent} -> {child or '?'}" for parent, child in track.stamps)
        raise PoseError(f"{path}: {track.topic} has poses of several pairs of frames: {pairs}")
    edge = next(iter(track.stamps))
    poses, unusable = track.poses(edge)
    _note_unusable(path, track.topic, poses, unusable, notes)
    moving_frame = edge[1] or (pose_frame or "").lstrip("/")
    if moving_frame == lidar_frame:
        return poses
    taken = f"taken as those of the lidar ({lidar_frame or 'no frame'})"
    if not moving_frame:
        notes.append(
            f"{track.topic} does not say which frame it poses: {taken}; pose_frame tells it"
        )
        return poses
    static = {e: t.poses(e)[0] for t in tf if t.static for e in t.stamps}
    mounting = compose(static, moving_frame, lidar_frame, np.inf)
    if mounting is None:
        notes.append(
            f"{track.topic} has poses of {moving_frame}, and no static transforms lead from there "
            f"to the lidar: {taken}"
        )
        return poses
    notes.append(
        f"poses of {moving_frame} carried to {lidar_frame} by static transforms of the log"
    )
    return Trajectory(poses.stamps_ns, poses.T_map_lidar @ mounting.T_map_lidar[0], lidar_frame)


def _from_tf(
    path: str,
    tf: list[PoseTrack],
    lidar_frame: str,
    options: LogOptions,
    notes: list[str],
) -> Trajectory:
    edges: dict[Edge, Trajectory] = {}
    for track in tf:
        for edge in track.stamps:
            edges[edge], unusable = track.poses(edge)
            name = f"{track.topic} ({edge[0]} -> {edge[1]})"
            _note_unusable(path, name, edges[edge], unusable, notes)
    frames = {frame for edge in edges for frame in edge}
    root = "map" if "map" in frames else _root(edges, lidar_frame)
    map_frame = options.map_frame or root
    poses = compose(edges, map_frame, lidar_frame, options.max_gap_s)
    if poses is None:
        raise PoseError(
            f"{path}: tf does not lead from {map_frame!r} to the lidar's frame {lidar_frame!r}; "
            f"its frames: {', '.join(sorted(frames))}"
        )
    if not len(poses.stamps_ns):
        raise PoseError(
            f"{path}: at no time does tf have all transforms from {map_frame!r} to {lidar_frame!r}"
        )
    notes.append(f"poses of {lidar_frame} in {map_frame} from tf")
    return poses


def _root(edges: dict[Edge, Trajectory], frame: str) -> str:
    parents = {child: parent for parent, child in edges}
    seen = {frame}
    while (parent := parents.get(frame)) is not None and parent not in seen:
        frame = parent
        seen.add(frame)
    return frame


def _note_unusable(
    path: str, name: str, poses: Trajectory, unusable: int, notes: list[str]
) -> None:
    if not len(poses.stamps_ns):
        raise PoseError(
            f"{path}: none of the {unusable} poses of {name} is usable (not finite, or no rotation)"
        )
    if unusable:
        notes.append(f"{unusable} poses of {name} left out: not finite, or a time twice")
