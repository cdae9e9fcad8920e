"""A run directory from outside: its tables, and the map that they were made from."""

import os
from pathlib import Path

import pandas as pd

from tilestream.errors import StoreNotFoundError
from tilestream.files import Files
from tilestream.pipeline.jobs.inventory import tables_in
from tilestream.store import TileStore, open_store
from tilestream.tables import read_mark, read_tables


def map_of(place: str | os.PathLike[str]) -> TileStore:
    """The map of a run directory: its own `map.zarr`, else the store that its tables name.

    Args:
        place: a run directory of any job, or a tile store itself (a path or an fsspec URL).

    Raises:
        StoreNotFoundError: nothing there, or the map has moved; says how to name its new place.
        StoreError: something else lies there.
    """
    inside = Files.at(place).under("map.zarr")
    if inside.there():
        return open_store(inside.address)
    made_from_it = [*table_paths(place, "starts"), *table_paths(place, "factors")]
    if not made_from_it:
        return open_store(place)
    named = read_mark(made_from_it[0]).facts.get("store", inside.address)
    if "://" not in named:
        named = os.path.normpath(Path(made_from_it[0]).parent.absolute() / named)
    try:
        return open_store(named)
    except StoreNotFoundError as error:
        raise StoreNotFoundError(
            f"{error}; if the map of {place} is elsewhere now, link {inside.address} to it"
        ) from None


def rows_of(place: str | os.PathLike[str], table: str) -> pd.DataFrame | None:
    """The rows of a table of a run directory, e.g. `predictions`; None where it has none."""
    paths = table_paths(place, table)
    return read_tables(paths) if paths else None


def table_paths(place: str | os.PathLike[str], table: str) -> list[str]:
    """The files of a table of a run directory, sorted: of the main job, or of a command alone."""
    root = Files.at(place).address
    return [
        path
        for folder in (f"{root}/tables/{table}", f"{root}/{table}")
        for path in tables_in(folder)
    ]
