"""What a map update changes: tiles, and sample points whose estimated error got worse."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import pandas as pd

from tilestream.apps.changes import Changes, changes
from tilestream.apps.runs import places_of
from tilestream.crs import require_same
from tilestream.errors import StoreNotFoundError, UsageError
from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.notes import Notes, noticed
from tilestream.pipeline.jobs.run_before import REPORT, before_update, told_in
from tilestream.pipeline.jobs.run_folder import map_of, stores_named
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.store import TileStore

WORSE = 0.02
"""Estimates that grew by more than this count as worse [m]."""
OTHERWISE = "its estimates were made with other settings, not only of another map"
"""What is noted of two runs."""

NO_ESTIMATES = "it has no estimates: tiles are compared, and no sample points"


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


def diff(
    old: str | os.PathLike[str],
    new: str | os.PathLike[str] | None = None,
    *,
    worse: float = WORSE,
) -> MapDiff:
    """Compare two maps, and their estimates where both have some: what got worse, where and why.

    Args:
        old: a run directory (with estimates), whose map is found wherever it lies, or a tile store.
        new: likewise; None: the run `old` as it is now, with what it was before its map was last
            updated.
        worse: estimates that grew by more than this are worse, that fell by more better [m].

    Raises:
        StoreNotFoundError: nothing there; or a run's map is gone, and not both have estimates.
        UsageError: tiles of different size, which cannot be compared, one run whose map was not
            updated, or `worse` is no length.
        CrsError: maps in two CRS.

    Examples:
        >>> ts.diff("map.zarr", "map.zarr").same
        2
    """
    if not (math.isfinite(worse) and worse >= 0.0):
        raise UsageError(f"worse is {worse!r}: give metres, 0 or more")
    before = _was(old) if new is None else _is(old)
    after = _is(old if new is None else new)
    gone = {side.named: side.gone for side in (before, after) if side.gone}
    if gone and (before.places is None or after.places is None):
        raise StoreNotFoundError("; ".join(gone.values()))
    told: dict[str, list[str]] = {}
    if (before.places is None) != (after.places is None):  # two maps are compared by their tiles
        told = {side.named: [NO_ESTIMATES] for side in (before, after) if side.places is None}
    if before.settings and after.settings and before.settings != after.settings:
        told = {after.named: [OTHERWISE]}
    return MapDiff(
        *(((), (), (), 0) if gone else _tiles(before, after)),
        changes(before.places, after.places, worse),
        worse,
        noticed(before.notes, after.notes, told),
        gone,
    )


@dataclass(frozen=True, eq=False)
class _Side:
    """One of the two that are compared."""

    named: str
    tile_size: float
    crs: str | None
    tiles: Mapping[TileKey, str]
    places: pd.DataFrame | None
    notes: Notes
    settings: str = ""
    gone: str = ""
    """Why its map is not there; then it has no tiles."""


def _is(place: str | os.PathLike[str]) -> _Side:
    """A run or a store as it is."""
    named, told = os.fspath(place), told_in(Files.at(place).under(REPORT))
    places, settings = _estimates(place), "" if told is None else told.settings
    try:
        store = map_of(place)
    except StoreNotFoundError as error:
        return _Side(named, 0.0, None, {}, places, {}, settings, str(error))
    return _Side(
        store.url,
        store.settings.tile_size,
        store.settings.crs,
        store.identities(),
        places,
        noticed({named: _moved(named, store)}, map_notes(store)),
        settings,
    )


def _was(place: str | os.PathLike[str]) -> _Side:
    """A run as it was before its map was updated."""
    told, places = before_update(Files.at(place))
    named = f"{place}, before"
    return _Side(named, told.tile_size, told.crs, told.keys, places, {}, told.settings)


def _moved(place: str, found: TileStore) -> list[str]:
    """A note where a map was not where it is looked for first."""
    named = stores_named(place)
    if not named or named[0] == found.url:
        return []
    return [f"its map is taken from {found.url}; there is none at {named[0]}"]


def _tiles(
    before: _Side, after: _Side
) -> tuple[tuple[TileKey, ...], tuple[TileKey, ...], tuple[TileKey, ...], int]:
    """Which tiles are added, removed and changed, and how many are the same."""
    if before.tile_size != after.tile_size:
        raise UsageError(
            f"{before.named} has tiles of {before.tile_size:g} m and {after.named} of "
            f"{after.tile_size:g} m: compare maps of one tile size"
        )
    require_same(before.named, before.crs, after.named, after.crs)
    had, has = before.tiles, after.tiles
    both = sorted(set(had) & set(has))
    return (
        tuple(sorted(set(has) - set(had))),
        tuple(sorted(set(had) - set(has))),
        tuple(key for key in both if had[key] != has[key]),
        sum(had[key] == has[key] for key in both),
    )


def _estimates(place: str | os.PathLike[str]) -> pd.DataFrame | None:
    """The places of a run with estimates and factors; None where there are none."""
    rows = places_of(place)
    return rows if "estimate" in rows else None
