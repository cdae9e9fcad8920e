"""The one CRS of a map that is made from several sources."""

from collections.abc import Iterable

import pyproj
import pyproj.exceptions

from tilestream.errors import CrsError


def one_crs(asked: str | None, sources: Iterable[tuple[str, str | None]]) -> str | None:
    """The CRS that all sources are in; None: no one names one.

    Args:
        asked: the CRS that was asked for, any string that pyproj reads; None: none was.
        sources: path and CRS of each source; None: its file names none.

    Raises:
        CrsError: there are two, named with their sources, or one that pyproj cannot read.
    """
    named = [(path, crs) for path, crs in sources if crs]
    if asked is not None:
        named.insert(0, ("the crs that was asked for", asked))
    for who, crs in named[1:]:
        if not _same(named[0], (who, crs)):
            raise CrsError(
                f"{named[0][0]} is {_short(named[0][1])} and {who} is {_short(crs)}: bring all "
                "sources into one CRS first (for example with PDAL's filters.reprojection)"
            )
    if not named:
        return None
    _parsed(*named[0])
    return named[0][1]


def _same(a: tuple[str, str], b: tuple[str, str]) -> bool:
    return a[1] == b[1] or bool(_parsed(*a).equals(_parsed(*b), ignore_axis_order=True))


def _parsed(who: str, text: str) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"{who}: {_short(text)} is no CRS that pyproj reads: {error}") from None


def _short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}…"
