"""The sources of a map: each opened as far as its header, and what became of it."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tilestream.crs import named, one_crs
from tilestream.errors import PartialError, SourceError, StoreNotFoundError, UsageError
from tilestream.files import place_of
from tilestream.formats import files_of, matches_of, open_source
from tilestream.formats.base import SourceInfo, Span
from tilestream.formats.drive import DriveSource
from tilestream.formats.logs import ScanSelection, is_log
from tilestream.formats.registry import state_of
from tilestream.marks import hash_of
from tilestream.notes import noticed
from tilestream.pipeline.engine.plan import megabytes
from tilestream.pipeline.jobs.overlap import packed
from tilestream.pipeline.jobs.strays import Kept
from tilestream.pipeline.stages.fragments import Fragment
from tilestream.pipeline.stages.scatter import needed_to_open
from tilestream.settings import IngestSettings, LogOptions, LogSettings, MapSettings
from tilestream.store import TileStore, open_store

POINTS_PER_TASK = 4_000_000
"""Points of a source that one scatter task reads: seconds of work, not milliseconds."""


@dataclass(frozen=True)
class Source:
    """One input of an ingest, and what became of it."""

    path: str
    """The file, absolute, since workers may run elsewhere."""
    state: str
    """Hash of its size, time of change and way of reading: whether it is still the same."""
    info: SourceInfo | None = None
    """What is in it; None where it could not be opened."""
    spans: tuple[Span, ...] = ()
    """The pieces in which it is read."""
    options: tuple[tuple[str, Any], ...] = ()
    """How it is read: topics and scans of a log."""
    points: int = 0
    """Finite points that were read."""
    dropped: int = 0
    """Points that were not finite."""
    scans: str = ""
    """The scans of a log that become map points (`overlap.packed`)."""
    told: tuple[str, ...] = ()
    """What was noticed as it was read, beyond its header."""
    reason: str = ""
    """Why it failed; empty where it did not."""

    @property
    def record(self) -> dict[str, Any]:
        """What a store keeps of it."""
        info = self.info
        return {
            "path": self.path,
            "state": self.state,
            "format": info.format if info else "",
            "size_bytes": info.size_bytes if info else 0,
            "crs": info.crs if info else None,
            "contents": list(info.contents) if info else [],
            "notes": [*(info.notes if info else ()), *self.told],
            "told": list(self.told),
            "scans": self.scans,
            "points": self.points,
            "dropped": self.dropped,
            "reason": self.reason,
        }


def examine_all(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    settings: IngestSettings,
    log_options: LogOptions | None = None,
    scans: ScanSelection | None = None,
) -> list[Source]:
    """Every file that the sources name, opened as far as its header.

    Args:
        sources: files, globs and map directories.
        settings: of the map.
        log_options: topics and frames of the logs among them; None: found.
        scans: which scans of the logs; None: all.

    Raises:
        UsageError: there are no sources.
        SourceNotFoundError: a path or glob that matches nothing.
    """
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    of_logs = {} if log_options is None else log_options.given
    of_logs |= {} if scans is None else {"scans": scans}
    by_place: dict[str, list[str]] = {}
    found: list[Source] = []
    for match in [match for pattern in sources for match in matches_of(pattern)]:
        try:
            files = files_of(match)
        except (SourceError, OSError) as error:
            found.append(Source(place_of(match), state="", reason=str(error)))
            continue
        for file in files:
            by_place.setdefault(os.path.realpath(file), []).append(place_of(file))
    for paths in by_place.values():
        noise = {"keep_noise": True} if settings.keep_noise else {}
        found.append(_examine(paths, of_logs if is_log(paths[0]) else noise))
    if not found:
        raise UsageError("no sources: name at least one file, glob or map directory")
    return sorted(found, key=lambda source: source.path)


def _examine(paths: Sequence[str], options: dict[str, Any]) -> Source:
    """Open a source as far as its header; a failure is its reason, not an exception.

    Args:
        paths: its names; more than one: it was named so often.
        options: how it is read.
    """
    path, *others = paths
    readable = tuple(sorted(options.items()))
    known = Source(path, "", options=readable)
    try:
        if not Path(path).exists():
            open_source(path)  # which says why
        state = hash_of(*state_of(path), repr(readable))
        source = open_source(path, **options)
        info = source.info()
        spans = tuple(source.spans(POINTS_PER_TASK))
    except (SourceError, OSError) as error:
        return replace(known, reason=str(error))
    if others:
        again = ", ".join(dict.fromkeys(other for other in others if other != path))
        told = f"named {len(paths)} times{f', also as {again}' if again else ''}: read once"
        info = replace(info, notes=(*info.notes, told))
    scans = ""
    if isinstance(source, DriveSource):
        scans = packed(source.log.stamps_ns[source.used], source.log.point_counts[source.used])
    return replace(known, state=state, info=info, spans=spans, scans=scans)


def within(found: Sequence[Source], memory: int) -> list[Source]:
    """The sources; one that needs more memory than a task may use says so, if others do not.

    Where none fits, planning refuses the job as a whole.
    """
    needed = {s.path: needed_to_open(s.info) for s in found if s.info is not None}
    if all(need > memory for need in needed.values()):
        return list(found)
    told = "needs {} to be opened and may use {}: allow more memory (--memory)"
    return [
        replace(s, info=None, reason=told.format(megabytes(needed[s.path]), megabytes(memory)))
        if needed.get(s.path, 0) > memory
        else s
        for s in found
    ]


def with_crs(settings: IngestSettings, found: Sequence[Source]) -> IngestSettings:
    """The settings with the one CRS of the map."""
    named = [(source.path, source.info.crs) for source in found if source.info is not None]
    return settings.model_copy(update={"crs": one_crs(settings.crs, named)})


def as_read(source: Source, fragments: Sequence[Fragment], kept: Kept) -> Source:
    """A source with what was read of it, and what was left out."""
    left_out = sum(one.left_out for one in fragments)
    told = kept.notes
    if left_out:
        why = "points of a class of noise (7 or 18) or withheld are left out"
        told += (f"{left_out:,} {why}; keep_noise (--keep-noise) keeps them",)
    dropped = sum(one.dropped for one in fragments)
    return replace(source, told=told, points=kept.points, dropped=dropped)


def as_remembered(source: Source, record: Mapping[str, Any]) -> Source:
    """A source that is as it was, with what a store has recorded as it was read."""
    told = tuple(record["told"])
    return replace(source, told=told, points=record["points"], dropped=record["dropped"])


def map_notes(store: TileStore) -> dict[str, list[str]]:
    """What was noticed of the sources that a map was made from, by source."""
    found: dict[str, list[str]] = {}
    for source in store.sources():
        found[source["path"]] = list(source["notes"])
        if store.settings.crs is not None and source["crs"] is None:
            told = f"names no CRS: taken to be in the map's, {named(store.settings.crs)}"
            found[source["path"]].append(told)
        if source["dropped"] and not is_log(source["path"]):  # of a log: pulses without a return
            told = f"{source['dropped']:,} points are not finite and left out"
            found[source["path"]].append(told)
        if source["reason"]:
            found[source["path"]].append(f"not read: {source['reason']}")
    return noticed(found)


def crs_of_map(sources: Iterable[str], url: str, asked: str | None) -> str | None:
    """The CRS that a map has, or will have by the headers of its sources; None: a local frame.

    Args:
        sources: what it is made from; none: it is there.
        url: where it is or will be.
        asked: the CRS that is asked for; None: none is.

    Raises:
        SourceError, CrsError: as `ingest`.
        PartialError: none of the files can be read; lists them.
    """
    try:
        return open_store(url).settings.crs
    except StoreNotFoundError:
        every = list(sources)
        named = list(_without_logs(every))
        settings = IngestSettings(crs=asked)
        found = examine_all(named, settings) if named else []
        reasons = {s.path: s.reason.removeprefix(f"{s.path}: ") for s in found if s.reason}
        if reasons and len(reasons) == len(found) and len(named) == len(every):
            raise PartialError(f"{url}: no source of the map can be read:", reasons) from None
        return with_crs(settings, found).crs


def _without_logs(sources: Iterable[str]) -> Iterator[str]:
    """The sources that name no log; of a glob that names some, the files that are none."""
    for source in sources:
        if not is_log(source):
            yield source
        elif not Path(source).exists():
            yield from (path for path in matches_of(source) if not is_log(path))


def ingest_settings(settings: MapSettings) -> IngestSettings:
    """How a map is cut into tiles."""
    return IngestSettings(**settings.model_dump(include=set(IngestSettings.model_fields)))


def scans_of(log: LogSettings) -> ScanSelection:
    """Which scans of a log are used.

    Raises:
        UsageError: an offset that is not below `every`.
    """
    return ScanSelection(every=log.every, offset=log.offset, from_s=log.from_s, until_s=log.until_s)
