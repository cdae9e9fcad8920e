"""The job that makes a map: sources in, tile store out, in ten steps over plan and run."""

import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from tilestream.crs import same
from tilestream.errors import (
    SourceError,
    StoreNotFoundError,
    UsageError,
    require_all_done,
)
from tilestream.formats.logs import ScanSelection
from tilestream.lock import only_writer
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.jobs.map_reading import GONE, MADE_BY, Reading, remembered
from tilestream.pipeline.jobs.sources import Source, examine_all, with_crs, within
from tilestream.settings import DEFAULT_MEMORY, IngestSettings, LogOptions
from tilestream.store import StoreSettings, TileStore, open_store

logger = logging.getLogger(__name__)

Recorded = list[dict[str, Any]]
"""The sources that a store knows."""


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
    one task, within the promised memory. A killed ingest continues where it was when called again.
    Of a map that is there only what an update reaches is made again: a source that is new, has
    changed or was taken away is read (what it gave is known), and of the others what they give to
    the tiles that differ; all other tiles stay as they are.

    Args:
        sources: files, globs and Autoware map directories, mixed: PCD, LAS, LAZ, PLY, E57, logs.
            They are the whole map: a source that the store knows must be given again, as long as
            it is there.
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
        SourceError: no source can be opened, and there is no map yet.
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
            ahead=lambda: () if reading.sorted_out or reading.current else None,
            shared=[reading.store.url],
            inputs=reading.inputs,
        )
        failures = reading.close(outcomes)
    require_all_done(reading.store.url, failures)
    return reading.store


def read_sources(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    url: str | os.PathLike[str],
    settings: IngestSettings,
    memory: int,
    log_options: LogOptions | None,
    scans: ScanSelection | None,
) -> Reading:
    """What `ingest` begins with; arguments and errors as there."""
    found = within(examine_all(sources, settings, log_options, scans), memory)
    wanted = store_settings(with_crs(settings, found))
    store = _there(str(url), wanted, found)
    if store is None:
        require_some(found)
        store = TileStore.create(url, wanted)
    recorded = _recorded(store, found)
    reading = _reading(store, found, recorded, memory)
    for path in reading.gone:
        logger.warning("%s %s", path, GONE)
    if reading.current and recorded != store.sources():
        store.end(recorded, MADE_BY)  # the sources have moved, or have other names now
    return reading


def _reading(store: TileStore, found: Sequence[Source], recorded: Recorded, memory: int) -> Reading:
    """What is to be read of sources, of a store that is there and knows those that it is of."""
    current = _is_current(store, found, recorded)
    as_before = {} if current else remembered(store, found, recorded)
    gone = _gone(found, recorded)
    return Reading(store, found, memory, current=current, remembered=as_before, gone=gone)


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
    require_some(found)
    wanted = store_settings(with_crs(settings, found))
    there = _there(str(url), wanted, found)
    if there is None:
        return Reading(TileStore(str(url), wanted), found, memory)
    return _reading(there, found, _recorded(there, found), memory)


def _there(url: str, wanted: StoreSettings, found: Sequence[Source]) -> TileStore | None:
    """The store to write to, if it is there and is the same map; None: none is there.

    Raises:
        UsageError: the store has other settings, or knows a source that is there and was not given.
    """
    try:
        store = open_store(url)
    except StoreNotFoundError:
        return None
    for name, value in asdict(wanted).items():
        there = getattr(store.settings, name)
        if there != value and not (name == "crs" and _fits(value, there)):
            raise UsageError(
                f"{url} has {name} {there!r}, asked for is {value!r}: "
                "use the same setting, or another path for the new store"
            )
    forgotten = [path for path in _absent(found, _recorded(store, found)) if Path(path).exists()]
    if forgotten:
        raise UsageError(
            f"{url} was also made from {', '.join(forgotten)}: give all sources of the map, move "
            "away what is no part of it any more, or give another path for the new store"
        )
    return store


def _absent(found: Sequence[Source], recorded: Recorded) -> list[str]:
    """The sources that a store knows and that were not given."""
    given = {source.path for source in found}
    return sorted({source["path"] for source in recorded} - given)


def _gone(found: Sequence[Source], recorded: Recorded) -> list[str]:
    """The sources of a store that were not given, by any name that they may have now."""
    known = {source["path"]: source["state"] for source in recorded}
    renamed = {source.state for source in found if source.path not in known}
    return [path for path in _absent(found, recorded) if known[path] not in renamed]


def require_some(found: Sequence[Source]) -> None:
    """Refuse sources of which none can be opened, before anything is made of them.

    Raises:
        SourceError: says why the first cannot.
    """
    if all(source.reason for source in found):
        several = f"none of {len(found)} sources can be read: " * (len(found) > 1)
        raise SourceError(several + found[0].reason)


def _recorded(store: TileStore, found: Sequence[Source]) -> Recorded:
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


def _is_current(store: TileStore, found: Sequence[Source], recorded: Recorded) -> bool:
    """Whether the store is whole, and made from exactly these sources by these stages."""
    known = {(s["path"], s["state"]) for s in recorded if not s["reason"]}
    if known != {(s.path, s.state) for s in found} or store.made_by() != MADE_BY:
        return False
    condition = store.condition()
    return condition.whole and all(mark.status == "done" for mark in condition.marks.values())
