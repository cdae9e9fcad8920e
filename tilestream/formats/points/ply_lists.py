"""PLY whose vertices have lists or come behind an element that does: where they lie is only told by
the rows before them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError
from tilestream.formats.base import Block, Span
from tilestream.formats.points.rows import even_spans, finite_block, steps, whole_span
from tilestream.formats.points.text_rows import TextRows
from tilestream.kernels.list_rows import CUT_SHORT, find_rows


@dataclass(frozen=True)
class Property:
    """A property of an element."""

    name: str
    dtype: np.dtype[Any]
    """Its type, or that of the items of a list."""
    length: np.dtype[Any] | None = None
    """Type of the length that stands before a list; None: it is no list."""

    @property
    def least_bytes(self) -> int:
        """Bytes in a binary row: the least, if it is a list."""
        return (self.length or self.dtype).itemsize


@dataclass(frozen=True)
class Element:
    """An element: rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def least_bytes(self) -> int:
        """Bytes of a binary row: the least, if it has lists."""
        return sum(p.least_bytes for p in self.properties)

    @property
    def has_lists(self) -> bool:
        """Whether its rows differ in length."""
        return any(p.length is not None for p in self.properties)


@dataclass(frozen=True)
class ListRows:
    """Vertices of a binary file behind or among lists: it is read whole, and its rows are found."""

    path: str
    """The file."""
    offset: int
    """Where the first element starts [bytes]."""
    before: tuple[Element, ...]
    """The elements before the vertices."""
    vertex: Element
    """The vertices."""
    big_endian: bool
    """The byte order of all numbers."""

    @property
    def count(self) -> int:
        """Number of vertices."""
        return self.vertex.count

    def check_size(self, file_bytes: int) -> None:
        """Refuse a file that is too short for the rows that it claims, were all its lists empty."""
        elements = (*self.before, self.vertex)
        needed = self.offset + sum(e.count * e.least_bytes for e in elements)
        if needed > file_bytes:
            raise self._cut_short(f"at least {needed} bytes, but the file ends at {file_bytes}")

    def spans(self, points: int) -> list[Span]:
        """One: rows are found from the beginning."""
        return even_spans(self.count, max(self.count, points))

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`."""
        whole_span(span, self.count, self.path)
        data = np.fromfile(self.path, np.uint8)
        self.check_size(len(data))
        at = self.offset
        for element in self.before:
            at = self._found(data, at, element, np.empty((0, 3), np.int64))
        places = np.empty((self.count, 3), np.int64)
        self._found(data, at, self.vertex, places)
        types = {p.name: p.dtype for p in self.vertex.properties}
        for step in steps(span, block_points):
            part = places[step.start : step.stop]
            x, y, z = (
                _gathered(data, part[:, axis], types[name].newbyteorder(self._order))
                for axis, name in enumerate("xyz")
            )
            yield finite_block(x, y, z)

    @property
    def _order(self) -> Any:
        return ">" if self.big_endian else "<"

    def _found(
        self, data: NDArray[np.uint8], at: int, element: Element, places: NDArray[np.int64]
    ) -> int:
        """Where the rows of an element end, whose x, y and z are put into `places`."""
        if not element.properties:
            return at
        names = [p.name for p in element.properties]
        wanted = np.array([names.index(axis) if len(places) else -1 for axis in "xyz"])
        sizes = np.array(
            [(p.length.itemsize if p.length else 0, p.dtype.itemsize) for p in element.properties]
        )
        end = int(find_rows(data, at, element.count, sizes, self.big_endian, wanted, places))
        if end == CUT_SHORT:
            raise self._cut_short(f"its element {element.name!r} ends behind it, at {len(data)}")
        return end

    def _cut_short(self, what: str) -> CorruptSourceError:
        return CorruptSourceError(
            f"{self.path}: its header claims {self.count} vertices, {what}: it is cut short or its "
            "header is wrong; copy it again from where it came from"
        )


@dataclass(frozen=True, kw_only=True)
class ListTextRows(TextRows):
    """The same as text: of each row the words x, y and z are taken."""

    vertex: Element

    def numbers_of(self, row: bytes) -> bytes:
        """x, y and z of a row with lists; the row as it is where it has too few words."""
        words, at, found = row.split(), 0, {}
        for p in self.vertex.properties:
            if at >= len(words):
                return row
            found[p.name] = words[at]
            at += 1 if p.length is None else 1 + _length(words[at])
        return b" ".join(found[axis] for axis in "xyz") if at == len(words) else row


def _length(word: bytes) -> int:
    return int(word) if word.isdigit() else 0


def _gathered(
    data: NDArray[np.uint8], places: NDArray[np.int64], dtype: np.dtype[Any]
) -> NDArray[Any]:
    """Numbers that begin at some places."""
    found: NDArray[Any] = data[places[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]
    return found
