"""What every outside format answers: two small protocols, and the values they pass."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from tilestream.records import Float64

Corner = tuple[float, float, float]
Bounds = tuple[Corner, Corner]
"""Lowest and highest x, y, z [m, map frame]."""


def corner_of(xyz: Float64) -> Corner:
    """x, y and z as plain numbers."""
    x, y, z = xyz.tolist()
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class SourceInfo:
    """What is in a file of points, as far as its header (or, where cheap, its content) tells."""

    path: str
    """The file, as it was named."""
    format: str
    """Name of the format, e.g. `pcd binary`."""
    size_bytes: int
    """Size of the file [bytes]."""
    points: int | None
    """Number of points that the file holds; None where only reading it whole can tell."""
    bounds: Bounds | None = None
    """Lowest and highest x, y, z [m, map frame], where the header tells; else None."""
    fields: tuple[tuple[str, str], ...]
    """Name and type of each field of a point, as the file names them, e.g. `("x", "float32")`."""
    crs: str | None = None
    """Coordinate reference system as WKT or an authority code; None where the file has none."""
    resident_bytes: int = 0
    """What a reader must hold at once besides a block [bytes]: 0 where it reads in blocks, the
    size of the decoded content for a format that only opens whole."""
    contents: tuple[str, ...] = ()
    """What it is made of, a line each: topics of a log, scans of a survey."""
    notes: tuple[str, ...] = ()
    """What a user should know, a line each: what was assumed, chosen, lost or left out."""


@dataclass(frozen=True)
class Span:
    """Points `start` to `stop` (exclusive) of a source, in the file's order."""

    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Block:
    """Some points of a source."""

    points: Float64
    """(n, 3) finite points [m, map frame], n >= 0."""
    dropped: int
    """Points of the file that were not finite and are not here."""
    left_out: int = 0
    """Points that the file itself marks as noise or withheld, and that are not here."""


class PointSource(Protocol):
    """A file of points in the map frame (or a drive that becomes one)."""

    @property
    def path(self) -> str:
        """The file, as it was named."""

    def info(self) -> SourceInfo:
        """What is in the file, without reading its points where possible."""

    def spans(self, points: int) -> list[Span]:
        """The file in pieces of about `points` points that can be read independently, in any order
        and by different processes; together they are the whole file, each point once. One span
        where the format can only be read from its beginning. Empty for a file without points.
        """

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in blocks of at most `block_points` points of the file.

        Raises:
            CorruptSourceError: the file is cut short or damaged; names file and offset or field.
        """
