"""Autoware's maps: a directory with `pointcloud_map.pcd`, a file or a folder of PCD files, which
`pointcloud_map_metadata.yaml` lists where the map is divided.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

from tilestream.errors import CorruptSourceError, SourceNotFoundError
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.formats.points.pcd import open_pcd
from tilestream.formats.points.rows import RowSource, whole_span
from tilestream.formats.projector import CLOUD, METADATA, PROJECTOR, read_mapping, read_projector
from tilestream.formats.registry import Format
from tilestream.notes import some_of


@dataclass(frozen=True)
class MapDirectory:
    """A map: its PCD files one behind the other, in the order of their names."""

    path: str
    """The directory, as it was named."""
    files: tuple[str, ...]
    """Its PCD files, sorted: those that the metadata lists, where there is one."""
    crs: str | None
    """CRS of x and y, where `map_projector_info.yaml` tells one."""
    notes: tuple[str, ...]
    """What else a user should know: size of the parts, projector, files that are not listed."""

    @cached_property
    def _parts(self) -> tuple[RowSource, ...]:
        return tuple(open_pcd(path) for path in self.files)

    @cached_property
    def _starts(self) -> tuple[int, ...]:
        return tuple(accumulate((part.rows.count for part in self._parts), initial=0))

    def info(self) -> SourceInfo:
        """What the headers of all files tell together."""
        return SourceInfo(
            path=self.path,
            format="autoware divided map" if len(self.files) > 1 else "autoware map",
            size_bytes=sum(part.summary.size_bytes for part in self._parts),
            points=self._starts[-1],
            fields=tuple(
                dict.fromkeys(field for part in self._parts for field in part.summary.fields)
            ),
            crs=self.crs,
            resident_bytes=max((part.summary.resident_bytes for part in self._parts), default=0),
            notes=self.notes,
        )

    def spans(self, points: int) -> list[Span]:
        """The spans of each file."""
        return [
            Span(start + span.start, start + span.stop)
            for start, part in zip(self._starts, self._parts, strict=False)
            for span in part.spans(points)
        ]

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in blocks; see `PointSource.blocks`."""
        whole_span(span, self._starts[-1], self.path)
        for start, part in zip(self._starts, self._parts, strict=False):
            first = max(span.start - start, 0)
            last = min(span.stop - start, part.rows.count)
            if first < last:
                yield from part.blocks(Span(first, last), block_points)


def open_map_directory(path: str) -> MapDirectory:
    """A map; the metadata of a divided one is read, and every file that it lists is there.

    Raises:
        CorruptSourceError: the metadata cannot be read, or names a file outside of the directory.
        SourceNotFoundError: files that it lists are missing, names them; or there are none.
    """
    folder = Path(path)
    metadata = folder / METADATA
    if not metadata.exists():
        return _undivided(folder, path)
    content = read_mapping(metadata)
    width, height = (
        _length(content.pop(name, None), name, metadata)
        for name in ("x_resolution", "y_resolution")
    )
    for name, corner in content.items():
        _check_corner(name, corner, metadata)
    files = sorted({_file(folder, name, metadata) for name in content})
    _refuse_missing(files, metadata)
    return _map_of(folder, path, files, f"{len(files)} parts of {width:g} x {height:g} m")


def _undivided(folder: Path, path: str) -> MapDirectory:
    """A map without metadata: its one PCD file, or all of its folder."""
    inside = folder / CLOUD
    files = [inside] if inside.is_file() else sorted(inside.glob("*.pcd"))
    if not files:
        raise SourceNotFoundError(f"{inside}: holds no PCD file; copy the map's files there")
    return _map_of(folder, path, files, f"{len(files)} PCD files, no {METADATA}")


def _map_of(folder: Path, path: str, files: list[Path], told: str) -> MapDirectory:
    projector = folder / PROJECTOR
    crs, notes = read_projector(projector) if projector.is_file() else (None, ())
    notes = (told, *notes, *_unlisted(folder, set(files)))
    return MapDirectory(path, tuple(map(str, files)), crs, notes)


UNDIVIDED = Format(
    name="Autoware's map",
    what="its PCD file, with CRS",
    open=open_map_directory,
    marker=CLOUD,
)
FORMAT = Format(
    name="Autoware's divided map",
    what="its PCD files, with CRS",
    open=open_map_directory,
    marker=METADATA,
)


def _length(value: Any, name: str, metadata: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise CorruptSourceError(f"{metadata}: {name} is {value!r}, not a length in metres")
    return float(value)


def _file(folder: Path, name: Any, metadata: Path) -> Path:
    """Where a listed file is: in the sub-directory if it is there, else beside the metadata."""
    if not isinstance(name, str) or not name.lower().endswith(".pcd"):
        raise CorruptSourceError(f"{metadata}: entry {name!r} is no name of a PCD file")
    inside = folder / CLOUD / name
    file = inside if inside.is_file() else folder / name
    home = folder.resolve()
    if Path(name).is_absolute() or ".." in Path(name).parts or home not in file.resolve().parents:
        raise CorruptSourceError(
            f"{metadata}: entry {name!r} points outside of {folder}; a divided map lists files of "
            "its own directory only"
        )
    return file


def _check_corner(name: Any, corner: Any, metadata: Path) -> None:
    """Refuse an entry that does not say where its part lies: lowest x and y [m]."""
    match corner:
        case [int() | float() as x, int() | float() as y] if math.isfinite(x) and math.isfinite(y):
            return
    raise CorruptSourceError(f"{metadata}: entry {name!r} has {corner!r}, not its corner [x, y]")


def _refuse_missing(files: list[Path], metadata: Path) -> None:
    missing = sorted(file.name for file in files if not file.is_file())
    if missing:
        raise SourceNotFoundError(
            f"{metadata}: lists {len(missing)} of {len(files)} files that are missing: "
            f"{some_of(missing, 5)}; copy them, or take them out of the list"
        )


def _unlisted(folder: Path, listed: set[Path]) -> tuple[str, ...]:
    found = [*folder.glob("*.pcd"), *(folder / CLOUD).glob("*.pcd")]
    names = sorted(file.name for file in found if file.is_file() and file not in listed)
    if not names:
        return ()
    more = ", …" if len(names) > 5 else ""
    return (f"{len(names)} PCD files are not listed and not read: {', '.join(names[:5])}{more}",)
