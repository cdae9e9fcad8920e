"""What is in anything that tilestream reads or writes: one function for each kind of it.

A new kind is a file that describes it, and a line in `KINDS`.
"""

import os

from tilestream.apps.info.kinds import KINDS
from tilestream.apps.info.record import Info
from tilestream.errors import UnknownFormatError, UsageError
from tilestream.files import Files
from tilestream.formats import describe
from tilestream.settings import LogOptions

__all__ = ["KINDS", "Info", "info"]


def info(path: str | os.PathLike[str], log_options: LogOptions | None = None) -> Info:
    """What is in a file, a folder, a tile store, a run directory or a model.

    Args:
        path: any of `KINDS`; a store or a run directory also at an fsspec URL.
        log_options: topics and frames of a log; None: found.

    Raises:
        SourceNotFoundError: nothing there.
        UsageError: nothing there, at a URL; or a file of others, which is read from a disk.
        UnknownFormatError: nothing that tilestream reads.
        TilestreamError: it is damaged, or cannot be read; as its own reader says.

    Examples:
        >>> ts.info("route.csv").plain()["kind"]
        'routes'
    """
    name = os.fspath(path)
    place = Files.at(name)
    names = frozenset(place.names())
    if not (place.local or names or place.there()):
        raise UsageError(
            f"{name}: nothing is there; what others made is read from a disk: copy it here"
        )
    for kind in KINDS:
        if kind.fits(name, names):
            return kind.describe(name, log_options or LogOptions())
    try:
        describe(name)  # says what is there, and what would be read
    except UnknownFormatError as error:
        known = "; ".join(kind.name for kind in KINDS)
        raise UnknownFormatError(f"{error}; besides there are {known}") from None
    raise UnknownFormatError(f"{name}: of no known kind")
