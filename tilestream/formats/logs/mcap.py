"""MCAP logs of ROS 2 messages.

A log is read through once when it is opened: every chunk that holds a cloud or a pose is unpacked,
its CRC tested, the poses kept, and of each cloud the layout is checked and the place noted. After
that any slice of scans is read by seeking to its chunks, whether the file has an index or not.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tilestream.errors import CorruptSourceError, PoseError, SourceError
from tilestream.formats.logs import ros2
from tilestream.formats.logs.base import RecordedScan, Recording
from tilestream.formats.logs.drivers import recorded_scan
from tilestream.formats.logs.mcap_file import MAGIC, McapFile, Message
from tilestream.formats.logs.ros2_poses import POSE_TYPES, PoseTrack, choose_poses
from tilestream.formats.registry import Format
from tilestream.records import Int64
from tilestream.settings import LogOptions


@dataclass(frozen=True, eq=False)
class McapScans:
    """Where the scans of a log lie: a `ScanReader`."""

    path: str
    """The file, as it was named."""
    topic: str
    """Topic of the scans."""
    places: Int64
    """(k, 4) where each scan lies: offset of its chunk in the file, start and size of the message
    in the unpacked chunk, size of the unpacked chunk [bytes]."""

    def read(self, indices: Sequence[int]) -> Iterator[RecordedScan]:
        """The scans with these indices; see `ScanReader.read`."""
        with McapFile(self.path, topics=False) as file:
            unpacked, content = -1, b""
            for index in indices:
                record, start, size, _ = (int(value) for value in self.places[index])
                if record != unpacked:
                    unpacked, content = record, file.unpack(record)
                try:
                    cloud = ros2.read_cloud(memoryview(content)[start : start + size])
                except CorruptSourceError as error:
                    raise _located(self.path, self.topic, record, error) from error
                yield recorded_scan(cloud.stamp_ns, cloud.rows())


def open_mcap(path: str, options: LogOptions) -> Recording:
    """A log of scans (sensor_msgs/PointCloud2) with poses (nav_msgs/Odometry,
    geometry_msgs/PoseStamped, PoseWithCovarianceStamped or tf2_msgs/TFMessage).

    Scans are those of the named topic, else of the one with the most clouds. Poses are those of the
    named topic; else, among topics of Odometry and poses, of those given in the map's frame (if
    there are any) the one with the most messages; else those of tf.

    A topic of PoseStamped does not name the frame that it poses: `options.pose_frame` does. Static
    transforms of the log lead from there to the lidar. Without them, or without this name, the
    poses are taken as the lidar's, and `notes` says so.

    Raises:
        CorruptSourceError: a CRC fails, or a message contradicts itself; names file and offset.
        SourceError: no clouds, or several topics that are equally good; names what is there.
        PoseError: no poses, several topics that are equally good, or no way to the lidar's frame.
    """
    with McapFile(path) as file:
        notes: list[str] = []
        points_topic = _choose_clouds(file, options.points_topic, notes)
        tracks = _pose_tracks(file, options.pose_topic)
        index = _read_through(file, points_topic, tracks)
        if file.lost:
            notes.append(f"{file.lost}; {len(index.stamps)} whole scans recovered")
        if file.unchecked:
            notes.append("has records without a CRC: damage to them cannot be seen")
        pose_topic, poses = choose_poses(path, list(tracks.values()), index.frame, options, notes)
        order = np.argsort(np.asarray(index.stamps), kind="stable")
        places = np.asarray(index.places, dtype=np.int64)[order]
        return Recording(
            path=path,
            format="mcap",
            size_bytes=file.size,
            contents=tuple(f"topic {t.name}: {t.type}, {t.messages} messages" for t in file.topics),
            points_topic=points_topic,
            pose_topic=pose_topic,
            frame=index.frame,
            fields=index.fields,
            stamps_ns=np.asarray(index.stamps, dtype=np.int64)[order],
            point_counts=np.asarray(index.counts, dtype=np.int64)[order],
            held_bytes=2 * places[:, 3],  # a chunk, packed and unpacked
            trajectory=poses,
            notes=tuple(notes),
            reader=McapScans(path, points_topic, places),
        )


FORMAT = Format(
    name="MCAP",
    what="logs with point clouds and poses",
    open=open_mcap,
    endings=(".mcap",),
    magic=MAGIC,
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
            f"{', '.join(t.name for t in best)}; name one as points_topic, or with commas all that "
            "are lidars of one vehicle"
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


def _located(path: str, topic: str, record: int, error: Exception) -> CorruptSourceError:
    return CorruptSourceError(f"{path}: {topic}, record at byte {record}: {error}")
