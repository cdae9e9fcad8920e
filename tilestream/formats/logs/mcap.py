"""MCAP logs: scans with their poses, in slices; and a drive as map points.

A log is read through once when it is opened: every chunk that holds a cloud or a pose is unpacked,
its CRC tested, the poses kept, and of each cloud the layout is checked and the place noted. After
that any slice of scans is read by seeking to its chunks, whether the file has an index or not.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError, PoseError, SourceError, UsageError
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.formats.logs import ros2
from tilestream.formats.logs.log_poses import POSE_TYPES, PoseTrack, choose_poses
from tilestream.formats.logs.mcap_file import McapFile, Message, Topic
from tilestream.formats.logs.poses import PoseStatus, interpolate, transform
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64, Int64, Scan, Trajectory

MAX_GAP_S = 1.0
"""Longest time between two poses that is interpolated over [s]."""


@dataclass(frozen=True)
class ScanSelection:
    """Which scans of a log to use. Two selections with the same `every` and different `offset`, or
    one `until_s` and the other `from_s` the same time, share no scan: one maps, one localizes.
    """

    start: int = 0
    """First scan, counted over all scans of the log by header stamp."""
    stop: int | None = None
    """First scan not to use; None: to the end."""
    every: int = 1
    """Use the scans whose index leaves the remainder `offset` when divided by `every`."""
    offset: int = 0
    """See `every`; 0 <= offset < every."""
    from_s: float = 0.0
    """Use the scans from this time on [s after the first scan of the log]."""
    until_s: float | None = None
    """Use the scans before this time [s after the first scan of the log]; None: to the end."""

    def __post_init__(self) -> None:
        if self.every < 1 or not 0 <= self.offset < self.every:
            raise UsageError(
                f"scan selection: every = {self.every}, offset = {self.offset}; "
                "every must be at least 1 and offset from 0 to every - 1"
            )
        if self.start < 0 or (self.stop is not None and self.stop < self.start):
            raise UsageError(
                f"scan selection: start = {self.start}, stop = {self.stop}; "
                "start must be at least 0 and stop not before it"
            )

    def indices(self, stamps_ns: Int64) -> Int64:
        """Indices of the scans to use, rising, among scans with these (k,) rising stamps [ns]."""
        index = np.arange(len(stamps_ns))
        use = (index >= self.start) & (index % self.every == self.offset)
        if self.stop is not None:
            use &= index < self.stop
        if len(stamps_ns):
            since = (stamps_ns - stamps_ns[0]) / 1e9
            use &= since >= self.from_s
            if self.until_s is not None:
                use &= since < self.until_s
        return np.flatnonzero(use)


@dataclass(frozen=True, eq=False)
class ScanLog:
    """The scans of a log and where the lidar was, opened by `open_log`. A value: it holds no open
    file and can be sent to another process, which then need not read the log through again.
    """

    path: str
    """The file, as it was named."""
    size_bytes: int
    """Size of the file [bytes]."""
    topics: tuple[Topic, ...]
    """What was recorded, by name."""
    points_topic: str
    """Topic of the scans."""
    pose_topic: str
    """Topic of the poses."""
    frame: str
    """Frame of the points, as recorded."""
    fields: tuple[tuple[str, str], ...]
    """Name and type of each field of a point, as in the first scan."""
    stamps_ns: Int64
    """(k,) header stamps of all scans, in order [ns since the epoch]."""
    point_counts: Int64
    """(k,) points of each scan as its header claims, returns or not."""
    T_map_lidar: Float64
    """(k, 4, 4) pose of the lidar at each scan's stamp; NaN where it has none."""
    pose_status: NDArray[np.int8]
    """(k,) `PoseStatus`: POSED, or why the scan is skipped."""
    trajectory: Trajectory
    """The recorded poses, of the lidar."""
    notes: tuple[str, ...]
    """What a user should know: choices made, scans skipped, what was lost from a cut file."""
    places: Int64 = field(repr=False)
    """(k, 4) where each scan lies: offset of its chunk in the file, start and size of the message
    in the unpacked chunk, size of the unpacked chunk [bytes]."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(k,) which scans have a pose."""
        return np.equal(self.pose_status, PoseStatus.POSED)

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The posed scans of a slice of the log, by index in order of their stamps.

        Scans without a pose are left out (`pose_status` says why); points that are no returns are
        left out and counted in `Scan.dropped`.

        Raises:
            CorruptSourceError: the file is damaged, or is not the one that was opened.
        """
        return self.scans_at(np.arange(len(self))[start:stop:step])

    def scans_at(self, indices: Iterable[int] | Int64) -> Iterator[Scan]:
        """As `scans`, for any scans by index, e.g. of a `ScanSelection`."""
        wanted = [int(i) for i in indices if self.pose_status[i] == PoseStatus.POSED]
        for index, cloud in self.clouds_at(wanted):
            yield _scan(cloud, self.T_map_lidar[index])

    def clouds_at(self, indices: Iterable[int]) -> Iterator[tuple[int, ros2.Cloud]]:
        """Index and packed cloud of some scans, posed or not; each chunk is unpacked once for
        scans that follow each other in it.
        """
        with McapFile(self.path, topics=False) as file:
            unpacked, content = -1, b""
            for index in indices:
                record, start, size, _ = (int(value) for value in self.places[index])
                if record != unpacked:
                    unpacked, content = record, file.unpack(record)
                try:
                    cloud = ros2.read_cloud(memoryview(content)[start : start + size])
                except CorruptSourceError as error:
                    raise _located(self.path, self.points_topic, record, error) from error
                if cloud.stamp_ns != self.stamps_ns[index]:
                    raise CorruptSourceError(
                        f"{self.path}: has changed since it was opened; open it again"
                    )
                yield index, cloud

    def info(self, indices: Int64 | None = None) -> SourceInfo:
        """What is in the log; of the scans, those given by index (default: all)."""
        used = np.arange(len(self)) if indices is None else indices
        posed = used[self.posed[used]]
        path_m = norms(np.diff(self.T_map_lidar[posed, :3, 3], axis=0)).sum()
        stamps = self.stamps_ns[used]
        duration_s = (stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0
        # a chunk packed and unpacked, and one scan's columns
        largest_scan = int(self.point_counts[used].max(initial=0))
        resident = 2 * int(self.places[used, 3].max(initial=0)) + 80 * largest_scan
        return SourceInfo(
            path=self.path,
            format="mcap",
            size_bytes=self.size_bytes,
            points=int(self.point_counts[posed].sum()),
            bounds=None,
            fields=self.fields,
            crs=None,
            resident_bytes=resident,
            notes=(
                *(f"topic {t.name}: {t.type}, {t.messages} messages" for t in self.topics),
                (
                    f"{len(used)} scans of {self.points_topic} over {duration_s:.1f} s, "
                    f"{len(posed)} with a pose from {self.pose_topic}, along {path_m:.1f} m"
                ),
                *self.notes,
            ),
        )


def open_log(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    map_frame: str | None = None,
    pose_frame: str | None = None,
    max_gap_s: float = MAX_GAP_S,
) -> ScanLog:
    """Open a log of scans (sensor_msgs/PointCloud2) with poses (nav_msgs/Odometry,
    geometry_msgs/PoseStamped, PoseWithCovarianceStamped or tf2_msgs/TFMessage).

    The log is read through once; in one process a log that has not changed is not read again.

    Args:
        path: an .mcap file of ROS 2 messages.
        points_topic: topic of the scans; default: the PointCloud2 topic with the most messages.
        pose_topic: topic of the poses; default: among Odometry and Pose topics those given in
            `map_frame` (if there are any), then the one with the most messages; else tf.
        map_frame: frame that counts as the map; default `map`; with tf, where there is no such
            frame, the root of the tree above the lidar.
        pose_frame: frame whose poses these are, for topics that do not name it (PoseStamped).
            Static transforms of the log lead from it to the lidar. Without them, or without this
            name, the poses are taken as the lidar's, and `notes` says so.
        max_gap_s: longest time between two poses that is interpolated over [s].

    Raises:
        SourceNotFoundError: no such file.
        UnknownFormatError: not an MCAP file.
        CorruptSourceError: a CRC fails, or a message contradicts itself; names file and offset.
        SourceError: no clouds, or several topics that are equally good; names what is there.
        PoseError: no poses, none at the time of any scan, or several topics that are equally good.
    """
    path = str(path)
    try:
        stat = Path(path).stat()
        identity = (stat.st_size, stat.st_mtime_ns)
    except OSError:
        identity = (0, 0)  # McapFile says what is wrong with it
    return _open(path, identity, points_topic, pose_topic, map_frame, pose_frame, max_gap_s)


@lru_cache(maxsize=8)
def _open(
    path: str,
    identity: tuple[int, int],  # noqa: ARG001 - part of the cache's key
    points_topic: str | None,
    pose_topic: str | None,
    map_frame: str | None,
    pose_frame: str | None,
    max_gap_s: float,
) -> ScanLog:
    with McapFile(path) as file:
        notes: list[str] = []
        points_topic = _choose_clouds(file, points_topic, notes)
        tracks = _pose_tracks(file, pose_topic)
        index = _read_through(file, points_topic, tracks)
        if file.lost:
            notes.append(f"{file.lost}; {len(index.stamps)} whole scans recovered")
        if file.unchecked:
            notes.append("has records without a CRC: damage to them cannot be seen")
        pose_topic, poses = choose_poses(
            path, list(tracks.values()), index.frame, pose_topic, map_frame, pose_frame,
            max_gap_s, notes,
        )  # fmt: skip
        order = np.argsort(np.asarray(index.stamps), kind="stable")
        stamps = np.asarray(index.stamps, dtype=np.int64)[order]
        T_map_lidar, status = interpolate(poses, stamps, max_gap_s)
        notes += _skipped(path, stamps, status, poses, max_gap_s)
        return ScanLog(
            path=path,
            size_bytes=file.size,
            topics=file.topics,
            points_topic=points_topic,
            pose_topic=pose_topic,
            frame=index.frame,
            fields=index.fields,
            stamps_ns=stamps,
            point_counts=np.asarray(index.counts, dtype=np.int64)[order],
            T_map_lidar=T_map_lidar,
            pose_status=status,
            trajectory=poses,
            notes=tuple(notes),
            places=np.asarray(index.places, dtype=np.int64)[order],
        )


def _choose_clouds(file: McapFile, named: str | None, notes: list[str]) -> str:
    """The topic of the scans."""
    there = ", ".join(f"{t.name} ({t.type or 'no type'}, {t.messages})" for t in file.topics)
    clouds = [t for t in file.topics if t.type == ros2.POINT_CLOUD and t.messages]
    if named is not None:
        clouds = [t for t in clouds if t.name == named]
    if not clouds:
        what = f"no {ros2.POINT_CLOUD} messages" + (f" on topic {named}" if named else "")
        cut = f" (the file is {file.lost})" if file.lost else ""
        raise SourceError(f"{file.path}: {what}{cut}; topics: {there or 'none'}")
    most = max(t.messages for t in clouds)
    best = [t for t in clouds if t.messages == most]
    if len(best) > 1:
        raise SourceError(
            f"{file.path}: several topics have {most} clouds each: "
            f"{', '.join(t.name for t in best)}; name one as points_topic"
        )
    if best[0].encoding != "cdr":
        raise SourceError(
            f"{file.path}: {best[0].name} is encoded as {best[0].encoding!r}, not as ROS 2 does "
            "(cdr); convert the log to ROS 2"
        )
    if len(clouds) > 1:
        others = ", ".join(f"{t.name} ({t.messages})" for t in clouds if t is not best[0])
        notes.append(f"of several topics of clouds took {best[0].name} ({most}), not {others}")
    return best[0].name


def _pose_tracks(file: McapFile, named: str | None) -> dict[str, PoseTrack]:
    """An empty track for each topic whose poses are wanted: tf always, of the others the one named
    or, if none is named, all.
    """
    tracks = {
        t.name: PoseTrack(t.name, t.type)
        for t in file.topics
        if t.encoding == "cdr"
        and (t.type == ros2.TF or (t.type in POSE_TYPES and named in (None, t.name)))
    }
    if named is not None and named not in tracks:
        there = ", ".join(f"{t.name} ({t.type or 'no type'})" for t in file.topics)
        raise PoseError(f"{file.path}: no poses on topic {named}; topics: {there}")
    return tracks


@dataclass
class _Index:
    """What one reading of a log collects about its scans."""

    frame: str = ""
    fields: tuple[tuple[str, str], ...] = ()
    stamps: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    places: list[tuple[int, int, int, int]] = field(default_factory=list)

    def add(self, cloud: ros2.Cloud, message: Message) -> None:
        if not self.stamps:
            self.frame, self.fields = cloud.frame, cloud.fields
        if cloud.frame != self.frame:
            raise CorruptSourceError(f"frame {cloud.frame!r} after frame {self.frame!r}")
        self.stamps.append(cloud.stamp_ns)
        self.counts.append(cloud.points)
        self.places.append((message.record, message.start, len(message.data), message.unpacked))


def _read_through(file: McapFile, points_topic: str, tracks: dict[str, PoseTrack]) -> _Index:
    index, read = _Index(), Counter[str]()
    for message in file.messages({points_topic, *tracks}):
        read[message.topic] += 1
        try:
            if message.topic == points_topic:
                index.add(ros2.read_cloud(message.data), message)
            else:
                track = tracks[message.topic]
                track.add(ros2.read_poses(track.type, message.data))
        except CorruptSourceError as error:
            raise _located(file.path, message.topic, message.record, error) from error
    for topic in file.topics:
        if topic.name in {points_topic, *tracks} and read[topic.name] != topic.messages:
            raise CorruptSourceError(
                f"{file.path}: its summary counts {topic.messages} messages of {topic.name}, its "
                f"chunks hold {read[topic.name]}; write the log anew (mcap recover)"
            )
    return index


def _skipped(
    path: str, stamps_ns: Int64, status: NDArray[np.int8], poses: Trajectory, max_gap_s: float
) -> list[str]:
    """A note for each reason for which scans have no pose."""
    reasons = {
        PoseStatus.BEFORE: "before the first pose",
        PoseStatus.AFTER: "after the last pose",
        PoseStatus.GAP: f"where poses are more than {max_gap_s:g} s apart",
    }
    if not (status == PoseStatus.POSED).any():
        raise PoseError(
            f"{path}: none of the {len(stamps_ns)} scans has a pose: scans are from "
            f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s, poses from "
            f"{poses.stamps_ns[0] / 1e9:.3f} to {poses.stamps_ns[-1] / 1e9:.3f} s, and none is "
            f"interpolated over more than {max_gap_s:g} s; are these the same clock?"
        )
    counts = {why: int((status == code).sum()) for code, why in reasons.items()}
    return [f"{n} of {len(status)} scans skipped: {why}" for why, n in counts.items() if n]


def _located(path: str, topic: str, record: int, error: Exception) -> CorruptSourceError:
    return CorruptSourceError(f"{path}: {topic}, record at byte {record}: {error}")


def _scan(cloud: ros2.Cloud, T_map_lidar: Float64) -> Scan:
    rows = cloud.rows()
    points = ros2.positions(rows)
    keep = _kept(ros2.returned(points))
    intensity = cloud.field(ros2.INTENSITY_FIELDS)
    ring = cloud.field(ros2.RING_FIELDS)
    time = cloud.field(ros2.TIME_FIELDS)
    return Scan(
        stamp_ns=cloud.stamp_ns,
        points=points[keep],
        T_map_lidar=T_map_lidar,
        intensity=None if intensity is None else rows[intensity][keep].astype(np.float32),
        ring=None if ring is None else rows[ring][keep].astype(np.int32),
        time_offset=(
            None if time is None else ros2.time_offsets(_native(rows[time][keep]), cloud.stamp_ns)
        ),
        dropped=len(points) - len(points[keep]),
    )


def _kept(keep: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """What to index with: a slice, which copies nothing, where all points stay."""
    return slice(None) if keep.all() else keep


def _native(values: NDArray[np.generic]) -> NDArray[np.generic]:
    return values.astype(values.dtype.newbyteorder("="))


class McapDrive:
    """A drive as map points: the posed scans of a log, moved into the map. A `PointSource`, opened
    by `open_drive`; points are counted over the scans used, in order of their stamps.
    """

    def __init__(
        self,
        log: ScanLog,
        scans: ScanSelection,
        range_max: float | None,
    ) -> None:
        self.log = log
        self._range_max = range_max
        self._selected = scans.indices(log.stamps_ns)
        self._used = self._selected[log.posed[self._selected]]
        self._ends = np.cumsum(log.point_counts[self._used])

    @property
    def path(self) -> str:
        """The file, as it was named."""
        return self.log.path

    def info(self) -> SourceInfo:
        """What is in the drive; `points` counts those of the scans used as their headers do."""
        return self.log.info(self._selected)

    def spans(self, points: int) -> list[Span]:
        """Ranges of whole scans of about `points` points each."""
        spans, start = [], 0
        for end, following in zip(self._ends, (*self._ends[1:], np.inf), strict=True):
            if end > start and following - start > points:
                spans.append(Span(start, int(end)))
                start = int(end)
        return (
            spans
            if not len(self._ends) or start == self._ends[-1]
            else [*spans, Span(start, int(self._ends[-1]))]
        )

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in the map frame, a scan or a part of one in each block.

        `Block.dropped` counts what was no return: not finite, or at the lidar's own origin. Points
        beyond the drive's `range_max` are left out and not counted.
        """
        begins = self._ends - self.log.point_counts[self._used]
        touched = np.flatnonzero((self._ends > span.start) & (begins < span.stop))
        clouds = self.log.clouds_at(self._used[touched].tolist())
        for begin, (index, cloud) in zip(begins[touched].tolist(), clouds, strict=True):
            rows = cloud.rows()[max(span.start - begin, 0) : span.stop - begin]
            for at in range(0, len(rows), block_points):
                yield self._block(rows[at : at + block_points], self.log.T_map_lidar[index])

    def _block(self, rows: NDArray[np.void], T_map_lidar: Float64) -> Block:
        points = ros2.positions(rows)
        keep = ros2.returned(points)
        dropped = len(points) - int(keep.sum())
        if self._range_max is not None:
            keep &= (points**2).sum(axis=1) <= self._range_max**2
        return Block(transform(T_map_lidar, points[_kept(keep)]), dropped)


def open_drive(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    map_frame: str | None = None,
    pose_frame: str | None = None,
    max_gap_s: float = MAX_GAP_S,
    scans: ScanSelection | None = None,
    range_max: float | None = None,
) -> McapDrive:
    """A log as a source of map points; see `open_log` for the arguments not given here.

    Args:
        path: an .mcap file of ROS 2 messages.
        points_topic: topic of the scans.
        pose_topic: topic of the poses.
        map_frame: frame that counts as the map.
        pose_frame: frame whose poses these are.
        max_gap_s: longest time between two poses that is interpolated over [s].
        scans: which scans become the map; default: all.
        range_max: points farther than this from the lidar are left out [m]; default: none.

    Raises:
        UsageError: `range_max` is not positive.
        SourceError: as `open_log`.
        PoseError: as `open_log`, and if no scan of the selection has a pose.
    """
    if range_max is not None and not range_max > 0:
        raise UsageError(f"range_max = {range_max}: must be a positive length in metres")
    log = open_log(
        path,
        points_topic=points_topic,
        pose_topic=pose_topic,
        map_frame=map_frame,
        pose_frame=pose_frame,
        max_gap_s=max_gap_s,
    )
    scans = scans or ScanSelection()
    if not log.posed[scans.indices(log.stamps_ns)].any():
        raise PoseError(f"{path}: none of its {len(log)} scans that {scans} selects has a pose")
    return McapDrive(log, scans, range_max)
