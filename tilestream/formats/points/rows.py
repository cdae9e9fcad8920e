"""Points that lie row by row in a file, binary or as text, and what reading them has in common."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import CorruptSourceError, UsageError, foreign_errors
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.kernels.rows import finite_points
from tilestream.records import Float64

_LINE_MAX = 1 << 16
"""Longest line of text that is read as one row [bytes]."""
_NOT_FINITE = re.compile(rb"[-+]?(?:1\.#[A-Za-z0-9]+|nan\([^()\s]*\))", re.IGNORECASE)
"""Words for numbers that are not finite as other C libraries write them: -nan(ind), 1.#INF."""


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
    """`count` points in spans of at most `points`, as equal as whole numbers allow."""
    if points < 1:
        raise UsageError(f"a span of {points} points: give at least 1")
    pieces = math.ceil(count / points)
    edges = [count * i // pieces for i in range(pieces + 1)] if pieces else []
    return [Span(a, b) for a, b in pairwise(edges)]


def steps(span: Span, block_points: int) -> Iterator[Span]:
    """A span in pieces of `block_points`; the last one takes what is left."""
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


@dataclass(frozen=True)
class TextRows:
    """Rows of numbers as text, a line each, in words separated by white space."""

    path: str
    """The file."""
    offset: int
    """Where the first row starts [bytes]."""
    words: int
    """Numbers in a row."""
    count: int
    """Number of rows that the header claims."""
    columns: Columns
    """Which words are x, y and z."""
    more_follows: bool = False
    """Whether something else may come behind the last row."""
    skipped: int = 0
    """Rows of something else before the first one."""

    def spans(self, points: int) -> list[Span]:
        """One: text is read from its beginning."""
        return even_spans(self.count, max(self.count, points))

    def check_size(self, file_bytes: int) -> None:
        """Refuse a file that is too short for the rows that it claims, two bytes a number."""
        needed = self.offset + 2 * self.words * self.count
        if needed > file_bytes:
            raise CorruptSourceError(
                f"{self.path}: its header claims {self.count} points of {self.words} numbers, at "
                f"least {needed} bytes, but the file ends at {file_bytes}: it is cut short or its "
                "header is wrong; copy it again from where it came from"
            )

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span; see `PointSource.blocks`. What is before it is read and skipped.

        Raises:
            CorruptSourceError: a row has too few or too many words or one that is no number, rows
                are missing or left over, or the last one does not end with a newline (so that its
                last number may be cut short).
        """
        whole_span(span, self.count, self.path)
        with Path(self.path).open("rb") as file:
            file.seek(self.offset)
            lines = (line for line in iter(partial(file.readline, _LINE_MAX), b"") if line.strip())
            for _ in islice(lines, self.skipped + span.start):
                pass
            for step in steps(span, block_points):
                rows = list(islice(lines, step.stop - step.start))
                self._check_rows(rows, step)
                table = self._numbers(rows, step)
                x, y, z = (table[:, column.offset] for column in self.columns)
                yield finite_block(x, y, z)
            if span.stop == self.count and not self.more_follows:
                self._check_end(next(lines, b""))

    def _check_rows(self, rows: list[bytes], step: Span) -> None:
        if len(rows) < step.stop - step.start:
            raise CorruptSourceError(
                f"{self.path}: ends after {step.start + len(rows)} of {self.count} points: it is "
                "cut short or its header is wrong; copy it again from where it came from"
            )
        if not rows[-1].endswith(b"\n"):
            raise CorruptSourceError(
                f"{self.path}: point {step.stop - 1} does not end with a newline, so its last "
                "number may be cut short; if the file is whole, add a newline at its end"
            )

    def _numbers(self, rows: list[bytes], step: Span) -> Float64:
        rows = [self.numbers_of(row) for row in rows]
        table = _table(rows)
        if table.shape != (len(rows), self.words):
            rows = [_NOT_FINITE.sub(b"nan", row) for row in rows]
            table = _table(rows)
        if table.shape != (len(rows), self.words):
            row = next((i for i, row in enumerate(rows) if not self._is_row(row)), 0)
            raise CorruptSourceError(
                f"{self.path}: point {step.start + row} is {rows[row][:80]!r}, not {self.words} "
                "numbers: the file is damaged or its header is wrong"
            )
        return table

    def numbers_of(self, row: bytes) -> bytes:
        """The words of a row that are read: all."""
        return row

    def _is_row(self, line: bytes) -> bool:
        try:
            return len([float(word) for word in line.split()]) == self.words
        except ValueError:
            return False

    def _check_end(self, line: bytes) -> None:
        if line:
            raise CorruptSourceError(
                f"{self.path}: more rows than the {self.count} points that its header claims, "
                f"the next one is {line[:60]!r}"
            )


def _table(rows: list[bytes]) -> Float64:
    """Rows of numbers; an empty table where they are none, or of different length."""
    try:
        return np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    except (ValueError, OverflowError):
        return np.empty((0, 0))
