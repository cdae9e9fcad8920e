"""A run directory from outside: its tables, and the map that they were made from."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from tilestream.bounded_yaml import parse_yaml
from tilestream.errors import (
    DamagedError,
    IncompleteError,
    StoreNotFoundError,
    foreign_errors,
)
from tilestream.files import Files
from tilestream.pipeline.jobs.inventory import tables_in
from tilestream.pipeline.jobs.run_names import CONFIG
from tilestream.pipeline.jobs.run_state import record_of
from tilestream.store import TileStore, open_store
from tilestream.tables import read_mark, read_tables


def map_of(place: str | os.PathLike[str]) -> TileStore:
    """The map of a run directory, wherever it lies: the first of `stores_named` that is there.

    Args:
        place: a run directory of any job, or a tile store itself (a path or an fsspec URL).

    Raises:
        StoreNotFoundError: nothing there, or the map is gone; says how to name its new place.
        IncompleteError: tables that do not tell, for their job has not ended.
        DamagedError: the record of the run is not what was written.
        StoreError: something else lies there.
    """
    named = stores_named(place)
    if not named and not Files.at(place).there():
        raise StoreNotFoundError(
            f"{place}: no tile store and no run directory is there: check the path; `tilestream "
            f"ingest SOURCES --store {place}` makes a store, `tilestream estimate` a run"
        )
    if not named:
        return open_store(place)
    for url in named:
        with suppress(StoreNotFoundError):
            return open_store(url)
    inside = Files.at(place).under("map.zarr").address
    raise StoreNotFoundError(
        f"no tile store of {place} at {', nor at '.join(named)}; if it is elsewhere now, link "
        f"{inside} to it"
    )


def stores_named(place: str | os.PathLike[str]) -> list[str]:
    """Where the map of a run directory may be, the likeliest first; empty: it is no run directory.

    A job's own map is inside. Another one is where the tables name it: from where they are now, as
    a project moves as a whole; as a link is followed; from where they were made, where only the
    run directory has moved; or where the settings of the job name it. At last the inside again,
    which can be a link that someone has made.

    Raises:
        IncompleteError: nothing tells, and there are tables of a job that has not ended.
        DamagedError: the record of the run is not what was written.
    """
    folder = Files.at(place)
    record_of(folder)
    inside, job = folder.under("map.zarr"), job_of(folder)
    own = job.get("map") or {}
    found = [] if not job or own.get("store") else [inside.address]
    try:
        tables = [*table_paths(place, "starts"), *table_paths(place, "factors")]
    except IncompleteError:
        if not (job or inside.there()):
            raise
        tables = []
    if tables:
        found += _named_by(tables[0], folder.address, str(job.get("out", "")))
    found += [str(own["store"])] if own.get("store") else []
    found += [inside.address] if inside.there() else []
    return list(dict.fromkeys(found))


def _named_by(table: str, run_dir: str, was: str) -> list[str]:
    """Where a table of a run directory, which was at another place maybe, says that its map is."""
    named = read_mark(table).facts.get("store")
    if named is None:
        return []
    if "://" in named or "://" in table:
        return [str(named)]
    here = Path(table).parent
    folders = [here, here.resolve()]
    if was and "://" not in was:
        folders.append(Path(was) / here.relative_to(run_dir))
    return [os.path.normpath(folder / named) for folder in folders]


def job_of(run_dir: Files) -> Mapping[str, Any]:
    """The settings of the job that a run directory is of, as they were written; empty: of tables
    alone there are none.

    Raises:
        DamagedError: they are not what was written.
    """
    file = run_dir.under(CONFIG)
    try:
        text = file.read().decode("utf-8", "replace")
    except (FileNotFoundError, NotADirectoryError):
        return {}
    with foreign_errors(DamagedError, f"{file.address}: no settings of a job"):
        return dict(parse_yaml(text))


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
