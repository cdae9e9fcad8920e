"""What every format of logs brings: a `Recording` of what was found, and a `ScanReader`.

A new format is one file: a function that opens a log as a `Recording`, and its `Format`, which
`formats/logs/__init__.py` lists. Poses at the times of the scans, selections, lidar returns and
a drive as map points come with it (`scan_log.py`, `formats/drive.py`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from tilestream.records import Float64, Int64, Trajectory

METADATA = "metadata.yaml"
"""What every rosbag2 folder has beside its files."""


@dataclass(frozen=True, eq=False)
class RecordedScan:
    """A scan as it lies in a log: every point, whether it is a return or not."""

    stamp_ns: int
    """Time of its header [ns since the epoch]."""
    points: Float64
    """(n, 3) points in the lidar frame [m]; not finite, or 0, where a pulse did not come back."""
    intensity: NDArray[Any] | None = None
    """(n,) intensity, any number type; None where the log has none."""
    ring: NDArray[Any] | None = None
    """(n,) index of the beam, any number type; None where the log has none."""
    time: NDArray[Any] | None = None
    """(n,) time of each point as the driver wrote it, see `drivers.time_offsets`; None where the
    log has none."""


class ScanReader(Protocol):
    """Reads the scans of a log. A value: it holds no open file and can be pickled."""

    def read(self, indices: Sequence[int]) -> Iterator[RecordedScan]:
        """The scans with these indices, in this order; what scans that follow each other share is
        read once.

        Raises:
            CorruptSourceError: the log is damaged; names file and place.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What is in a log of scans and poses, after it was read through once."""

    path: str
    """The log, as it was named."""
    format: str
    """Name of the format, e.g. `mcap`."""
    size_bytes: int
    """Size of the log [bytes]."""
    contents: tuple[str, ...] = ()
    """What was recorded, a line each: its topics."""
    points_topic: str
    """Topic of the scans, or what stands for it in a format without topics."""
    pose_topic: str
    """Topic of the poses, or what stands for it."""
    frame: str
    """Frame of the points, as recorded; empty where the log does not name it."""
    fields: tuple[tuple[str, str], ...]
    """Name and type of each field of a point, as in the first scan."""
    stamps_ns: Int64
    """(k,) header stamps of all scans, not falling [ns since the epoch]."""
    point_counts: Int64
    """(k,) points of each scan, returns or not."""
    held_bytes: Int64
    """(k,) what reading each scan holds at once besides its points [bytes]."""
    trajectory: Trajectory
    """The recorded poses, of the lidar in the map frame; at least one."""
    notes: tuple[str, ...] = ()
    """What a user should know: choices that were made, what was lost from a cut file."""
    reader: ScanReader
    """Reads the scans, by index into `stamps_ns`."""
