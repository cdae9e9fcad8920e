"""The tree of frames of a log: what its transforms are between any two, and at which times."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tilestream.errors import PoseError
from tilestream.formats.logs.pose_tracks import PoseTrack, apart, beyond
from tilestream.formats.logs.poses import Edge, interpolate, inverse, matrices, path_between
from tilestream.records import Float64, Int64, Trajectory
from tilestream.settings import LogOptions

SAME_M, SAME_DEG = 0.01, 0.1
"""Two that give the same mount contradict each other beyond this [m, deg]."""
CONSTANT = 1e-6
"""A transform that never changes by more holds at all times [m, and of a rotation matrix]."""

Way = list[Edge]
"""From frame to frame: (parent, child), or (child, parent) against its direction."""


@dataclass(frozen=True, eq=False)
class Link:
    """The transforms of one pair of frames."""

    topics: str
    """Who gives them."""
    poses: Trajectory
    """Of the child in the parent."""
    holds: bool
    """Whether the first holds at all times."""

    def at(self, stamps_ns: Int64, options: LogOptions) -> Float64:
        """(m, 4, 4) at some times, NaN where there is none."""
        if self.holds:
            return np.broadcast_to(self.poses.T_map_lidar[:1], (len(stamps_ns), 4, 4))
        return interpolate(self.poses, stamps_ns, options.max_gap_s, options.max_speed_mps)[0]


@dataclass
class Frames:
    """The transforms that the tf topics of a log give, of all its files together.

    What contradicts itself is refused when it is used, and only then: two topics or publishers that
    give one pair of frames, and two ways between two frames.
    """

    path: str
    """The log."""
    tracks: list[PoseTrack]
    """Its tf topics."""
    options: LogOptions
    """How far is interpolated."""
    notes: list[str]
    """Takes what a user should know."""
    _links: dict[Edge, Link] = field(default_factory=dict)

    @cached_property
    def edges(self) -> dict[Edge, list[PoseTrack]]:
        """Who gives each pair of frames."""
        found: dict[Edge, list[PoseTrack]] = {}
        for track in self.tracks:
            for edge in track.stamps:
                found.setdefault(edge, []).append(track)
        return found

    @property
    def names(self) -> list[str]:
        """All frames."""
        return sorted({frame for edge in self.edges for frame in edge})

    def above(self, frame: str) -> list[str]:
        """The frames that carry a frame, itself first, then parents before their parents."""
        seen = [frame]
        for at in seen:
            seen += sorted({a for a, b in self.edges if b == at} - set(seen))
        return seen

    def roots(self, frame: str) -> list[str]:
        """The frames above a frame (or it) that no other carries."""
        children = {child for _, child in self.edges}
        return [above for above in self.above(frame) if above not in children]

    def way(self, source: str, target: str, without: tuple[Edge, ...] = ()) -> Way | None:
        """The shortest way from frame to frame; None: there is none."""
        return path_between([edge for edge in self.edges if edge not in without], source, target)

    def along(self, way: Way, stamps_ns: Int64) -> Float64:
        """(m, 4, 4) the pose of the end of a way in its beginning, NaN where there is none.

        Raises:
            PoseError: the transforms contradict each other.
        """
        T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        for edge in way:
            step = self.link(self.given(edge)).at(stamps_ns, self.options)
            T = T @ (step if edge in self.edges else inverse(step))
        self._note_other_parents([self.given(edge) for edge in way])
        return T

    def given(self, edge: Edge) -> Edge:
        """A step of a way as the log gives it, from parent to child."""
        return edge if edge in self.edges else edge[::-1]

    def stamps_of(self, way: Way) -> Int64:
        """The times at which something on a way is given anew; where nothing moves, those at which
        it is said again and again, else once.
        """
        links = [self.link(self.given(edge)) for edge in way]
        moving = [link.poses.stamps_ns for link in links if not link.holds]
        once = [link.poses.stamps_ns for link in links]
        again = [stamps for stamps in once if len(stamps) > 1]
        return np.unique(np.concatenate(moving or again or once))

    def holds(self, way: Way) -> bool:
        """Whether what a way gives holds at all times."""
        return all(self.link(self.given(edge)).holds for edge in way)

    def link(self, edge: Edge) -> Link:
        """The transforms of a pair of frames, checked against all others that give them.

        Raises:
            PoseError: they contradict each other.
        """
        if edge not in self._links:
            self._links[edge] = self._together(edge)
            self._compare_with_other_way(edge)
        return self._links[edge]

    def _together(self, edge: Edge) -> Link:
        first, *others = [self._of_topic(track, edge) for track in self.edges[edge]]
        for other in others:
            self._agree(f"{edge[0]} -> {edge[1]}", first, other)
        return first

    def _of_topic(self, track: PoseTrack, edge: Edge) -> Link:
        what = f"{edge[0]} -> {edge[1]}"
        if not track.static:
            poses = track.poses(self.path, edge, self.notes)
            T = poses.T_map_lidar
            holds = bool(np.abs(T - T[0]).max() <= CONSTANT)
            if holds:
                self.notes.append(f"{what} is always the same on {track.topic}: taken as static")
            return Link(track.topic, poses, holds)
        stamps, numbers = track.recorded(edge)
        usable = np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, 3:]).sum(axis=1) > 1e-6)
        if not usable.any():
            raise PoseError(
                f"{self.path}: none of the transforms {what} of {track.topic} is usable (not "
                "finite, or no rotation)"
            )
        T = matrices(numbers[usable])
        poses = Trajectory(stamps[usable][:1], T[:1], edge[1])
        metres, degrees = apart(np.broadcast_to(T[:1], T.shape), T)
        if metres.max() > SAME_M or degrees.max() > SAME_DEG:
            worst = int(np.argmax(np.maximum(metres / SAME_M, degrees / SAME_DEG)))
            raise PoseError(
                f"{self.path}: {track.topic} gives {what} twice, {_told(T[0])} and "
                f"{_told(T[worst])}: give the right mount as extrinsic (--extrinsic), or record "
                "one of them"
            )
        if metres.max() > CONSTANT or degrees.max() > CONSTANT:
            self.notes.append(
                f"{track.topic} gives {what} twice, {metres.max() * 1000:.1f} mm and "
                f"{degrees.max():.3f} deg apart: took the first"
            )
        return Link(track.topic, poses, True)

    def _agree(self, what: str, one: Link, other: Link) -> None:
        """Refuse two that give the same and contradict each other; note those that do not."""
        moving = other if one.holds else one
        stamps = moving.poses.stamps_ns
        T_one, T_other = one.at(stamps, self.options), other.at(stamps, self.options)
        self.compare(what, one.topics, other.topics, T_one, T_other)

    def compare(self, what: str, one: str, other: str, T_one: Float64, T_other: Float64) -> None:
        """Refuse what two give of one pair of frames where it is not the same in the middle of all
        times that both have, (k, 4, 4) each; else note it.

        Raises:
            PoseError: they contradict each other; names both.
        """
        metres, degrees = apart(T_one, T_other)
        known = np.isfinite(metres)
        if not known.any():
            self.notes.append(
                f"{what} is given by {one} and {other}, never at one time: took {one}"
            )
            return
        between = np.median(metres[known]), np.median(degrees[known])
        told = f"{between[0]:.3f} m and {between[1]:.2f} deg apart"
        if beyond(*np.array(between)[:, None])[0]:
            raise PoseError(
                f"{self.path}: {what} is given by {one} and by {other}, {told}: name the right one "
                "as pose_topic (a tf topic too), or record one of them"
            )
        self.notes.append(f"{what} is given by {one} and {other}, {told}: took {one}")

    def _compare_with_other_way(self, edge: Edge) -> None:
        """A second way between two frames has to agree."""
        link, (parent, child) = self._links[edge], edge
        other = self.way(parent, child, without=(edge,))
        if not other:
            return
        stamps = self.stamps_of(other) if link.holds else link.poses.stamps_ns
        T_other, T_link = self.along(other, stamps), link.at(stamps, self.options)
        around = " -> ".join([parent, *(b for _, b in other)])
        self.compare(f"{parent} -> {child}", link.topics, around, T_link, T_other)

    def _note_other_parents(self, used: Way) -> None:
        """Note what also carries a frame on a way, and leads nowhere that could be compared."""
        for parent, child in used:
            others = [a for a, b in self.edges if b == child and (a, b) not in used]
            others = [a for a in others if self.way(a, child, without=((a, child),)) is None]
            if others:
                self.notes.append(
                    f"{child} has several parents: took the transforms from {parent}, not from "
                    f"{', '.join(sorted(others))}"
                )


def _told(T: Float64) -> str:
    """A mount as (x, y, z) [m]."""
    x, y, z = T[:3, 3]
    return f"({x:.3f}, {y:.3f}, {z:.3f})"
