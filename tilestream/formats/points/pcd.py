"""PCD, the point clouds of PCL and Autoware: ascii, binary and binary_compressed.

Open3D, the one dependency that reads PCD too, holds a whole file at once, reads coordinates in
float64 as zeros, and a file that is cut short as an empty cloud (0.20). No dependency brings LZF,
the compression of the third encoding: it is a kernel (`kernels/lzf.py`).
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.errors import CorruptSourceError, UsageError
from tilestream.files import Files
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.formats.points.pcd_header import (
    Encoding,
    Layout,
    encoding_of,
    looks_like_pcd,
    read_header,
)
from tilestream.formats.points.rows import (
    BinaryRows,
    Columns,
    RowSource,
    even_spans,
    finite_block,
    steps,
    whole_span,
)
from tilestream.formats.points.text_rows import TextRows
from tilestream.formats.points.written import as_points, as_text, table_of
from tilestream.formats.projector import crs_beside
from tilestream.formats.registry import Format
from tilestream.kernels import lzf

_TWO_SIZES = np.dtype("<u4")
"""Compressed and uncompressed size stand before the data of binary_compressed [bytes]."""


@dataclass(frozen=True)
class CompressedRows:
    """The points of binary_compressed: all x stand first, then all y, …, compressed together."""

    path: str
    """The file."""
    offset: int
    """Where the compressed bytes start [bytes]."""
    count: int
    """Number of points that the header claims."""
    columns: Columns
    """Where x, y and z lie in a row, were the points rows."""
    packed_bytes: int
    """Size of the compressed points [bytes]."""
    unpacked_bytes: int
    """Size of the decoded points [bytes]."""

    def spans(self, points: int) -> list[Span]:
        """One: the points are decoded all together."""
        return even_spans(self.count, max(self.count, points))

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`."""
        whole_span(span, self.count, self.path)
        unpacked = self._unpack()
        x, y, z = (
            np.ndarray((self.count,), c.dtype, unpacked.data, c.offset * self.count)
            for c in self.columns
        )
        for step in steps(span, block_points):
            part = slice(step.start, step.stop)
            yield finite_block(x[part], y[part], z[part])

    def _unpack(self) -> NDArray[np.uint8]:
        with Path(self.path).open("rb") as file:
            file.seek(self.offset)
            packed = np.fromfile(file, np.uint8, self.packed_bytes)
        unpacked = np.empty(self.unpacked_bytes, np.uint8)
        damaged = lzf.decompress(packed, unpacked)
        if damaged != lzf.WHOLE:
            raise CorruptSourceError(
                f"{self.path}: the compressed points are damaged at offset "
                f"{self.offset + damaged}: copy the file again from where it came from"
            )
        return unpacked


def open_pcd(path: str) -> RowSource:
    """A PCD file; its header is read and checked against the size of the file.

    VIEWPOINT is where the sensor stood: it is not applied to the coordinates (nor does PCL).
    Coordinates may be of any numeric type; float64 ones arrive exactly. The CRS is that of an
    Autoware map, where its `map_projector_info.yaml` is beside the file.

    Raises:
        CorruptSourceError: the header is incomplete, contradicts itself, names a type that PCD
            does not have or has no x, y, z; or the file is too short for what it claims.
    """
    with Path(path).open("rb") as file:
        header, offset = read_header(file, path)
        size_bytes = os.fstat(file.fileno()).st_size
        encoding = encoding_of(header, path)
        layout = Layout(header, path)
        rows = _rows(file, encoding, layout, offset, size_bytes, path)
    resident, end = 0, size_bytes
    if isinstance(rows, CompressedRows):
        resident, end = rows.packed_bytes + rows.unpacked_bytes, rows.offset + rows.packed_bytes
    elif isinstance(rows, BinaryRows):
        end = offset + layout.size * layout.count
    crs, notes = crs_beside(Path(path))
    if size_bytes > end:
        notes += (f"{size_bytes - end} bytes behind the last point are ignored",)
    summary = SourceInfo(
        path=path,
        format=f"pcd {encoding}",
        size_bytes=size_bytes,
        points=layout.count,
        fields=layout.fields,
        crs=crs,
        resident_bytes=resident,
        notes=notes,
    )
    return RowSource(summary, rows)


def _rows(
    file: BinaryIO, encoding: Encoding, layout: Layout, offset: int, size_bytes: int, path: str
) -> BinaryRows | TextRows | CompressedRows:
    """Where the points lie, within the size of the file."""
    if encoding == "binary_compressed":
        file.seek(offset)
        data = offset + 2 * _TWO_SIZES.itemsize
        sizes = np.frombuffer(file.read(2 * _TWO_SIZES.itemsize), np.uint8)
        packed, unpacked = _compressed_sizes(sizes, layout, offset, size_bytes, path)
        return CompressedRows(path, data, layout.count, layout.columns, packed, unpacked)
    rows: BinaryRows | TextRows
    if encoding == "ascii":
        rows = TextRows(path, offset, layout.words, layout.count, layout.text_columns)
    else:
        rows = BinaryRows(path, offset, layout.size, layout.count, layout.columns)
    rows.check_size(size_bytes)
    return rows


FORMAT = Format(
    name="PCD",
    what="ascii, binary, binary_compressed",
    open=open_pcd,
    endings=(".pcd",),
    magic=b"# .PCD",
    recognise=looks_like_pcd,
)


def _compressed_sizes(
    sizes: NDArray[np.uint8], layout: Layout, offset: int, size_bytes: int, path: str
) -> tuple[int, int]:
    """Bytes before and after decoding, checked before anything of that size is allocated."""
    data = offset + 2 * _TWO_SIZES.itemsize
    if size_bytes < data:
        if layout.count == 0 and size_bytes == offset:
            return 0, 0
        raise CorruptSourceError(f"{path}: cut short at {size_bytes}, before its points")
    packed, unpacked = (int(size) for size in sizes.view(_TWO_SIZES))
    if data + packed > size_bytes:
        raise CorruptSourceError(
            f"{path}: claims {packed} compressed bytes from offset {data}, but the file ends at "
            f"{size_bytes}: it is cut short; copy it again from where it came from"
        )
    if unpacked != layout.size * layout.count:
        raise CorruptSourceError(
            f"{path}: claims {unpacked} bytes of points at offset {offset + 4}, but its header "
            f"claims {layout.count} points of {layout.size} bytes"
        )
    if unpacked > 100 * packed:
        # three bytes of LZF become at most 264
        raise CorruptSourceError(
            f"{path}: claims {unpacked} bytes of points in {packed} compressed ones at offset "
            f"{offset}, more than LZF can hold"
        )
    return packed, unpacked


def write_pcd(
    path: str | os.PathLike[str],
    points: ArrayLike,
    *,
    fields: dict[str, ArrayLike] | None = None,
    encoding: Encoding = "binary",
    comments: Sequence[str] = (),
) -> None:
    """Write points as PCD; the file takes its name only once it is whole.

    Args:
        path: the file; an existing one is replaced.
        points: (n, 3) coordinates [m]: float32 where that moves none by more than 0.1 mm, else
            float64.
        fields: further values per point, (n,) each, written with their own type.
        encoding: how the points are written.
        comments: lines of the header that programs pass over.

    Raises:
        UsageError: shapes or types that do not fit, or an encoding that PCD does not have.
    """
    table = table_of(as_points(points), fields)
    if encoding == "ascii":
        data = as_text(table)
    elif encoding == "binary":
        data = table.tobytes()
    elif encoding == "binary_compressed":
        data = _packed(b"".join(table[name].tobytes() for name in table.dtype.names or ()))
    else:
        raise UsageError(f"encoding {encoding!r}: give ascii, binary or binary_compressed")
    with Files.at(path).writing() as file:
        file.write(_header_of(table, encoding, comments))
        file.write(data)


def _header_of(table: NDArray[Any], encoding: str, comments: Sequence[str]) -> bytes:
    names = table.dtype.names or ()
    types = [table.dtype[name] for name in names]
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {' '.join(line.split())}" for line in comments),
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(t.itemsize) for t in types),
        "TYPE " + " ".join(t.kind.upper() for t in types),
        "COUNT " + " ".join("1" for _ in types),
        f"WIDTH {len(table)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        f"DATA {encoding}",
    )
    return "".join(f"{line}\n" for line in lines).encode()


def _packed(raw: bytes) -> bytes:
    if len(raw) > np.iinfo(_TWO_SIZES).max:
        raise UsageError(
            f"{len(raw)} bytes of points: binary_compressed holds 4 GiB, use binary or tiles"
        )
    unpacked = np.frombuffer(bytearray(raw), np.uint8)
    packed = np.empty(len(raw) + len(raw) // 32 + 1, np.uint8)
    length = lzf.compress(unpacked, packed)
    sizes = np.array([length, len(raw)], _TWO_SIZES)
    return sizes.tobytes() + packed[:length].tobytes()
