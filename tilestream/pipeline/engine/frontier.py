"""Which tasks may run now, as outcomes come in."""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from itertools import islice

from tilestream.errors import NOT_RUN
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.engine.time_left import Pace

RETRIES = 2
"""How often a task is tried again whose failure may be passing."""
LOOK_AHEAD = 64
"""Tasks among which one is looked for whose stage is not held by its first task."""
MOST_TOGETHER = 16
"""Tasks that travel together, at most."""
SECONDS_TOGETHER = 1.0
"""How long tasks may take that travel together, about [s]: what is free by the first of them waits
for the last, and so does who watches."""


class Frontier:
    """The tasks that may run now, as outcomes come in.

    What others wait for comes in the order of the plan; what has just become possible comes first,
    so that a tile goes through all stages while its neighbourhood is at hand, and no stage waits
    for the end of another. A stage begins with one task alone: it compiles the stage's kernels for
    all workers that share a cache, while others begin with other stages. Short tasks travel
    together: what a scheduler does costs as much for one as for many.
    """

    def __init__(self, retries: int = RETRIES) -> None:
        self._tasks: dict[str, Task] = {}  # those that have not ended
        self._retries = retries
        self._tries: Counter[str] = Counter()
        self._begun: set[str] = set()
        self._tried: set[str] = set()
        self._paces: dict[str, Pace] = {}
        self._ahead: set[str] = set()  # keys of those that were taken before they were free
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
    def ready(self) -> int:
        """How many tasks may run now."""
        return len(self._ready)

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

    def take_together(self, share: int) -> tuple[Task, ...]:
        """The next tasks that one worker may run in turn: one that may run, what becomes possible
        by it, and others that may run; none where none may until another one has ended.

        Only short ones travel together, and none that has failed before: it may kill its worker.

        Args:
            share: how many of those that may run now one worker may take.
        """
        together: list[Task] = []
        freed: deque[Task] = deque()
        met: Counter[str] = Counter()
        left, task = SECONDS_TOGETHER, self.take()
        if task is not None and (task.stage not in self._tried or self._tries[task.key]):
            return (task,)
        while task is not None:
            together.append(task)
            left -= self._seconds(task)
            for after in self._after.get(task.key, ()):
                met[after.key] += 1
                if met[after.key] == self._open.get(after.key):
                    freed.append(after)
            if len(together) == MOST_TOGETHER:
                break
            task = self._short(freed, left)
            if task is not None:
                self._ahead.add(task.key)
            elif share > 1:
                task, share = self._short(self._ready, left), share - 1
        return tuple(together)

    def _short(self, some: deque[Task], seconds: float) -> Task | None:
        """The first of some tasks that may travel with others, and takes so long at most [s]."""
        for place, task in enumerate(islice(some, LOOK_AHEAD)):
            tried = task.stage in self._tried and not self._tries[task.key]
            if tried and self._seconds(task) <= seconds:
                del some[place]
                return task
        return None

    def _seconds(self, task: Task) -> float:
        """How long a task takes, about."""
        return self._pace(task).per_work() * task.work

    def _pace(self, task: Task) -> Pace:
        return self._paces.setdefault(task.stage, Pace(task.applies.seconds))

    def tries(self, key: str) -> int:
        """How often a task has failed so far."""
        return self._tries[key]

    def learn(self, outcome: Outcome) -> Iterator[Outcome]:
        """Note an outcome; give what is certain now.

        That is the outcome itself, unless the task is to be tried again, and those of the tasks
        that cannot run any more because of it.
        """
        self._tried.add(outcome.stage)
        if outcome.made:
            task = self._tasks[outcome.key]
            self._pace(task).learn(task.work, outcome.seconds)
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

    def learn_together(
        self, together: Collection[Task], outcomes: Iterable[Outcome]
    ) -> Iterator[Outcome]:
        """Note the outcomes of tasks that travelled together, of each after those that it needs;
        one that has none, since one that it needs failed, waits again.
        """
        for outcome in outcomes:
            yield from self.learn(outcome)
        self._ahead.difference_update(task.key for task in together)

    def _free(self, task: Task) -> bool:
        """Whether the last open need of a task has just been met, and nobody runs it yet."""
        left = self._open.get(task.key, 0) - 1
        if left > 0:
            self._open[task.key] = left
        return left == 0 and self._drop(task) and task.key not in self._ahead

    def _drop(self, task: Task) -> bool:
        """Whether a task was still waiting; it does not wait any more."""
        return self._open.pop(task.key, None) is not None

    def _refuse(self, task: Task, need: Outcome) -> Outcome:
        reason = need.reason
        if not need.refused:
            reason = f"{NOT_RUN}{need.key} failed: {reason}"
        refused = self._failed[task.key] = Outcome(task.key, task.stage, reason=reason)
        return refused
