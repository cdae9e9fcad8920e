"""Files of points, whatever their format: one protocol (base.py) and the registry below."""

import glob
import inspect
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tilestream.errors import (
    CorruptSourceError,
    SourceNotFoundError,
    UnknownFormatError,
    UsageError,
)
from tilestream.formats.base import Block, PointSource, SourceInfo, Span
from tilestream.formats.logs.mcap import open_drive
from tilestream.formats.points.autoware import is_map_directory, open_map_directory
from tilestream.formats.points.las import MAGIC as LAS_MAGIC
from tilestream.formats.points.las import open_las
from tilestream.formats.points.pcd import looks_like_pcd, open_pcd
from tilestream.formats.points.ply import MAGIC as PLY_MAGIC
from tilestream.formats.points.ply import looks_like_ply, open_ply
from tilestream.records import Float64

try:
    from tilestream.formats.points import e57
except ModuleNotFoundError as missing:
    if missing.name != "pye57":
        raise
    e57 = None  # type: ignore[assignment]  # the extra is not installed

__all__ = [
    "FORMATS",
    "Block",
    "Format",
    "PointSource",
    "SourceInfo",
    "Span",
    "describe",
    "expand_sources",
    "open_source",
]

_HEAD = 4096
"""What is read of a file to see which format it has [bytes]."""
_READ_MAX = 1_000_000_000
"""Largest file that `describe` reads for its bounds [bytes]."""
_BLOCK = 1 << 17
"""Points that `describe` reads at once: they stay in the cache."""


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

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options that `open` takes."""
        return tuple(inspect.signature(self.open).parameters)[1:]

    def __str__(self) -> str:
        return f"{self.name} ({', '.join(self.endings)}): {self.what}"


def _begins_with(magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


def _open_e57(path: str) -> PointSource:
    if e57 is None:
        raise UnknownFormatError(f"{path}: E57 needs an extra: pip install 'tilestream[e57]'")
    return e57.open_e57(path)


_E57_MAGIC = b"ASTM-E57"
_MCAP_MAGIC = b"\x89MCAP0\r\n"

FORMATS = (
    Format(
        name="PCD",
        endings=(".pcd",),
        what="ascii, binary, binary_compressed",
        magic=b"# .PCD",
        looks_like=looks_like_pcd,
        open=open_pcd,
    ),
    Format(
        name="LAS",
        endings=(".las", ".laz"),
        what="1.0 to 1.4, LAZ and COPC, with CRS",
        magic=LAS_MAGIC,
        looks_like=_begins_with(LAS_MAGIC),
        open=open_las,
    ),
    Format(
        name="PLY",
        endings=(".ply",),
        what="ascii, binary of either byte order",
        magic=PLY_MAGIC,
        looks_like=looks_like_ply,
        open=open_ply,
    ),
    Format(
        name="E57",
        endings=(".e57",),
        what="cartesian or spherical scans with their poses (extra `e57`)",
        magic=_E57_MAGIC,
        looks_like=_begins_with(_E57_MAGIC),
        open=_open_e57,
    ),
    Format(
        name="MCAP",
        endings=(".mcap",),
        what="logs with point clouds and poses: the map that the drive saw",
        magic=_MCAP_MAGIC,
        looks_like=_begins_with(_MCAP_MAGIC),
        open=open_drive,
    ),
)
"""What `open_source` reads, besides a directory of Autoware's divided map."""


def open_source(path: str | os.PathLike[str], **options: object) -> PointSource:
    """A file of points, by its ending (in any case) and checked against its first bytes.

    Args:
        path: a file of one of `FORMATS`, or a directory of Autoware's divided map.
        options: what a format takes, e.g. the topics of a log; files of another one ignore it, so
            that a mixed list can share its options.

    Raises:
        SourceNotFoundError: there is no such file.
        UnknownFormatError: the ending is of no supported format, or the content is of another one.
        CorruptSourceError: the file is empty, cut short or damaged.
        UsageError: an option that no format takes.
    """
    name = os.fspath(path)
    if Path(name).is_dir():
        return open_map_directory(name)
    if not Path(name).is_file():
        raise SourceNotFoundError(f"{name}: no such file; check the path")
    with Path(name).open("rb") as file:
        head = file.read(_HEAD)
    found = _format_of(name, head)
    known = {option for f in FORMATS for option in f.options}
    if unknown := sorted(options.keys() - known):
        raise UsageError(f"{name}: no format takes the option {', '.join(unknown)}")
    return found.open(name, **{o: options[o] for o in found.options if o in options})


def describe(path: str | os.PathLike[str], **options: object) -> SourceInfo:
    """What is in a file, as `PointSource.info`, and its bounds also where no header tells them.

    For those a file of up to 1 GB is read; a note says how many of its points are not finite.
    Arguments and errors as for `open_source`.
    """
    source = open_source(path, **options)
    found = source.info()
    if found.bounds is not None or not found.points or found.size_bytes > _READ_MAX:
        return found
    lowest, highest, dropped = np.full(3, np.inf), np.full(3, -np.inf), 0
    for span in source.spans(found.points):
        for block in source.blocks(span, _BLOCK):
            lowest = np.minimum(lowest, block.points.min(axis=0, initial=np.inf))
            highest = np.maximum(highest, block.points.max(axis=0, initial=-np.inf))
            dropped += block.dropped
    notes = (*found.notes, f"{dropped} points are not finite") if dropped else found.notes
    if dropped == found.points:
        return replace(found, notes=notes)
    return replace(found, bounds=(_corner(lowest), _corner(highest)), notes=notes)


def _corner(corner: Float64) -> tuple[float, float, float]:
    x, y, z = corner.tolist()
    return x, y, z


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
        matches = [pattern]
    elif glob.has_magic(pattern):
        named = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207  Path's is relative only
        matches = [path for path in named if Path(path).is_file() or is_map_directory(Path(path))]
    else:
        raise SourceNotFoundError(f"{pattern}: no such file or directory; check the path")
    if not matches:
        raise SourceNotFoundError(f"{pattern}: the pattern matches no file; check the path")
    return [file for path in matches for file in _files_of(path)]


def _files_of(path: str) -> list[str]:
    return list(open_map_directory(path).files) if Path(path).is_dir() else [path]
