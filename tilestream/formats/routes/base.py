"""What every file of routes brings: paths as it draws them, and the words in it as numbers."""

import math
from dataclasses import dataclass
from pathlib import Path

from tilestream.errors import CorruptSourceError, TilestreamError
from tilestream.records import Float64

DEGREES = "OGC:CRS84"
"""Longitude and latitude in degrees, in this order."""


@dataclass(frozen=True, eq=False)
class Path3:
    """A path as a file draws it."""

    route_id: str
    """Its name in the file, or the file's."""
    positions: Float64
    """(n, 3) points, in the file's unit; z is NaN where there is none."""
    crs: str | None = None
    """Coordinate reference system, where the file names it."""
    recorded: bool = False
    """Whether it was recorded pose by pose: points lie close together, also where the vehicle
    stands."""
    stamps_s: Float64 | None = None
    """(n,) time of each point [s], where it was recorded."""
    notes: tuple[str, ...] = ()
    """What its reader noticed."""
    lanelets: tuple[tuple[str, int], ...] = ()
    """Of a lane the lanelets that it is joined of: the number of each, and where in `positions` it
    begins."""


@dataclass(frozen=True)
class Lost:
    """A route that cannot be used."""

    route_id: str
    """Its name in the file, or the file's."""
    error: TilestreamError
    """Why, and where."""


def text_of(path: str) -> str:
    """The text of a file, in UTF-8.

    Raises:
        CorruptSourceError: it is none.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptSourceError(f"{path}: not a text file ({error})") from error


def number(path: str, place: str, word: object) -> float:
    """A finite number of a file.

    Raises:
        CorruptSourceError: it is none; names the place.
    """
    try:
        value = float(word)  # type: ignore[arg-type] # whatever a file holds
    except (TypeError, ValueError):
        raise CorruptSourceError(f"{path}: {place} is no number: {word!r}") from None
    if not math.isfinite(value):
        raise CorruptSourceError(f"{path}: {place} is not finite: {word!r}")
    return value
