"""How much of a drive was measured, and how much of it nobody knows."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from tilestream.counts import count_of

EVALUATED = 0.5
"""Share of a drive, or of a route, that must have been evaluated where a gate opens."""
TOLD = 3
"""Reasons that a line tells."""


@dataclass(frozen=True)
class DriveMeasured:
    """The scans of a drive: which were measured, and why the others were not."""

    drive: str
    """Its name, or its log."""
    scans: int
    """Scans in the log."""
    selected: int
    """Those that were to be used."""
    posed: int
    """Those of them with a pose."""
    sample_points: int
    """Places of the drive: one of these scans stands for each."""
    measured: int
    """Places that were measured."""
    reasons: Mapping[str, int]
    """Why the other scans were not measured, the commonest first; with `measured` they sum up to
    `scans`."""

    @property
    def evaluated(self) -> bool:
        """Whether enough of it was (`EVALUATED`): of the scans that were to be used enough have a
        pose, and enough of the places were measured.
        """
        return (
            self.posed >= EVALUATED * self.selected
            and self.measured >= EVALUATED * self.sample_points
            and self.measured > 0
        )

    @property
    def why(self) -> str:
        """The commonest reasons with their numbers."""
        told = [f"{count:,} {reason}" for reason, count in list(self.reasons.items())[:TOLD]]
        return "; ".join(told) + ("; …" if len(self.reasons) > TOLD else "")

    def __str__(self) -> str:
        """The headline of a drive."""
        why = f" ({self.why})" if self.reasons else ""
        return f"measured {self.measured:,} of {count_of(self.scans, 'scan')}{why}"

    def plain(self) -> dict[str, Any]:
        """Its fields, and `evaluated`, for machines."""
        return {**asdict(self), "reasons": dict(self.reasons), "evaluated": self.evaluated}
