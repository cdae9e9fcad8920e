"""What was read of files of routes: the good, each with a name of its own, and the bad."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tilestream.errors import SourceError, SourceNotFoundError, TilestreamError
from tilestream.files import local_path
from tilestream.formats.routes.arc_length import require_length
from tilestream.formats.routes.base import Lost
from tilestream.records import Route

TOLD = 5
"""So many of the names that were made are told."""


@dataclass(frozen=True)
class RoutesRead:
    """What was read of one file of routes, or of several."""

    routes: tuple[Route, ...] = ()
    """The routes that can be used, each with a name of its own."""
    lost: tuple[Lost, ...] = ()
    """Those that cannot."""
    notes: tuple[str, ...] = ()
    """What a user should know of the routes that can, each with its file before it."""

    @property
    def failures(self) -> dict[str, str]:
        """Why routes cannot be used, by their names."""
        names = distinct([f"route {lost.route_id}" for lost in self.lost])
        return dict(zip(names, (str(lost.error) for lost in self.lost), strict=True))

    def notes_of(self, files: Iterable[str]) -> dict[str, list[str]]:
        """The notes by the file that they are of; what is told of several together is the
        `routes`'.
        """
        found: dict[str, list[str]] = {}
        named = sorted(files, key=len, reverse=True)
        for note in self.notes:
            file = next((name for name in named if note.startswith(f"{name}: ")), "routes")
            found.setdefault(file, []).append(note.removeprefix(f"{file}: "))
        return found

    def at_least(self, spacing: float) -> "RoutesRead":
        """Without the routes that are too short for two sample points; those are lost.

        Args:
            spacing: distance between sample points [m].

        Raises:
            TilestreamError: none is left; says why the first is lost.
        """
        good, lost = [], list(self.lost)
        for route in self.routes:
            try:
                require_length(route, spacing)
                good.append(route)
            except TilestreamError as error:
                lost.append(Lost(route.route_id, error))
        return _some(replace(self, routes=tuple(good), lost=tuple(lost)))


def together(parts: Iterable[RoutesRead]) -> RoutesRead:
    """What was read of several files.

    Raises:
        TilestreamError: no route of them can be used; says why the first cannot.
    """
    parts = list(parts)
    routes, notes = named([route for part in parts for route in part.routes])
    told = tuple(note for part in parts for note in part.notes)
    lost = tuple(lost for part in parts for lost in part.lost)
    return _some(RoutesRead(routes, lost, (*told, *notes)))


def read_each(
    files: Iterable[tuple[str, Mapping[str, Any]]], read: Callable[..., RoutesRead]
) -> RoutesRead:
    """What is read of several files, each once by whatever names it has; one that cannot be read is
    lost, and the others are read.

    Args:
        files: each with the keywords of `read`.
        read: reads one.

    Raises:
        SourceNotFoundError: there is no such file.
        TilestreamError: as `together`.
    """
    parts: list[RoutesRead] = []
    names: dict[str, str] = {}
    for path, options in files:
        real = os.path.realpath(local_path(path))
        if real in names:
            told = f"{path}: the file is named before, as {names[real]}, and is read once"
            parts.append(RoutesRead(notes=(told,)))
            continue
        names[real] = path
        try:
            parts.append(read(path, **options))
        except SourceNotFoundError:
            raise
        except SourceError as error:
            parts.append(RoutesRead(lost=(Lost(Path(path).stem, error),)))
        except OSError as error:
            lost = SourceError(f"{path}: cannot be read ({error})")
            parts.append(RoutesRead(lost=(Lost(Path(path).stem, lost),)))
    return together(parts)


def named(routes: Sequence[Route]) -> tuple[tuple[Route, ...], tuple[str, ...]]:
    """The routes, each with a name of its own, and a note on each name that several had."""
    old = [route.route_id for route in routes]
    new = distinct(old)
    called: dict[str, list[str]] = {}
    for before, after in zip(old, new, strict=True):
        called.setdefault(before, []).append(after)
    notes = tuple(
        f"{len(names)} routes are named {name}: here they are {', '.join(names[:TOLD])}"
        + (", ..." if len(names) > TOLD else "")
        for name, names in called.items()
        if len(names) > 1
    )
    renamed = (
        route if route.route_id == name else replace(route, route_id=name)
        for route, name in zip(routes, new, strict=True)
    )
    return tuple(renamed), notes


def distinct(names: Sequence[str]) -> list[str]:
    """The names, each once: the second `a` is called `a-2`, or what follows where that is one."""
    taken, found = set(names), []
    count: dict[str, int] = {}
    for name in names:
        new, number = name, count.get(name, 0) + 1
        if number > 1:
            while (new := f"{name}-{number}") in taken:
                number += 1
            taken.add(new)
        count[name] = number
        found.append(new)
    return found


def _some(read: RoutesRead) -> RoutesRead:
    if not read.routes and read.lost:
        raise read.lost[0].error
    return read
