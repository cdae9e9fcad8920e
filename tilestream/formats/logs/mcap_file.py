"""The MCAP container: where each message lies, every checksum tested, what a cut file still holds.

Works with a summary and chunk index, without them, and on a file that was cut short: then every
record that is whole is read, and `McapFile.lost` says from which byte on nothing is.
Format: mcap.dev/spec.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.summary import Summary

from tilestream.errors import CorruptSourceError, foreign_errors
from tilestream.formats.logs.mcap_chunk import LARGEST_RECORD, unpack_chunk
from tilestream.formats.logs.messages import Message, Topic

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<BQQQI")
_PIECE = 1 << 20
"""What is read at once of a record that only counts for the CRC [bytes]."""
_READ = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.DATA_END)
"""Records that are read; all others are passed over."""


class McapFile(AbstractContextManager["McapFile"]):
    """An MCAP file that is open for reading: a `MessageFile`.

    The place of a message is the offset in the file of the chunk that holds it (or of the message
    itself, outside of chunks), and start and size in the unpacked chunk.

    Args:
        path: the file, which begins with `MAGIC`.
        topics: whether summary and topics are read; False for a file of which only known records
            are unpacked.

    Raises:
        OSError: there is no such file.
        CorruptSourceError: a checksum fails, or records contradict each other; names file, offset.
    """

    def __init__(self, path: str, *, topics: bool = True) -> None:
        self.path = path
        self._stream = Path(path).open("rb")  # noqa: SIM115 - __exit__ closes it
        try:
            self.size = self._stream.seek(0, io.SEEK_END)
            self.whole = self._ends_whole()
            self.lost: str | None = None
            self.unchecked = False
            self._channels: dict[int, tuple[str, str, str]] = {}
            self._schemas: dict[int, str] = {}
            self._last: tuple[int, bytes] = (-1, b"")
            self._learnt: dict[tuple[int, bytes], bytes] = {}
            self._summary = self._read_summary() if self.whole and topics else None
            self.topics = self._count_topics() if topics else ()
        except BaseException:
            self._stream.close()
            raise

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """The messages of some topics in the file's order; chunks that hold none of them are
        passed over where the file has an index.
        """
        wanted = set(topics)
        for record, content in self._contents(wanted):
            for opcode, start, stop in self._inner_records(record, content):
                if opcode != Opcode.MESSAGE:
                    self._learn(opcode, content[start:stop])
                    continue
                if stop - start < MESSAGE_HEAD.size:
                    raise self._corrupt(record, "holds a message shorter than its own head")
                channel, *_ = MESSAGE_HEAD.unpack_from(content, start)
                if channel not in self._channels:
                    raise self._corrupt(record, f"holds a message of the unknown channel {channel}")
                topic = self._channels[channel][0]
                if topic in wanted:
                    start += MESSAGE_HEAD.size
                    data = memoryview(content)[start:stop]
                    held = 2 * len(content)  # a chunk, packed and unpacked
                    yield Message(topic, (record, start, stop - start), held, data)

    def content(self, topic: str, place: Sequence[int]) -> memoryview:  # noqa: ARG002
        """The message at a place; messages of one chunk, one after the other, unpack it once."""
        record, start, size = place
        if self._last[0] != record:
            self._last = (record, self.unpack(record))
        return memoryview(self._last[1])[start : start + size]

    def where(self, place: Sequence[int]) -> str:
        """A place in words."""
        return f"record at byte {place[0]}"

    def unpack(self, record: int) -> bytes:
        """The records inside the chunk at an offset of the file, or the record itself where a
        message lies outside of chunks. Tests the chunk's CRC.
        """
        opcode, content = self._record(record)
        return self._unpacked(record, opcode, content)

    def _ends_whole(self) -> bool:
        return (
            self.size >= 2 * len(MAGIC) + FOOTER.size
            and self._read(self.size - len(MAGIC), len(MAGIC)) == MAGIC
        )

    def _read_summary(self) -> Summary | None:
        """The summary where the file has one that leads to every chunk; else None."""
        at = self.size - len(MAGIC) - FOOTER.size
        opcode, _, start, _, crc = FOOTER.unpack(self._read(at, FOOTER.size))
        if opcode != Opcode.FOOTER or start > at:
            raise self._corrupt(at, "should be the footer and is not")
        if start == 0:
            return None
        if at - start > LARGEST_RECORD:
            raise self._corrupt(start, f"(the summary) claims {at - start} bytes")
        content = self._read(start, at + FOOTER.size - 4 - start)
        if crc and zlib.crc32(content) != crc:
            raise self._corrupt(start, "(the summary) fails its CRC")
        return self._useful(self._summary_of(start, content[: at - start]))

    def _summary_of(self, start: int, content: bytes) -> Summary:
        summary = Summary()
        for opcode, begin, end in self._inner_records(start, content):
            stream = ReadDataStream(io.BytesIO(content[begin:end]))
            with self._errors(start, "(the summary) cannot be read"):
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(stream)
                    summary.schemas[schema.id] = schema
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(stream)
                    summary.channels[channel.id] = channel
                elif opcode == Opcode.STATISTICS:
                    summary.statistics = Statistics.read(stream)
                elif opcode == Opcode.CHUNK_INDEX:
                    summary.chunk_indexes.append(ChunkIndex.read(stream))
        return summary

    @staticmethod
    def _useful(summary: Summary) -> Summary | None:
        """The summary if it leads to every chunk, each once; else None."""
        if summary.statistics is None or not summary.chunk_indexes:
            return None
        chunks = {index.chunk_start_offset for index in summary.chunk_indexes}
        if not summary.statistics.chunk_count == len(summary.chunk_indexes) == len(chunks):
            return None
        counted = summary.statistics.channel_message_counts
        if not all(channel in summary.channels for channel in counted):
            return None
        if sum(counted.values()) != summary.statistics.message_count:
            return None
        return summary

    def _count_topics(self) -> tuple[Topic, ...]:
        counts: Counter[int] = Counter()
        if self._summary is not None and self._summary.statistics is not None:
            for schema in self._summary.schemas.values():
                self._schemas[schema.id] = schema.name
            for channel in self._summary.channels.values():
                self._learn_channel(channel)
            counts.update(self._summary.statistics.channel_message_counts)
        else:
            for record, content in self._contents(None):
                for opcode, start, stop in self._inner_records(record, content):
                    if opcode == Opcode.MESSAGE:
                        counts[int.from_bytes(content[start : start + 2], "little")] += 1
                    else:
                        self._learn(opcode, content[start:stop])
        messages: Counter[tuple[str, str, str]] = Counter()
        for channel_id, named in self._channels.items():
            messages[named] += counts[channel_id]
        return tuple(Topic(*named, count) for named, count in sorted(messages.items()))

    def _contents(self, wanted: set[str] | None) -> Iterator[tuple[int, bytes]]:
        """Offset and unpacked content of each chunk (or message outside of chunks)."""
        if self._summary is None or wanted is None:
            yield from self._walk()
            return
        channels = {number for number, named in self._channels.items() if named[0] in wanted}
        for index in sorted(self._summary.chunk_indexes, key=lambda c: c.chunk_start_offset):
            held = index.message_index_offsets
            if not held or not channels.isdisjoint(held):
                yield index.chunk_start_offset, self.unpack(index.chunk_start_offset)

    def _walk(self) -> Iterator[tuple[int, bytes]]:
        """As `_contents`, record by record from the beginning; ends where a cut file does."""
        at, crc = len(MAGIC), zlib.crc32(MAGIC)
        try:
            while True:
                opcode, size = self._head(at)
                if opcode not in _READ:
                    for piece in range(at, at + size, _PIECE):
                        crc = zlib.crc32(self._read(piece, min(_PIECE, at + size - piece)), crc)
                    at += size
                    continue
                opcode, content = self._record(at)
                if opcode == Opcode.DATA_END:
                    self._check_data_crc(at, content, crc)
                    break
                crc = zlib.crc32(content, crc)
                if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    yield at, self._unpacked(at, opcode, content)
                else:
                    self._learn(opcode, content[RECORD_HEAD.size :])
                at += size
        except CorruptSourceError:
            if self.whole:
                raise
        if not self.whole:
            self.lost = f"cut short: whole up to byte {at} of {self.size}, nothing read after it"

    def _check_data_crc(self, at: int, content: bytes, crc: int) -> None:
        recorded = int.from_bytes(content[RECORD_HEAD.size : RECORD_HEAD.size + 4], "little")
        if recorded not in (0, crc):
            raise self._corrupt(at, f"(end of data) gives CRC {recorded:#x}, the data {crc:#x}")
        self.unchecked &= recorded == 0

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode and size, head included, of the record at an offset; it ends within the file."""
        head = self._read(at, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise self._corrupt(at, "is cut short")
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode == 0 or at + RECORD_HEAD.size + length > self.size:
            raise self._corrupt(at, f"(opcode {opcode}) claims {length} bytes, more than there are")
        return opcode, RECORD_HEAD.size + length

    def _record(self, at: int) -> tuple[int, bytes]:
        """Opcode and bytes, head included, of the record at an offset."""
        opcode, size = self._head(at)
        if size > LARGEST_RECORD:
            raise self._corrupt(at, f"claims {size} bytes, more than {LARGEST_RECORD}")
        content = self._read(at, size)
        if len(content) < size:
            raise self._corrupt(at, "is cut short")
        return opcode, content

    def _unpacked(self, at: int, opcode: int, content: bytes) -> bytes:
        if opcode == Opcode.MESSAGE:
            self.unchecked = True
            return content
        if opcode != Opcode.CHUNK:
            raise self._corrupt(at, f"should be a chunk and is of opcode {opcode}")
        with self._errors(at, "does not unpack, so its CRC cannot hold"):
            data, recorded, crc = unpack_chunk(memoryview(content)[RECORD_HEAD.size :])
        if recorded not in (0, crc):
            raise self._corrupt(at, f"fails its CRC (recorded {recorded:#x}, found {crc:#x})")
        self.unchecked |= recorded == 0
        return data

    def _inner_records(self, record: int, content: bytes) -> Iterator[tuple[int, int, int]]:
        """Opcode, start and stop of the content of each record inside an unpacked chunk."""
        at = 0
        while at < len(content):
            if at + RECORD_HEAD.size > len(content):
                raise self._corrupt(record, "ends inside a record")
            opcode, length = RECORD_HEAD.unpack_from(content, at)
            start, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
            if opcode == 0 or at > len(content):
                raise self._corrupt(record, "ends inside a record")
            yield opcode, start, at

    def _learn(self, opcode: int, content: bytes) -> None:
        key = (opcode, content[:2])  # its number
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL) or self._learnt.get(key) == content:
            return
        if opcode == Opcode.SCHEMA:
            self._learnt.clear()  # it may be the one of a channel that came before
        self._learnt[key] = content
        stream = ReadDataStream(io.BytesIO(content))
        what = f"{self.path}: a schema or channel cannot be read"
        with foreign_errors(CorruptSourceError, what, "copy the file anew"):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name
            else:
                self._learn_channel(Channel.read(stream))

    def _learn_channel(self, channel: Channel) -> None:
        named = self._schemas.get(channel.schema_id, "").replace("/msg/", "/")
        self._channels[channel.id] = (channel.topic, named, channel.message_encoding)

    def _read(self, at: int, length: int) -> bytes:
        self._stream.seek(min(at, self.size))
        return self._stream.read(length)

    def _errors(self, at: int, what: str) -> AbstractContextManager[None]:
        """Whatever the libraries raise on damaged bytes of the record at an offset."""
        what = f"{self.path}: record at byte {at} {what}"
        return foreign_errors(CorruptSourceError, what, "copy the file anew")

    def _corrupt(self, at: int, what: str) -> CorruptSourceError:
        return CorruptSourceError(f"{self.path}: record at byte {at} {what}; copy the file anew")
