"""How a task is performed, whatever its stage, and what became of it."""

import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tilestream.errors import NOT_RUN, TileNotReadyError, TilestreamError
from tilestream.pipeline.engine.outputs import Facts, Made, TileArrays
from tilestream.pipeline.engine.plan import require_fit
from tilestream.pipeline.engine.stage import BASE_BYTES, Task

STANDING = (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)
"""What the disk refuses in the same way however often it is asked."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task."""

    key: str
    """The task's key."""
    stage: str
    """The task's stage."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Small facts of what it made; none where it failed."""
    made: bool = False
    """Whether it made something: else it failed, or found its work done."""
    reason: str = ""
    """Why it failed; empty where it did not."""
    seconds: float = 0.0
    """How long it ran [s]."""
    details: str = ""
    """The traceback of a failure, for --debug."""
    passing: bool = False
    """Whether another try may succeed: the machine failed, not the data."""

    @property
    def ok(self) -> bool:
        """Whether the task is done."""
        return not self.reason

    @property
    def refused(self) -> bool:
        """Whether it was not run, since a task that it needs had failed."""
        return self.reason.startswith(NOT_RUN)


def perform(task: Task, memory: int | None) -> tuple[Facts, bool]:
    """Do the work of a task, unless it is done; the facts, and whether anything was made.

    Raises:
        PlanError: what it reads is larger than was expected, and does not fit.
        Exception: whatever its function raises is its failure.
    """
    known = task.writes.known(task.identity)
    if known is not None:
        return known, False
    if memory is not None:
        require_fit(task, BASE_BYTES + task.applies.memory(_read_counts(task)), memory)
    try:
        made = task.applies.function(**task.arguments())
    except TileNotReadyError as error:
        if task.applies.tells_failures and isinstance(task.writes, TileArrays):
            return task.writes.refuse(str(error), task.identity), True
        raise
    whole = made if isinstance(made, Made) else Made(made)
    columns = (*task.applies.columns, *whole.columns)
    return task.writes.write(whole, task.identity, columns), True


def found(task: Task) -> Outcome | None:
    """The outcome of a task whose work is done already; None: it has to run."""
    began = time.perf_counter()
    try:
        known = task.writes.known(task.identity)
    except Exception:  # noqa: BLE001 - whatever keeps it from being read, who runs it says so
        return None
    if known is None:
        return None
    return Outcome(task.key, task.stage, known, seconds=time.perf_counter() - began)


def _read_counts(task: Task) -> Mapping[str, int]:
    """How much a task reads: as it is there, else as the plan expected."""
    there: Counter[str] = Counter()
    for what in task.reads.values():
        for one in what if isinstance(what, tuple) else (what,):
            there.update(one.counts())
    return {**task.counts, **there}


def attempt(task: Task, memory: int | None = None) -> Outcome:
    """Do the work of a task and say what became of it; never raises.

    What we refuse ourselves (`TilestreamError`), a path that cannot be used and a bug
    stand; where the disk, the network or the memory failed, another try may succeed.

    Args:
        task: what to do.
        memory: what it may use [bytes]; None: whatever it needs.
    """
    began, passing = time.perf_counter(), False
    try:
        facts, made = perform(task, memory)
    except TilestreamError as error:
        reason, details = str(error), traceback.format_exc()
    except MemoryError:
        reason, details = "out of memory: allow less work at a time (--memory)", ""
        passing = True
    except OSError as error:
        reason, details = f"{error} ({type(error).__name__})", traceback.format_exc()
        passing = not isinstance(error, STANDING)
    except Exception as error:  # noqa: BLE001 - whatever fails is listed, and the others go on
        reason, details = f"{type(error).__name__}: {error}", traceback.format_exc()
    else:
        return Outcome(task.key, task.stage, facts, made, seconds=time.perf_counter() - began)
    seconds = time.perf_counter() - began
    return Outcome(task.key, task.stage, {}, False, reason, seconds, details, passing)


def attempt_all(tasks: Iterable[Task], memory: int | None = None) -> list[Outcome]:
    """`attempt` tasks in turn, as `in_turn`."""
    return in_turn(tasks, partial(attempt, memory=memory))


def in_turn(tasks: Iterable[Task], outcome_of: Callable[[Task], Outcome]) -> list[Outcome]:
    """The outcomes of tasks, each after those that it needs; of one that needs a task that failed
    among them there is none.
    """
    outcomes: list[Outcome] = []
    undone: set[str] = set()
    for task in tasks:
        if not undone.isdisjoint(task.needs):
            undone.add(task.key)
            continue
        outcomes.append(outcome_of(task))
        if not outcomes[-1].ok:
            undone.add(task.key)
    return outcomes
