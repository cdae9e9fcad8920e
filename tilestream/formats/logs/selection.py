"""Which scans of a log are used."""

from dataclasses import dataclass

import numpy as np

from tilestream.errors import UsageError
from tilestream.records import Int64


@dataclass(frozen=True)
class ScanSelection:
    """Which scans of a log to use. Two selections with the same `every` and different `offset`, or
    one `until_s` and the other `from_s` the same time, share no scan: one maps, one localizes.
    """

    start: int = 0
    """First scan, counted over all scans of the log by header stamp."""
    stop: int | None = None
    """First scan not to use; None: to the end."""
    every: int = 1
    """Use the scans whose index leaves the remainder `offset` when divided by `every`."""
    offset: int = 0
    """See `every`; 0 <= offset < every."""
    from_s: float = 0.0
    """Use the scans from this time on [s after the first scan of the log]."""
    until_s: float | None = None
    """Use the scans before this time [s after the first scan of the log]; None: to the end."""

    def __post_init__(self) -> None:
        if self.every < 1 or not 0 <= self.offset < self.every:
            raise UsageError(
                f"scan selection: every = {self.every}, offset = {self.offset}; "
                "every must be at least 1 and offset from 0 to every - 1"
            )
        if self.start < 0 or (self.stop is not None and self.stop < self.start):
            raise UsageError(
                f"scan selection: start = {self.start}, stop = {self.stop}; "
                "start must be at least 0 and stop not before it"
            )

        if self.until_s is not None and self.until_s <= self.from_s:
            raise UsageError(
                f"scan selection: from_s = {self.from_s:g}, until_s = {self.until_s:g}; "
                "until_s must be later than from_s"
            )

    def __str__(self) -> str:
        parts = [
            f"from scan {self.start} on" * (self.start > 0),
            f"before scan {self.stop}" * (self.stop is not None),
            f"every {self.every} from {self.offset} on" * (self.every > 1),
            f"from {self.from_s:g} s on" * (self.from_s > 0.0),
            f"until {self.until_s} s" * (self.until_s is not None),
        ]
        return ", ".join(part for part in parts if part) or "all scans"

    def indices(self, stamps_ns: Int64) -> Int64:
        """Indices of the scans to use, rising, among scans with these (k,) rising stamps [ns]."""
        index = np.arange(len(stamps_ns))
        use = (index >= self.start) & (index % self.every == self.offset)
        if self.stop is not None:
            use &= index < self.stop
        if len(stamps_ns):
            since = (stamps_ns - stamps_ns[0]) / 1e9
            use &= since >= self.from_s
            if self.until_s is not None:
                use &= since < self.until_s
        return np.flatnonzero(use)
