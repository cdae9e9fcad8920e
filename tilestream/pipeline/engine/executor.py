"""How tasks run: one by one in this process, or on Dask, with the same outcomes."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from tilestream.pipeline.engine.attempt import Outcome, attempt, found
from tilestream.pipeline.engine.dask_executor import DaskNames, run_on_dask
from tilestream.pipeline.engine.events import DashboardClient, dashboard_client
from tilestream.pipeline.engine.frontier import RETRIES, Frontier
from tilestream.pipeline.engine.late_client import LateClient
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.seen import require_blocking, require_seen
from tilestream.pipeline.engine.stage import Task

PATIENCE = 600.0
"""How long a scheduler may be without any worker before the run is given up [s]."""

Watch = Callable[[Outcome, int, int], None]
"""Called after each task: its outcome, how much of its stage has ended, how much that is in all
(in what the stage counts: tiles, scans, points)."""
Grow = Callable[[Outcome], Iterable[Task]]
"""Called after each task: what is to be done besides, now that its outcome is known."""
Ahead = Callable[[], Sequence[Task] | None]
"""Called as the plan grows: tasks that it will have in the end, those that it has among them or
not; None: not known yet. An answer that has not changed is the same object."""


def execute(
    plan: Plan,
    client: Any | None,
    watch: Watch | None,
    *,
    grow: Grow | None = None,
    ahead: Ahead | None = None,
    shared: Sequence[str] = (),
    inputs: Sequence[str] = (),
    retries: int = RETRIES,
    patience: float = PATIENCE,
) -> list[Outcome]:
    """Run tasks, each as soon as those that it needs are done.

    A task that failed for a passing reason (a lost worker, the disk, the network, memory) is tried
    again after the others. A task whose need failed is not run: its outcome says which need and
    why. Everything else is finished.

    Args:
        plan: what to run; a need that is not among its tasks counts as done.
        client: a Dask client, maybe a late one, which is made when there is something to do;
            None: one by one in this process.
        watch: is told of each outcome.
        grow: adds tasks to the plan while it runs.
        ahead: tells what it will have added in the end, for the time left on the dashboard.
        shared: folders and stores that all workers must see, also those that come later.
        inputs: files that they all must see.
        retries: how often a task is tried again.
        patience: how long to wait for a worker while the scheduler has none [s].

    Returns:
        The outcomes in the order of the tasks, whatever the order in which they ended.

    Raises:
        UsageError: an asynchronous client, a worker that does not see what is shared, or that may
            use less memory than a task.
        TaskError: the scheduler was lost, or has had no worker for too long. What is done is
            marked: the same command continues.
    """
    run = _Run(plan.tasks, watch, grow, ahead, Frontier(retries))
    if client is None:
        run.hear(_run_here(run.frontier, plan.memory))
        return run.outcomes
    if isinstance(client, LateClient):  # it stays unmade where all is done already
        run.hear(run.frontier.sifted(found))
        run.hear(run.frontier.refusals())
        if not run.frontier.left:
            return run.outcomes
        client = client.for_tasks(run.frontier.left if grow is None else client.most)
    names = DaskNames()
    require_blocking(client)
    meet = partial(require_seen, client, shared, inputs, memory=plan.memory)
    with dashboard_client(client, names, shared) as page:
        run.show(page)
        run.hear(run_on_dask(run.frontier, client, names, plan.memory, patience, meet))
    return run.outcomes


class _Run:
    """What a run knows of its tasks while they end, wherever that is."""

    def __init__(
        self,
        tasks: Iterable[Task],
        watch: Watch | None,
        grow: Grow | None,
        ahead: Ahead | None,
        frontier: Frontier,
    ) -> None:
        self.frontier = frontier
        self._watch, self._grow = watch, grow
        self._ahead: Ahead = ahead or (lambda: None if grow else ())
        self._page: DashboardClient | None = None
        self._tasks: dict[str, Task] = {}
        self._ended: dict[str, Outcome] = {}
        self._total: Counter[str] = Counter()
        self._done: Counter[str] = Counter()
        self._add(tasks)

    @property
    def outcomes(self) -> list[Outcome]:
        """In the order of the tasks."""
        return [self._ended[key] for key in self._tasks]

    def show(self, page: DashboardClient) -> None:
        """From now on, tell a page what it is told here; first, what has been so far."""
        self._page = page
        page.plan(list(self._tasks.values()))
        page.expect(self._ahead())
        for outcome in self._ended.values():
            page.learn(outcome, self._tasks[outcome.key])

    def hear(self, outcomes: Iterable[Outcome]) -> None:
        """Take outcomes as they come, and add the tasks that they lead to."""
        for outcome in outcomes:
            self._ended[outcome.key] = outcome
            self._done[outcome.stage] += self._tasks[outcome.key].work
            if self._page is not None:
                self._page.learn(outcome, self._tasks[outcome.key])
            if self._watch is not None:
                self._watch(outcome, self._done[outcome.stage], self._total[outcome.stage])
            if self._grow is not None:
                self._add(self._grow(outcome))

    def _add(self, tasks: Iterable[Task]) -> None:
        more = list(tasks)
        self.frontier.add(more)
        for task in more:
            self._tasks[task.key] = task
            self._total[task.stage] += task.work
        if self._page is not None and more:
            self._page.plan(more)
            self._page.expect(self._ahead())


def _run_here(frontier: Frontier, memory: int) -> Iterator[Outcome]:
    while not frontier.idle:
        yield from frontier.refusals()
        if (task := frontier.take()) is not None:
            yield from frontier.learn(attempt(task, memory))
