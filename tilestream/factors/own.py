"""A factor of one's own: a file of its own, outside of the package.

```python
from tilestream import Column

REACH = 10.0
COLUMNS = (Column("overhead", "FS", "1", "Share of the points around that are overhead.", "own"),)


def factors(around):
    above = around.points[:, 2] > around.place[2] + 3.0
    return {"overhead": above.mean() if len(above) else 0.0}
```

A job names the file (`factors: [overhead.py]`), or an entry point of the group `tilestream.factors`
that names a module. Its columns stand in the tables of factors beside the others, and models learn
from them. The text of the file is part of the identity of the tables: a changed one is computed
anew (what it imports is not looked at). It runs as the job does: take it from whom you trust.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.factors import observability
from tilestream.factors.catalogue import COLUMNS
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS
from tilestream.files import local_path
from tilestream.grid import MM_PER_M, Box
from tilestream.marks import hash_of
from tilestream.records import Cells, Column, Float64
from tilestream.store import TileStore

GROUP = "tilestream.factors"
"""Group of the entry points that name modules with factors."""
OWN = "own"
"""Where the facts of a table, and a making, tell of factors of one's own."""
FARTHEST = 200.0
"""Most that a factor may look at around a place [m]."""
TAKEN = frozenset(
    c.name for c in (*PLACE_COLUMNS, *COLUMNS, *observability.COLUMNS, *STATUS_COLUMNS)
)
"""Names of columns that are not free."""


@dataclass(frozen=True, eq=False)
class Around:
    """A place, and what of the map is around it: all that a factor of one's own is told."""

    place: Float64
    """(3,) of the lidar [m, map frame]."""
    heading: float
    """Direction of travel [rad, from the map's x axis]."""
    points: Float64
    """(n, 3) map points within `REACH` of the place, horizontally, in one order [m, map frame]."""
    cells: Cells
    """The NDT cells whose means are within `REACH`, likewise."""


@dataclass(frozen=True)
class OwnFactors:
    """A file of factors, as it is sent to workers: its identity is its text."""

    name: str
    """What to call it: the name of the file without its ending, or of the entry point."""
    text: str
    """Its source."""
    package: str = ""
    """The package that it imports from, of an entry point."""

    @property
    def columns(self) -> tuple[Column, ...]:
        """What it returns."""
        return tuple(_module(self).COLUMNS)

    @property
    def reach(self) -> float:
        """How far around a place it looks, horizontally [m]."""
        return float(_module(self).REACH)

    @property
    def hash(self) -> str:
        """Hash of its text."""
        return hash_of(self.text)

    def of(self, around: Around) -> dict[str, float]:
        """Its values at a place, by column.

        Raises:
            UsageError: it failed there, or returned something else than its columns.
        """
        x, y = around.place[:2].tolist()
        where = f"factors {self.name} at x {x:.1f}, y {y:.1f} m"
        try:
            found = {name: float(value) for name, value in _module(self).factors(around).items()}
        except Exception as error:
            raise UsageError(f"{where}: {type(error).__name__}: {error}") from error
        names = {column.name for column in self.columns}
        if found.keys() != names:
            told, wanted = ", ".join(sorted(found)), ", ".join(sorted(names))
            raise UsageError(f"{where} returned {told or 'nothing'}: return its COLUMNS, {wanted}")
        return found


@lru_cache(maxsize=32)
def _module(own: OwnFactors) -> ModuleType:
    """The file, run.

    Raises:
        UsageError: it cannot be run, or lacks what a file of factors has.
    """
    module = ModuleType(own.name)
    module.__package__ = own.package
    try:
        exec(compile(own.text, f"<factors {own.name}>", "exec"), module.__dict__)
    except Exception as error:
        raise UsageError(f"factors {own.name}: {type(error).__name__}: {error}") from error
    columns, reach = getattr(module, "COLUMNS", None), getattr(module, "REACH", None)
    known = isinstance(columns, tuple | list) and all(isinstance(c, Column) for c in columns)
    if not known or not columns or not callable(getattr(module, "factors", None)):
        raise UsageError(
            f"factors {own.name}: give COLUMNS (a tuple of ts.Column), REACH [m] and a function "
            "factors(around)"
        )
    if not isinstance(reach, int | float) or not 0.0 < reach <= FARTHEST:
        raise UsageError(f"factors {own.name}: REACH is {reach!r}: give up to {FARTHEST:g} m")
    taken = sorted({c.name for c in columns} & TAKEN)
    if taken:
        raise UsageError(f"factors {own.name}: {', '.join(taken)} is there already: rename it")
    module.__dict__["COLUMNS"] = tuple(
        replace(c, factor_set="own", dtype="float64") for c in columns
    )
    return module


def own_factors(names: Sequence[str]) -> tuple[OwnFactors, ...]:
    """The files of factors that a job names.

    Args:
        names: files (`….py`), or entry points of the group `tilestream.factors`.

    Raises:
        SourceNotFoundError: no such file, or no such entry point; names those there are.
        UsageError: a file that is none of factors, or two columns of one name.
    """
    found = tuple(_own(name) for name in names)
    columns = [column.name for own in found for column in own.columns]
    twice = sorted({name for name in columns if columns.count(name) > 1})
    if twice:
        raise UsageError(f"factors: two columns are named {', '.join(twice)}: rename one")
    return found


def _own(name: str) -> OwnFactors:
    if name.endswith(".py"):
        file = Path(local_path(name))
        if not file.is_file():
            raise SourceNotFoundError(f"{name}: no such file of factors")
        return OwnFactors(file.stem, file.read_text())
    there = {point.name: point.value for point in entry_points(group=GROUP)}
    spec = find_spec(there[name]) if name in there else None
    if spec is None or spec.origin is None:
        known = f"; installed are {', '.join(sorted(there))}" if there else ""
        raise SourceNotFoundError(
            f"{name}: no factors of this name: give a file that ends with .py, or an entry point "
            f"of the group {GROUP}{known}"
        )
    return OwnFactors(name, Path(os.fspath(spec.origin)).read_text(), spec.parent or "")


def columns_in(facts: Mapping[str, Any]) -> tuple[Column, ...]:
    """The columns of one's own that a table says it has (`OWN`)."""
    return tuple(Column(**column) for column in facts.get(OWN, ()))


def own_table(
    own: Sequence[OwnFactors], store: TileStore, places: pd.DataFrame, cell_size: float
) -> pd.DataFrame:
    """The values at sample points, a row each; NaN where the place is not `done`.

    Args:
        own: at least one.
        store: the map.
        places: with `x`, `y`, `z` [m], `heading` [rad] and `status`.
        cell_size: edge of the cells [m].

    Raises:
        TileNotReadyError: a tile within reach failed or was skipped.
        UsageError: as `OwnFactors.of`.
    """
    names = [column.name for one in own for column in one.columns]
    table = pd.DataFrame(np.nan, places.index, names)
    rows = places.index[places["status"] == "done"]
    if not len(rows):
        return table
    at = places.loc[rows, ["x", "y", "z"]].to_numpy(np.float64)
    box = Box.around(at, max(one.reach for one in own))
    points = store.points_in(box) / MM_PER_M
    points = points[np.lexsort(points[:, ::-1].T)]  # one order, however the map is cut into tiles
    cells = store.cells_in(box, cell_size)
    for row, place in zip(rows, at, strict=True):
        heading = float(places.loc[row, "heading"])
        for one in own:
            first, last = np.searchsorted(points[:, 0], place[0] + [-one.reach, one.reach])
            strip = points[first : last + 1]
            near, of_cells = (_within(xy, place, one.reach) for xy in (strip, cells.mean))
            around = Around(place, heading, strip[near], _some(cells, of_cells))
            for name, value in one.of(around).items():
                table.loc[row, name] = value if math.isfinite(value) else np.nan
    return table


def _within(positions: Float64, place: Float64, reach: float) -> NDArray[np.bool_]:
    """(n,) whether positions are within reach of a place, horizontally."""
    offset = positions[:, :2] - place[:2]
    near: NDArray[np.bool_] = (offset**2).sum(axis=1) <= reach**2
    return near


def _some(cells: Cells, which: NDArray[np.bool_]) -> Cells:
    index, count = cells.index[which], cells.count[which]
    return Cells(index, count, cells.mean[which], cells.covariance[which], cells.cell_size)
