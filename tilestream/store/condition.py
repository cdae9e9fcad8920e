"""Whether a map is whole, being written, or damaged."""

from collections.abc import Mapping
from dataclasses import dataclass

from tilestream.errors import IncompleteError
from tilestream.grid import TileKey
from tilestream.lock import Holder
from tilestream.marks import Mark
from tilestream.notes import some_of
from tilestream.store.record import State

NAMED = 5
"""Tiles that a message names; of the others the number."""


@dataclass(frozen=True)
class Condition:
    """The state of a map, seen from outside."""

    url: str
    """The store."""
    state: State
    """What it says of itself."""
    marks: Mapping[TileKey, Mark]
    """What became of the points of each tile that it must have."""
    writer: Holder | None
    """Who writes to it now."""

    @property
    def lost(self) -> dict[TileKey, Mark]:
        """The tiles that it must have and has not, neither done nor failed for a reason."""
        lost = ("missing", "damaged")
        return {key: mark for key, mark in self.marks.items() if mark.status in lost}

    @property
    def whole(self) -> bool:
        """Whether its ingest has ended and nothing was lost since."""
        return self.state == "whole" and not self.lost

    def __str__(self) -> str:
        if self.whole:
            return "whole"
        if self.writer is not None:
            return f"being written by {self.writer}: wait until that ends"
        if self.state == "whole":
            names = [str(key) for key in self.lost]
            tiles = f"tile{'s' if len(names) > 1 else ''} {some_of(names, NAMED)}"
            return f"damaged, it has lost {tiles}: ingest its sources again, which makes these anew"
        return "half-made: its ingest was stopped; run the same command again to end it"

    def require_whole(self) -> None:
        """Refuse a map that is not whole.

        Raises:
            IncompleteError: it is being written, half-made or damaged; says what to do.
        """
        if not self.whole:
            raise IncompleteError(
                f"{self.url} is {self}; partial (--partial) goes on without, and says so at every "
                "place that could see what is missing"
            )
