"""The scans of a drive as a task reads them, as if by the sensor that is asked for."""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import lru_cache
from typing import Any

import numpy as np

from tilestream.errors import UsageError
from tilestream.formats.logs import ScanLog, open_log
from tilestream.formats.logs.degrade import degraded
from tilestream.formats.logs.deskew import Sweep, deskew
from tilestream.formats.registry import state_of
from tilestream.marks import hash_of
from tilestream.pipeline.engine.stage import Counts
from tilestream.records import Scan
from tilestream.sensor import AS_RECORDED
from tilestream.settings import LogOptions


@dataclass(frozen=True)
class Reading:
    """How a log is read: its topics and frames, as if by which sensor.

    Examples:
        >>> ts.Reading("drive.mcap", beams=16, range_max=30.0).as_sensor
        '16 beams, 30 m'
    """

    path: str
    """The log."""
    options: LogOptions = field(default_factory=LogOptions)
    """Its topics and frames."""
    beams: int | None = None
    """Beams that remain; None: all."""
    range_max: float | None = None
    """Largest range [m]; None: as recorded."""
    blind_rear_deg: float | None = None
    """Blind sector at the rear [deg]; None: none."""
    deskew: bool = False
    """Whether the distortion of motion is removed by the time of each point."""
    sweep_s: float | None = None
    """Duration of a turn [s], for logs without the time of each point; None: they have it."""

    @property
    def as_sensor(self) -> str:
        """As if by which sensor the scans are read, in words."""
        parts = [
            f"{self.beams} beams" if self.beams else "",
            f"{self.range_max:g} m" if self.range_max else "",
            f"rear blind {self.blind_rear_deg:g} deg" if self.blind_rear_deg else "",
            "de-skewed" if self.deskew else "",
        ]
        return ", ".join(part for part in parts if part) or AS_RECORDED

    def __post_init__(self) -> None:
        """Refuse what no scan could be read as, before any task runs.

        Raises:
            UsageError: a number outside of its range; what is known of one lidar, asked of several.
        """
        self._degraded(Scan(0, np.zeros((0, 3))))
        if self.sweep_s is not None and not 0.0 < self.sweep_s < math.inf:
            raise UsageError(f"sweep is {self.sweep_s!r}: give a positive time in seconds")
        topic = self.options.points_topic or ""
        if "," in topic and (self.beams or self.deskew):
            raise UsageError(
                f"{topic}: beams and times of points are those of one lidar, and not "
                "known of several together: leave beams and deskew out, or name one topic"
            )

    @property
    def state(self) -> str:
        """Hash of the log as it is now, and of how it is read; wherever it lies: a job whose files
        have moved has not to measure anew. Options that are not given are left out, so that one
        more of them changes no hash.
        """
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "options"}
        own["path"] = os.path.basename(os.path.realpath(self.path))  # noqa: PTH119
        topics = {"points_topic": None, "pose_topic": None}
        how: dict[str, Any] = {**own, **topics, **self.options.given}
        return hash_of(how, *state_of(self.path))

    def open(self) -> ScanLog:
        """The log."""
        return open_log(self.path, self.options)

    def seen(self, scan: Scan, log: ScanLog) -> Scan:
        """A scan of the log as it is to be localized."""
        if self.deskew:
            sweep = None if self.sweep_s is None else Sweep(self.sweep_s)
            scan = deskew(
                scan,
                log.trajectory,
                sweep=sweep,
                max_gap_s=self.options.max_gap_s,
                max_speed_mps=self.options.max_speed_mps,
            )
        return self._degraded(scan)

    def _degraded(self, scan: Scan) -> Scan:
        return degraded(
            scan,
            beams=self.beams,
            range_max=self.range_max,
            blind_rear_deg=self.blind_rear_deg,
        )


@dataclass(frozen=True, slots=True)
class Sample:
    """A scan of a sample point of a drive."""

    number: int
    """Number of the sample point along the drive; of all its scans."""
    scan: int
    """Index of the scan in the log."""
    stamp_ns: int
    """Its header stamp [ns since the epoch]."""
    arc_length: float
    """Length of the drive up to here [m]."""


@dataclass(frozen=True)
class DriveScans:
    """Some scans of a drive, all of each sample point, the nearest to it first."""

    reading: Reading
    state: str
    """Of the log and of how it is read (`Reading.state`)."""
    samples: tuple[Sample, ...]
    makers: tuple[str, ...] = ()

    @property
    def sample_points(self) -> int:
        """How many sample points they are of."""
        return len({sample.number for sample in self.samples})

    @property
    def identity(self) -> str:
        """Hash of the log and of the sample points."""
        return hash_of(self.state, self.samples)

    def read(self) -> "OpenedScans":
        """The scans, read one after the other."""
        return OpenedScans(_opened(self.reading, self.state), self)

    def counts(self) -> Counts:
        """Nothing that memory depends on: scans are read one by one."""
        return {}


@dataclass(frozen=True, eq=False)
class OpenedScans:
    """Scans of an opened log."""

    log: ScanLog
    wanted: DriveScans

    def __iter__(self) -> Iterator[tuple[Sample, Scan]]:
        """Each sample point with its scan as recorded, which has a pose."""
        samples = self.wanted.samples
        scans = self.log.scans_at([sample.scan for sample in samples])
        return zip(samples, scans, strict=True)

    def seen(self, scan: Scan) -> Scan:
        """A scan as it is to be localized."""
        return self.wanted.reading.seen(scan, self.log)


def opened(reading: Reading) -> ScanLog:
    """A log; a process reads it through once while the file stays as it is."""
    return _opened(reading, reading.state)


@lru_cache(maxsize=4)
def _opened(reading: Reading, state: str) -> ScanLog:  # noqa: ARG001 - a changed file is another
    return reading.open()
