"""Streets: routes between buildings, what each is made of, and where along it one is."""

import json
import os
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.errors import CorruptSourceError, SourceNotFoundError, UsageError
from tilestream.records import Float64
from tilestream.simulation.footprints import Footprints
from tilestream.simulation.free_space import MIN_CLEARANCE, clearance, resample

SPOTS = ("tunnel", "crossing", "bridge", "one-sided", "furnished", "narrow", "wide")
"""What a stretch of a route may be."""


@dataclass(frozen=True)
class Spot:
    """A stretch of a route that is of a kind of its own."""

    kind: str
    """One of `SPOTS`."""
    begin: float
    """Arc length where it begins [m]."""
    end: float
    """Arc length where it ends [m]."""
    side: str = "right"
    """Of a one-sided street: where the vegetation is."""


@dataclass(frozen=True, eq=False)
class Street:
    """A route through the city."""

    name: str
    """`I` to `V` for the paper's paths."""
    kind: str
    """What sort of street it is, in words."""
    xy: Float64
    """(n, 2) sample points, 1 m of arc length apart [m, map frame]."""
    driven: bool
    """Whether scans are taken along it; else it is only mapped."""
    spots: tuple[Spot, ...] = ()
    """Its tunnels, crossings, bridges and one-sided stretches."""

    @property
    def number(self) -> int:
        """What its random streams are told apart by."""
        return zlib.crc32(self.name.encode())

    @property
    def arc(self) -> Float64:
        """(n,) arc length of each sample point [m]."""
        return np.arange(len(self.xy), dtype=np.float64)

    def at(self, arc: Float64) -> Float64:
        """(k, 2) positions at arc lengths [m]; beyond an end the route goes on straight."""
        arc = np.asarray(arc, np.float64)
        last = len(self.xy) - 1
        row = np.clip(np.floor(arc).astype(np.int64), 0, last - 1)
        step = self.xy[row + 1] - self.xy[row]
        return np.asarray(self.xy[row] + (arc - row)[:, None] * step)

    def heading(self, arc: Float64) -> Float64:
        """(k,) direction of travel [rad, from x to y], over 2 m of the route."""
        arc = np.asarray(arc, np.float64)
        step = self.at(arc + 1.0) - self.at(arc - 1.0)
        return np.arctan2(step[:, 1], step[:, 0])

    def back(self) -> "Street":
        """The street from its end to its beginning; without its spots, which are told by arc length
        from the other end.
        """
        return replace(self, xy=self.xy[::-1], spots=())

    def spots_of(self, *kinds: str) -> tuple[Spot, ...]:
        """Its stretches of these kinds."""
        return tuple(spot for spot in self.spots if spot.kind in kinds)


def read_streets(path: str | os.PathLike[str]) -> tuple[Street, ...]:
    """Routes from GeoJSON: LineStrings in metres with `name`, `kind`, `driven` and `spots`.

    Raises:
        SourceNotFoundError: there is no such file.
        CorruptSourceError: it is no GeoJSON of LineStrings.
        UsageError: a spot of no known kind or outside of its route.
    """
    if not Path(path).is_file():
        raise SourceNotFoundError(f"{path}: no such file of routes; check the path")
    try:
        features = json.loads(Path(path).read_text())["features"]
        lines = [(f["properties"], np.array(f["geometry"]["coordinates"])) for f in features]
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptSourceError(f"{path}: no GeoJSON of routes: {error!r}") from None
    return tuple(_street(properties, line, str(path)) for properties, line in lines)


def street_called(streets: tuple[Street, ...], name: str) -> Street:
    """The street of that name.

    Raises:
        UsageError: there is none; names those that are.
    """
    for street in streets:
        if street.name == name:
            return street
    known = ", ".join(street.name for street in streets)
    raise UsageError(f"no street is called {name}; there are {known}")


def _street(properties: dict[str, Any], line: Float64, path: str) -> Street:
    name = str(properties.get("name", ""))
    if not name or line.ndim != 2 or len(line) < 2 or not np.isfinite(line).all():
        raise CorruptSourceError(f"{path}: a route without a name or with fewer than two places")
    spots = tuple(Spot(**spot) for spot in properties.get("spots", ()))
    line = line[:, :2]
    steps = np.hypot(*np.diff(line, axis=0).T)
    xy = line if np.abs(steps - 1.0).max() < 0.1 else resample(line)
    for spot in spots:
        if spot.kind not in SPOTS or not 0 <= spot.begin < spot.end <= len(xy) - 1:
            raise UsageError(f"{path}: route {name}: {spot} is of no kind of {SPOTS} or outside")
    driven = bool(properties.get("driven", True))
    return Street(name, str(properties.get("kind", "")), xy, driven, spots)


def check_clear(street: Street, footprints: Footprints) -> None:
    """Refuse a route that comes nearer to a building than `MIN_CLEARANCE`, exactly.

    Raises:
        UsageError: names the route, the arc length and the distance.
    """
    clear = clearance(street.xy, footprints)
    row = int(np.argmin(clear))
    if clear[row] < MIN_CLEARANCE:
        raise UsageError(
            f"route {street.name} comes within {max(clear[row], 0.0):.2f} m of a building at "
            f"{row} m, ({street.xy[row, 0]:.1f}, {street.xy[row, 1]:.1f}): "
            f"keep {MIN_CLEARANCE} m away"
        )
