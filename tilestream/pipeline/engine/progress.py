"""How far a run is: what its client sends, what the scheduler sees, and the figures of both.

Plain state without Dask: the page on the dashboard shows it, the JSON route prints it.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from tilestream.errors import alike
from tilestream.pipeline.engine.map_view import MapView
from tilestream.pipeline.engine.time_left import Left, Pace, slower_than_before, time_left

NAME = "tilestream"
"""Of what the dashboard shows of a run: its plugin, its topic of events, its page and its route."""
WAITING, RUNNING, DONE, FAILED, REFUSED = range(5)
STATUSES = ("waiting", "running", "done", "failed", "refused")
"""Names of the statuses: refused is what was not run since a task that it needs had failed."""
RATE_OVER = 60.0
"""Over how long the rate of a stage is taken [s]."""
MOST_FAILURES = 1_000
"""Failures that are kept with their reasons; of the others, the count. All are in the run's own
record."""
LONGEST_REASON = 500
"""Characters of a reason that are kept."""
NOWHERE = -1
"""In place of a tile's number: a task that belongs to no one tile."""


@dataclass
class Stage:
    """What a stage is made of and how fast it goes."""

    name: str
    """As in the keys of its tasks."""
    pace: Pace
    """How long its work takes."""
    counts: list[int] = field(default_factory=lambda: [0] * len(STATUSES))
    """Tasks of each status."""
    work: int = 0
    """All of its work, in what the stage counts."""
    work_ended: int = 0
    """The work that has ended, well or not."""
    expected: tuple[int, int] = 0, 0
    """Tasks and work that it is expected to have in the end, if more than it has."""
    promised_bytes: int = 0
    """Largest promise of its tasks [bytes]."""
    began: float | None = None
    """When its first task ran, by the clock of the `Progress` [s]."""
    recent: deque[tuple[float, int]] = field(default_factory=deque)
    """(time, tasks) that ended of late."""

    @property
    def left(self) -> Left:
        """What has not ended, with what is expected to follow."""
        tasks, work = self.expected
        return Left(
            self.pace,
            max(self.work, work) - self.work_ended,
            max(sum(self.counts), tasks) - sum(self.counts[DONE:]),
        )

    def rate(self, now: float) -> float:
        """Tasks per second of late; zero before anything has ended."""
        while self.recent and self.recent[0][0] < now - RATE_OVER:
            self.recent.popleft()
        if self.began is None or not self.recent:
            return 0.0
        span = max(0.5, min(RATE_OVER, now - self.began))
        return sum(tasks for _, tasks in self.recent) / span

    def facts(self, now: float, slower: float) -> dict[str, Any]:
        """The stage for machines, in a run that is slower than earlier ones by a factor."""
        return {
            "stage": self.name,
            "tasks": sum(self.counts),
            **dict(zip(STATUSES, self.counts, strict=True)),
            "expected": max(0, self.expected[0] - sum(self.counts)),
            "tasks_per_second": round(self.rate(now), 3),
            "core_seconds_left": round(self.pace.per_work(slower) * self.left.work, 1),
            "promised_bytes": self.promised_bytes,
        }


class Progress:
    """One client's run: its tasks by stage and tile, with the status of each.

    Fifty bytes per task and its key: a city of 100,000 tiles is no burden to a scheduler.
    """

    def __init__(self, client: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.client = client
        """Dask's name of the client that runs it."""
        self.places: set[str] = set()
        """Hashes of the folders and stores that it writes."""
        self.state: Literal["running", "ended", "lost"] = "running"
        """`lost`: the client is gone without having ended the run."""
        self.stages: list[Stage] = []
        """In the order in which they were first told of."""
        self.tiles: list[tuple[int, int]] = []
        """The tiles, in the order in which they were first told of."""
        self.changes = array("q")
        """Places in `tiles` of those that changed, as they did: who shows them keeps its place
        in it."""
        self.failures: list[tuple[str, str, str]] = []
        """(task, stage, reason), the first of them."""
        self.failed = 0
        """How many there are in all."""
        self.map = MapView()
        """What is drawn on the map."""
        self.complete = False
        """Whether all that follows is known, if only as expected."""
        self._clock = clock
        self._began = clock()
        self._ended: float | None = None
        self._reasons: dict[str, str] = {}
        self._lines: tuple[int, list[str]] = 0, []
        self._stages: dict[str, int] = {}
        self._tiles: dict[tuple[int, int], int] = {}
        self._tasks_of: list[list[int]] = []
        self._open: dict[str, int] = {}
        self._stage_of = array("H")
        self._status_of = bytearray()
        self._work_of = array("q")
        self._tile_of = array("q")

    def plan(self, stages: list[list[Any]], tasks: Iterable[list[Any]]) -> None:
        """Learn of tasks.

        Args:
            stages: [name, largest promise in bytes, seconds per unit of work as known before] of
                each stage that the tasks name.
            tasks: [key, number in `stages`, work, tile column, tile row] of each; the last two
                are None for a task of no one tile.
        """
        if self._ended is not None:  # its client goes on
            self.complete = False
            self._began += self._clock() - self._ended
            self.state, self._ended = "running", None
        numbers = [self._stage(*stage) for stage in stages]
        for key, stage, work, ix, iy in tasks:
            number = len(self._status_of)
            self._open[key] = number
            self._stage_of.append(numbers[stage])
            self._status_of.append(WAITING)
            self._work_of.append(work)
            self._tile_of.append(NOWHERE if ix is None else self._tile((ix, iy), number))
            self.stages[numbers[stage]].counts[WAITING] += 1
            self.stages[numbers[stage]].work += work

    def expect(self, stages: Iterable[list[Any]], complete: bool) -> None:
        """Learn what stages will have in the end, in place of what was expected so far.

        Args:
            stages: [name, largest promise in bytes, seconds per unit of work, tasks, work] of each.
            complete: whether nothing else will follow.
        """
        self.complete = complete
        for known in self.stages:
            known.expected = 0, 0
        for name, promise, before, tasks, work in stages:
            self.stages[self._stage(name, promise, before)].expected = tasks, work

    def seen(self, key: str, running: bool) -> None:
        """Learn that a task was handed to a worker, or taken from one that was lost."""
        number = self._open.get(key)
        if number is not None:
            stage = self.stages[self._stage_of[number]]
            stage.began = stage.began or self._clock()
            self._set(number, RUNNING if running else WAITING)

    def learn(self, outcomes: Iterable[list[Any]]) -> None:
        """Learn what became of tasks: [key, status, name of a failure, its reason, how long it
        took to make something, else 0] of each.
        """
        now = self._clock()
        ended = [0] * len(self.stages)
        for key, status, name, reason, seconds in outcomes:
            number = self._open.pop(key, None)
            if number is None:
                continue
            self._set(number, status)
            place, work = self._stage_of[number], self._work_of[number]
            stage = self.stages[place]
            stage.work_ended += work
            ended[place] += status != REFUSED  # which took no time, and tells nothing of the rate
            if seconds:
                stage.pace.learn(work, seconds)
            if status == FAILED:
                self.failed += 1
                if len(self.failures) < MOST_FAILURES:
                    same = self._reasons.setdefault(reason, reason)
                    self.failures.append((name, stage.name, same))
        for stage, tasks in zip(self.stages, ended, strict=True):
            if tasks:
                stage.began = stage.began or now
                stage.recent.append((now, tasks))

    def end(self, state: Literal["ended", "lost"]) -> None:
        """Learn that the run has ended, or that its client is gone."""
        self.state, self._ended = state, self._clock()
        if state == "ended":
            self.expect([], complete=True)

    def statuses(self, tile: int) -> list[tuple[int, int]]:
        """(number of the stage, status) of the tasks of the tile at a place in `tiles`."""
        return [(self._stage_of[n], self._status_of[n]) for n in self._tasks_of[tile]]

    def facts(self, threads: int) -> dict[str, Any]:
        """The run for machines, of workers that run so many tasks at a time."""
        now = self._clock()
        slower = slower_than_before(stage.pace for stage in self.stages)
        left = time_left((stage.left for stage in self.stages), threads)
        return {
            "client": self.client,
            "state": self.state,
            "seconds": round((self._ended or now) - self._began, 1),
            "share_done": round(self._share_done(slower), 4),
            "left": {
                **{name: _rounded(value) for name, value in left._asdict().items()},
                "complete": self.complete,
            },
            "stages": [stage.facts(now, slower) for stage in self.stages],
            "map": {"tiles": len(self.tiles), **self.map.facts()},
            "reasons": self._alike(),
            "failures": [
                {"key": key, "stage": stage, "reason": reason}
                for key, stage, reason in self.failures
            ],
            "failures_not_listed": self.failed - len(self.failures),
        }

    def tile_facts(self) -> dict[str, dict[str, str]]:
        """The status of each stage of each tile, by names."""
        return {
            f"{ix}_{iy}": {
                self.stages[stage].name: STATUSES[status] for stage, status in self.statuses(place)
            }
            for place, (ix, iy) in enumerate(self.tiles)
        }

    def _share_done(self, slower: float) -> float:
        """Of the time that all work takes; where all of it takes none, of the tasks."""
        paces = [stage.pace.per_work(slower) for stage in self.stages]
        done = sum(p * s.work_ended for p, s in zip(paces, self.stages, strict=True))
        whole = done + sum(p * s.left.work for p, s in zip(paces, self.stages, strict=True))
        if not whole:
            return 1.0 - len(self._open) / max(1, len(self._status_of))
        return done / whole

    def _alike(self) -> list[str]:
        """The failures that are kept, a line for each reason, as the terminal has them."""
        count, lines = self._lines
        if count != len(self.failures):
            lines = alike({key: reason for key, _, reason in self.failures})
            self._lines = len(self.failures), lines
        return lines

    def _stage(self, name: str, promise: int, before: float) -> int:
        if name not in self._stages:
            self._stages[name] = len(self.stages)
            self.stages.append(Stage(name, Pace(before)))
        stage = self.stages[self._stages[name]]
        stage.promised_bytes = max(stage.promised_bytes, promise)
        return self._stages[name]

    def _tile(self, tile: tuple[int, int], number: int) -> int:
        if tile not in self._tiles:
            self._tiles[tile] = len(self.tiles)
            self.tiles.append(tile)
            self._tasks_of.append([])
        self._tasks_of[self._tiles[tile]].append(number)
        return self._tiles[tile]

    def _set(self, number: int, status: int) -> None:
        counts = self.stages[self._stage_of[number]].counts
        counts[self._status_of[number]] -= 1
        counts[status] += 1
        self._status_of[number] = status
        if self._tile_of[number] != NOWHERE:
            self.changes.append(self._tile_of[number])


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
