"""What was noticed of sources: kept by source, and told once for all that share it."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

Notes = Mapping[str, Sequence[str]]
"""What a user should know, by source: the path of a file, or what else it is about."""
MATCHER = "matcher"
"""What notes on the settings of a matcher are about."""
NUMBER = re.compile(r"\d[\d,.]*")
"""What may differ between notes that are told as one."""
NAMED = 2
"""Sources that are named of those that share a note; of the others the number."""


def some_of(names: Sequence[str], most: int) -> str:
    """The first of some names, and how many others there are: `a, b and 3 more`."""
    more = len(names) - most
    told = ", ".join(names[:most])
    return f"{told} and {more:,} more" if more > 0 else told


class Shared(NamedTuple):
    """A note that several sources have, or one."""

    sources: tuple[str, ...]
    text: str
    """Of the first of them."""
    others: int = 0
    """So many other notes differ from this one in their numbers only."""

    @property
    def of(self) -> str:
        """Its sources in words."""
        return some_of(self.sources, NAMED)

    @property
    def told(self) -> str:
        """The note, and how many are like it."""
        return self.text + (f" (and {self.others:,} with other numbers)" if self.others else "")

    def __str__(self) -> str:
        """The note with its sources, on a line."""
        return f"{self.of}: {self.told}"


def noticed(*parts: Notes) -> dict[str, list[str]]:
    """All notes by source, each once; a source without any is left out."""
    found: dict[str, dict[str, None]] = {}
    for part in parts:
        for source, notes in part.items():
            found.setdefault(source, {}).update(dict.fromkeys(notes))
    return {source: list(notes) for source, notes in found.items() if notes}


def shared(notes: Notes) -> list[Shared]:
    """The notes, each with all sources that have it, in the order of the first of them.

    Notes that differ in their numbers only are one where there are more than `NAMED` of them.
    """
    alike: dict[str, dict[str, list[str]]] = {}
    for source, texts in notes.items():
        for text in texts:
            alike.setdefault(NUMBER.sub("#", text), {}).setdefault(text, []).append(source)
    found = []
    for of_text in alike.values():
        every = tuple(dict.fromkeys(source for sources in of_text.values() for source in sources))
        if len(of_text) > NAMED:
            found.append(Shared(every, next(iter(of_text)), len(of_text) - 1))
        else:
            found += [Shared(tuple(sources), text) for text, sources in of_text.items()]
    return found
