"""How a file or a directory is recognised: by its ending and first bytes, or by a file inside."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from tilestream.errors import (
    CorruptSourceError,
    SourceNotFoundError,
    UnknownFormatError,
    foreign_errors,
)

Opened_co = TypeVar("Opened_co", covariant=True)

_PACKED = {".zstd": "zstd -d", ".zst": "zstd -d", ".gz": "gunzip", ".bz2": "bunzip2"}
"""Endings of compressed files, and what unpacks them."""
_HEAD = 4096
"""What is read of a file to see which format it has [bytes]."""


@dataclass(frozen=True)
class Format(Generic[Opened_co]):
    """A format that tilestream reads: each is one file of the package, which ends with this."""

    name: str
    """What it is called."""
    what: str
    """What of it is read."""
    open: Callable[..., Opened_co]
    """Opens a file of it, by its path."""
    endings: tuple[str, ...] = ()
    """How its files end, in lower case; none for a format that is a directory."""
    magic: bytes = b""
    """How every file of it begins (one of the ways)."""
    recognise: Callable[[bytes], bool] | None = None
    """Whether the first bytes of a file are of this format; None: by `magic`."""
    marker: str = ""
    """The file or folder that every directory of this format has; empty for one that is a file."""
    options: tuple[str, ...] = ()
    """Names of the options that `open` takes."""

    def looks_like(self, head: bytes) -> bool:
        """Whether the first bytes of a file are of this format."""
        if self.recognise is not None:
            return self.recognise(head)
        return bool(self.magic) and head.startswith(self.magic)

    def opened(self, path: str, *arguments: object, **options: object) -> Opened_co:
        """What `open` makes of a file, and `CorruptSourceError` of all that a library raises."""
        try:
            with foreign_errors(CorruptSourceError, f"{path}: cannot be read as {self.name}"):
                return self.open(path, *arguments, **options)
        except MemoryError as error:
            raise CorruptSourceError(
                f"{path}: claims more than fits into memory ({error}): it is damaged, or too large"
            ) from error

    @property
    def short(self) -> str:
        """Its name, and what a file or a directory of it is known by."""
        where = ", ".join(self.endings) or f"a directory with {self.marker}"
        return f"{self.name} ({where})"

    def __str__(self) -> str:
        return f"{self.short}: {self.what}"


def format_of(path: str, formats: Sequence[Format[Opened_co]]) -> Format[Opened_co]:
    """The format of a file, by its ending (in any case) and checked against its first bytes; of a
    directory, by its marker.

    Raises:
        SourceNotFoundError: there is no such file.
        UnknownFormatError: the ending is of none of the formats, the content is of another one, or
            a directory has no marker; says what is known.
        CorruptSourceError: the file ends within its first bytes.
    """
    if Path(path).is_dir():
        found = format_of_directory(path, formats)
        if found is None:
            ending = next(f.endings[0] for f in formats if f.endings)
            raise UnknownFormatError(
                f"{path}: a directory of no supported format; give its files, e.g. "
                f"'{path}/*{ending}'; supported are {_known(formats)}"
            )
        return found
    if not Path(path).is_file():
        place = Path(path)
        link = f", but a link to {place.readlink()}" if place.is_symlink() else ""
        raise SourceNotFoundError(f"{path}: no such file{link}; check the path")
    with Path(path).open("rb") as file:
        head = file.read(_HEAD)
    content = next((f for f in formats if f.looks_like(head)), None)
    named = format_of_ending(path, formats)
    if named is None:
        raise UnknownFormatError(f"{path}: {_unknown_ending(path, content, formats)}")
    if content is not named:
        raise _another_content(path, head, named, content)
    return named


def format_of_ending(path: str, formats: Sequence[Format[Opened_co]]) -> Format[Opened_co] | None:
    """The format whose files end as this path does, in any case; None: no format's do."""
    ending = Path(path).suffix.lower()
    return next((f for f in formats if ending in f.endings), None)


def format_of_directory(
    path: str, formats: Sequence[Format[Opened_co]]
) -> Format[Opened_co] | None:
    """The format whose marker is in this directory; None: no format's is, or it is none."""
    return next((f for f in formats if f.marker and (Path(path) / f.marker).exists()), None)


def _unknown_ending(
    path: str, content: Format[Opened_co] | None, formats: Sequence[Format[Opened_co]]
) -> str:
    ending = Path(path).suffix.lower()
    if ending in _PACKED:
        return f"it is compressed: unpack it first ({_PACKED[ending]})"
    what = f"the ending {ending!r} is of no supported format" if ending else "it has no ending"
    if content is not None:
        return f"{what}; its content looks like {content.name}, rename it to {content.endings[0]}"
    return f"{what}; supported are {_known(formats)}"


def _known(formats: Sequence[Format[Opened_co]]) -> str:
    return ", ".join(one.short for one in formats)


def _another_content(
    path: str, head: bytes, named: Format[Opened_co], content: Format[Opened_co] | None
) -> UnknownFormatError | CorruptSourceError:
    ending = Path(path).suffix.lower()
    if content is not None:
        return UnknownFormatError(
            f"{path}: ends with {ending} but its content looks like {content.name}; rename it to "
            f"end with {content.endings[0]}"
        )
    if named.magic.startswith(head[: len(named.magic)]):
        return CorruptSourceError(
            f"{path}: ends at offset {len(head)}, within the first bytes of a {named.name} file: "
            "it is empty or cut short; copy it again from where it came from"
        )
    return UnknownFormatError(
        f"{path}: ends with {ending} but its content is no {named.name}, nor of another supported "
        f"format; it begins with {head[:16]!r}"
    )


def state_of(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Size [bytes] and time of the last change [ns] of a file: what tells that it is another one.
    Of a directory, the sums over it and all that is in it.

    Raises:
        OSError: there is no such file.
    """
    root = Path(path)
    stats = [found.stat() for found in (root, *(root.rglob("*") if root.is_dir() else ()))]
    return sum(stat.st_size for stat in stats), sum(stat.st_mtime_ns for stat in stats)
