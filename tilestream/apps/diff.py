"""What a map update changes: tiles, and sample points whose estimated error got worse."""

import os
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from tilestream.crs import require_same
from tilestream.errors import UsageError
from tilestream.grid import TileKey
from tilestream.notes import Notes, noticed
from tilestream.pipeline.jobs.run_folder import map_of, rows_of
from tilestream.pipeline.jobs.sources import map_notes

SAME_PLACE = 0.5
"""Sample points this near to each other are compared [m]: half their spacing."""
WORSE = 0.02
"""Estimates that grew by more than this count as worse [m]."""


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
    worse: pd.DataFrame
    """Sample points whose estimate got worse, the worst first: `route_id`, `arc_length`, `x`, `y`,
    `before`, `after`, `change` [m]."""
    compared: int
    """Sample points with an estimate in both; 0 where one of them has none."""
    notes: Notes
    """What was noticed of the sources of both maps, by source."""


def diff(
    old: str | os.PathLike[str], new: str | os.PathLike[str], *, worse: float = WORSE
) -> MapDiff:
    """Compare two maps, and their estimates where both have some.

    Args:
        old: a run directory (with estimates) or a tile store.
        new: likewise.
        worse: estimates that grew by more than this are listed [m].

    Raises:
        StoreNotFoundError: nothing there.
        UsageError: tiles of different size, which cannot be compared.
        CrsError: maps in two CRS.

    Examples:
        >>> ts.diff("map.zarr", "map.zarr").same
        2
    """
    before, after = map_of(old), map_of(new)
    if before.settings.tile_size != after.settings.tile_size:
        raise UsageError(
            f"{before.url} has tiles of {before.settings.tile_size:g} m and {after.url} of "
            f"{after.settings.tile_size:g} m: compare maps of one tile size"
        )
    require_same(before.url, before.settings.crs, after.url, after.settings.crs)
    had, has = before.identities(), after.identities()
    both = sorted(set(had) & set(has))
    points, compared = _worse(_estimates(old), _estimates(new), worse)
    return MapDiff(
        tuple(sorted(set(has) - set(had))),
        tuple(sorted(set(had) - set(has))),
        tuple(key for key in both if had[key] != has[key]),
        sum(had[key] == has[key] for key in both),
        points,
        compared,
        noticed(map_notes(before), map_notes(after)),
    )


def _estimates(place: str | os.PathLike[str]) -> pd.DataFrame | None:
    """The estimates of a run directory; None where there are none."""
    rows = rows_of(place, "predictions")
    if rows is None:
        return None
    kept: pd.DataFrame = rows[rows["status"] == "done"].reset_index(drop=True)
    return kept


def _worse(
    old: pd.DataFrame | None, new: pd.DataFrame | None, limit: float
) -> tuple[pd.DataFrame, int]:
    names = ["route_id", "arc_length", "x", "y", "before", "after", "change"]
    if old is None or new is None or old.empty or new.empty:
        return pd.DataFrame(columns=names), 0
    origin = old[["x", "y", "z"]].to_numpy(np.float64)[0]
    tree = cKDTree(old[["x", "y", "z"]].to_numpy(np.float64) - origin)
    distance, row = tree.query(new[["x", "y", "z"]].to_numpy(np.float64) - origin)
    near = np.asarray(distance) <= SAME_PLACE
    before = old["estimate"].to_numpy()[row]
    table = new.assign(before=before, after=new["estimate"], change=new["estimate"] - before)
    found = table.loc[near & (table["change"] > limit), names]
    order = found.sort_values(["change", "route_id", "arc_length"], ascending=[False, True, True])
    return order.reset_index(drop=True), int(near.sum())
