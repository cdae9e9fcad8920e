"""Points that lie row by row in a file as text."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.base import Block, Span
from tilestream.formats.points.rows import Columns, even_spans, finite_block, steps, whole_span
from tilestream.records import Float64

_LINE_MAX = 1 << 16
"""Longest line of text that is read as one row [bytes]."""
_NOT_FINITE = re.compile(rb"[-+]?(?:1\.#[A-Za-z0-9]+|nan\([^()\s]*\))", re.IGNORECASE)
"""Words for numbers that are not finite as other C libraries write them: -nan(ind), 1.#INF."""


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
