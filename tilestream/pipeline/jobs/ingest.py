"""The job that makes a map: sources in, tile store out, in ten steps over plan and run."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from tilestream.crs import same
from tilestream.errors import (
    CorruptSourceError,
    PartialError,
    SourceError,
    StoreNotFoundError,
    UsageError,
)
from tilestream.formats.logs import ScanSelection
from tilestream.lock import only_writer
from tilestream.notes import noticed
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.engine.outputs import TileArrays
from tilestream.pipeline.engine.plan import DEFAULT_MEMORY, Plan
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.sources import (
    Source,
    as_read,
    examine_all,
    with_crs,
    within,
)
from tilestream.pipeline.jobs.strays import without_strays
from tilestream.pipeline.stages.merge import merge, merge_tasks
from tilestream.pipeline.stages.scatter import (
    Fragment,
    SourceSpan,
    fragments_of,
    scatter,
    scatter_tasks,
)
from tilestream.settings import IngestSettings, LogOptions
from tilestream.store import Manifest, StoreSettings, TileStore, open_store

MADE_BY = {stage.name: stage.version for stage in (scatter, merge)}
"""What a map is made by: another version makes it anew."""


def ingest(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    *,
    tile_size: float = 100.0,
    halo: float = 10.0,
    map_leaf: float = 0.2,
    crs: str | None = None,
    keep_noise: bool = False,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    log_options: LogOptions | None = None,
    scans: ScanSelection | None = None,
) -> TileStore:
    """Make a tile store from point clouds, map directories and logs of drives.

    Sources are read in blocks, scattered to tile fragments, and each tile is merged and thinned by
    one task, within the promised memory. A killed ingest continues where it was when called again;
    a changed source redoes the tiles that it touches; unchanged tiles are kept.

    Args:
        sources: files, globs and Autoware map directories, mixed: PCD, LAS, LAZ, PLY, E57, logs.
            They are the whole map: a source that the store knows must be given again.
        url: the store, a local path or any fsspec URL.
        tile_size: edge of a tile [m].
        halo: what tasks read around a tile [m].
        map_leaf: edge of the voxels that the map is thinned to [m]; 0 keeps all points.
        crs: CRS of the map; None: that of the sources.
        keep_noise: keep the points of LAS files that are of a class of noise, or withheld.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        log_options: topics and frames of the logs among the sources; None: found.
        scans: which scans of logs become the map; None: all.

    Returns:
        The store, with every tile that holds a point.

    Raises:
        UsageError: settings that cannot be, or that differ from those of the existing store.
        SourceNotFoundError: a path or glob that matches nothing.
        LockedError: another process writes to the store.
        CrsError: two sources in different CRS, or a source that is not in `crs`.
        PlanError: the job does not fit `memory`.
        PartialError: some sources or tiles failed; the message lists them with reasons, and
            the rest is done and can be opened.

    Examples:
        >>> store = ts.ingest(["street.pcd"], "small.zarr", tile_size=20.0)
        >>> store.settings.tile_size, store.condition().whole
        (20.0, True)
    """
    settings = IngestSettings(
        tile_size=tile_size, halo=halo, map_leaf=map_leaf, crs=crs, keep_noise=keep_noise
    )
    with only_writer(url):
        reading = read_sources(sources, url, settings, memory, log_options, scans)
        outcomes = execute(
            reading.first(),
            client,
            watch,
            grow=lambda outcome: reading.grown(outcome) or (),
            shared=[reading.store.url],
        )
        failures = reading.close(outcomes)
    if failures:
        raise PartialError(
            f"{reading.store.url}: {len(failures)} sources or tiles failed, the rest is done:",
            failures,
        )
    return reading.store


class Reading:
    """A map in the making: its sources are read first, then it is known which tiles it has."""

    def __init__(
        self, store: TileStore, found: Sequence[Source], memory: int, current: bool
    ) -> None:
        """Sources, opened as far as their headers.

        Args:
            store: where the tiles go.
            found: the sources.
            memory: what a task may use [bytes].
            current: whether the store is whole and made from these sources: nothing is left to do.
        """
        self.store = store
        self.found = list(found)
        self.merges: tuple[Task, ...] = ()
        """The tasks that write tiles, once all sources are read."""
        self._memory = memory
        self._current = current
        readable = [(s.info, s.spans, s.state, s.options) for s in found if s.info is not None]
        self.scatters = Plan((), memory) if current else scatter_tasks(store, readable, memory)
        """The tasks that read the sources."""
        spans = {task.key: task.reads["blocks"] for task in self.scatters.tasks}
        self._open = {key: span.path for key, span in spans.items() if isinstance(span, SourceSpan)}
        self._read: dict[str, list[Outcome]] = {source.path: [] for source in found}

    @property
    def left_out(self) -> dict[str, str]:
        """The sources that could not be opened, and why."""
        return {source.path: source.reason for source in self.found if source.reason}

    @property
    def notes(self) -> dict[str, list[str]]:
        """What the headers of the sources tell, by source."""
        return noticed({one.path: one.info.notes for one in self.found if one.info is not None})

    def first(self) -> Plan:
        """What to run first: the tasks that read the sources.

        Raises:
            PartialError: none can be read; the map stays as it was.
        """
        if not self._current and not self.scatters.tasks:
            self._sorted_out()
        return self.scatters

    def grown(self, outcome: Outcome) -> tuple[Task, ...] | None:
        """The tasks that write the tiles, as soon as the last source is read; else None.

        Raises:
            PartialError: no source could be read; the map stays as it was.
        """
        path = self._open.pop(outcome.key, None)
        if path is None:
            return None
        self._read[path].append(outcome)
        return None if self._open else self._sorted_out()

    def _sorted_out(self) -> tuple[Task, ...]:
        fragments: list[Fragment] = []
        for number, source in enumerate(self.found):
            parts = self._read[source.path]
            failed = [outcome.reason for outcome in parts if not outcome.ok]
            if failed:
                self.found[number] = replace(source, reason=failed[0])
            elif not source.reason:
                indices = [Fragment.of(outcome.facts) for outcome in parts]
                try:
                    kept = without_strays(source.path, indices, self.store.grid)
                except CorruptSourceError as error:
                    self.found[number] = replace(source, reason=str(error))
                    continue
                self.found[number] = as_read(source, indices, kept)
                fragments += kept.fragments
        fragments.sort(key=lambda fragment: [int(part) for part in fragment.name.split("-")])
        self.merges = merge_tasks(self.store, fragments, self._memory).tasks
        failures = self._unread()
        if failures and not self.merges:
            self._record()
            raise PartialError(
                f"{self.store.url}: no source could be read, the map is as it was:", failures
            )
        self.store.begin(
            Manifest.of(
                {
                    t.tile: (t.identity, t.counts["points"])
                    for t in self.merges
                    if t.tile is not None
                }
            )
        )
        return self.merges

    def _unread(self) -> dict[str, str]:
        return {source.path: source.reason for source in self.found if source.reason}

    def close(self, outcomes: Sequence[Outcome]) -> dict[str, str]:
        """Record what was made; what failed, with its reason.

        Args:
            outcomes: of the tasks that write tiles, others besides.

        Raises:
            SourceError: the sources hold no points.
        """
        if self._current:
            return {}
        ended = {outcome.key: outcome for outcome in outcomes}
        failed = {task.key: ended[task.key].reason for task in self.merges if task.key in ended}
        failed = {key: reason for key, reason in failed.items() if reason}
        fragments_of(self.store.url).remove()  # first, since a full disk may need the room
        for task in self.merges:
            if task.key in failed and isinstance(task.writes, TileArrays):
                task.writes.refuse(failed[task.key], task.identity)
        self._record()
        failures = self._unread() | failed
        if not self.merges and not failures:
            sources = ", ".join(source.path for source in self.found)
            raise SourceError(f"{self.store.url}: the sources hold no points: {sources}")
        return failures

    def _record(self) -> None:
        fragments_of(self.store.url).remove()
        self.store.end([source.record for source in self.found], MADE_BY)


def read_sources(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    settings: IngestSettings,
    memory: int,
    log_options: LogOptions | None = None,
    scans: ScanSelection | None = None,
) -> Reading:
    """What `ingest` begins with; arguments and errors as there."""
    found = within(examine_all(sources, settings, log_options, scans), memory)
    store = _create_or_resume(str(url), with_crs(settings, found), found)
    current = _is_current(store, found)
    recorded = _recorded(store, found)
    if current and recorded != store.sources():
        store.end(recorded, MADE_BY)  # the sources have moved, or have other names now
    return Reading(store, found, memory, current)


def store_settings(settings: IngestSettings) -> StoreSettings:
    """What of the settings a store is: the rest is how its sources are read."""
    return StoreSettings(**settings.model_dump(include={f.name for f in fields(StoreSettings)}))


def plan_ingest(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    settings: IngestSettings,
    memory: int = DEFAULT_MEMORY,
    log_options: LogOptions | None = None,
    scans: ScanSelection | None = None,
) -> Reading:
    """What `ingest` would read first, without running or writing anything.

    The tasks that write tiles are planned from what the reading finds; sources that cannot be
    opened are left out. Arguments and errors as for `ingest`; where no source can be opened, the
    error is the first one's.
    """
    found = examine_all(sources, settings, log_options, scans)
    if all(source.reason for source in found):
        raise SourceError(found[0].reason)
    store = TileStore(str(url), store_settings(with_crs(settings, found)))
    return Reading(store, found, memory, current=False)


def _create_or_resume(url: str, settings: IngestSettings, found: Sequence[Source]) -> TileStore:
    """The store to write to: a new one, or the one that is there if it is the same map.

    Raises:
        UsageError: the store has other settings, or knows a source that was not given.
    """
    wanted = store_settings(settings)
    try:
        store = open_store(url)
    except StoreNotFoundError:
        return TileStore.create(url, wanted)
    for name, value in asdict(wanted).items():
        there = getattr(store.settings, name)
        if there != value and not (name == "crs" and _fits(value, there)):
            raise UsageError(
                f"{url} has {name} {there!r}, asked for is {value!r}: "
                "use the same setting, or another path for the new store"
            )
    given = {source.path for source in found}
    forgotten = sorted({s["path"] for s in _recorded(store, found)} - given)
    if forgotten:
        raise UsageError(
            f"{url} was also made from {', '.join(forgotten)}: give all sources of the map, "
            "or another path for the new store"
        )
    return store


def _recorded(store: TileStore, found: Sequence[Source]) -> list[dict[str, Any]]:
    """The sources that a store knows, each under the path that it was found by.

    It is known by the file that the path leads to; where nothing is there any more, by name and
    state: it has moved.
    """
    given = {os.path.realpath(source.path): source.path for source in found}
    moved = {(Path(source.path).name, source.state): source.path for source in found}
    known = []
    for source in store.sources():
        path = source["path"]
        now = given.get(os.path.realpath(path))
        if now is None and not Path(path).exists():
            now = moved.get((Path(path).name, source["state"]))
        known.append({**source, "path": now or path})
    return known


def _fits(asked: str | None, there: str | None) -> bool:
    """Whether the CRS of a store is that of the map, or the map names none."""
    return asked is None or (there is not None and same(asked, there))


def _is_current(store: TileStore, found: Sequence[Source]) -> bool:
    """Whether the store is whole, and made from exactly these sources by these stages."""
    recorded = {(s["path"], s["state"]) for s in _recorded(store, found) if not s["reason"]}
    if recorded != {(s.path, s.state) for s in found} or store.made_by() != MADE_BY:
        return False
    condition = store.condition()
    return condition.whole and all(mark.status == "done" for mark in condition.marks.values())
