"""The poses of the lidar in the map, from those that a log has: resolved, or refused by name."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tilestream.errors import PoseError
from tilestream.formats.logs import ros
from tilestream.formats.logs.base import METADATA
from tilestream.formats.logs.frames import Frames, Way
from tilestream.formats.logs.pose_tracks import PoseTrack, apart, beyond
from tilestream.formats.logs.poses import Edge
from tilestream.records import Float64, Trajectory
from tilestream.settings import LogOptions

NO_POSES = f"no poses; a log needs {', '.join(ros.POSE_TYPES)} or {ros.TF} messages"
MAP = "map"
"""The frame of the map by convention (ROS REP 105)."""
VEHICLE = ("base_link", "base_footprint", "base")
"""What the frame of a vehicle is called by convention: what a localizer poses (ROS REP 105)."""


@dataclass
class LidarPoses:
    """How the poses of a log become those of its lidar in the map.

    The map is the frame that is given, else `map`, else the one root above the poses, unless that
    is an odometry's. Transforms lead from there to the frame in which poses are given, and from the
    frame that they pose to that of the clouds; or the mount is given.

    Which frame a topic poses that does not say: the one that is given; else the one above the lidar
    that tf has at the same places; else, where tf has none of them moving, the one that is called
    as a vehicle is.
    """

    path: str
    """The log."""
    frames: Frames
    """Its transforms."""
    lidar: str
    """Frame of its clouds; empty where it names none."""
    options: LogOptions
    """What is given."""
    notes: list[str]
    """Takes what was assumed."""

    def of_topic(self, track: PoseTrack) -> Trajectory:
        """From the poses of a topic.

        Raises:
            PoseError: something leads nowhere, is not said, or contradicts itself.
        """
        if len(track.stamps) > 1:
            pairs = ", ".join(f"{parent} -> {child or '?'}" for parent, child in track.stamps)
            raise PoseError(
                f"{self.path}: {track.topic} has poses of several pairs of frames: {pairs}"
            )
        edge = next(iter(track.stamps))
        poses = track.poses(self.path, edge, self.notes)
        parent = edge[0] or self._unnamed_parent(track.topic)
        map_frame = self._map_frame(track.topic, parent)
        child = self._posed(track.topic, (parent, edge[1]), poses)
        if child != self.lidar:
            self._check_clouds({parent, map_frame, *self.frames.above(parent)})
        own = ((parent, child), (child, parent)) if child else ()
        self._check_against_tf(track.topic, (parent, child), map_frame, poses)
        T = poses.T_map_lidar
        if parent != map_frame:
            T = self._from_map(track.topic, map_frame, parent, own, poses) @ T
        T = self._to_lidar(track.topic, child, own, Trajectory(poses.stamps_ns, T))
        return self._posed_only(track.topic, replace(poses, T_map_lidar=T))

    def of_tf(self, topic: str) -> Trajectory:
        """From the transforms alone.

        Raises:
            PoseError: as `of_topic`.
        """
        mount, frames = self.options.mount, self.frames
        moved = _bare(self.options.pose_frame) if mount is not None else self.lidar
        if not moved:
            what = (
                "pose_frame (--pose-frame)" if mount is not None else "lidar_frame (--lidar-frame)"
            )
            raise PoseError(
                f"{self.path}: which frame of {topic} is the lidar's is not said: give {what}, one "
                f"of {', '.join(frames.names)}"
            )
        map_frame = self._map_frame(topic, moved)
        self._check_clouds({map_frame})
        way = frames.way(map_frame, moved)
        if not way:
            raise PoseError(
                f"{self.path}: tf does not lead from {map_frame!r} to the lidar's frame {moved!r}; "
                f"its frames: {', '.join(frames.names)}: give map_frame (--map-frame) or "
                f"lidar_frame (--lidar-frame){self._of_a_bag()}"
            )
        stamps = frames.stamps_of(way)
        T = frames.along(way, stamps)
        known = np.isfinite(T).all(axis=(1, 2))
        if not known.any():
            raise PoseError(
                f"{self.path}: at no time does tf have all transforms from {map_frame!r} to "
                f"{moved!r}"
            )
        self.notes.append(f"poses of {moved} in {map_frame} from tf")
        poses = Trajectory(stamps[known], T[known], moved)
        return poses if mount is None else self._with_mount(topic, moved, poses)

    def _check_clouds(self, fixed: set[str]) -> None:
        """Refuse clouds that somebody has moved into the map, or into another fixed frame."""
        if self.lidar in fixed and self.options.mount is None:
            raise PoseError(
                f"{self.path}: the clouds are in {self.lidar!r}, in which the lidar moves: "
                "name the topic of its own scans as points_topic, or give lidar_frame "
                "(--lidar-frame) if they are named wrongly"
            )

    def _unnamed_parent(self, topic: str) -> str:
        given = _bare(self.options.map_frame)
        if not given:
            raise PoseError(
                f"{self.path}: {topic} does not say in which frame its poses are: give map_frame "
                "(--map-frame map) if they are in the map's"
            )
        self.notes.append(f"{topic} does not say in which frame its poses are: {given}, as given")
        return given

    def _map_frame(self, topic: str, below: str) -> str:
        """Which frame is the map's."""
        given = _bare(self.options.map_frame)
        if given:
            return given
        if MAP in (below, *self.frames.names):
            return MAP
        roots = self.frames.roots(below)
        if len(roots) != 1:
            raise PoseError(
                f"{self.path}: no frame is called {MAP!r}, and above the poses of {topic} are "
                f"several roots: give map_frame (--map-frame), one of {', '.join(roots) or below}"
            )
        if is_odometry(roots[0]):
            raise self._nowhere(topic, MAP, roots[0])
        self.notes.append(
            f"no frame is called {MAP!r}: took {roots[0]}, the root of the frames, as the map's"
        )
        return roots[0]

    def _nowhere(self, topic: str, map_frame: str, parent: str) -> PoseError:
        return PoseError(
            f"{self.path}: {topic} has its poses in the frame {parent!r}, and no transforms of the "
            f"log lead from {map_frame!r} to it: give map_frame (--map-frame {parent}) if the map "
            f"was made in it, or another pose_topic (a tf topic too){self._of_a_bag()}"
        )

    def _posed(self, topic: str, edge: Edge, poses: Trajectory) -> str:
        """Which frame a topic poses; empty where the mount is given, so that it does not matter."""
        given, said = _bare(self.options.pose_frame), edge[1]
        if given:
            if said and said != given:
                self.notes.append(f"{topic} says that it poses {said}: taken as {given}, as given")
            return given
        if said or self.options.mount is not None:
            return said
        candidates = self.frames.above(self.lidar) if self.lidar else []
        found = self._as_tf_has_it(edge[0], candidates, poses)
        if found is None:
            named = [frame for frame in candidates if frame.rpartition("/")[2] in VEHICLE]
            if len(named) == 1:
                self.notes.append(
                    f"{topic} does not say which frame it poses: took {named[0]}, the vehicle by "
                    "its name; pose_frame (--pose-frame) says otherwise"
                )
                return named[0]
        elif found:
            self.notes.append(
                f"{topic} does not say which frame it poses: {found}, which is there in tf"
            )
            return found
        raise PoseError(
            f"{self.path}: {topic} does not say which frame it poses: give pose_frame "
            f"(--pose-frame), one of {', '.join(candidates) or 'its frames'}"
            + (f"; {self.lidar} if they are the lidar's own" if self.lidar else "")
        )

    def _as_tf_has_it(self, parent: str, candidates: list[str], poses: Trajectory) -> str | None:
        """The frame that tf has at the same places in the middle of all times; None: tf has none of
        them moving in this parent; empty: it has, and none is there.
        """
        found: dict[str, float] = {}
        moving = False
        for frame in candidates:
            way = self.frames.way(parent, frame)
            if not way or self.frames.holds(way):
                continue
            T = self.frames.along(way, poses.stamps_ns)
            metres, degrees = apart(T, poses.T_map_lidar)
            if not np.isfinite(metres).any():
                continue
            moving = True
            middle = np.array([np.nanmedian(metres)]), np.array([np.nanmedian(degrees)])
            if not beyond(*middle)[0]:
                found[frame] = float(middle[0][0])
        return min(found, key=lambda frame: found[frame]) if found else "" if moving else None

    def _check_against_tf(self, topic: str, edge: Edge, map_frame: str, poses: Trajectory) -> None:
        """Refuse poses of a topic that tf has elsewhere: by both, a log would be in two places.

        Poses that are in the map's frame, of a topic that was named, are taken as they are.
        """
        parent, child = edge
        way = self.frames.way(parent, child) if child else None
        if not way:
            return
        if self.options.pose_topic == topic and parent == map_frame:
            return
        given = [self.frames.given(edge) for edge in way]
        given_by = ", ".join(sorted({self.frames.link(edge).topics for edge in given}))
        T = self.frames.along(way, poses.stamps_ns)
        self.frames.compare(f"{parent} -> {child}", topic, given_by, poses.T_map_lidar, T)

    def _from_map(
        self, topic: str, map_frame: str, parent: str, own: Sequence[Edge], poses: Trajectory
    ) -> Float64:
        way = self.frames.way(map_frame, parent, tuple(own))
        if way is None:
            raise self._nowhere(topic, map_frame, parent)
        self.notes.append(f"poses of {topic} carried from {parent} to {map_frame} by {_said(way)}")
        return self.frames.along(way, poses.stamps_ns)

    def _to_lidar(self, topic: str, child: str, own: Sequence[Edge], poses: Trajectory) -> Float64:
        """The poses, (k, 4, 4), moved from the frame that is posed to the lidar."""
        if self.options.mount is not None:
            return self._with_mount(topic, child, poses).T_map_lidar
        if not self.lidar:
            raise PoseError(
                f"{self.path}: the clouds name no frame: give lidar_frame (--lidar-frame {child} "
                f"if the poses of {topic} are the lidar's), or the mount as extrinsic (--extrinsic)"
            )
        if child == self.lidar:
            return poses.T_map_lidar
        way = self.frames.way(child, self.lidar, tuple(own))
        if way is None:
            raise PoseError(
                f"{self.path}: {topic} has poses of {child}, and no transforms of the log lead "
                f"from there to the clouds' frame {self.lidar}: give the mount, the pose of the "
                f"lidar in {child}, as extrinsic (--extrinsic x,y,z,roll,pitch,yaw), or pose_frame "
                f"(--pose-frame {self.lidar}) if the poses are the lidar's{self._of_a_bag()}"
            )
        how = "static transforms" if self.frames.holds(way) else "transforms"
        self.notes.append(f"poses of {child} carried to {self.lidar} by {how} of the log")
        return poses.T_map_lidar @ self.frames.along(way, poses.stamps_ns)

    def _with_mount(self, topic: str, child: str, poses: Trajectory) -> Trajectory:
        mount = self.options.mount
        assert mount is not None
        self.notes.append(
            f"the lidar is mounted on {child or f'what {topic} poses'} as given: "
            f"{self.options.extrinsic}"
        )
        return replace(poses, T_map_lidar=poses.T_map_lidar @ mount.T_base_lidar, frame=self.lidar)

    def _posed_only(self, topic: str, poses: Trajectory) -> Trajectory:
        """Without the poses that could not be carried, which are noted."""
        known, count = np.isfinite(poses.T_map_lidar).all(axis=(1, 2)), len(poses.stamps_ns)
        if known.all():
            return replace(poses, frame=self.lidar)
        if not known.any():
            raise PoseError(
                f"{self.path}: at no time of the {count} poses of {topic} does the log have "
                "all transforms that carry them to the map and the lidar"
            )
        self.notes.append(
            f"{int((~known).sum())} of {count} poses of {topic} left out: no transform at "
            "their time"
        )
        return Trajectory(poses.stamps_ns[known], poses.T_map_lidar[known], self.lidar)

    def _of_a_bag(self) -> str:
        """What may be missing: another file of the same recording."""
        folder = Path(self.path).parent
        if Path(self.path).is_file() and (folder / METADATA).is_file():
            return f"; the file is one of the rosbag2 {folder}: give that folder"
        return ""


def choose_poses(
    path: str,
    tracks: list[PoseTrack],
    cloud_frame: str,
    options: LogOptions,
    notes: list[str],
) -> tuple[str, Trajectory]:
    """Topic and poses of the lidar in the map; `LidarPoses` has the rules. Notes what was assumed.

    Args:
        path: the log.
        tracks: the poses of its topics, tf among them.
        cloud_frame: frame of its clouds, as recorded.
        options: what is given.
        notes: takes notes.

    Raises:
        PoseError: no poses, several topics that are equally good, or poses that cannot be resolved.
    """
    lidar = _bare(options.lidar_frame) or cloud_frame
    if cloud_frame and lidar != cloud_frame:
        notes.append(f"the clouds name the frame {cloud_frame}: taken as {lidar}, as given")
    named = options.pose_topic
    topics = [t for t in tracks if t.type in ros.POSE_TYPES and t.count]
    tf = [t for t in tracks if t.type == ros.TF and t.count]
    of_lidar = LidarPoses(path, Frames(path, tf, options, notes), lidar, options, notes)
    if named is None and topics:
        topic = _best(path, topics, _bare(options.map_frame) or MAP, notes)
        return topic.topic, of_lidar.of_topic(topic)
    for topic in topics:
        if topic.topic == named:
            return topic.topic, of_lidar.of_topic(topic)
    moving = [t for t in tf if not t.static]
    if not moving:
        raise PoseError(f"{path}: {NO_POSES}" + (f" on {named}" if named else ""))
    return named or moving[0].topic, of_lidar.of_tf(named or moving[0].topic)


def is_odometry(frame: str) -> bool:
    """Whether a frame is one of odometry by its name: its origin is where a drive began."""
    return "odom" in frame.rpartition("/")[2].lower()


def _bare(frame: str | None) -> str:
    return (frame or "").lstrip("/")


def _said(way: Way) -> str:
    return "tf " + " -> ".join([way[0][0], *(b for _, b in way)])


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
