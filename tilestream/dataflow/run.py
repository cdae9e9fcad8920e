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
    run = _run_on_dask(client) if client is not None else _run_here
    for outcome in run(tasks, ended):
        ended[outcome.key] = outcome
        done[outcome.stage] += work[outcome.key]
        if watch is not None:
            watch(outcome, done[outcome.stage], total[outcome.stage])
    return [ended[task.key] for task in tasks]


def _refusal(task: Task, ended: dict[str, Outcome]) -> Outcome | None:
    """The outcome of a task whose need failed; None where it may run."""
    for need in task.needs:
        if need in ended and not ended[need].ok:
            reason = f"not run, since {need} failed: {ended[need].reason}"
            return Outcome(task.key, task.stage, None, reason)
    return None


def _run_here(tasks: Sequence[Task], ended: dict[str, Outcome]) -> Iterator[Outcome]:
    for task in tasks:
        yield _refusal(task, ended) or attempt(task)


def _run_on_dask(
    client: Any,
) -> Callable[[Sequence[Task], dict[str, Outcome]], Iterator[Outcome]]:
    def run(tasks: Sequence[Task], ended: dict[str, Outcome]) -> Iterator[Outcome]:
        keys = {task.key for task in tasks}
        waiting = deque(tasks)
        running = distributed.as_completed(loop=client.loop)
        by_future: dict[str, Task] = {}
        here = uuid.uuid4().hex[:8]  # so that two runs on one scheduler never share a key
        while waiting or by_future:
            window = IN_FLIGHT_PER_THREAD * max(1, sum(client.nthreads().values()))
            for _ in range(len(waiting)):
                if len(by_future) >= window:
                    break
                task = waiting.popleft()
                refusal = _refusal(task, ended)
                if refusal is not None:
                    yield refusal
                elif all(need in ended or need not in keys for need in task.needs):
                    stage, name = task.key.split("-", 1)
                    future = client.submit(attempt, task, key=f"{stage}-{here}-{name}")
                    by_future[future.key] = task
                    running.add(future)
                else:
                    waiting.append(task)
            if by_future:
                future = next(running)
                yield _outcome(by_future.pop(future.key), future)
                future.release()

    return run


def _outcome(task: Task, future: Any) -> Outcome:
    """What became of a task on Dask; a worker that was lost too often is a failure too."""
    if future.status == "finished":
        outcome: Outcome = future.result()
        return outcome
    return Outcome(task.key, task.stage, None, f"{task.key} was lost: {future.exception()}")


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
                env={"NUMBA_NUM_THREADS": "1"},
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
    else:
        yield None
