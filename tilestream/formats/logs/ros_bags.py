"""Logs of ROS that are no MCAP: sqlite3 files of rosbag2 (.db3) and bags of ROS 1 (.bag).

Needs the extra `ros` (rosbags, which reads both without ROS). Neither format has checksums. A bag
is indexed as a whole when it is opened, in some 100 bytes of memory per message.
"""

import bz2
import errno
import io
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lz4.frame

from tilestream.errors import COPY_AGAIN, CorruptSourceError, UnknownFormatError, foreign_errors
from tilestream.formats.logs import ros
from tilestream.formats.logs.base import Recording
from tilestream.formats.logs.mcap_chunk import LARGEST_RECORD
from tilestream.formats.logs.messages import Message, Topic
from tilestream.formats.logs.recording import record
from tilestream.formats.registry import Format
from tilestream.settings import LogOptions

try:
    from rosbags import rosbag1, rosbag2
except ModuleNotFoundError as missing:
    if missing.name != "rosbags":
        raise
    rosbag1 = rosbag2 = None  # the extra is not installed

Unpack = Callable[[bytes], bytes]
"""Unpacks a chunk."""
CHUNK_BYTES = 1 << 20
"""What a bag of ROS 1 unpacks at once besides a message [bytes]: a chunk is closed at 768 KB."""


class _RosbagsFile(AbstractContextManager["_RosbagsFile"]):
    """A file that `rosbags` reads: a `MessageFile`.

    The place of a message is the time at which it was recorded [ns], which of those of its topic at
    that time it is, and its size.
    """

    lost: str | None = None
    unchecked = False
    encoding: str
    """How its messages are written."""
    chunk_bytes: int
    """What is unpacked at once besides a message [bytes]."""

    def __init__(self, path: str, reader: Any, *, topics: bool) -> None:
        self.path = path
        self.size = Path(path).stat().st_size
        with self._errors():
            reader.open()
        self._reader = reader
        try:
            with self._errors():
                self.topics = self._counted() if topics else ()
        except BaseException:
            reader.close()
            raise

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """The messages of some topics, in order of the times at which they were recorded."""
        wanted = self._of(set(topics))
        last, seen = -1, Counter[str]()
        with self._errors():
            for connection, time, data in self._reader.messages(wanted) if wanted else ():
                if time != last:
                    last, seen = time, Counter()
                place = (time, seen[connection.topic], len(data))
                seen[connection.topic] += 1
                held = 2 * (len(data) + self.chunk_bytes)
                yield Message(connection.topic, place, held, memoryview(data))

    def content(self, topic: str, place: Sequence[int]) -> memoryview:
        """The message of a topic at a place.

        Raises:
            CorruptSourceError: it is not the one that was there.
        """
        time, nth, size = place
        with self._errors():
            there = self._reader.messages(self._of({topic}), time, time + 1)
            found = next((data for i, (_, _, data) in enumerate(there) if i == nth), b"")
        if len(found) != size:
            raise CorruptSourceError(
                f"{self.path}: {self.where(place)} is not the one that was there when the log was "
                "opened: has it changed? open it again"
            )
        return memoryview(found)

    def where(self, place: Sequence[int]) -> str:
        """A place in words."""
        return f"message recorded at {place[0]} ns"

    def _of(self, topics: set[str]) -> list[Any]:
        return [c for c in self._reader.connections if c.topic in topics]

    def _counted(self) -> tuple[Topic, ...]:
        counts: Counter[tuple[str, str, str]] = Counter()
        for connection in self._reader.connections:
            named = connection.msgtype.replace("/msg/", "/")
            encoding = getattr(connection.ext, "serialization_format", self.encoding)
            of_type = ros.OTHER_NAMES.get(named, named)
            counts[connection.topic, of_type, encoding] += connection.msgcount
        return tuple(Topic(*named, count) for named, count in sorted(counts.items()))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        what = f"{self.path}: cannot be read by rosbags"
        try:
            with foreign_errors(CorruptSourceError, what):
                yield
        except OSError as error:
            if error.errno not in (None, errno.EINVAL):  # not of the machine, but of a false offset
                raise
            raise CorruptSourceError(f"{what} ({error}); {COPY_AGAIN}") from error


class Db3File(_RosbagsFile):
    """A sqlite3 file of a rosbag2, open for reading."""

    encoding = "cdr"
    chunk_bytes = 0

    def __init__(self, path: str, *, topics: bool = True) -> None:
        if rosbag2 is None:
            raise _without_extra(path)
        super().__init__(path, rosbag2.Reader(path), topics=topics)


class BagFile(_RosbagsFile):
    """A bag of ROS 1, open for reading."""

    encoding = "ros1"
    chunk_bytes = CHUNK_BYTES

    def __init__(self, path: str, *, topics: bool = True) -> None:
        if rosbag1 is None:
            raise _without_extra(path)
        super().__init__(path, rosbag1.Reader(_Bounded(Path(path))), topics=topics)
        for at, chunk in self._reader.chunks.items():
            self._reader.chunks[at] = chunk._replace(decompressor=_bounded(chunk.decompressor))


@dataclass(frozen=True)
class _Bounded:
    """A path whose file gives no more at once than it has, whatever is claimed to be there."""

    path: Path

    def exists(self) -> bool:
        """Whether there is a file."""
        return self.path.exists()

    def open(self, mode: str) -> "_BoundedFile":
        """The file, open for reading."""
        return _BoundedFile(io.FileIO(self.path, mode))


class _BoundedFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        held = os.fstat(self.fileno()).st_size
        return super().read(held if size is None or size < 0 else min(size, held))


def _bounded(unpack: Unpack) -> Unpack:
    """What unpacks a chunk of a bag, and never to more than any chunk holds."""
    unpackers = {
        bz2.decompress: bz2.BZ2Decompressor,
        lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
    }
    if unpack not in unpackers:
        return unpack

    def within(packed: bytes) -> bytes:
        data = bytes(unpackers[unpack]().decompress(packed, max_length=LARGEST_RECORD + 1))
        if len(data) > LARGEST_RECORD:
            raise ValueError(f"a chunk unpacks to more than {LARGEST_RECORD} bytes")
        return data

    return within


def _without_extra(path: str) -> UnknownFormatError:
    return UnknownFormatError(
        f"{path}: logs of ROS that are no MCAP need one library more: pip install 'tilestream[ros]'"
    )


def open_db3(path: str, options: LogOptions) -> Recording:
    """The scans and poses of a sqlite3 file, see `recording.record`.

    Raises:
        UnknownFormatError: the extra `ros` is not installed.
    """
    return record(path, "rosbag2 sqlite3", [path], Db3File, options)


def open_ros1_bag(path: str, options: LogOptions) -> Recording:
    """The scans and poses of a bag of ROS 1; errors as `open_db3`."""
    return record(path, "ROS 1 bag", [path], BagFile, options)


DB3 = Format(
    name="rosbag2 sqlite3",
    what="logs with point clouds and poses (extra `ros`)",
    open=open_db3,
    endings=(".db3",),
    magic=b"SQLite format 3\0",
)
BAG = Format(
    name="ROS 1 bag",
    what="logs with point clouds and poses (extra `ros`)",
    open=open_ros1_bag,
    endings=(".bag",),
    magic=b"#ROSBAG V2.0\n",
)
