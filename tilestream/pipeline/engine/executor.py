"""How tasks run: one by one in this process, or on Dask, with the same outcomes."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from tilestream.pipeline.engine.attempt import Outcome, attempt
from tilestream.pipeline.engine.dask_executor import DaskNames, run_on_dask
from tilestream.pipeline.engine.events import dashboard_client
from tilestream.pipeline.engine.frontier import RETRIES, Frontier
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


def execute(
    plan: Plan,
    client: Any | None,
    watch: Watch | None,
    *,
    grow: Grow | None = None,
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
        client: a Dask client; None: one by one in this process.
        watch: is told of each outcome.
        grow: adds tasks to the plan while it runs.
        shared: folders and stores that all workers must see, also those that come later.
        inputs: files that they all must see.
        retries: how often a task is tried again.
        patience: how long to wait for a worker while the scheduler has none [s].

    Returns:
        The outcomes in the order of the tasks, whatever the order in which they ended.

    Raises:
        UsageError: an asynchronous client, or a worker that does not see what is shared.
        TaskError: the scheduler was lost, or has had no worker for too long. What is done is
            marked: the same command continues.
    """
    if client is not None:
        require_blocking(client)
    frontier, names = Frontier(retries), DaskNames()
    work: dict[str, int] = {}
    total: Counter[str] = Counter()
    done: Counter[str] = Counter()
    ended: dict[str, Outcome] = {}
    with ExitStack() as stack:
        if client is None:
            running, page = _run_here(frontier, plan.memory), None
        else:
            meet = partial(require_seen, client, shared, inputs)
            running = run_on_dask(frontier, client, names, plan.memory, patience, meet)
            page = stack.enter_context(dashboard_client(client, names))

        def add(tasks: Iterable[Task]) -> None:
            more = list(tasks)
            frontier.add(more)
            for task in more:
                work[task.key] = task.work
                total[task.stage] += task.work
            if page is not None and more:
                page.plan(more)

        add(plan.tasks)
        for outcome in running:
            ended[outcome.key] = outcome
            done[outcome.stage] += work[outcome.key]
            if page is not None:
                page.learn(outcome)
            if watch is not None:
                watch(outcome, done[outcome.stage], total[outcome.stage])
            if grow is not None:
                add(grow(outcome))
    return [ended[key] for key in work]


def _run_here(frontier: Frontier, memory: int) -> Iterator[Outcome]:
    while not frontier.idle:
        yield from frontier.refusals()
        if (task := frontier.take()) is not None:
            yield from frontier.learn(attempt(task, memory))
