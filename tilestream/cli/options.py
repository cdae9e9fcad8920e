"""Options that several commands have, and what their words mean."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from tilestream.cli.printing import say_notes
from tilestream.errors import PartialError, UsageError
from tilestream.formats.routes import RoutesRead, read_all_routes, read_each
from tilestream.notes import noticed
from tilestream.pipeline.jobs.along_routes import off_map
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.settings import LogOptions
from tilestream.store import TileStore

StoreUrl = Annotated[str, typer.Argument(help="The tile store.")]
Routes = Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or a log.")]
Config = Annotated[str, typer.Argument(help="A YAML file, begun with `tilestream template`.")]
Changes = Annotated[
    list[str], typer.Option("--set", help="key=value over the file, e.g. model.seed=1.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]


def numbers(lists: list[str], option: str) -> list[float]:
    """The numbers of an option that takes several, also with commas between them.

    Raises:
        UsageError: one is no number.
    """
    parts = [part.strip() for text in lists for part in text.split(",")]
    try:
        found = [float(part) for part in parts]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        told = ", ".join(lists)
        raise UsageError(f"{option} {told}: give numbers, with commas between them")
    return found


@contextmanager
def routes_of(
    files: list[str],
    project_to: str | None,
    spacing: float,
    store: TileStore,
    log_options: LogOptions,
) -> Iterator[tuple[RoutesRead, dict[str, list[str]]]]:
    """The routes of all files that can be used, logs read as these options say, and the notes on
    them and on their map by source, which are printed.

    Raises:
        SourceError, UsageError: none of them can be used; says why the first cannot.
        PartialError: when all is done with the good ones, some cannot be used; lists them, with
            what else failed.
    """
    how = {
        "project_to": project_to,
        "map_crs": store.settings.crs,
        "log_options": log_options,
    }
    read = read_each(((path, how) for path in files), read_all_routes).at_least(spacing)
    known = () if store.manifest is None else store.manifest.identities
    near = [route for route in read.routes if not off_map(known, store.grid, [route])]
    far = {"routes": off_map(known, store.grid, read.routes) if near else []}  # none is refused
    notes = noticed(map_notes(store), read.notes_of(files), far)
    say_notes(notes)
    try:
        yield read, notes
    except PartialError as error:
        raise error.with_more(read.failures) from None
    if read.failures:
        raise PartialError(f"{len(read.failures)} routes are left out:", read.failures)
