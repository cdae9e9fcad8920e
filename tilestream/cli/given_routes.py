"""The routes that a command is given: those that can be used, and why others cannot."""

from collections.abc import Iterator
from contextlib import contextmanager

from tilestream.cli.printing import say_notes
from tilestream.counts import count_of
from tilestream.errors import PartialError
from tilestream.formats.routes import RoutesRead, read_all_routes, read_each
from tilestream.notes import noticed
from tilestream.pipeline.jobs.along_routes import off_map
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.settings import LogOptions
from tilestream.store import TileStore


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
        raise PartialError(f"{count_of(len(read.failures), 'route')} left out:", read.failures)
