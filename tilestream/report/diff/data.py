"""What the comparison of two maps says: of their tiles, and of the estimates at the same places."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.from_above import FromAbove
from tilestream.grid import TileKey
from tilestream.notes import Notes
from tilestream.records import Float64, Int64
from tilestream.report.measured import MEASURES, estimated_column
from tilestream.report.segments import reaches, stretches

WORSE = 0.02
"""Estimates that grew by more than this count as worse [m]."""
PLACE = (
    "route_id", "arc_length", "x", "y", "before", "after", "change", "length", "why",
    "interpolated",
)  # fmt: skip
"""The columns of a place that changed."""
STRETCH = (
    "route_id", "begin", "end", "length", "places", "interpolated", "at", "x", "y", "before",
    "after", "why",
)  # fmt: skip
"""The columns of a stretch of road."""
OTHERS = tuple(estimated_column(name) for name in MEASURES if name != "mean")
"""The parts of an estimate that are known of before and after too …"""
ENDS = ("low", "high")
"""… and the ends of its interval."""
Kind = Literal["worse", "better", "alike", "lost", "appeared", "neither"]
"""What became of a place: its estimate grew, fell, or did not change by more than the limit; it had
one that is gone; it has one now; it has none and had none."""
TILES = ("added", "removed", "changed")
"""What became of a tile that is not the same."""


@dataclass(frozen=True, eq=False)
class Changes:
    """How the estimates of places differ from earlier ones."""

    places: pd.DataFrame
    """A row per place of the newer estimates, along each route: `route_id`, `sample`,
    `arc_length`, `x`, `y`, `z`, `before`, `after` [m; NaN: no estimate], `why` it got worse,
    `reason` (as the newer table has it), `interpolated_before` and `interpolated_after`: whether
    the estimate was not evaluated, and `OTHERS` and `ENDS` with `_before` and `_after`."""
    left: pd.DataFrame
    """Places that had an estimate and that the newer ones come nowhere near: `route_id`,
    `arc_length`, `x`, `y`, `before`."""
    limit: float
    """Estimates that grew or fell by more than this count as worse or better [m]."""

    @cached_property
    def change(self) -> Float64:
        """(n,) how much the estimates have grown [m]; NaN where one is missing."""
        return self._column("after") - self._column("before")

    @cached_property
    def reach(self) -> Float64:
        """(n,) the length of road that each place stands for [m]."""
        return reaches(self.places)

    @cached_property
    def kind(self) -> NDArray[np.str_]:
        """(n,) what became of each place (`Kind`)."""
        before, after = (np.isfinite(self._column(name)) for name in ("before", "after"))
        with np.errstate(invalid="ignore"):
            parts = {
                "worse": self.change > self.limit,
                "better": self.change < -self.limit,
                "alike": before & after,
                "lost": before,
                "appeared": after,
            }
        return np.select(list(parts.values()), list(parts), "neither")

    @cached_property
    def interpolated(self) -> NDArray[np.bool_]:
        """(n,) whether an estimate of a place, before or after, is interpolated."""
        before, after = (self.places[f"interpolated_{when}"] for when in ("before", "after"))
        found: NDArray[np.bool_] = before.to_numpy(np.bool_) | after.to_numpy(np.bool_)
        return found

    def rows(self, kind: Kind) -> Int64:
        """The places that this became of, rising."""
        return np.flatnonzero(self.kind == kind)

    @cached_property
    def worse(self) -> pd.DataFrame:
        """Places whose estimate grew by more than the limit, the worst first (`PLACE`; lengths and
        errors in m).
        """
        return self._changed("worse")

    @cached_property
    def better(self) -> pd.DataFrame:
        """Those whose estimate fell by more than that, the best first; without `why`."""
        return self._changed("better").drop(columns="why")

    @cached_property
    def stretches(self) -> pd.DataFrame:
        """Stretches of road that got worse, the worst first (`stretches_of`)."""
        return self.stretches_of("worse")

    @property
    def compared(self) -> int:
        """Places with an estimate in both."""
        return int(np.isfinite(self.change).sum())

    @property
    def compared_interpolated(self) -> int:
        """Those of them with one that is interpolated."""
        return int((self.interpolated & np.isfinite(self.change)).sum())

    @property
    def length(self) -> float:
        """Of road that places with an estimate in both stand for [m]."""
        return float(self.reach[np.isfinite(self.change)].sum())

    @property
    def lost(self) -> int:
        """Places that had an estimate and have none."""
        return len(self.rows("lost"))

    @property
    def appeared(self) -> int:
        """Places that have an estimate and had none: they are not compared."""
        return len(self.rows("appeared"))

    def length_of(self, kind: Kind) -> float:
        """Of the road that this became of [m]."""
        return float(self.reach[self.rows(kind)].sum())

    def estimates(self, measure: str) -> tuple[Float64, Float64]:
        """(n,) a part of the estimates (`MEASURES`) before and after [m, or 1 of p_fail].

        Raises:
            UsageError: no such measure.
        """
        name = estimated_column(measure)
        if measure == "mean":
            return self._column("before"), self._column("after")
        return self._column(f"{name}_before"), self._column(f"{name}_after")

    def stretch_rows(self, kind: Kind) -> list[Int64]:
        """Rows of each stretch of road that this became of, with what it bridges; the one with the
        largest change, or estimate where one is missing, first.
        """
        rows = self.rows(kind)
        parts = stretches(self.places, rows) if rows.size else []
        weight = self._weight(kind)
        return sorted(parts, key=lambda part: -float(np.nanmax(weight[part])))

    def stretches_of(self, kind: Kind) -> pd.DataFrame:
        """The same as a table (`STRETCH`): `begin`, `end`, `length` [m], `places`, how many of them
        are `interpolated`, and of the place with the largest change `at`, `x`, `y`, `before`,
        `after` [m] and `why`: of a lost estimate the reason of the newer table.
        """
        parts, weight = self.stretch_rows(kind), self._weight(kind)
        ends = self.places["arc_length"].to_numpy()
        worst = [part[int(np.nanargmax(weight[part]))] for part in parts]
        table = self.places.iloc[worst].rename(columns={"arc_length": "at"})
        found = table.assign(
            begin=[ends[part[0]] for part in parts],
            end=[ends[part[-1]] for part in parts],
            length=[float(self.reach[part].sum()) for part in parts],
            places=[len(part) for part in parts],
            interpolated=[int(self.interpolated[part].sum()) for part in parts],
            why=table["reason"] if kind == "lost" else table["why"],
        )
        return found[list(STRETCH)].reset_index(drop=True)

    def _weight(self, kind: Kind) -> Float64:
        """(n,) how much a place of this kind matters; NaN: it is of another kind."""
        of = {"better": -self.change, "lost": self._column("before")}
        of |= {"appeared": self._column("after")}
        return np.where(self.kind == kind, of.get(kind, self.change), np.nan)

    def _changed(self, kind: Kind) -> pd.DataFrame:
        rows = self.rows(kind)
        table = self.places.assign(
            change=self.change, length=self.reach, interpolated=self.interpolated
        ).iloc[rows]
        order = table.sort_values(
            ["change", "route_id", "arc_length"], ascending=[kind == "better", True, True]
        )
        return order[list(PLACE)].reset_index(drop=True)

    def _column(self, name: str) -> Float64:
        return self.places[name].to_numpy(np.float64)


@dataclass(frozen=True)
class Side:
    """One of the two that are compared, as a page tells it."""

    name: str
    """A path or URL, of a run before its update said so."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What is known of it, by name."""


def _nothing() -> None:
    return None


@dataclass(frozen=True, eq=False)
class MapDiff:
    """How a map differs from an older one."""

    added: tuple[TileKey, ...]
    """Tiles that the older one does not have."""
    removed: tuple[TileKey, ...]
    """Tiles that only the older one has."""
    changed: tuple[TileKey, ...]
    """Tiles whose points are others."""
    same: int
    """Tiles that are the same."""
    places: Changes
    """Places whose estimates changed, where both have some."""
    limit: float
    """Estimates that grew or fell by more than this count as worse or better [m]."""
    notes: Notes
    """What was noticed of the sources of both maps, and of where these were found, by source."""
    gone: Mapping[str, str] = field(default_factory=dict)
    """Runs whose map is gone, and where it was looked for: then no tiles are compared (`added`,
    `removed` and `changed` are empty, `same` is 0), and estimates only."""
    sides: tuple[Side, Side] = (Side("the older one"), Side("the newer one"))
    """The older and the newer one."""
    without: tuple[str, ...] = ()
    """Those of them, by name, that have no estimates."""
    otherwise: bool = False
    """Whether the estimates were made with other settings too, not only of another map."""
    tile_size: float = 0.0
    """Edge of the tiles of both [m]."""
    crs: str | None = None
    """CRS of the newer map, of the older one where that names none; None: a local frame."""
    digits: int | None = None
    """With how many significant digits estimates are told; None: their worth is not known."""
    above: Callable[[], FromAbove | None] = _nothing
    """The newer map from above, read when it is drawn; None: it has no such picture."""

    @property
    def worse(self) -> pd.DataFrame:
        """Sample points whose estimate got worse, the worst first: `route_id`, `arc_length`, `x`,
        `y`, `before`, `after`, `change`, `length` of road [m], `why`.
        """
        return self.places.worse

    @property
    def compared(self) -> int:
        """Sample points with an estimate in both; 0 where one of them has none."""
        return self.places.compared
