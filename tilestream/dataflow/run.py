"""How tasks run: one by one in this process, or on Dask, with the same outcomes."""

import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import distributed

from tilestream.dataflow.plan import Task
from tilestream.dataflow.tasks import Outcome, attempt

IN_FLIGHT_PER_THREAD = 4
"""Tasks handed to Dask at a time, per thread of its workers."""

Watch = Callable[[Outcome, int, int], None]
"""Called after each task: its outcome, how much of its stage has ended, how much that is in all
(in what the stage counts: tiles, scans, points)."""


def execute(tasks: Sequence[Task], client: Any | None, watch: Watch | None) -> list[Outcome]:
    """Run tasks, each as soon as those that it needs are done.

    A task whose need failed is not run: its outcome says which need and why. Everything else is
    finished.

    Args:
        tasks: each after the tasks that it needs; a need that is not among them counts as done.
        client: a Dask client; None: one by one in this process.
        watch: is told of each outcome.

    Returns:
        The outcomes in the order of the tasks, whatever the order in which they ended.
    """
    ended: dict[str, Outcome] = {}
    work = {task.key: task.work for task in tasks}
    total: Counter[str] = Counter()
    done: Counter[str] = Counter()
    for task in tasks:
        total[task.stage] += task.work
    frontier = Frontier(tasks)
    for outcome in _run_here(frontier) if client is None else _run_on_dask(frontier, client):
        ended[outcome.key] = outcome
        done[outcome.stage] += work[outcome.key]
        if watch is not None:
            watch(outcome, done[outcome.stage], total[outcome.stage])
    return [ended[task.key] for task in tasks]


class Frontier:
    """The tasks that may run now, in their order, as outcomes come in."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        keys = {task.key for task in tasks}
        self._ready: deque[Task] = deque()
        self._open: dict[str, int] = {}
        self._after: dict[str, list[Task]] = {}
        for task in tasks:
            needs = keys.intersection(task.needs)
            self._open[task.key] = len(needs)
            for need in needs:
                self._after.setdefault(need, []).append(task)
            if not needs:
                self._ready.append(task)

    def take(self) -> Task | None:
        """The next task that may run; None where none may until another one has ended."""
        return self._ready.popleft() if self._ready else None

    def learn(self, outcome: Outcome) -> Iterator[Outcome]:
        """Note an outcome; give those of the tasks that cannot run any more because of it."""
        for task in self._after.pop(outcome.key, []):
            if self._open[task.key] < 0:
                continue
            if outcome.ok:
                self._open[task.key] -= 1
                if self._open[task.key] == 0:
                    self._ready.append(task)
            else:
                self._open[task.key] = -1
                reason = f"not run, since {outcome.key} failed: {outcome.reason}"
                refused = Outcome(task.key, task.stage, None, reason)
                yield refused
                yield from self.learn(refused)


def _run_here(frontier: Frontier) -> Iterator[Outcome]:
    while (task := frontier.take()) is not None:
        outcome = attempt(task)
        yield outcome
        yield from frontier.learn(outcome)


def _run_on_dask(frontier: Frontier, client: Any) -> Iterator[Outcome]:
    running = distributed.as_completed(loop=client.loop)
    by_future: dict[str, Task] = {}
    here = uuid.uuid4().hex[:8]  # so that two runs on one scheduler never share a key
    while True:
        window = IN_FLIGHT_PER_THREAD * max(1, sum(client.nthreads().values()))
        while len(by_future) < window and (task := frontier.take()) is not None:
            stage, name = task.key.split("-", 1)
            future = client.submit(attempt, task, key=f"{stage}-{here}-{name}")
            by_future[future.key] = task
            running.add(future)
        if not by_future:
            return
        future = next(running)
        outcome = _outcome(by_future.pop(future.key), future)
        future.release()
        yield outcome
        yield from frontier.learn(outcome)


def _outcome(task: Task, future: Any) -> Outcome:
    """What became of a task on Dask; a worker that was lost too often is a failure too.

    A result that was lost with its worker is waited for: Dask does the task again, which finds its
    work marked as done.
    """
    try:
        outcome: Outcome = future.result()
    except Exception as error:  # noqa: BLE001 - `attempt` never raises, so this is Dask's own
        return Outcome(task.key, task.stage, None, f"lost by Dask: {error or future.status}")
    return outcome


@contextmanager
def dask_client(scheduler: str | None, workers: int, memory: int) -> Iterator[Any | None]:
    """A Dask client, or None where the tasks run in this process.

    Args:
        scheduler: address of a running scheduler, e.g. `tcp://10.0.0.1:8786`; None: a local one.
        workers: worker processes of the local cluster, one thread each, listening on loopback
            only; 1 without a scheduler: no cluster, this process does the work.
        memory: what a worker may use before Dask restarts it [bytes], twice the tasks' promise.
    """
    if scheduler is not None:
        with distributed.Client(scheduler) as client:
            yield client
    elif workers > 1:
        with (
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=2 * memory,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                env={"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
    else:
        yield None
