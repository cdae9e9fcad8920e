"""What is told of anything: one record for all kinds, with the same names in `--json`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from tilestream.formats.base import Bounds, Corner
from tilestream.notes import Notes, shared
from tilestream.records import Float64


@dataclass(frozen=True, kw_only=True)
class Info:
    """What is in something that tilestream reads or has written. What is not known is None; what
    does not apply is empty.
    """

    path: str
    """As it was named."""
    kind: str
    """One of `KINDS`: `points`, `log`, `routes`, `map`, `run`, `model`, `comparison`, `scene`."""
    format: str
    """Name of the format, e.g. `pcd binary`, `mcap`, `Lanelet2`."""
    state: str = "whole"
    """`whole`; else what is wrong: half-made, being written, damaged, failed, and what to do."""
    size_bytes: int | None = None
    """Size of the file or files; None: of what we have written nobody counts."""
    crs: str | None = None
    """Coordinate reference system, as WKT or an authority code; None: none is named."""
    unit: str = "m"
    """Of x and y in `bounds`: `m`, also where the file has feet, or `degrees`."""
    frames: Mapping[str, str] = field(default_factory=dict)
    """Names of frames, as recorded: of the `scans` of a log."""
    bounds: Bounds | None = None
    """Lowest and highest x, y, z, the last one in metres; NaN: there is no z."""
    heights: tuple[float, float] | None = None
    """Lowest and highest z [m]; None: nothing has one."""
    points: int | None = None
    """Points of a map or of a log's scans with a pose, places of a run."""
    fields: Sequence[tuple[str, str]] = ()
    """Name and type of each field of a point."""
    coverage: Mapping[str, Any] = field(default_factory=dict)
    """How much there is, by name: `length_m` (driven or drawn, no jump in it), `scans`,
    `scans_with_pose`, `poses`, `routes`, `vertices`, `vertices_with_z`, `tiles`, `drives`,
    `places`, …; `from` and `until` [UTC, or s where a file counts from its own start]."""
    contents: Sequence[str] = ()
    """What it is made of, a line each: topics, tables, sources."""
    notes: Sequence[str] = ()
    """What a user should know: what was assumed, chosen, lost or left out."""

    def plain(self) -> dict[str, Any]:
        """As JSON has it: a NaN is None."""
        found = asdict(self)
        if self.bounds is not None:
            found["bounds"] = [[_known(value) for value in corner] for corner in self.bounds]
        return found

    def over(self, xyz: Float64) -> "Info":
        """With the extent of (n, 3) points, of which some may have no z."""
        if not len(xyz):
            return self
        low, high = (_corner(xyz, least) for least in (True, False))
        return replace(self, bounds=(low, high), heights=heights_of((low, high)))


def heights_of(bounds: Bounds | None) -> tuple[float, float] | None:
    """The z of bounds; None: there is none."""
    if bounds is None or not np.isfinite([bounds[0][2], bounds[1][2]]).all():
        return None
    return bounds[0][2], bounds[1][2]


def told(notes: Notes) -> list[str]:
    """Notes as lines, alike ones together."""
    return [str(note) for note in shared(notes)]


def utc(stamp_ns: int) -> str:
    """A time [ns since the epoch] as people write it, in UTC."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(timespec="milliseconds")


def _corner(xyz: Float64, least: bool) -> Corner:
    values = []
    for column in xyz.T:
        known = column[np.isfinite(column)]
        values.append(float((known.min() if least else known.max()) if len(known) else np.nan))
    x, y, z = values
    return x, y, z


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None
