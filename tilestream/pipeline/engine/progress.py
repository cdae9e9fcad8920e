"""How far a run is: what its client sends, what the scheduler sees, and the figures of both.

Plain state without Dask: the page on the dashboard shows it, the JSON route prints it.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

NAME = "tilestream"
"""Of what the dashboard shows of a run: its plugin, its topic of events, its page and its route."""
WAITING, RUNNING, DONE, FAILED, REFUSED = range(5)
STATUSES = ("waiting", "running", "done", "failed", "refused")
"""Names of the statuses: refused is what was not run since a task that it needs had failed."""
RATE_OVER = 60.0
"""Over how long the rate of a stage is taken [s]."""
MOST_FAILURES = 200
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
    counts: list[int] = field(default_factory=lambda: [0] * len(STATUSES))
    """Tasks of each status."""
    work: int = 0
    """All of its work, in what the stage counts."""
    work_ended: int = 0
    """The work that has ended, well or not."""
    promised_bytes: int = 0
    """Largest promise of its tasks [bytes]."""
    began: float | None = None
    """When its first task ran, by the clock of the `Progress` [s]."""
    recent: deque[tuple[float, int, int]] = field(default_factory=deque)
    """(time, tasks, work) that ended of late."""

    def rates(self, now: float) -> tuple[float, float]:
        """Tasks and work per second of late; zeros before anything has ended."""
        while self.recent and self.recent[0][0] < now - RATE_OVER:
            self.recent.popleft()
        if self.began is None or not self.recent:
            return 0.0, 0.0
        span = max(0.5, min(RATE_OVER, now - self.began))
        tasks, work = (sum(entry[i] for entry in self.recent) for i in (1, 2))
        return tasks / span, work / span

    def facts(self, now: float) -> dict[str, Any]:
        """The stage for machines."""
        tasks_per_s, work_per_s = self.rates(now)
        left = self.work - self.work_ended
        return {
            "stage": self.name,
            "tasks": sum(self.counts),
            **dict(zip(STATUSES, self.counts, strict=True)),
            "tasks_per_second": round(tasks_per_s, 3),
            "seconds_left": round(left / work_per_s, 1) if work_per_s else (None if left else 0.0),
            "promised_bytes": self.promised_bytes,
        }


class Progress:
    """One client's run: its tasks by stage and tile, with the status of each.

    Fifty bytes per task and its key: a city of 100,000 tiles is no burden to a scheduler.
    """

    def __init__(self, client: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.client = client
        """Dask's name of the client that runs it."""
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
        self._clock = clock
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
            stages: [name, largest promise in bytes] of each stage that the tasks name.
            tasks: [key, number in `stages`, work, tile column, tile row] of each; the last two
                are None for a task of no one tile.
        """
        self.state = "running"
        numbers = [self._stage(name, promise) for name, promise in stages]
        for key, stage, work, ix, iy in tasks:
            number = len(self._status_of)
            self._open[key] = number
            self._stage_of.append(numbers[stage])
            self._status_of.append(WAITING)
            self._work_of.append(work)
            self._tile_of.append(NOWHERE if ix is None else self._tile((ix, iy), number))
            self.stages[numbers[stage]].counts[WAITING] += 1
            self.stages[numbers[stage]].work += work

    def seen(self, key: str, running: bool) -> None:
        """Learn that a task was handed to a worker, or taken from one that was lost."""
        number = self._open.get(key)
        if number is not None:
            stage = self.stages[self._stage_of[number]]
            stage.began = stage.began or self._clock()
            self._set(number, RUNNING if running else WAITING)

    def learn(self, outcomes: Iterable[list[Any]]) -> None:
        """Learn what became of tasks: [key, status, name of a failure, its reason] of each."""
        now = self._clock()
        ended = [[0, 0] for _ in self.stages]
        for key, status, name, reason in outcomes:
            number = self._open.pop(key, None)
            if number is None:
                continue
            self._set(number, status)
            place, work = self._stage_of[number], self._work_of[number]
            self.stages[place].work_ended += work
            if status != REFUSED:  # which took no time, and tells nothing of the rate
                ended[place][0] += 1
                ended[place][1] += work
            if status == FAILED:
                self.failed += 1
                if len(self.failures) < MOST_FAILURES:
                    self.failures.append((name, self.stages[place].name, reason))
        for stage, (tasks, work) in zip(self.stages, ended, strict=True):
            if tasks:
                stage.began = stage.began or now
                stage.recent.append((now, tasks, work))

    def statuses(self, tile: int) -> list[tuple[int, int]]:
        """(number of the stage, status) of the tasks of the tile at a place in `tiles`."""
        return [(self._stage_of[n], self._status_of[n]) for n in self._tasks_of[tile]]

    def facts(self) -> dict[str, Any]:
        """The run for machines."""
        now = self._clock()
        return {
            "client": self.client,
            "state": self.state,
            "stages": [stage.facts(now) for stage in self.stages],
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

    def _stage(self, name: str, promise: int) -> int:
        if name not in self._stages:
            self._stages[name] = len(self.stages)
            self.stages.append(Stage(name))
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
