"""A map in the making: which of its sources are read, and which of its tiles are written.

```
sources that are new or changed -- read --> what they give to each tile --+
sources that are as they were ---------- what the store knows of that ----+--> tiles that differ
tiles that differ --> spans of all sources that give to them -- read --> merged
```
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tilestream.errors import CorruptSourceError, DamagedError, PartialError, SourceError
from tilestream.grid import TileKey
from tilestream.marks import Mark
from tilestream.notes import noticed
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.outputs import TileArrays
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.sources import Source, as_read, as_remembered
from tilestream.pipeline.jobs.strays import without_strays
from tilestream.pipeline.stages.fragments import Fragment, fragments_of
from tilestream.pipeline.stages.map_plan import MapPlan, TilePoints
from tilestream.pipeline.stages.merge import merge, merge_tasks
from tilestream.pipeline.stages.scatter import SourceSpan, scatter, scatter_tasks
from tilestream.store import Manifest, Share, Shares, TileStore, added

MADE_BY = {stage.name: stage.version for stage in (scatter, merge)}
"""What a map is made by: another version makes it anew."""
GONE = "is not there any more: what it gave is taken away from the map"
"""What is said of a source that a map was made of."""
Given = Mapping[int, Mapping[TileKey, Share]]
"""What a source gives to each tile, by the first point of each span of it."""


@dataclass(frozen=True)
class Remembered:
    """A source that has not changed, as the store knows it."""

    source: Source
    given: Given

    def is_told_by(self, read: Mapping[int, Fragment]) -> bool:
        """Whether what was read of it again, by the first point of the span, is what it gave."""
        known = {start: self.given.get(start, {}) for start in read}
        return all(one.only(known[start]).shares == known[start] for start, one in read.items())


class Reading:
    """A map in the making: its sources are read first, then it is known which tiles it has."""

    def __init__(
        self,
        store: TileStore,
        found: Sequence[Source],
        memory: int,
        *,
        current: bool = False,
        remembered: Mapping[str, Remembered] | None = None,
        gone: Sequence[str] = (),
    ) -> None:
        """Sources, opened as far as their headers.

        Args:
            store: where the tiles go.
            found: the sources.
            memory: what a task may use [bytes].
            current: whether the store is whole and made from these sources: nothing is left to do.
            remembered: by path, the sources that have not changed since the store was made.
            gone: sources that the map was made of and that are not there any more.
        """
        self.gone = tuple(gone)
        self.store = store
        self.found = list(found)
        self.merges: tuple[Task, ...] = ()
        """The tasks that write tiles, once all sources are read."""
        self.sorted_out = False
        """Whether all is read, and it is known which tiles differ."""
        self.current = current
        """Whether nothing is left to do."""
        self._memory = memory
        self._remembered = dict(remembered or {})
        self._opened = tuple(found)
        readable = [(s.info, s.spans, s.state, s.options) for s in found if s.info is not None]
        scatters = () if current else scatter_tasks(store, readable, memory).tasks
        self._spans = {task.key: task for task in scatters}
        self._keys: dict[str, dict[int, str]] = {source.path: {} for source in found}
        for task in scatters:
            span = task.reads["blocks"]
            assert isinstance(span, SourceSpan)
            self._keys[span.path][span.span.start] = task.key
        self._path = {key: path for path, keys in self._keys.items() for key in keys.values()}
        self._open = {key for key, path in self._path.items() if path not in self._remembered}
        self._read: dict[str, Fragment] = {}
        self._given: dict[str, Given] = {}
        self._written: dict[TileKey, Mark] = {}

    @property
    def scatters(self) -> Plan:
        """The tasks that read sources now: at first those that are new or have changed."""
        tasks = tuple(task for key, task in self._spans.items() if key in self._open)
        return Plan(tasks, self._memory)

    @property
    def inputs(self) -> list[str]:
        """The files that are read; none where the map is current."""
        return [] if self.current else [one.path for one in self.found if not one.reason]

    @property
    def left_out(self) -> dict[str, str]:
        """The sources that could not be read, and why."""
        return {source.path: source.reason for source in self.found if source.reason}

    @property
    def notes(self) -> dict[str, list[str]]:
        """What the headers of the sources tell, by source, and which sources are gone."""
        told = {one.path: one.info.notes for one in self.found if one.info is not None}
        return noticed(told, {path: [GONE] for path in self.gone})

    @property
    def map_plan(self) -> MapPlan:
        """The map as it is or will be, once it is known which tiles differ."""
        return MapPlan.of_merges(self.store, self.merges, self._written)

    def first(self) -> Plan:
        """What to run first: the tasks that read sources; none: nothing is to be read.

        Raises:
            PartialError: none can be read; the map stays as it was.
        """
        if not self._open and not self.current:
            self._next()
        return self.scatters

    def expected(self, read: Iterable[TileKey]) -> MapPlan:
        """The map as it will be, before anything is read; `scatters` are then all tasks that will
        read.

        Args:
            read: the tiles that the sources that are read first may give points to.
        """
        if self.current:
            return MapPlan.of_store(self.store, partial=True)
        self._given = {path: before.given for path, before in self._remembered.items()}
        wanted, touched = self._wanted(()), set(read)
        touched |= wanted.keys() - self._written.keys()
        self._open |= self._giving(touched)
        marks = self.store.written(touched)
        counts = {key: marks[key].facts["points"] for key in touched if key in marks}
        points = MapPlan.of_merges(self.store, (), self._written).points
        expected = {key: TilePoints("expected", "", counts.get(key, 0)) for key in touched}
        return MapPlan(self.store, {**points, **expected})

    def grown(self, outcome: Outcome) -> tuple[Task, ...] | None:
        """What to run as soon as the last source is read: other spans, of tiles that differ; when
        those are read too, the tasks that write tiles (`sorted_out`). None: not all is read yet.

        Raises:
            PartialError: no source could be read; the map stays as it was.
        """
        if outcome.key not in self._open:
            return None
        self._open.remove(outcome.key)
        if outcome.ok:
            self._read[outcome.key] = Fragment.of(outcome.facts)
        else:
            self._fail(self._path[outcome.key], outcome.reason)
        return None if self._open else self._next()

    def close(self, outcomes: Sequence[Outcome]) -> dict[str, str]:
        """Record what was made; what failed, with its reason.

        Args:
            outcomes: of the tasks that write tiles, others besides.

        Raises:
            SourceError: the sources hold no points.
        """
        if self.current:
            return {}
        ended = {outcome.key: outcome for outcome in outcomes}
        failed = {task.key: ended[task.key].reason for task in self.merges if task.key in ended}
        failed = {key: reason for key, reason in failed.items() if reason}
        fragments_of(self.store.url).remove()  # first, since a full disk may need the room
        for task in self.merges:
            if task.key in failed and isinstance(task.writes, TileArrays):
                task.writes.refuse(failed[task.key], task.identity)
        self._record()
        failures = self.left_out | failed
        if not (self.merges or self._written or failures):
            sources = ", ".join(source.path for source in self.found)
            raise SourceError(f"{self.store.url}: the sources hold no points: {sources}")
        return failures

    def _next(self) -> tuple[Task, ...]:
        """What to run when nothing is being read."""
        fragments = self._settled()
        self._open = {
            key
            for source in self.found
            if not source.reason and source.path not in self._given
            for key in self._keys[source.path].values()
            if key not in self._read
        }
        if self._open:
            return self.scatters.tasks
        wanted = self._wanted(fragments)
        self._open = self._giving(wanted.keys() - self._written.keys())
        return self.scatters.tasks if self._open else self._begin(wanted)

    def _wanted(self, fragments: Iterable[Fragment]) -> dict[TileKey, Task]:
        """The task that merges each tile, of what the sources give; notes which are written."""
        totals: dict[TileKey, Share] = {}
        for given in self._given.values():
            for tiles in given.values():
                for key, share in tiles.items():
                    totals[key] = added(totals.get(key, (0, 0, 0)), share)
        tasks = merge_tasks(self.store, totals, fragments, self._memory)
        marks, wanted = self.store.written(totals), {t.tile: t for t in tasks if t.tile is not None}
        self._written = {k: m for k, m in marks.items() if m.is_of(wanted[k].identity)}
        return wanted

    def _settled(self) -> list[Fragment]:
        """Find what each source gives, as it is remembered, else as it was read; the fragments of
        what was read, without strays.
        """
        self._given, fragments = {}, []
        for number, source in enumerate(self._opened):
            if self.found[number].reason:
                continue
            keys = self._keys[source.path]
            read = {start: self._read[key] for start, key in keys.items() if key in self._read}
            before = self._remembered.get(source.path)
            if before is not None and before.is_told_by(read):
                self.found[number], self._given[source.path] = before.source, before.given
                fragments += [one.only(before.given.get(at, {})) for at, one in read.items()]
            elif len(read) == len(keys):
                try:
                    kept = without_strays(source.path, list(read.values()), self.store.grid)
                except CorruptSourceError as error:
                    self._fail(source.path, str(error))
                    continue
                self.found[number] = as_read(source, list(read.values()), kept)
                shares = (fragment.shares for fragment in kept.fragments)
                self._given[source.path] = dict(zip(read, shares, strict=True))
                fragments += kept.fragments
        return fragments

    def _giving(self, tiles: Iterable[TileKey]) -> set[str]:
        """The spans that give points to some tiles and have not been read."""
        wanted = set(tiles)
        return {
            self._keys[path][start]
            for path, given in self._given.items()
            for start, of_tiles in given.items()
            if not wanted.isdisjoint(of_tiles) and self._keys[path][start] not in self._read
        }

    def _begin(self, wanted: Mapping[TileKey, Task]) -> tuple[Task, ...]:
        """Write down which tiles the map will have; the tasks that write those that differ."""
        if self.left_out and not wanted:
            self._record()
            still = ", the map is as it was" if self.store.manifest is not None else ""
            raise PartialError(f"{self.store.url}: no source could be read{still}:", self.left_out)
        made = {key: task for key, task in wanted.items() if key not in self._written}
        self.merges = Plan.of(made.values(), self._memory).tasks
        self.sorted_out = True
        tiles = {key: (task.identity, task.counts["points"]) for key, task in wanted.items()}
        self.store.begin(Manifest.of(tiles))
        return self.merges

    def _fail(self, path: str, reason: str) -> None:
        """Note why a source cannot be read; the first reason counts."""
        for number, source in enumerate(self._opened):
            if source.path == path and not self.found[number].reason:
                self.found[number] = replace(source, reason=reason)

    def _record(self) -> None:
        fragments_of(self.store.url).remove()
        spans = {
            (number, start): tiles
            for number, source in enumerate(self.found)
            for start, tiles in self._given.get(source.path, {}).items()
        }
        self.store.end([source.record for source in self.found], MADE_BY, Shares(spans))


def remembered(
    store: TileStore, found: Sequence[Source], known: Sequence[Mapping[str, Any]]
) -> dict[str, Remembered]:
    """By path, the sources that have not changed since a store was made, as far as it knows what
    they gave.

    Args:
        store: the store.
        found: the sources.
        known: the sources as the store has recorded them, each under the path it was found by.
    """
    try:
        shares = store.shares()
    except DamagedError:
        shares = None
    if shares is None or store.made_by() != MADE_BY:
        return {}
    opened = {(source.path, source.state): source for source in found if source.info is not None}
    by_source, as_before = shares.by_source(), {}
    for number, record in enumerate(known):
        source, given = opened.get((record["path"], record["state"])), by_source.get(number, {})
        if source is None or record["reason"] or "told" not in record:
            continue
        if given.keys() <= {span.start for span in source.spans}:
            as_before[source.path] = Remembered(as_remembered(source, record), given)
    return as_before
