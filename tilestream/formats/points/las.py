"""LAS and LAZ (also COPC, which reads as LAZ), the formats of surveyors.

laspy reads the headers and writes the files. Points are read past it: plain ones as the rows that
they are, packed ones chunk by chunk with lazrs, whose own seek, on which laspy relies, goes astray
where chunks differ in size (COPC). What a header claims is checked before either allocates by it.
"""

import logging
import math
import os
import struct
from datetime import date
from pathlib import Path
from typing import BinaryIO

import laspy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.crs import Entered, parsed
from tilestream.errors import CorruptSourceError, UsageError
from tilestream.files import Files
from tilestream.formats.base import Bounds, SourceInfo, corner_of
from tilestream.formats.points.las_crs import OURS, crs_of
from tilestream.formats.points.laz_rows import LazRows, chunks_of, laspy_errors
from tilestream.formats.points.rows import (
    BinaryRows,
    Column,
    Flag,
    RowSource,
    Scaling,
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
        with laspy_errors(path, "header"):
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
            with laspy_errors(path, "LAZ record"):
                packing = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
            chunks = chunks_of(file, packing, plain, size_bytes)
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
    header.creation_date, header.generating_software = NO_DAY, OURS
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
