"""From files of messages to a recording: read through once, scans by index after that.

Every cloud and pose is read, with whatever checks its file has; the poses are kept, and of each
cloud the layout is checked and the place noted. After that any slice of scans is read by going to
its places.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from tilestream.errors import CorruptSourceError, PoseError
from tilestream.formats.logs import ros
from tilestream.formats.logs.base import RecordedScan, Recording
from tilestream.formats.logs.clouds import choose_clouds
from tilestream.formats.logs.drivers import recorded_scan
from tilestream.formats.logs.lidar_poses import NO_POSES, choose_poses
from tilestream.formats.logs.messages import Message, MessageFile, OpenFile, Topic
from tilestream.formats.logs.pose_tracks import PoseTrack
from tilestream.records import Int64
from tilestream.settings import LogOptions


@dataclass(frozen=True, eq=False)
class MessageScans:
    """Where the scans of a log lie: a `ScanReader`."""

    files: tuple[str, ...]
    """The files of the log."""
    open_file: OpenFile
    """Opens one of them."""
    topic: str
    """Topic of the scans."""
    encoding: str
    """How they are written."""
    places: Int64
    """(k, 4) where each scan lies: number of its file, and its place there (`messages.Place`)."""

    def read(self, indices: Sequence[int]) -> Iterator[RecordedScan]:
        """The scans with these indices; see `ScanReader.read`."""
        with ExitStack() as stack:
            number, file = -1, None
            for index in indices:
                of_file, *place = self.places[index].tolist()
                if file is None or of_file != number:
                    stack.close()
                    path = self.files[of_file]
                    number, file = of_file, stack.enter_context(self.open_file(path, topics=False))
                try:
                    cloud = ros.read_cloud(file.content(self.topic, place), self.encoding)
                except CorruptSourceError as error:
                    raise _located(file, self.topic, place, error) from error
                yield recorded_scan(cloud.stamp_ns, cloud.rows())


def record(
    path: str, name: str, files: Sequence[str], open_file: OpenFile, options: LogOptions
) -> Recording:
    """What is in a log of scans (sensor_msgs/PointCloud2) with poses (nav_msgs/Odometry,
    geometry_msgs/PoseStamped, PoseWithCovarianceStamped or tf2_msgs/TFMessage).

    Scans are those of the named topic; else `clouds.choose_clouds` has the rule. Poses are those of
    the named topic; else, among topics of Odometry and poses, of those given in the map's frame (if
    there are any) the one with the most messages; else those of tf. How they become those of the
    lidar in the map: `lidar_poses.LidarPoses`.

    Args:
        path: the log, as it was named.
        name: name of its format.
        files: its files, one recording together.
        open_file: opens one of them.
        options: topics and frames.

    Raises:
        CorruptSourceError: a check fails, or a message contradicts itself; names file and place.
        SourceError: no clouds, or several topics that are equally good; names what is there.
        PoseError: no poses, several topics that are equally good, or poses that cannot be resolved.
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(open_file(file)) for file in files]
        topics = _topics(opened)
        notes: list[str] = []
        clouds = choose_clouds(path, opened, topics, options.points_topic, notes)
        tracks = _pose_tracks(path, topics, options.pose_topic)
        index = _Index()
        for number, file in enumerate(opened):
            before = len(index.stamps)
            _read_through(file, number, clouds, tracks, index)
            if file.lost:
                where = f"{file.path}: " if len(files) > 1 else ""
                whole = len(index.stamps) - before
                notes.append(f"{where}{file.lost}; {whole} whole scans recovered")
        if any(file.unchecked for file in opened):
            notes.append("has records without a CRC: damage to them cannot be seen")
        pose_topic, poses = choose_poses(path, list(tracks.values()), index.frame, options, notes)
        order = np.argsort(np.asarray(index.stamps), kind="stable")
        places = np.asarray(index.places, dtype=np.int64)[order]
        return Recording(
            path=path,
            format=name,
            size_bytes=sum(file.size for file in opened),
            contents=tuple(f"topic {t.name}: {t.type}, {t.messages} messages" for t in topics),
            points_topic=clouds.name,
            pose_topic=pose_topic,
            frame=(options.lidar_frame or index.frame).lstrip("/"),
            fields=index.fields,
            stamps_ns=np.asarray(index.stamps, dtype=np.int64)[order],
            point_counts=np.asarray(index.counts, dtype=np.int64)[order],
            held_bytes=np.asarray(index.held, dtype=np.int64)[order],
            trajectory=poses,
            notes=tuple(dict.fromkeys(notes)),
            reader=MessageScans(tuple(files), open_file, clouds.name, clouds.encoding, places),
        )


def _topics(files: Sequence[MessageFile]) -> list[Topic]:
    """The topics of all files together."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for file in files:
        for topic in file.topics:
            counts[topic.name, topic.type, topic.encoding] += topic.messages
    return [Topic(*named, count) for named, count in sorted(counts.items())]


def _pose_tracks(path: str, topics: Sequence[Topic], named: str | None) -> dict[str, PoseTrack]:
    """An empty track for each topic whose poses are wanted: tf always, of the others the one named
    or, if none is named, all.
    """
    tracks = {
        t.name: PoseTrack(t.name, t.type, t.encoding)
        for t in topics
        if t.encoding in ros.ENCODINGS
        and (t.type == ros.TF or (t.type in ros.POSE_TYPES and named in (None, t.name)))
    }
    there = ", ".join(f"{t.name} ({t.type or 'no type'})" for t in topics)
    if named is not None and named not in tracks:
        raise PoseError(f"{path}: no poses on topic {named}; topics: {there}")
    if not tracks:
        raise PoseError(f"{path}: {NO_POSES}; topics: {there}")
    return tracks


@dataclass
class _Index:
    """What one reading of a log collects about its scans."""

    frame: str = ""
    fields: tuple[tuple[str, str], ...] = ()
    stamps: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    held: list[int] = field(default_factory=list)
    places: list[tuple[int, int, int, int]] = field(default_factory=list)

    def add(self, cloud: ros.Cloud, file: int, message: Message) -> None:
        if not self.stamps:
            self.frame, self.fields = cloud.frame, cloud.fields
        if cloud.frame != self.frame:
            raise CorruptSourceError(f"frame {cloud.frame!r} after frame {self.frame!r}")
        self.stamps.append(cloud.stamp_ns)
        self.counts.append(cloud.points)
        self.held.append(message.held)
        self.places.append((file, *message.place))


def _read_through(
    file: MessageFile, number: int, clouds: Topic, tracks: dict[str, PoseTrack], index: _Index
) -> None:
    """Take in the clouds and poses of one file of a log."""
    read = Counter[str]()
    for message in file.messages({clouds.name, *tracks}):
        read[message.topic] += 1
        try:
            if message.topic == clouds.name:
                index.add(ros.read_cloud(message.data, clouds.encoding), number, message)
            else:
                track = tracks[message.topic]
                track.add(ros.read_poses(track.type, message.data, track.encoding))
        except CorruptSourceError as error:
            raise _located(file, message.topic, message.place, error) from error
    for topic in file.topics:
        if topic.name in {clouds.name, *tracks} and read[topic.name] != topic.messages:
            raise CorruptSourceError(
                f"{file.path}: its summary counts {topic.messages} messages of {topic.name}, its "
                f"chunks hold {read[topic.name]}; write the log anew (mcap recover)"
            )


def _located(
    file: MessageFile, topic: str, place: Sequence[int], error: Exception
) -> CorruptSourceError:
    return CorruptSourceError(f"{file.path}: {topic}, {file.where(place)}: {error}")
