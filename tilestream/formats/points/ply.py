"""PLY, ascii and binary of either byte order: the vertices are the points.

Why not plyfile, with which the tests write: a binary file it maps into memory, as fast as this
reads it (5 M points of 145 MB: 0.05 s of CPU and 147 MB resident; here 0.10 s and 17 MB), but a
file that is cut while it is mapped ends the process (bus error). Text, and all faces of a mesh, it
reads row by row in Python: 8.5 s for 1 M points as text (here 1.6), 7 s for 1 M faces (here they
are passed over). It has no blocks of text, and takes a last number that may be cut short, or rows
left over, without a word. It is under the GPL, which this package is not. The price is this file
and the next, 300 lines.
"""

import os
import re
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.base import SourceInfo
from tilestream.formats.points.ply_lists import Element, ListRows, ListTextRows, Property
from tilestream.formats.points.rows import BinaryRows, RowSource, columns_of
from tilestream.formats.points.text_rows import TextRows
from tilestream.formats.registry import Format

_HEADER_MAX = 1 << 20
"""Longest header that is read [bytes]."""
_TYPES = {
    name: np.dtype(code)
    for names, code in (
        (("char", "int8"), "i1"),
        (("uchar", "uint8"), "u1"),
        (("short", "int16"), "i2"),
        (("ushort", "uint16"), "u2"),
        (("int", "int32"), "i4"),
        (("uint", "uint32"), "u4"),
        (("float", "float32"), "f4"),
        (("double", "float64"), "f8"),
    )
    for name in names
}
_BYTE_ORDER: dict[str, Literal["=", "<", ">"]] = {
    "ascii": "=",
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}


def looks_like_ply(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a PLY header."""
    return re.match(rb"ply\r?\n", head) is not None


def open_ply(path: str) -> RowSource:
    """A PLY file; its header is read and checked against the size of the file. x, y and z may be of
    any numeric type.

    Raises:
        CorruptSourceError: the header is incomplete, contradicts itself, names a type that PLY does
            not have or no vertices with x, y, z; or the file is too short for what it claims.
    """
    with Path(path).open("rb") as file:
        encoding, elements, offset = _read_header(file, path)
        size_bytes = os.fstat(file.fileno()).st_size
    number = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if number is None:
        raise CorruptSourceError(
            f"{path}: has no element 'vertex' among {', '.join(e.name for e in elements)}"
        )
    before, vertex, others = tuple(elements[:number]), elements[number], elements[number + 1 :]
    plain = [p for p in vertex.properties if p.length is None]
    names = [p.name for p in plain]
    types = [p.dtype.newbyteorder(_BYTE_ORDER[encoding]) for p in plain]
    rows: BinaryRows | TextRows | ListRows
    resident = 0
    if encoding == "ascii":
        more = any(other.count for other in others)
        skipped = sum(element.count for element in before if element.properties)
        columns = columns_of(names, range(len(names)), types, path)
        if vertex.has_lists:
            xyz = columns_of("xyz", range(3), types[:3], path)
            rows = ListTextRows(path, offset, 3, vertex.count, xyz, more, skipped, vertex=vertex)
        else:
            rows = TextRows(path, offset, len(names), vertex.count, columns, more, skipped)
    elif vertex.has_lists or any(element.has_lists for element in before):
        columns_of(names, range(len(names)), types, path)
        rows = ListRows(path, offset, before, vertex, encoding == "binary_big_endian")
        resident = size_bytes + 24 * vertex.count
    else:
        offset += sum(element.count * element.least_bytes for element in before)
        ends = list(accumulate(t.itemsize for t in types))
        columns = columns_of(names, [0, *ends], types, path)
        rows = BinaryRows(path, offset, vertex.least_bytes, vertex.count, columns)
        _check_others(rows, others, size_bytes)
    rows.check_size(size_bytes)
    summary = SourceInfo(
        path=path,
        format=f"ply {encoding}",
        size_bytes=size_bytes,
        points=vertex.count,
        fields=tuple(
            (p.name, p.dtype.name if p.length is None else f"{p.dtype.name}[]")
            for p in vertex.properties
        ),
        resident_bytes=resident,
        notes=tuple(
            f"element {element.name!r} ({element.count} rows) is ignored"
            for element in (*before, *others)
        ),
    )
    return RowSource(summary, rows)


FORMAT = Format(
    name="PLY",
    what="ascii, binary of either byte order",
    open=open_ply,
    endings=(".ply",),
    magic=b"ply",
    recognise=looks_like_ply,
)


def _read_header(file: BinaryIO, path: str) -> tuple[str, list[Element], int]:
    """Encoding, elements, and where the data starts."""
    encoding, elements, words = "", [], [""]
    file.readline(_HEADER_MAX)
    while words != ["end_header"]:
        at = file.tell()
        line = file.readline(_HEADER_MAX)
        if not line.endswith(b"\n") or at > _HEADER_MAX:
            raise CorruptSourceError(
                f"{path}: its PLY header has no end_header up to offset {at + len(line)}: the file "
                "is cut short or damaged; copy it again from where it came from"
            )
        words = line.decode("ascii", "replace").split()
        match words:
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as word, _]:
                encoding = word
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(Element(name, int(count), ()))
            case ["property", *described] if elements:
                last = elements.pop()
                properties = (*last.properties, _property(described, last.name, path))
                elements.append(Element(last.name, last.count, properties))
            case ["end_header"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise CorruptSourceError(
                    f"{path}: cannot read {line[:60]!r} at offset {at} in its PLY header"
                )
    if not encoding or not elements:
        missing = "element" if encoding else "format"
        raise CorruptSourceError(f"{path}: its PLY header has no {missing} line")
    return encoding, elements, file.tell()


def _property(described: list[str], element: str, path: str) -> Property:
    match described:
        case [kind, name] if kind in _TYPES:
            return Property(name, _TYPES[kind])
        case ["list", length, kind, name] if _is_whole(length) and kind in _TYPES:
            return Property(name, _TYPES[kind], _TYPES[length])
    raise CorruptSourceError(
        f"{path}: property {' '.join(described)[:80]!r} of element {element!r} has an unknown "
        f"type; PLY has {', '.join(_TYPES)}"
    )


def _is_whole(length: str) -> bool:
    return length in _TYPES and _TYPES[length].kind in "iu"


def _check_others(rows: BinaryRows, others: Sequence[Element], size_bytes: int) -> None:
    """Refuse a file that ends within the elements behind the vertices, as far as sizes tell."""
    end = rows.offset + rows.size * rows.count
    for other in others:
        end += other.count * other.least_bytes
        if other.count and end > size_bytes:
            raise CorruptSourceError(
                f"{rows.path}: its {other.count} rows of element {other.name!r} end at {end} or "
                f"later, but the file ends at {size_bytes}: it is cut short or its header is wrong"
            )
