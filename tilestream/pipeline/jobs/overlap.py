"""A drive and the map that it is localized in: do they share scans, or one pass through a street?

An error that is measured with a scan that the map was made of is far too small.
"""

import base64
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.errors import UsageError
from tilestream.formats.logs import ScanLog
from tilestream.records import Int64


@dataclass(frozen=True)
class Overlap:
    """What a drive shares with the map that it is localized in."""

    drive: str
    """Its log."""
    scans: int
    """Scans that are to be localized."""
    mapped: int
    """Those of them that the map was made of: of the same recording, or with as many points, at
    the same time."""
    source: str
    """The source of the map that has them, or that was recorded with them; empty: none."""

    @property
    def notes(self) -> list[str]:
        """What a user should know of it."""
        told = ""
        if self.mapped:
            told = (
                f"{self.mapped:,} of {self.scans:,} scans to be localized are in the map, from "
                f"{self.source}: their errors are too small"
            )
        elif self.source:
            told = (
                f"map and drive share one pass, other scans of {self.source}: what stood or drove "
                "there then is in both"
            )
        return [told] if told else []

    def require_none(self) -> None:
        """Refuse to measure with scans that are in the map.

        Raises:
            UsageError: some are.
        """
        if self.mapped:
            raise UsageError(
                f"{self.drive}: {self.notes[0]}; localize others (as with every 2, and offset 0 "
                "for the map, 1 for the drive), or allow it (--allow-overlap; label.allow_overlap)"
            )


def packed(stamps_ns: Int64, point_counts: Int64) -> str:
    """The scans of a log that made a map, (k,) times, rising [ns], and (k,) points of each, as a
    text.
    """
    rows = np.stack([np.diff(stamps_ns, prepend=0), point_counts]).astype("<i8")
    return base64.b85encode(zlib.compress(rows.tobytes())).decode("ascii")


def unpacked(text: str) -> tuple[Int64, Int64]:
    """Times [ns] and points of each scan of a text of `packed`."""
    rows = np.frombuffer(zlib.decompress(base64.b85decode(text)), "<i8").reshape(2, -1)
    return np.cumsum(rows[0]), rows[1].astype(np.int64)


def overlap(log: ScanLog, scans: Sequence[int], sources: Iterable[Mapping[str, Any]]) -> Overlap:
    """What a drive shares with a map.

    Args:
        log: of the drive.
        scans: those of it that are to be localized.
        sources: what the map is made of, as a store records it (`TileStore.sources`).
    """
    stamps, counts = log.stamps_ns[scans], log.point_counts[scans]
    mapped = np.zeros(len(scans), dtype=bool)
    having, beside = "", ""
    for source in sources:
        if not source.get("scans"):  # no log, or a map of before they were kept
            continue
        known = dict(zip(*(column.tolist() for column in unpacked(source["scans"])), strict=True))
        recorded_with = _one_recording(log, list(known), source)
        there = [
            stamp in known and (recorded_with or known[stamp] == count)
            for stamp, count in zip(stamps.tolist(), counts.tolist(), strict=True)
        ]
        mapped |= there
        having = having or (source["path"] if any(there) else "")
        beside = beside or (source["path"] if recorded_with else "")
    return Overlap(log.path, len(scans), int(mapped.sum()), having or beside)


def _one_recording(log: ScanLog, stamps_ns: Sequence[int], source: Mapping[str, Any]) -> bool:
    """Whether a source of a map is this log, wherever it lies: of one size, at one time."""
    at_once = stamps_ns[0] <= log.stamps_ns[-1] and log.stamps_ns[0] <= stamps_ns[-1]
    here = str(Path(log.path).absolute()) == source["path"]
    return here or bool(at_once and log.size_bytes == source["size_bytes"])
