"""Where results go: written whole, marked last, known again by their identity."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import pandas as pd

from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.marks import Mark
from tilestream.records import Column
from tilestream.store import Tile, open_store
from tilestream.store.arrays import read_marks
from tilestream.tables import read_mark, read_tables, write_table

Facts = Mapping[str, Any]


@dataclass(frozen=True)
class Made:
    """What a stage's function made, with small facts that the mark keeps."""

    value: Any
    facts: dict[str, Any] = field(default_factory=dict)
    columns: tuple[Column, ...] = ()
    """What columns mean that this table has beyond those of its stage."""


class Stored(NamedTuple):
    """A Parquet table as it is read back."""

    rows: pd.DataFrame
    facts: dict[str, Any]


def way_to(url: str, table: str) -> str:
    """A store as a table names it: from the table's folder, if both are local paths."""
    if "://" in url or "://" in table:
        return url
    return os.path.relpath(url, Path(table).parent)


class Output(Protocol):
    """A place for one result."""

    def known(self, identity: str) -> Facts | None:
        """The facts of what is there, if it is whole and of this identity; else None."""

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:
        """Replace what is there by a result; its facts."""

    def read(self) -> Any:
        """What was written."""


@dataclass(frozen=True, slots=True)
class TileArrays:
    """A table of a tile of a store: an array per column."""

    store_url: str
    tile: TileKey
    table: str

    def known(self, identity: str) -> Facts | None:
        """As `Output`; the store's own record, long where a map has many sources, is not read."""
        (mark,) = read_marks(Files.at(self.store_url), [f"{self.tile}/{self.table}"])
        return mark.facts if mark.is_of(identity) else None

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """As `Output`; the value is a dictionary of arrays."""
        mark = Mark("done", identity=identity, facts=made.facts)
        self._there().write_table(self.table, made.value, mark)
        return made.facts

    def refuse(self, reason: str, identity: str) -> Facts:
        """Replace what is there by the reason why there is nothing."""
        self._there().write_reason(self.table, Mark("failed", reason, identity))
        return {"failed": reason}

    def read(self) -> Any:
        """The columns by name."""
        return self._there().read_table(self.table)

    def _there(self) -> Tile:
        return Tile(open_store(self.store_url), self.tile)


@dataclass(frozen=True, slots=True)
class Parquet:
    """A table with documented columns in a file of its own."""

    path: str

    def known(self, identity: str) -> Facts | None:
        """As `Output`."""
        mark = read_mark(self.path)
        return mark.facts if mark.is_of(identity) else None

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:
        """As `Output`; the value is a data frame."""
        facts = {"rows": len(made.value), **made.facts}
        if "store" in facts:  # the same bytes wherever a job lies, and a way that moves with it
            facts["store"] = way_to(facts["store"], self.path)
        write_table(self.path, made.value, columns, Mark("done", identity=identity, facts=facts))
        return {"rows": len(made.value)}

    def files(self, identity: str) -> dict[str, str]:
        """What a task of this identity writes: the identity of each file, by path."""
        return {self.path: identity}

    def read(self) -> Any:
        """The rows, and the facts of the mark."""
        return Stored(read_tables([self.path]), read_mark(self.path).facts)
