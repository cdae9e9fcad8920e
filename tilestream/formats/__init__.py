"""Files of points, whatever their format: one protocol (base.py) and the registry below."""

import os
from collections.abc import Iterable
from dataclasses import replace
from glob import has_magic
from pathlib import Path

import numpy as np

from tilestream.errors import SourceError, SourceNotFoundError, UsageError
from tilestream.files import local_path
from tilestream.formats.base import Block, PointSource, SourceInfo, Span, corner_of
from tilestream.formats.drive import DRIVES
from tilestream.formats.points import autoware, e57, las, pcd, ply
from tilestream.formats.registry import Format, format_of, format_of_directory, format_of_ending
from tilestream.patterns import paths_of

__all__ = [
    "FORMATS",
    "Block",
    "Format",
    "PointSource",
    "SourceInfo",
    "Span",
    "describe",
    "expand_sources",
    "files_of",
    "matches_of",
    "open_source",
    "require_format",
]

_READ_MAX = 1_000_000_000
"""Largest file that `describe` reads for its bounds [bytes]."""
_BLOCK = 1 << 17
"""Points that `describe` reads at once: they stay in the cache."""

FORMATS: tuple[Format[PointSource], ...] = (
    pcd.FORMAT,
    las.FORMAT,
    ply.FORMAT,
    e57.FORMAT,
    autoware.FORMAT,
    autoware.UNDIVIDED,
    *DRIVES,
)
"""What `open_source` reads."""


def open_source(path: str | os.PathLike[str], **options: object) -> PointSource:
    """A file or directory of points in the map frame, of one of `FORMATS`.

    Args:
        path: the file; its ending, in any case, must fit its content.
        options: what a format takes, e.g. the topics of a log; files of another one ignore it, so
            that a mixed list can share its options.

    Raises:
        SourceNotFoundError: there is no such file.
        UnknownFormatError: the ending is of no supported format, or the content is of another one.
        CorruptSourceError: the file is empty, cut short or damaged.
        UsageError: an option that no format takes, or a file that is not on this machine.
    """
    name = local_path(path)
    found = format_of(name, FORMATS)
    known = {option for f in FORMATS for option in f.options}
    if unknown := sorted(options.keys() - known):
        raise UsageError(f"{name}: no format takes the option {', '.join(unknown)}")
    return found.opened(name, **{o: options[o] for o in found.options if o in options})


def describe(path: str | os.PathLike[str], **options: object) -> SourceInfo:
    """What is in a file, as `PointSource.info`, and its bounds also where no header tells them.

    For those a file of up to 1 GB is read; notes say how many of its points are not finite, and how
    many the file marks as noise or withheld, which do not count.
    Arguments and errors as for `open_source`.
    """
    source = open_source(path, **options)
    found = source.info()
    if found.bounds is not None or not found.points or found.size_bytes > _READ_MAX:
        return found
    lowest, highest, dropped, left_out = np.full(3, np.inf), np.full(3, -np.inf), 0, 0
    for span in source.spans(found.points):
        for block in source.blocks(span, _BLOCK):
            lowest = np.minimum(lowest, block.points.min(axis=0, initial=np.inf))
            highest = np.maximum(highest, block.points.max(axis=0, initial=-np.inf))
            dropped += block.dropped
            left_out += block.left_out
    notes = found.notes
    if dropped:
        notes += (f"{dropped} points are not finite",)
    if left_out:
        notes += (f"{left_out} points are of a class of noise or withheld",)
    if dropped + left_out == found.points:
        return replace(found, notes=notes)
    return replace(found, bounds=(corner_of(lowest), corner_of(highest)), notes=notes)


def expand_sources(
    patterns: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[str]:
    """The files that patterns name: sorted, each once.

    Args:
        patterns: one or more of a file, a glob (`**` goes through directories) or a directory of a
            known format; one of Autoware's maps stands for its PCD files.

    Raises:
        SourceNotFoundError: a file does not exist or a glob matches nothing; names it.
        UnknownFormatError: a directory of no known format.
        UsageError: a file that is not on this machine.
    """
    if isinstance(patterns, str | os.PathLike):
        patterns = [patterns]
    found: dict[str, str] = {}
    for pattern in patterns:
        for path in matches_of(pattern):
            for file in files_of(path):
                found.setdefault(os.path.realpath(file), file)
    return sorted(found.values())


def matches_of(pattern: str | os.PathLike[str]) -> list[str]:
    """The files and directories of known formats that a pattern names, sorted; of a glob also what
    is called as a file is and is none: a link to nothing, a directory.

    Raises:
        SourceNotFoundError: it names nothing.
        UsageError: a file that is not on this machine.
    """
    name = local_path(pattern)
    matches = [path for path in paths_of(name) if path == name or _is_meant(path)]
    if not matches:
        what = ", and as a pattern it matches no file" if has_magic(name) else ""
        raise SourceNotFoundError(f"{name}: no such file or directory{what}; check the path")
    return matches


def require_format(sources: Iterable[str]) -> None:
    """Refuse sources of which none is of a format that is read, by their first bytes.

    Raises:
        SourceNotFoundError: one names nothing.
        SourceError, OSError: why the first cannot be read.
    """
    errors: list[Exception] = []
    for path in [match for source in sources for match in matches_of(source)]:
        try:
            format_of(path, FORMATS)
        except (SourceError, OSError) as error:
            errors.append(error)
        else:
            return
    if errors:
        raise errors[0]


def _is_meant(path: str) -> bool:
    """Whether a glob that matches this means it: not the folders that lie between the files."""
    if not Path(path).is_dir():
        return True
    return format_of_directory(path, FORMATS) is not None or bool(format_of_ending(path, FORMATS))


def files_of(path: str) -> list[str]:
    """The files that a match stands for: those of a map directory, else itself.

    Raises:
        SourceError: a directory of no known format, or a map directory that cannot be read.
    """
    maps = (autoware.FORMAT, autoware.UNDIVIDED)
    if Path(path).is_dir() and format_of(path, FORMATS) in maps:
        return list(autoware.open_map_directory(path).files)
    return [path]
