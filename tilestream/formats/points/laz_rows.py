"""Points of a LAZ file: chunks, each unpacked by itself with lazrs."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import lazrs
import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError
from tilestream.formats.base import Block, Span
from tilestream.formats.points.rows import (
    BinaryRows,
    Flag,
    Scaling,
    finite_block,
    flagged,
    steps,
    whole_span,
)

_DECODED = lazrs.DecompressionSelection(
    lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
    | lazrs.SELECTIVE_DECOMPRESS_Z
    | lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
    | lazrs.SELECTIVE_DECOMPRESS_FLAGS
)
"""What is decoded of a LAZ point where its format can be decoded in parts (6 to 10)."""
_LARGEST_CHUNK = 1 << 28
"""What a chunk may claim to unpack to [bytes]: 7 million points, and writers choose 50,000."""
_LAYERED = 3
"""How such points are packed: each chunk in layers, after its first point, its count and the size
of each layer."""
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of an item of such a point, by its type; bytes that a user added (14) have one each."""


@contextmanager
def laspy_errors(path: str, where: str) -> Iterator[None]:
    """Whatever laspy and lazrs raise on damaged bytes, a panic of lazrs included, by our name."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit, MemoryError):
        raise
    except BaseException as error:
        raise CorruptSourceError(
            f"{path}: damaged or cut short in its {where}: {error}; copy it again from where it "
            "came from"
        ) from error


@dataclass(frozen=True)
class Chunk:
    """Compressed points that can be unpacked by themselves."""

    span: Span
    """Which points of the file."""
    offset: int
    """Where it starts [bytes]."""
    packed_bytes: int
    """Its size in the file [bytes]."""


@dataclass(frozen=True)
class LazRows:
    """Compressed points: chunks, one behind the other, that the writer chose the size of."""

    path: str
    """The file."""
    count: int
    """Number of points that the header claims."""
    scaling: Scaling
    """How the stored numbers become metres."""
    chunks: tuple[Chunk, ...]
    """The pieces that are unpacked by themselves."""
    packing: bytes
    """How lazrs is told the compression: the record of LAZ in the file's header."""
    dtype: np.dtype[Any]
    """Type of an unpacked point."""
    flags: tuple[Flag, ...]
    """What leaves points out."""

    def spans(self, points: int) -> list[Span]:
        """Whole chunks, at least one each."""
        spans, start = [], 0
        for stop in (chunk.span.stop for chunk in self.chunks):
            if stop - start >= points or stop == self.count:
                spans.append(Span(start, stop))
                start = stop
        return spans

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`."""
        whole_span(span, self.count, self.path)
        with Path(self.path).open("rb") as file:
            for chunk in self.chunks:
                start, stop = max(span.start, chunk.span.start), min(span.stop, chunk.span.stop)
                if start >= stop:
                    continue
                points = self._unpack(file, chunk)
                rows = points.view(np.uint8).reshape(len(points), self.dtype.itemsize)
                for step in steps(Span(start, stop), block_points):
                    part = slice(step.start - chunk.span.start, step.stop - chunk.span.start)
                    x, y, z = (points[name][part] for name in "XYZ")
                    yield finite_block(x, y, z, self.scaling, flagged(rows[part], self.flags))

    def _unpack(self, file: BinaryIO, chunk: Chunk) -> NDArray[Any]:
        """A chunk by itself: lazrs' own seek goes astray where chunks differ in size (COPC)."""
        file.seek(chunk.offset)
        packed = file.read(chunk.packed_bytes)
        count = chunk.span.stop - chunk.span.start
        points = np.zeros(count, self.dtype)
        with laspy_errors(self.path, f"points {chunk.span.start} to {chunk.span.stop - 1}"):
            _check_layers(packed, self.packing, self.dtype.itemsize)
            lazrs.decompress_points_with_chunk_table(
                packed, self.packing, points.view(np.uint8), [(count, len(packed))], _DECODED
            )
        return points


def chunks_of(
    file: BinaryIO, packing: bytes, rows: BinaryRows, size_bytes: int
) -> tuple[Chunk, ...]:
    """Where each chunk lies; the table's claims are checked before lazrs allocates by them.

    Args:
        file: the file, open.
        packing: the record of LAZ in its header.
        rows: the points as they would lie unpacked: where, of what size, how many.
        size_bytes: size of the file [bytes].

    Raises:
        CorruptSourceError: the table is not what the header and the file's size allow.
    """
    if not rows.count:
        return ()
    file.seek(rows.offset)
    table_at = int.from_bytes(file.read(8), "little", signed=True)
    if table_at == -1:  # written to a stream: the offset stands at the end of the file
        file.seek(size_bytes - 8)
        table_at = int.from_bytes(file.read(8), "little", signed=True)
    if not rows.offset + 8 <= table_at <= size_bytes - 8:
        raise CorruptSourceError(
            f"{rows.path}: its table of compressed chunks is at offset {table_at}, the file ends "
            f"at {size_bytes}: it is cut short or damaged"
        )
    file.seek(table_at + 4)
    claimed = int.from_bytes(file.read(4), "little")
    if (claimed - 1) * rows.size > table_at - rows.offset - 8:  # each begins with a whole point
        raise CorruptSourceError(
            f"{rows.path}: claims {claimed} chunks at offset {table_at}, more than the "
            f"{table_at - rows.offset} bytes before it hold: it is damaged"
        )
    with laspy_errors(rows.path, f"table of chunks at offset {table_at}"):
        vlr = lazrs.LazVlr(packing)
        if vlr.item_size() != rows.size:
            raise ValueError(f"its chunks hold points of {vlr.item_size()} bytes, not {rows.size}")
        file.seek(rows.offset)
        table: list[tuple[int, int]] = lazrs.read_chunk_table(file, vlr)
    points, packed = (sum(column) for column in zip(*table, strict=True)) if table else (0, 0)
    # the last chunk of equal ones may be filled in part, or not at all
    spare = 0 if vlr.uses_variable_size_chunks() else vlr.chunk_size()
    if not points - spare <= rows.count <= points or rows.offset + 8 + packed > table_at:
        raise CorruptSourceError(
            f"{rows.path}: its header claims {rows.count} points, its {len(table)} chunks hold "
            f"{points} in {packed} bytes before offset {table_at}: it is damaged"
        )
    chunks, start, offset = [], 0, rows.offset + 8
    for count, packed_bytes in table:
        span = Span(start, min(start + count, rows.count))
        if (span.stop - span.start) * rows.size > _LARGEST_CHUNK:
            raise CorruptSourceError(
                f"{rows.path}: claims {span.stop - span.start} points in a chunk of {packed_bytes} "
                f"bytes at offset {offset}, more than {_LARGEST_CHUNK} bytes of them: it is damaged"
            )
        if span.start < span.stop:
            chunks.append(Chunk(span, offset, packed_bytes))
        start, offset = span.stop, offset + packed_bytes
    return tuple(chunks)


def _check_layers(packed: bytes, packing: bytes, point_bytes: int) -> None:
    """Refuse a chunk whose layers claim more than it has: lazrs would end the process."""
    compressor, items = struct.unpack_from("<H30xH", packing)
    if compressor == _LAYERED:
        kinds = struct.iter_unpack("<HH2x", packing[34 : 34 + 6 * items])
        layers = sum(_LAYERS.get(kind, size) for kind, size in kinds)
        sizes = np.frombuffer(packed, "<u4", layers, point_bytes + 4)
        if sizes.sum(dtype=np.uint64) > len(packed):
            raise ValueError(f"its layers claim {sizes.tolist()} of {len(packed)} bytes")
