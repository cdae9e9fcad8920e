"""LAS and LAZ (also COPC, which reads as LAZ), the formats of surveyors.

laspy reads the headers and writes the files. Points are read past it: plain ones as the rows that
they are, packed ones chunk by chunk with lazrs, whose own seek, on which laspy relies, goes astray
where chunks differ in size (COPC). What a header claims is checked before either allocates by it.
"""

import logging
import math
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.crs import Entered, parsed
from tilestream.errors import CorruptSourceError, UsageError
from tilestream.files import Files
from tilestream.formats.base import Block, Bounds, SourceInfo, Span, corner_of
from tilestream.formats.points.las_crs import crs_of
from tilestream.formats.points.rows import (
    BinaryRows,
    Column,
    Flag,
    RowSource,
    Scaling,
    finite_block,
    flagged,
    steps,
    whole_span,
)
from tilestream.formats.points.written import as_points
from tilestream.formats.registry import Format
from tilestream.records import Float64

logging.getLogger("laspy").addHandler(logging.NullHandler())  # its errors are raised as ours

_HEADER = struct.Struct("<4s90xHIIBHI")
"""Magic, header size, where the points start, number of VLRs, point format, point size, points."""
_HEADER_1_4 = struct.Struct("<QIQ")
"""Where the EVLRs start, number of EVLRs, points: from byte 235 of the header of LAS 1.4."""
_VLR_MIN = 54
_EVLR = struct.Struct("<2x16sHQ32x")
NO_DAY = date(1970, 1, 1)
"""Written as the day of creation: the same points have the same bytes on any day."""
_SCALE = 0.001
"""What the writer rounds coordinates to [m]."""
_INT32 = np.dtype("<i4")
_XYZ = (Column(0, _INT32), Column(4, _INT32), Column(8, _INT32))
"""X, Y and Z begin every point, whatever its format."""
_DECODED = lazrs.DecompressionSelection(
    lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
    | lazrs.SELECTIVE_DECOMPRESS_Z
    | lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
    | lazrs.SELECTIVE_DECOMPRESS_FLAGS
)
"""What is decoded of a LAZ point where its format can be decoded in parts (6 to 10)."""
_NOISE = (7, 18)
"""Classes of points that are noise: low, and high."""
_WITHHELD = bytes(bool(value & 0x04) for value in range(256))
"""The flags of a point of the formats 6 to 10, which have a byte for them …"""
_CLASSIFIED = bytes(value in _NOISE for value in range(256))
"""… and one for the class."""
_EITHER = bytes(bool(value & 0x80) or value & 0x1F in _NOISE for value in range(256))
"""The one byte that the formats 0 to 5 have for both."""
_FLAGS_AT = 15
"""Where that byte is in a point, or the first of the two."""
_OUTSIDE = 1.0
"""How far the first point may be outside of the header's bounds before they are wrong [m]."""
_LARGEST_CHUNK = 1 << 28
"""What a chunk may claim to unpack to [bytes]: 7 million points, and writers choose 50,000."""
_LAYERED = 3
"""How such points are packed: each chunk in layers, after its first point, its count and the size
of each layer."""
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of an item of such a point, by its type; bytes that a user added (14) have one each."""


@dataclass(frozen=True)
class _Chunk:
    """Compressed points that can be unpacked by themselves."""

    span: Span
    offset: int
    packed_bytes: int


@dataclass(frozen=True)
class LazRows:
    """Compressed points: chunks, one behind the other, that the writer chose the size of."""

    path: str
    """The file."""
    count: int
    """Number of points that the header claims."""
    scaling: Scaling
    """How the stored numbers become metres."""
    chunks: tuple[_Chunk, ...]
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

    def _unpack(self, file: BinaryIO, chunk: _Chunk) -> NDArray[Any]:
        """A chunk by itself: lazrs' own seek goes astray where chunks differ in size (COPC)."""
        file.seek(chunk.offset)
        packed = file.read(chunk.packed_bytes)
        count = chunk.span.stop - chunk.span.start
        points = np.zeros(count, self.dtype)
        with _laspy_errors(self.path, f"points {chunk.span.start} to {chunk.span.stop - 1}"):
            _check_layers(packed, self.packing, self.dtype.itemsize)
            lazrs.decompress_points_with_chunk_table(
                packed, self.packing, points.view(np.uint8), [(count, len(packed))], _DECODED
            )
        return points


def open_las(path: str, *, keep_noise: bool = False) -> RowSource:
    """A LAS or LAZ file; its header and chunk table are read and checked against its size. A
    coordinate is stored integer x scale + offset, in float64, brought to metres.

    Args:
        path: the file.
        keep_noise: also read the points that are of a class of noise, or withheld.

    Raises:
        CorruptSourceError: the file is too short for what its header claims, or damaged.
        CrsError: its CRS is in degrees, or in units that are no lengths.
    """
    with Path(path).open("rb") as file:
        size_bytes = os.fstat(file.fileno()).st_size
        points_at, point_bytes, count = _checked_header(file, size_bytes, path)
        file.seek(0)
        with _laspy_errors(path, "header"):
            header = laspy.LasHeader.read_from(file, read_evlrs=True)
            dimensions = list(header.point_format.dimensions)
            dtype = header.point_format.dtype()
        crs = crs_of(header, path)
        scaling = _scaling(header, crs, path)
        flags = () if keep_noise else _flags(header.point_format.id)
        plain = BinaryRows(path, points_at, point_bytes, count, _XYZ, scaling, flags)
        rows: BinaryRows | LazRows = plain
        resident, first_at = 0, points_at
        if header.are_points_compressed:
            with _laspy_errors(path, "LAZ record"):
                packing = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
            chunks = _chunks(file, packing, plain, size_bytes)
            rows = LazRows(path, count, scaling, chunks, packing, dtype, flags)
            first_at = chunks[0].offset if chunks else points_at
            sizes = (c.packed_bytes + point_bytes * (c.span.stop - c.span.start) for c in chunks)
            resident = max(sizes, default=0)
        else:
            plain.check_size(size_bytes)
        file.seek(first_at)
        first = np.frombuffer(file.read(_INT32.itemsize * 3), _INT32)
    bounds, notes = _bounds(header, crs, scaling, first) if count else (None, ())
    summary = SourceInfo(
        path=path,
        format=f"{'laz' if header.are_points_compressed else 'las'} {header.version}",
        size_bytes=size_bytes,
        points=count,
        bounds=bounds,
        fields=tuple((d.name, f"{d.num_bits} bit {d.kind.name}") for d in dimensions),
        crs=crs.crs,
        resident_bytes=resident,
        notes=(*crs.notes, *notes),
    )
    return RowSource(summary, rows)


FORMAT = Format(
    name="LAS",
    what="1.0 to 1.4, LAZ and COPC, with CRS",
    open=open_las,
    endings=(".las", ".laz"),
    magic=b"LASF",
    options=("keep_noise",),
)


@contextmanager
def _laspy_errors(path: str, where: str) -> Iterator[None]:
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


def _checked_header(file: BinaryIO, size_bytes: int, path: str) -> tuple[int, int, int]:
    """Where the points start, bytes of a point, number of points; all of it within the file."""
    head = file.read(375)
    if len(head) < 227:
        raise CorruptSourceError(
            f"{path}: ends at offset {len(head)}, within its LAS header of at least 227 bytes"
        )
    _, header_bytes, points_at, vlrs, _, point_bytes, count = _HEADER.unpack_from(head)
    evlrs_at, evlrs = 0, 0
    if head[25] >= 4 and len(head) == 375:
        evlrs_at, evlrs, whole_count = _HEADER_1_4.unpack_from(head, 235)
        count = whole_count or count  # some writers fill only the one of older versions
    if header_bytes + vlrs * _VLR_MIN > points_at or points_at > size_bytes or point_bytes < 20:
        raise CorruptSourceError(
            f"{path}: its LAS header claims {vlrs} VLRs behind {header_bytes} bytes and points of "
            f"{point_bytes} bytes from offset {points_at}, the file ends at {size_bytes}: it is "
            "cut short or damaged"
        )
    for _ in range(evlrs):
        file.seek(min(evlrs_at, size_bytes))
        evlr = file.read(_EVLR.size)
        evlrs_at += _EVLR.size + (_EVLR.unpack(evlr)[2] if len(evlr) == _EVLR.size else 0)
        if evlrs_at > size_bytes:
            raise CorruptSourceError(
                f"{path}: ends at {size_bytes}, within an extended record up to {evlrs_at}: it is "
                "cut short or damaged"
            )
    return points_at, point_bytes, count


def _flags(point_format: int) -> tuple[Flag, ...]:
    """What says of a point that it is noise or withheld."""
    if point_format < 6:
        return (Flag(_FLAGS_AT, _EITHER),)
    return (Flag(_FLAGS_AT, _WITHHELD), Flag(_FLAGS_AT + 1, _CLASSIFIED))


def _bounds(
    header: laspy.LasHeader, crs: Entered, scaling: Scaling, first: NDArray[np.int32]
) -> tuple[Bounds | None, tuple[str, ...]]:
    """The header's bounds [m], where they can be those of its points; else None and a note.

    Args:
        header: the header.
        crs: what brings it to metres.
        scaling: how stored integers become metres.
        first: the first point as it is stored, which a chunk begins with uncompressed.
    """
    low, high = (np.asarray(edge, float) * _metres(crs) for edge in (header.mins, header.maxs))
    point = first * np.array(scaling.scale) + scaling.offset
    inside = (low - _OUTSIDE <= point) & (point <= high + _OUTSIDE)
    if np.isfinite([low, high]).all() and (low <= high).all() and inside.all():
        return (corner_of(low), corner_of(high)), ()
    told = " to ".join(str(edge.tolist()) for edge in (low, high))
    return None, (f"the bounds in its header, {told} m, cannot be: only its points tell",)


def _metres(crs: Entered) -> Float64:
    """Length of a unit of x, y and z [m]."""
    return np.array([crs.xy.metres, crs.xy.metres, crs.z.metres])


def _scaling(header: laspy.LasHeader, crs: Entered, path: str) -> Scaling:
    """How stored integers become metres."""
    scale, offset = header.scales.tolist(), header.offsets.tolist()
    if not all(map(math.isfinite, scale + offset)) or 0.0 in scale:
        raise CorruptSourceError(
            f"{path}: scale {scale} and offset {offset} in its LAS header give no coordinates"
        )
    scale, offset = ((edge * _metres(crs)).tolist() for edge in (header.scales, header.offsets))
    return Scaling(tuple(scale), tuple(offset))


def _chunks(
    file: BinaryIO, packing: bytes, rows: BinaryRows, size_bytes: int
) -> tuple[_Chunk, ...]:
    """Where each chunk lies; the table's claims are checked before lazrs allocates by them."""
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
    with _laspy_errors(rows.path, f"table of chunks at offset {table_at}"):
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
            chunks.append(_Chunk(span, offset, packed_bytes))
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


def write_las(path: str | os.PathLike[str], points: ArrayLike, *, crs: str | None = None) -> None:
    """Write points as LAS 1.4, rounded to 1 mm; compressed if the path ends with `.laz`.

    Args:
        path: the file; an existing one is replaced. It takes its name only once it is whole.
        points: (n, 3) finite coordinates [m], each axis within 4,294 km.
        crs: any string that pyproj reads.

    Raises:
        UsageError: points that are not finite or too far from each other.
        CrsError: a CRS that pyproj cannot read.
    """
    table = as_points(points)
    if not np.isfinite(table).all():
        raise UsageError(f"{os.fspath(path)}: LAS holds no NaN or infinite coordinates")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = NO_DAY
    header.scales = np.full(3, _SCALE)
    header.offsets = (
        np.round((table.min(axis=0) + table.max(axis=0)) / 2) if len(table) else np.zeros(3)
    )
    if np.abs(table - header.offsets).max(initial=0.0) >= np.iinfo(np.int32).max * _SCALE:
        raise UsageError(f"{os.fspath(path)}: LAS holds 4,294 km in millimetres, no more")
    if crs is not None:
        header.add_crs(parsed(crs, os.fspath(path)))
    record = laspy.ScaleAwarePointRecord.zeros(len(table), header=header)
    record["X"], record["Y"], record["Z"] = np.rint((table - header.offsets) / _SCALE).T
    with Files.at(path).writing() as file:
        packed = Path(path).suffix.lower() == ".laz"
        backend = laspy.LazBackend.Lazrs if packed else None
        with laspy.LasWriter(
            file, header, do_compress=packed, laz_backend=backend, closefd=False
        ) as writer:
            writer.write_points(record)
