"""Points that lie row by row in a file, and what reading them has in common."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError, UsageError, foreign_errors
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.kernels.rows import finite_points


@dataclass(frozen=True)
class Column:
    """Where a coordinate lies in a row."""

    offset: int
    """Bytes from the start of the row, or the number of the word in a row of text."""
    dtype: np.dtype[Any]
    """Its type, with byte order."""


Columns = tuple[Column, Column, Column]
"""x, y and z."""


def columns_of(
    names: Sequence[str], places: Sequence[int], types: Sequence[np.dtype[Any]], path: str
) -> Columns:
    """Where x, y and z lie among the fields of a row.

    Args:
        names: name of each field.
        places: its `Column.offset`.
        types: its type, with byte order.
        path: the file, for messages.

    Raises:
        CorruptSourceError: one of x, y, z is missing or there twice.
    """

    def column(name: str) -> Column:
        if names.count(name) != 1:
            raise CorruptSourceError(
                f"{path}: has {names.count(name)} fields {name!r} among {' '.join(names)}; points "
                "need x, y and z"
            )
        i = names.index(name)
        return Column(places[i], types[i])

    return column("x"), column("y"), column("z")


class Rows(Protocol):
    """The points of a file, once its header is read."""

    @property
    def count(self) -> int:
        """Number of points that the header claims."""

    def spans(self, points: int) -> list[Span]:
        """Pieces of about `points` points; see `PointSource.spans`."""

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`."""


@dataclass(frozen=True)
class RowSource:
    """A `PointSource` whose header says all but the points."""

    summary: SourceInfo
    """What the header tells."""
    rows: Rows
    """The points."""

    @property
    def path(self) -> str:
        """The file, as it was named."""
        return self.summary.path

    def info(self) -> SourceInfo:
        """What the header tells."""
        return self.summary

    def spans(self, points: int) -> list[Span]:
        """The file in pieces; see `PointSource.spans`."""
        return self.rows.spans(points)

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in blocks; see `PointSource.blocks`."""
        what = f"{self.path}: cannot be read as {self.summary.format}"
        with foreign_errors(CorruptSourceError, what):
            yield from self.rows.blocks(span, block_points)


def even_spans(count: int, points: int) -> list[Span]:
    """`count` points in spans of at most `points`, as equal as whole numbers allow.

    Raises:
        UsageError: `points` is below 1.
    """
    if points < 1:
        raise UsageError(f"a span of {points} points: give at least 1")
    pieces = math.ceil(count / points)
    edges = [count * i // pieces for i in range(pieces + 1)] if pieces else []
    return [Span(a, b) for a, b in pairwise(edges)]


def steps(span: Span, block_points: int) -> Iterator[Span]:
    """A span in pieces of `block_points`; the last one takes what is left.

    Raises:
        UsageError: `block_points` is below 1.
    """
    if block_points < 1:
        raise UsageError(f"a block of {block_points} points: give at least 1")
    for start in range(span.start, span.stop, block_points):
        yield Span(start, min(start + block_points, span.stop))


def whole_span(span: Span, count: int, path: str) -> None:
    """Refuse a span that is not inside a source of `count` points."""
    if not 0 <= span.start <= span.stop <= count:
        raise UsageError(f"{path}: {span} is not inside its {count} points")


@dataclass(frozen=True)
class Scaling:
    """Coordinates as stored to metres: stored x scale + offset, each axis by itself."""

    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Metres per stored unit."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the stored origin lies [m]."""


METRES = Scaling()
"""Coordinates stored in metres."""


@dataclass(frozen=True)
class Flag:
    """A byte of each row that may say that its point is to be left out."""

    offset: int
    """Bytes from the start of the row."""
    values: bytes
    """256 bytes: 1 for each value of it that says so."""


def flagged(rows: NDArray[np.uint8], flags: Sequence[Flag]) -> NDArray[np.bool_]:
    """Which of (n, size) rows a flag leaves out, (n,)."""
    found = np.zeros(len(rows), np.bool_)
    for flag in flags:
        found |= np.frombuffer(flag.values, np.bool_)[rows[:, flag.offset]]
    return found


def finite_block(
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    scaling: Scaling = METRES,
    left_out: NDArray[np.bool_] | None = None,
) -> Block:
    """The points of three columns of stored numbers, without those that are NaN or infinite, nor
    those to be left out.
    """
    if left_out is not None and left_out.any():
        kept_rows = ~left_out
        block = finite_block(x[kept_rows], y[kept_rows], z[kept_rows], scaling)
        return replace(block, left_out=int(np.count_nonzero(left_out)))
    points = np.empty((len(x), 3))
    scale, offset = np.array(scaling.scale), np.array(scaling.offset)
    x, y, z = _native(x, y, z)
    kept = finite_points(x, y, z, scale, offset, points)
    return Block(points[:kept], dropped=len(x) - kept)


def _native(*columns: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """The columns in one type, of this machine's byte order: few, as each is compiled for anew."""
    kind, *others = {column.dtype for column in columns}
    if not others and kind in (np.float32, np.float64, np.int32) and kind.isnative:
        return columns
    return tuple(column.astype(np.float64) for column in columns)


@dataclass(frozen=True)
class BinaryRows:
    """Rows of one size, one behind the other."""

    path: str
    """The file."""
    offset: int
    """Where the first row starts [bytes]."""
    size: int
    """Bytes of a row."""
    count: int
    """Number of rows that the header claims."""
    columns: Columns
    """Where x, y and z lie in a row."""
    scaling: Scaling = METRES
    """How the stored numbers become metres."""
    flags: tuple[Flag, ...] = ()
    """What leaves points out."""

    def spans(self, points: int) -> list[Span]:
        """Any pieces, of equal size."""
        return even_spans(self.count, points)

    def check_size(self, file_bytes: int) -> None:
        """Refuse a file that is too short for the rows that it claims."""
        needed = self.offset + self.size * self.count
        if needed > file_bytes:
            raise CorruptSourceError(
                f"{self.path}: its header claims {self.count} points of {self.size} bytes from "
                f"offset {self.offset}, which ends at {needed}, but the file ends at {file_bytes}: "
                "it is cut short or its header is wrong; copy it again from where it came from"
            )

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`."""
        whole_span(span, self.count, self.path)
        room = np.empty(self.size * min(block_points, span.stop - span.start), np.uint8)
        with Path(self.path).open("rb", buffering=0) as file:
            file.seek(self.offset + span.start * self.size)
            for step in steps(span, block_points):
                n = step.stop - step.start
                self._fill(file, room[: n * self.size], self.offset + step.start * self.size)
                x, y, z = (self._view(room, n, column) for column in self.columns)
                rows = room[: n * self.size].reshape(n, self.size)
                yield finite_block(x, y, z, self.scaling, flagged(rows, self.flags))

    def _view(self, room: NDArray[np.uint8], n: int, column: Column) -> NDArray[Any]:
        return np.ndarray((n,), column.dtype, room.data, column.offset, (self.size,))

    def _fill(self, file: Any, room: NDArray[np.uint8], offset: int) -> None:
        filled = 0
        while filled < len(room):
            got = file.readinto(room[filled:].data)
            if not got:
                raise CorruptSourceError(
                    f"{self.path}: ends at offset {offset + filled}, in the middle of its points: "
                    "it became shorter while it was read"
                )
            filled += got
