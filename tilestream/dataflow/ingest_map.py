"""The job that makes a map: sources in, tile store out, in ten steps over plan and run."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pyproj
import pyproj.exceptions

from tilestream.config import IngestSettings
from tilestream.dataflow.ingest_tasks import MergeTask, ScatterTask, plan_merge, plan_scatter
from tilestream.dataflow.plan import DEFAULT_MEMORY, Plan
from tilestream.dataflow.run import Watch, execute
from tilestream.dataflow.tasks import Outcome
from tilestream.errors import (
    CrsError,
    PartialError,
    SourceError,
    SourceNotFoundError,
    StoreNotFoundError,
    UsageError,
)
from tilestream.formats import expand_sources, open_source
from tilestream.formats.base import SourceInfo, Span
from tilestream.formats.mcap import ScanSelection
from tilestream.ingest import Fragment
from tilestream.store import POINTS, Mark, StoreSettings, Tile, TileStore, hash_of, open_store
from tilestream.tiling import TileKey

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
    reason: str = ""
    """Why it failed; empty where it did not."""


def ingest(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    *,
    tile_size: float = 100.0,
    halo: float = 10.0,
    map_leaf: float = 0.2,
    crs: str | None = None,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    scans: ScanSelection | None = None,
) -> TileStore:
    """Make a tile store from point clouds, map directories and logs of drives.

    Sources are read in blocks, scattered to tile fragments, and each tile is merged and thinned by
    one task, within the promised memory. A killed ingest continues where it was when called again;
    a changed source redoes the tiles that it touches; unchanged tiles are kept.

    Args:
        sources: files, globs and Autoware map directories, mixed: PCD, LAS, LAZ, PLY, E57, MCAP.
            They are the whole map: a source that the store knows must be given again.
        url: the store, a local path or any fsspec URL.
        tile_size: edge of a tile [m].
        halo: what tasks read around a tile [m].
        map_leaf: edge of the voxels that the map is thinned to [m]; 0 keeps all points.
        crs: CRS of the map; None: that of the sources.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        points_topic: topic of the scans in MCAP logs; None: found by type.
        pose_topic: topic of the poses in MCAP logs; None: found by type.
        scans: which scans of MCAP logs become the map; None: all.

    Returns:
        The store, with every tile that holds a point.

    Raises:
        UsageError: settings that cannot be, or that differ from those of the existing store.
        SourceNotFoundError: a path or glob that matches nothing.
        CrsError: two sources in different CRS, or a source that is not in `crs`.
        PlanError: the job does not fit `memory`.
        PartialError: some sources or tiles failed; the message lists them with reasons, and
            the rest is done and can be opened.
    """
    read = read_sources(
        sources,
        url,
        IngestSettings(tile_size=tile_size, halo=halo, map_leaf=map_leaf, crs=crs),
        client=client,
        memory=memory,
        watch=watch,
        points_topic=points_topic,
        pose_topic=pose_topic,
        scans=scans,
    )
    failures = read.close(execute(read.merges.tasks, client, watch))
    if failures:
        raise PartialError(
            f"{read.store.url}: {len(failures)} sources or tiles failed, the rest is done:",
            failures,
        )
    return read.store


@dataclass(frozen=True)
class SourcesRead:
    """A map whose sources have been read, and what is left to do: to write its tiles."""

    store: TileStore
    """Where the tiles go."""
    found: Sequence[Source]
    """The sources, with their counts or reasons."""
    merges: Plan
    """The tasks that write tiles; none where the store is current."""

    @property
    def identities(self) -> dict[TileKey, str]:
        """The identity that the points of each tile have, or will have."""
        tasks = [task for task in self.merges.tasks if isinstance(task, MergeTask)]
        return {t.tile: t.mark.identity for t in tasks} if tasks else self.store.identities()

    def close(self, outcomes: Sequence[Outcome]) -> dict[str, str]:
        """Record what was made; what failed, with its reason.

        Raises:
            SourceError: the sources hold no points.
        """
        if not self.merges.tasks and self.store.identities():
            return {}
        _close(self.store, self.found, self.merges, outcomes)
        failures = {source.path: source.reason for source in self.found if source.reason}
        failures |= {outcome.key: outcome.reason for outcome in outcomes if not outcome.ok}
        if not outcomes and not failures:
            sources = ", ".join(source.path for source in self.found)
            raise SourceError(f"{self.store.url}: the sources hold no points: {sources}")
        return failures


def read_sources(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    settings: IngestSettings,
    *,
    client: Any | None,
    memory: int,
    watch: Watch | None,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    scans: ScanSelection | None = None,
) -> SourcesRead:
    """The first half of `ingest`: read all sources, plan the tiles. Arguments and errors as there.

    Where no source could be read, what is in the store stays: a full disk takes no map away. The
    tasks that write the tiles may then run together with those that need them.
    """
    found = _examine_all(sources, _log_options(points_topic, pose_topic, scans))
    store = _create_or_resume(str(url), _with_crs(settings, found), found)
    if _is_current(store, found):
        return SourcesRead(store, found, Plan((), memory))
    scatters = _plan_reading(store, found, memory)
    found, fragments = _sort_out(found, scatters, execute(scatters.tasks, client, watch))
    merges = plan_merge(
        store.url, fragments, store.settings.tile_size, store.settings.map_leaf, memory
    )
    failures = {source.path: source.reason for source in found if source.reason}
    if failures and not merges.tasks:
        _close(store, found, merges, [])
        raise PartialError(f"{store.url}: no source could be read, the map is as it was:", failures)
    _drop_tiles_without_points(store, merges)
    return SourcesRead(store, found, merges)


def plan_ingest(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    settings: IngestSettings,
    memory: int = DEFAULT_MEMORY,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    scans: ScanSelection | None = None,
) -> Plan:
    """What `ingest` would read first, without running or writing anything.

    The tasks that write tiles are planned from what the reading finds. Arguments and errors as for
    `ingest`; a source that cannot be opened raises its own error here.
    """
    found = _examine_all(sources, _log_options(points_topic, pose_topic, scans))
    for source in found:
        if source.reason:
            raise SourceError(source.reason)
    store = TileStore(str(url), StoreSettings(**_with_crs(settings, found).model_dump()))
    return _plan_reading(store, found, memory)


def _log_options(
    points_topic: str | None, pose_topic: str | None, scans: ScanSelection | None
) -> dict[str, Any]:
    wanted = {"points_topic": points_topic, "pose_topic": pose_topic, "scans": scans}
    return {name: value for name, value in wanted.items() if value is not None}


def _examine_all(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], log_options: dict[str, Any]
) -> list[Source]:
    """Every file that the sources name, opened as far as its header.

    Raises:
        UsageError: there are no sources.
        SourceNotFoundError: a path or glob that matches nothing.
    """
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    found: dict[str, Source] = {}
    for pattern in [os.fspath(source) for source in sources]:
        try:
            paths = expand_sources(pattern)
        except SourceNotFoundError:
            raise
        except SourceError as error:
            found[pattern] = Source(pattern, state="", reason=str(error))
            continue
        for path in paths:
            options = log_options if path.lower().endswith(".mcap") else {}
            absolute = str(Path(path).absolute())
            found.setdefault(absolute, _examine(absolute, options))
    if not found:
        raise UsageError("no sources: name at least one file, glob or map directory")
    return [found[path] for path in sorted(found)]


def _examine(path: str, options: dict[str, Any]) -> Source:
    """Open a source as far as its header; a failure is its reason, not an exception."""
    stat = Path(path).stat()
    readable = tuple(sorted(options.items()))
    known = Source(path, hash_of(stat.st_size, stat.st_mtime_ns, repr(readable)), options=readable)
    try:
        source = open_source(path, **options)
        info = source.info()
        spans = tuple(source.spans(POINTS_PER_TASK))
    except (SourceError, OSError) as error:
        return replace(known, reason=str(error))
    return replace(known, info=info, spans=spans)


def _with_crs(settings: IngestSettings, found: Sequence[Source]) -> IngestSettings:
    """The settings with the one CRS of the map.

    Raises:
        CrsError: there are two, named with their sources, or one that pyproj cannot read.
    """
    named = [(s.path, s.info.crs) for s in found if s.info is not None and s.info.crs]
    if settings.crs is not None:
        named.insert(0, ("the crs that was asked for", settings.crs))
    for who, crs in named[1:]:
        if not _same_crs(named[0], (who, crs)):
            raise CrsError(
                f"{named[0][0]} is {_short(named[0][1])} and {who} is {_short(crs)}: bring all "
                "sources into one CRS first (for example with PDAL's filters.reprojection)"
            )
    if named:
        _parse_crs(*named[0])
    return settings.model_copy(update={"crs": named[0][1] if named else None})


def _same_crs(a: tuple[str, str], b: tuple[str, str]) -> bool:
    return a[1] == b[1] or bool(_parse_crs(*a).equals(_parse_crs(*b), ignore_axis_order=True))


def _parse_crs(who: str, text: str) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"{who}: {_short(text)} is no CRS that pyproj reads: {error}") from None


def _short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}…"


def _create_or_resume(url: str, settings: IngestSettings, found: Sequence[Source]) -> TileStore:
    """The store to write to: a new one, or the one that is there if it is the same map.

    Raises:
        UsageError: the store has other settings, or knows a source that was not given.
    """
    wanted = StoreSettings(**settings.model_dump())
    try:
        store = open_store(url)
    except StoreNotFoundError:
        return TileStore.create(url, wanted)
    for name, value in asdict(wanted).items():
        there = getattr(store.settings, name)
        if there != value and not (name == "crs" and value is None):
            raise UsageError(
                f"{url} has {name} {there!r}, asked for is {value!r}: "
                "use the same setting, or another path for the new store"
            )
    forgotten = sorted({s["path"] for s in store.sources()} - {s.path for s in found})
    if forgotten:
        raise UsageError(
            f"{url} was also made from {', '.join(forgotten)}: give all sources of the map, "
            "or another path for the new store"
        )
    return store


def _is_current(store: TileStore, found: Sequence[Source]) -> bool:
    """Whether the store is whole and was made from exactly these sources as they are now."""
    recorded = {(s["path"], s["state"]) for s in store.sources() if not s["reason"]}
    return recorded == {(s.path, s.state) for s in found} and all(
        mark.status == "done" for mark in store.marks(POINTS).values()
    )


def _plan_reading(store: TileStore, found: Sequence[Source], memory: int) -> Plan:
    readable = [(s.info, s.spans, s.state, s.options) for s in found if s.info is not None]
    return plan_scatter(store.url, readable, store.settings.tile_size, memory)


def _sort_out(
    found: Sequence[Source], plan: Plan, outcomes: Sequence[Outcome]
) -> tuple[list[Source], list[Fragment]]:
    """The sources with their counts or reasons, and the fragments of those that were read whole."""
    by_path: dict[str, list[Outcome]] = {source.path: [] for source in found}
    for task, outcome in zip(plan.tasks, outcomes, strict=True):
        assert isinstance(task, ScatterTask)
        by_path[task.source].append(outcome)
    sources, fragments = [], []
    for source in found:
        failed = [o.reason for o in by_path[source.path] if not o.ok]
        parts = [o.result for o in by_path[source.path] if isinstance(o.result, Fragment)]
        if failed:
            source = replace(source, reason=failed[0])
        elif not source.reason:
            fragments += parts
            source = replace(
                source,
                points=sum(part.points for part in parts),
                dropped=sum(part.dropped for part in parts),
            )
        sources.append(source)
    return sources, fragments


def _drop_tiles_without_points(store: TileStore, merges: Plan) -> None:
    """Remove the tiles that no source touches any more."""
    touched = {task.tile for task in merges.tasks if isinstance(task, MergeTask)}
    for key in set(store.marks(POINTS)) - touched:
        store.remove(key)


def _close(
    store: TileStore, found: Sequence[Source], merges: Plan, outcomes: Sequence[Outcome]
) -> None:
    """Remove the fragments (first, since a full disk may need the room); record what was made."""
    store.remove_fragments()
    for task, outcome in zip(merges.tasks, outcomes, strict=True):
        assert isinstance(task, MergeTask)
        if not outcome.ok:
            mark = Mark("failed", outcome.reason, task.mark.inputs, task.mark.settings)
            Tile(store, task.tile).write_reason(POINTS, mark)
    store.write_sources(
        [
            {
                "path": source.path,
                "state": source.state,
                "format": source.info.format if source.info else "",
                "size_bytes": source.info.size_bytes if source.info else 0,
                "crs": source.info.crs if source.info else None,
                "notes": list(source.info.notes) if source.info else [],
                "points": source.points,
                "dropped": source.dropped,
                "reason": source.reason,
            }
            for source in found
        ]
    )
