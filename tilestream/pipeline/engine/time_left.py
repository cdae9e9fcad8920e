"""How long a run will still take, and how sure that is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

LEAST = 3
"""Tasks of a stage that must have ended before their pace counts for it, its first one left out:
that one compiles the kernels of the stage."""
MOST_SLOWER = 3.0
"""By what factor this run is taken to be slower or faster than earlier ones, at most: what a few
tasks say of all others."""
SIGMAS = 2.0
"""Half the width of the span that is told, in standard deviations."""
SURE = 0.9
"""Share of the time left that must go by the pace of this run for a span to be told."""


@dataclass
class Pace:
    """How long a unit of a stage's work takes: as told before, until enough tasks have ended."""

    before: float
    """What it took in earlier runs, or in those that the shipped figures are of [s]."""
    tasks: int = 0
    """Tasks that count."""
    work: float = 0.0
    """Their work."""
    seconds: float = 0.0
    """How long they took [s]."""
    _begun: bool = False
    _seconds_2: float = 0.0
    _seconds_work: float = 0.0
    _work_2: float = 0.0

    def learn(self, work: int, seconds: float) -> None:
        """Take a task that did some work in some time [s]; one without any work tells nothing."""
        if not self._begun:
            self._begun = True
        elif work > 0:
            self.tasks += 1
            self.work += work
            self.seconds += seconds
            self._seconds_2 += seconds * seconds
            self._seconds_work += seconds * work
            self._work_2 += work * work

    @property
    def known(self) -> bool:
        """Whether it is that of this run."""
        return self.tasks >= LEAST

    def per_work(self, slower: float = 1.0) -> float:
        """Time per unit of work [s], where this run is slower than earlier ones by a factor."""
        return self.seconds / self.work if self.known else self.before * slower

    def variance(self, work: float) -> float:
        """Of the time that so much work will take [s^2], where the pace is known.

        Times of tasks scatter about the pace with a variance that grows with their work, and the
        pace itself is that of a sample: `v W (1 + W / w)`, for `W` to come and `w` measured.
        """
        pace = self.per_work()
        squares = self._seconds_2 - 2.0 * pace * self._seconds_work + pace * pace * self._work_2
        spread = max(0.0, squares) / self.work * self.tasks / (self.tasks - 1)
        return spread * work * (1.0 + work / self.work)


class Left(NamedTuple):
    """What is left of a stage."""

    pace: Pace
    work: float
    tasks: int


class TimeLeft(NamedTuple):
    """How long a run will still take."""

    seconds: float | None
    """[s]; None: no worker is there."""
    low: float | None
    """[s]; with `high` the span of `SIGMAS` standard deviations, None where too much of it goes by
    earlier runs."""
    high: float | None
    share_known: float
    """Share of the time that goes by the pace of this run."""


def time_left(stages: Iterable[Left], threads: int) -> TimeLeft:
    """The time that all workers need for what is left: all of it, and its longest task at least.

    Args:
        stages: what is left of each.
        threads: how many tasks run at a time.
    """
    every = list(stages)
    slower = slower_than_before(stage.pace for stage in every)
    left = [stage for stage in every if stage.work > 0]
    if not left:
        return TimeLeft(0.0, 0.0, 0.0, 1.0)
    if threads < 1:
        return TimeLeft(None, None, None, _share_known(left, slower))
    longest = max(_seconds([one], slower) / max(1, one.tasks) for one in left)
    seconds = max(_seconds(left, slower) / threads, longest)
    share = _share_known(left, slower)
    if share < SURE:
        return TimeLeft(seconds, None, None, share)
    variance = sum(one.pace.variance(one.work) for one in left if one.pace.known)
    half = SIGMAS * float(np.sqrt(variance)) / min(threads, sum(one.tasks for one in left))
    return TimeLeft(seconds, max(0.0, seconds - half), seconds + half, share)


def slower_than_before(paces: Iterable[Pace]) -> float:
    """By which factor the tasks of this run that count take longer than earlier ones, all together;
    at most `MOST_SLOWER`, at least its inverse.
    """
    counted = [pace for pace in paces if pace.tasks]
    before = sum(pace.before * pace.work for pace in counted)
    if sum(pace.tasks for pace in counted) < LEAST or before <= 0.0:
        return 1.0
    ratio = sum(pace.seconds for pace in counted) / before
    return min(MOST_SLOWER, max(1.0 / MOST_SLOWER, ratio))


def _seconds(left: Sequence[Left], slower: float) -> float:
    return sum(one.pace.per_work(slower) * one.work for one in left)


def _share_known(left: Sequence[Left], slower: float) -> float:
    whole = _seconds(left, slower)
    known = [one for one in left if one.pace.known]
    return _seconds(known, slower) / whole if whole else 1.0
