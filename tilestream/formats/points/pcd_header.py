"""The header of a PCD: what its rows are, and where they start."""

import re
from itertools import accumulate
from typing import Any, BinaryIO, Literal

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.points.rows import Columns, columns_of

_KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS")
_HEADER_MAX = 1 << 16
"""Longest header that is read [bytes]."""
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}

Encoding = Literal["ascii", "binary", "binary_compressed"]


def looks_like_pcd(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a PCD header."""
    for line in head.splitlines():
        word = line.split(maxsplit=1)[:1]
        if word and not word[0].startswith(b"#"):
            return word[0].decode("ascii", "replace") in _KEYWORDS
        if line.startswith(b"# .PCD"):
            return True
    return False


def read_header(file: BinaryIO, path: str) -> tuple[dict[str, list[str]], int]:
    """The words behind each keyword, and where the data starts.

    Raises:
        CorruptSourceError: no header of a PCD, or none that ends.
    """
    header: dict[str, list[str]] = {}
    while file.tell() < _HEADER_MAX:
        line = file.readline(_HEADER_MAX)
        words = line.decode("ascii", "replace").split()
        if not line.endswith(b"\n"):
            break
        if not words or words[0].startswith("#"):
            continue
        keyword = "FIELDS" if words[0] == "COLUMNS" else words[0]
        if keyword not in (*_KEYWORDS, "DATA"):
            raise CorruptSourceError(
                f"{path}: unknown keyword {keyword[:40]!r} in its PCD header at offset "
                f"{file.tell() - len(line)}"
            )
        if keyword in header:
            raise CorruptSourceError(f"{path}: its PCD header has {keyword} twice")
        header[keyword] = words[1:]
        if keyword == "DATA":
            return header, file.tell()
    raise CorruptSourceError(
        f"{path}: its PCD header has no whole DATA line up to offset {file.tell()}: the file is "
        "cut short or damaged; copy it again from where it came from"
    )


def encoding_of(header: dict[str, list[str]], path: str) -> Encoding:
    """How the points are written.

    Raises:
        CorruptSourceError: in no way that PCD has.
    """
    match header["DATA"]:
        case [("ascii" | "binary" | "binary_compressed") as encoding]:
            return encoding
    raise CorruptSourceError(
        f"{path}: DATA {' '.join(header['DATA'])!r} in its PCD header: only ascii, binary and "
        "binary_compressed exist"
    )


class Layout:
    """What the header says about a row: fields, types, size, number of rows.

    Raises:
        CorruptSourceError: it lacks something, contradicts itself or names a type that PCD has not.
    """

    size: int
    """Bytes of a binary row."""
    words: int
    """Numbers in a row of text."""
    fields: tuple[tuple[str, str], ...]
    """Name and type of each field."""
    columns: Columns
    """Where x, y and z lie in a binary row."""
    text_columns: Columns
    """Which words of a row of text are x, y and z."""
    count: int
    """Number of points."""

    def __init__(self, header: dict[str, list[str]], path: str) -> None:
        self._header, self._path = header, path
        names = self._words("FIELDS")
        sizes = self._numbers("SIZE", len(names))
        kinds = self._words("TYPE", len(names))
        counts = self._numbers("COUNT", len(names)) if "COUNT" in header else [1] * len(names)
        types = [self._type(*field) for field in zip(names, kinds, sizes, strict=True)]
        self.size = sum(t.itemsize * n for t, n in zip(types, counts, strict=True))
        self.words = sum(counts)
        self.fields = tuple(
            (name, t.name if n == 1 else f"{t.name}[{n}]")
            for name, t, n in zip(names, types, counts, strict=True)
        )
        self.columns = self._columns(names, types, counts, [t.itemsize for t in types])
        self.text_columns = self._columns(names, types, counts, [1] * len(types))
        self.count = self._points()

    def _words(self, keyword: str, count: int | None = None) -> list[str]:
        words = self._header.get(keyword)
        if not words:
            raise CorruptSourceError(f"{self._path}: its PCD header has no {keyword}")
        if count is not None and len(words) != count:
            raise CorruptSourceError(
                f"{self._path}: {keyword} in its PCD header has {len(words)} values for {count} "
                "FIELDS"
            )
        return words

    def _numbers(self, keyword: str, count: int) -> list[int]:
        words = self._words(keyword, count)
        for word in words:
            if not re.fullmatch(r"[0-9]{1,18}", word):
                raise CorruptSourceError(
                    f"{self._path}: {keyword} {word[:40]!r} in its PCD header is no whole number"
                )
        return [int(word) for word in words]

    def _type(self, name: str, kind: str, size: int) -> np.dtype[Any]:
        if size not in _SIZES.get(kind, ()):
            raise CorruptSourceError(
                f"{self._path}: field {name!r} has the unknown type TYPE {kind} SIZE {size}; PCD "
                "has F of 4 and 8 bytes, I and U of 1, 2, 4 and 8"
            )
        return np.dtype(f"<{kind.lower()}{size}")

    def _columns(
        self, names: list[str], types: list[np.dtype[Any]], counts: list[int], widths: list[int]
    ) -> Columns:
        many = [name for name, n in zip(names, counts, strict=True) if n != 1 and name in "xyz"]
        if many:
            raise CorruptSourceError(
                f"{self._path}: field {many[0]!r} has COUNT {counts[names.index(many[0])]}; a "
                "coordinate has 1"
            )
        ends = accumulate(width * n for width, n in zip(widths, counts, strict=True))
        return columns_of(names, [0, *ends], types, self._path)

    def _points(self) -> int:
        """POINTS, or WIDTH x HEIGHT where an old file lacks it; both must agree."""
        claims = [self._numbers("POINTS", 1)[0]] if "POINTS" in self._header else []
        if "WIDTH" in self._header:
            height = self._numbers("HEIGHT", 1)[0] if "HEIGHT" in self._header else 1
            claims.append(self._numbers("WIDTH", 1)[0] * height)
        if not claims:
            raise CorruptSourceError(f"{self._path}: its PCD header has no POINTS")
        if len(set(claims)) > 1:
            raise CorruptSourceError(
                f"{self._path}: POINTS {claims[0]} in its PCD header is not WIDTH x HEIGHT = "
                f"{claims[1]}"
            )
        return claims[0]
