"""What a map update changes: tiles, and sample points whose estimated error got worse."""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from tilestream.apps.changes import changes
from tilestream.apps.runs import Run, places_of
from tilestream.crs import named, require_same
from tilestream.errors import DamagedError, StoreNotFoundError, UsageError, foreign_errors
from tilestream.files import Files, place_of, without_secrets
from tilestream.from_above import FromAbove, above_table, seen_from_above
from tilestream.grid import Box, TileKey
from tilestream.notes import Notes, noticed
from tilestream.pipeline.jobs.run_before import REPORT, before_update, told_in
from tilestream.pipeline.jobs.run_book import told_before
from tilestream.pipeline.jobs.run_findings import MOST_PIXELS
from tilestream.pipeline.jobs.run_folder import map_of, stores_named
from tilestream.pipeline.jobs.run_names import RECORD
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.records import Float64
from tilestream.report.data import BESIDE
from tilestream.report.diff.data import WORSE, MapDiff, Side
from tilestream.report.summary import digits_of
from tilestream.store import TileStore

OTHERWISE = "its estimates were made with other settings, not only of another map"
"""What is noted of two runs."""

NO_ESTIMATES = "it has no estimates: tiles are compared, and no sample points"
FAR = 200_000.0
"""A picture of more than this from end to end shows nothing of a street [m]."""


def diff(
    old: str | os.PathLike[str],
    new: str | os.PathLike[str] | None = None,
    *,
    worse: float = WORSE,
) -> MapDiff:
    """Compare two maps, and their estimates where both have some: what got worse, where and why.
    `tilestream.report.write_diff` makes a page of it.

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
    without = tuple(side.named for side in (before, after) if side.places is None)
    told: dict[str, list[str]] = {}
    if len(without) == 1:  # two maps are compared by their tiles
        told = {without[0]: [NO_ESTIMATES]}
    otherwise = bool(before.settings and after.settings) and before.settings != after.settings
    if otherwise:
        told = {after.named: [OTHERWISE]}
    tiles = ((), (), (), 0) if gone else _tiles(before, after)
    return MapDiff(
        *tiles,
        changes(before.places, after.places, worse),
        worse,
        noticed(before.notes, after.notes, told),
        gone,
        sides=(before.shown, after.shown),
        without=tuple(
            without_secrets(side.place) for side in (before, after) if side.places is None
        ),
        otherwise=otherwise,
        tile_size=after.tile_size,
        crs=after.crs or before.crs,
        digits=after.digits,
        above=_above(after, [key for of in tiles[:3] for key in of]),
    )


@dataclass(frozen=True, eq=False)
class _Side:
    """One of the two that are compared."""

    place: str
    """As it was given."""
    named: str
    """By its map, as far as that is there."""
    tile_size: float
    crs: str | None
    tiles: Mapping[TileKey, str]
    places: pd.DataFrame | None
    notes: Notes
    settings: str = ""
    gone: str = ""
    """Why its map is not there; then it has no tiles."""
    store: TileStore | None = None
    """Its map; None: it is gone, or no longer what it was."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What else is known of it, by name."""
    digits: int | None = None
    """With how many significant digits its estimates are told."""

    @property
    def shown(self) -> Side:
        """It in a few facts."""
        facts: dict[str, Any] = {}
        if not self.gone:
            facts |= {"tiles": len(self.tiles), "tile size [m]": self.tile_size}
            facts["CRS"] = "none: a local frame" if self.crs is None else named(self.crs)
        if self.places is not None:
            known = self.places["estimate"].dropna()
            facts |= {"sample points": len(self.places), "with an estimate": len(known)}
            facts["median estimate [m]"] = round(float(known.median()), 4) if len(known) else None
        return Side(without_secrets(self.place), facts | dict(self.facts))


def _is(place: str | os.PathLike[str]) -> _Side:
    """A run or a store as it is."""
    folder, name = Files.at(place), os.fspath(place)
    told = told_in(folder.under(REPORT))
    places, settings = _estimates(place), "" if told is None else told.settings
    facts, digits = _facts(folder)
    try:
        store = map_of(place)
    except StoreNotFoundError as error:
        none: dict[TileKey, str] = {}
        how: dict[str, Any] = {"facts": facts, "digits": digits}
        return _Side(name, name, 0.0, None, none, places, {}, settings, str(error), **how)
    if store.url != place_of(place):
        facts = {"map": without_secrets(store.url), **facts}
    return _Side(
        name,
        store.url,
        store.settings.tile_size,
        store.settings.crs,
        store.identities(),
        places,
        noticed({name: _moved(name, store)}, map_notes(store)),
        settings,
        store=store,
        facts=facts,
        digits=digits,
    )


def _was(place: str | os.PathLike[str]) -> _Side:
    """A run as it was before its map was updated."""
    told, places = before_update(Files.at(place))
    name = f"{place}, before"
    return _Side(name, name, told.tile_size, told.crs, told.keys, places, {}, told.settings)


def _facts(run_dir: Files) -> tuple[dict[str, Any], int | None]:
    """What a run says of how its estimates were made, and with how many digits they are told;
    nothing: it has no report, or is none.
    """
    with foreign_errors(DamagedError, f"{run_dir.address}: its report is damaged"):
        report = Run(run_dir.address).report
        if not report:
            return {}, None
        made, worth = report.get("facts") or {}, report.get("worth") or {}
        facts = {
            "title": report.get("title"),
            "sensor": made.get("sensor"),
            "matcher": (made.get("matcher") or {}).get("name"),
            "model": worth.get("model"),
            "checked on": worth.get("checked"),
            "tilestream": report.get("tilestream"),
            "run began": told_before(run_dir.under(RECORD)).get("began"),
        }
        digits = digits_of(report)
    return {name: fact for name, fact in facts.items() if fact is not None}, digits


def _moved(place: str, found: TileStore) -> list[str]:
    """A note where a map was not where it is looked for first."""
    where = stores_named(place)
    if not where or where[0] == found.url:
        return []
    return [f"its map is taken from {found.url}; there is none at {where[0]}"]


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


def _above(side: _Side, differ: list[TileKey]) -> Callable[[], FromAbove | None]:
    """The map from above around its places, else around the tiles that differ, as far as its store
    has pictures of its tiles.
    """

    def seen() -> FromAbove | None:
        corners = _corners(side.places, differ, side.tile_size)
        if side.store is None or not len(corners) or np.ptp(corners, axis=0).max() > FAR:
            return None
        box = Box.around(corners, BESIDE)
        drawn = side.store.marks(above_table().name, _touched(side, side.store, box))
        tiles = [key for key, mark in drawn.items() if mark.status == "done"]
        return seen_from_above(side.store, tiles, box, MOST_PIXELS) if tiles else None

    return seen


def _corners(places: pd.DataFrame | None, differ: list[TileKey], tile_size: float) -> Float64:
    """(n, 2) what a picture has to reach [m]."""
    if places is not None and len(places):
        return places[["x", "y"]].dropna().to_numpy(np.float64)
    low = np.array([(key.ix, key.iy) for key in differ], np.float64).reshape(-1, 2)
    corners: Float64 = np.concatenate([low, low + 1.0]) * tile_size
    return corners


def _touched(side: _Side, store: TileStore, box: Box) -> list[TileKey]:
    """The tiles of a side that a box touches, sorted."""
    edge = store.grid.tile_mm
    low_x, high_x = box.x_lo // edge, (box.x_hi - 1) // edge
    low_y, high_y = box.y_lo // edge, (box.y_hi - 1) // edge
    return sorted(k for k in side.tiles if low_x <= k.ix <= high_x and low_y <= k.iy <= high_y)


def _estimates(place: str | os.PathLike[str]) -> pd.DataFrame | None:
    """The places of a run with estimates and factors; None where there are none."""
    rows = places_of(place)
    return rows if "estimate" in rows else None
