"""How many tiles of a map an update changes, in numbers and in words."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from tilestream.counts import count_of
from tilestream.errors import StoreError, UsageError
from tilestream.grid import TileKey
from tilestream.store import open_store


@dataclass(frozen=True)
class Update:
    """How many tiles of a map are others than they were."""

    changed: int
    """That are new, or whose points are others."""
    removed: int
    """That the map has no more."""
    of: int
    """How many tiles the map has."""

    @classmethod
    def between(cls, had: Mapping[TileKey, str], has: Mapping[TileKey, str]) -> Self | None:
        """From the identities of the tiles of a map before and after; None: they are the same, or
        there was no map.
        """
        if not had or had == has:
            return None
        changed = sum(had.get(key) != identity for key, identity in has.items())
        return cls(changed, len(had.keys() - has.keys()), len(has))

    def facts(self, *, at_most: bool = False) -> dict[str, Any]:
        """It for machines, and in words (`told`).

        Args:
            at_most: it is what the headers of the sources tell, before they are read.
        """
        limit, verb = ("at most ", "change") if at_most else ("", "changed")
        gone = f", {self.removed:,} removed" if self.removed else ""
        told = f"map: {limit}{self.changed:,} of {count_of(self.of, 'tile')} {verb}{gone}"
        counts = {f"tiles_{name}": count for name, count in asdict(self).items()}
        return {"told": told, "at_most": at_most, **counts}

    def along(self, made: int, places: int, *, at_most: bool = False) -> dict[str, Any]:
        """The same of a run, with how many of its places are estimated anew.

        Args:
            made: how many are.
            places: how many there are.
            at_most: as of `facts`.
        """
        facts = self.facts(at_most=at_most)
        limit, verb = ("at most ", "are recomputed") if at_most else ("", "recomputed")
        told = f"{facts['told']}; {limit}{made:,} of {count_of(places, 'place')} {verb}"
        return {**facts, "told": told, "places_recomputed": made, "places": places}


def tiles_written(url: str) -> dict[TileKey, str]:
    """The identity of the points of each tile that lies in a store, also where an update of it was
    interrupted; none: there is no map.
    """
    try:
        store = open_store(url)
        keys = () if store.manifest is None else store.manifest.identities
    except (StoreError, UsageError):  # what is made there says why it cannot be
        return {}
    return {key: mark.identity for key, mark in store.written(keys).items()}
