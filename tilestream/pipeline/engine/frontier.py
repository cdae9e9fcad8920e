"""Which tasks may run now, as outcomes come in."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice

from tilestream.errors import NOT_RUN
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.stage import Task

RETRIES = 2
"""How often a task is tried again whose failure may be passing."""
LOOK_AHEAD = 64
"""Tasks among which one is looked for whose stage is not held by its first task."""


class Frontier:
    """The tasks that may run now, as outcomes come in.

    What others wait for comes in the order of the plan; what has just become possible comes first,
    so that a tile goes through all stages while its neighbourhood is at hand, and no stage waits
    for the end of another. A stage begins with one task alone: it compiles the stage's kernels for
    all workers that share a cache, while others begin with other stages.
    """

    def __init__(self, retries: int = RETRIES) -> None:
        self._tasks: dict[str, Task] = {}  # those that have not ended
        self._retries = retries
        self._tries: Counter[str] = Counter()
        self._begun: set[str] = set()
        self._tried: set[str] = set()
        self._ready: deque[Task] = deque()
        self._open: dict[str, int] = {}
        self._after: dict[str, list[Task]] = {}
        self._failed: dict[str, Outcome] = {}
        self._refused: deque[Outcome] = deque()

    def add(self, tasks: Iterable[Task]) -> None:
        """Take more tasks, each after those that it needs; a need that is not known is done.

        Those that may run at once come first, in their order: they have just become possible.
        """
        ready: list[Task] = []
        for task in tasks:
            all_needs = task.needs
            failed = [self._failed[need] for need in all_needs if need in self._failed]
            if failed:
                self._refused.append(self._refuse(task, failed[0]))
                continue
            self._tasks[task.key] = task
            needs = self._tasks.keys() & set(all_needs)
            if needs:
                self._open[task.key] = len(needs)
            else:
                ready.append(task)
            for need in needs:
                self._after.setdefault(need, []).append(task)
        self._ready.extendleft(reversed(ready))

    @property
    def idle(self) -> bool:
        """Whether nothing is left to run or to tell, but for what others run."""
        return not self._ready and not self._refused

    @property
    def left(self) -> int:
        """How many tasks have not ended, those that run included."""
        return len(self._tasks)

    def sifted(self, found: Callable[[Task], Outcome | None]) -> Iterator[Outcome]:
        """The outcomes of the tasks that need not run, and may be looked for by now.

        Args:
            found: the outcome of a task whose work is done already; None: it has to run.
        """
        to_run: list[Task] = []
        while self._ready:
            task = self._ready.popleft()
            outcome = found(task)
            if outcome is None:
                to_run.append(task)
            else:
                yield from self.learn(outcome)
        self._ready.extend(to_run)

    def refusals(self) -> Iterator[Outcome]:
        """The outcomes of tasks that were refused as they came."""
        while self._refused:
            yield self._refused.popleft()

    def take(self) -> Task | None:
        """The next task that may run; None where none may until another one has ended."""
        for place, task in enumerate(islice(self._ready, LOOK_AHEAD)):
            if task.stage in self._tried or task.stage not in self._begun:
                self._begun.add(task.stage)
                del self._ready[place]
                return task
        return None

    def tries(self, key: str) -> int:
        """How often a task has failed so far."""
        return self._tries[key]

    def learn(self, outcome: Outcome) -> Iterator[Outcome]:
        """Note an outcome; give what is certain now.

        That is the outcome itself, unless the task is to be tried again, and those of the tasks
        that cannot run any more because of it.
        """
        self._tried.add(outcome.stage)
        if outcome.passing and self._tries[outcome.key] < self._retries:
            self._tries[outcome.key] += 1
            self._ready.append(self._tasks[outcome.key])
            return
        if outcome.passing:
            reason = f"{outcome.reason} (tried {1 + self._tries[outcome.key]} times)"
            outcome = replace(outcome, reason=reason)
        certain = deque([outcome])
        while certain:
            known = certain.popleft()
            self._tasks.pop(known.key, None)
            after = self._after.pop(known.key, [])
            if known.ok:
                self._ready.extendleft(reversed([task for task in after if self._free(task)]))
            else:
                self._failed[known.key] = known
                certain.extend(self._refuse(task, known) for task in after if self._drop(task))
            yield known

    def _free(self, task: Task) -> bool:
        """Whether the last open need of a task has just been met."""
        left = self._open.get(task.key, 0) - 1
        if left > 0:
            self._open[task.key] = left
        return left == 0 and self._drop(task)

    def _drop(self, task: Task) -> bool:
        """Whether a task was still waiting; it does not wait any more."""
        return self._open.pop(task.key, None) is not None

    def _refuse(self, task: Task, need: Outcome) -> Outcome:
        reason = need.reason
        if not need.refused:
            reason = f"{NOT_RUN}{need.key} failed: {reason}"
        refused = self._failed[task.key] = Outcome(task.key, task.stage, reason=reason)
        return refused
