"""Files of points, whatever their format: one protocol (base.py) and the registry below."""

import glob
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tilestream.errors import CorruptSourceError, SourceNotFoundError, UnknownFormatError
from tilestream.formats.base import Block, PointSource, SourceInfo, Span
from tilestream.formats.pcd import looks_like_pcd, open_pcd

__all__ = [
    "FORMATS",
    "Block",
    "Format",
    "PointSource",
    "SourceInfo",
    "Span",
    "expand_sources",
    "open_source",
]

_HEAD = 4096
"""What is read of a file to see which format it has [bytes]."""


@dataclass(frozen=True)
class Format:
    """A format that tilestream reads."""

    name: str
    """What it is called."""
    endings: tuple[str, ...]
    """How its files end, in lower case."""
    what: str
    """What of it is read."""
    magic: bytes
    """How every file of it begins (one of the ways)."""
    looks_like: Callable[[bytes], bool]
    """Whether the first bytes of a file are of this format."""
    open: Callable[..., PointSource]
    """A file of it, by its path and the options of the format."""

    def __str__(self) -> str:
        return f"{self.name} ({', '.join(self.endings)}): {self.what}"


FORMATS = (
    Format(
        "PCD",
        (".pcd",),
        "ascii, binary, binary_compressed",
        b"# .PCD",
        looks_like_pcd,
        open_pcd,
    ),
)
"""What `open_source` reads, besides a directory of Autoware's divided map."""


def open_source(path: str | os.PathLike[str], **options: object) -> PointSource:
    """A file of points, by its ending (in any case) and checked against its first bytes.

    Args:
        path: a file of one of `FORMATS`.
        options: what the format takes, e.g. the topics of a log.

    Raises:
        SourceNotFoundError: there is no such file.
        UnknownFormatError: the ending is of no supported format, or the content is of another one.
        CorruptSourceError: the file is empty, cut short or damaged.
    """
    name = os.fspath(path)
    if not Path(name).is_file():
        raise SourceNotFoundError(f"{name}: no such file; check the path")
    with Path(name).open("rb") as file:
        head = file.read(_HEAD)
    return _format_of(name, head).open(name, **options)


def _format_of(path: str, head: bytes) -> Format:
    ending = Path(path).suffix.lower()
    content = next((f for f in FORMATS if f.looks_like(head)), None)
    named = next((f for f in FORMATS if ending in f.endings), None)
    if named is None:
        raise UnknownFormatError(f"{path}: {_unknown_ending(ending, content)}")
    if content is not None and content is not named:
        raise UnknownFormatError(
            f"{path}: ends with {ending} but its content looks like {content.name}; rename it to "
            f"end with {content.endings[0]}"
        )
    if content is None and named.magic.startswith(head[: len(named.magic)]):
        raise CorruptSourceError(
            f"{path}: ends at offset {len(head)}, within the first bytes of a {named.name} file: "
            "it is empty or cut short; copy it again from where it came from"
        )
    if content is None:
        raise UnknownFormatError(
            f"{path}: ends with {ending} but its content is no {named.name}, nor of another "
            f"supported format; it begins with {head[:16]!r}"
        )
    return named


def _unknown_ending(ending: str, content: Format | None) -> str:
    what = f"the ending {ending!r} is of no supported format" if ending else "it has no ending"
    if content is not None:
        return f"{what}; its content looks like {content.name}, rename it to {content.endings[0]}"
    return f"{what}; supported are " + "; ".join(map(str, FORMATS))


def expand_sources(
    patterns: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[str]:
    """The files that patterns name: sorted, each once.

    Args:
        patterns: one or more of a file, a glob (`**` goes through directories) or a directory of
            Autoware's divided map, which stands for its PCD files.

    Raises:
        SourceNotFoundError: a file does not exist or a glob matches nothing; names it.
    """
    if isinstance(patterns, str | os.PathLike):
        patterns = [patterns]
    found: dict[str, str] = {}
    for pattern in patterns:
        for path in _expand(os.fspath(pattern)):
            found.setdefault(os.path.realpath(path), path)
    return sorted(found.values())


def _expand(pattern: str) -> list[str]:
    if Path(pattern).exists():
        return [pattern]
    if not glob.has_magic(pattern):
        raise SourceNotFoundError(f"{pattern}: no such file or directory; check the path")
    named = glob.glob(pattern, recursive=True)  # noqa: PTH207  Path.glob takes no absolute pattern
    matches = sorted(path for path in named if Path(path).is_file())
    if not matches:
        raise SourceNotFoundError(f"{pattern}: the pattern matches no file; check the path")
    return matches
