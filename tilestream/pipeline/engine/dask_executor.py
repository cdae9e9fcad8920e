"""Tasks on Dask: a bounded number at a time, under readable keys, whatever becomes of workers."""

import logging
import queue
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import distributed
from dask.base import annotate, get_annotations
from distributed.comm.core import CommClosedError

from tilestream.errors import TaskError
from tilestream.pipeline.engine.attempt import Outcome, attempt_all, in_turn
from tilestream.pipeline.engine.frontier import Frontier
from tilestream.pipeline.engine.stage import Task

logger = logging.getLogger(__name__)

IN_FLIGHT_PER_THREAD = 4
"""Dask's tasks, each some of ours that travel together, that it has at a time, per thread of its
workers."""
PER_MESSAGE = 200
"""Dask's tasks that are handed over in a message, at most."""
LOOK_EVERY = 2.0
"""How often the scheduler is asked for its workers [s]."""
ANSWER_WITHIN = 30.0
"""How long a scheduler may take to answer before it is taken for lost [s]."""
RESULT_WITHIN = 5.0
"""How long a result of a task that has ended is waited for before a look at the scheduler [s]."""
Tasks = tuple[Task, ...]
"""Tasks that travel together."""
OURS = "ts0"
"""How the part of a Dask key begins that names the run."""


class DaskNames:
    """The Dask keys of one run's tasks: `factors-ts0a1b2c-12_3` of `factors-12_3`.

    Stage and tile stay readable, and two runs on one scheduler share no key.
    """

    def __init__(self) -> None:
        self._run = f"{OURS}{uuid.uuid4().hex[:5]}"

    def __call__(self, key: str) -> str:
        """The Dask key of a task, from its own."""
        stage, name = key.split("-", 1)
        return f"{stage}-{self._run}-{name}"


def run_on_dask(
    frontier: Frontier,
    client: Any,
    names: DaskNames,
    memory: int,
    patience: float,
    meet: Callable[[Sequence[str]], None],
) -> Iterator[Outcome]:
    """The outcomes of all tasks as they end, with a bounded number of them at Dask at any time.

    `meet` is called with the addresses of workers before they are counted on, and raises what is
    wrong with them: one that fails at once would take one task after the other.
    """
    workers = _Workers(client, patience, meet)
    workers.threads()
    workers.wait_for_orphans()
    submit = _Submitter(client, names, memory)
    running: dict[str, tuple[Tasks, Any]] = {}
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
    while running or not frontier.idle:
        yield from frontier.refusals()
        window = IN_FLIGHT_PER_THREAD * max(1, workers.threads())
        share = frontier.ready // window
        batch: list[Tasks] = []
        while len(running) + len(batch) < window and (tasks := frontier.take_together(share)):
            batch.append(tasks)
        for tasks, future in submit(batch, frontier.tries):
            running[future.key] = tasks, future
            future.add_done_callback(ended.put)
        over = _drain(ended) if running else []
        results = _gathered(over, client)
        for future in over:
            tasks, _ = running[future.key]
            outcomes = results.get(future.key) or _outcomes(tasks, future, workers)
            if outcomes is None:
                future.add_done_callback(ended.put)
            else:
                del running[future.key]
                future.release()
                yield from frontier.learn_together(tasks, outcomes)


def _drain(ended: "queue.SimpleQueue[Any]") -> list[Any]:
    """What has ended by now; waits for the first a little."""
    found = []
    with suppress(queue.Empty):
        found.append(ended.get(timeout=LOOK_EVERY))
        while True:
            found.append(ended.get_nowait())
    return found


def _gathered(futures: Sequence[Any], client: Any) -> dict[str, list[Outcome]]:
    """The outcomes by Dask key of those futures that give one at once, in one request."""
    whole = [future for future in futures if future.status == "finished"]
    gather = partial(client.gather, whole, asynchronous=True)
    try:
        results = client.sync(gather, callback_timeout=RESULT_WITHIN)
    except Exception:  # noqa: BLE001 - one of them was lost: each is asked for by itself
        return {}
    return dict(zip([future.key for future in whole], results, strict=True))


class _Submitter:
    """Hands tasks to Dask under readable keys, each stage in a span of its own."""

    def __init__(self, client: Any, names: DaskNames, memory: int) -> None:
        self._client = client
        self._names = names
        self._memory = memory
        self._spans: dict[str, Any] = {}

    def __call__(
        self, batch: Iterable[Tasks], tries: Callable[[str], int]
    ) -> Iterator[tuple[Tasks, Any]]:
        """Tasks that travel together, each with the future of its outcomes, which has the name of
        the first of them.

        One message for many: it costs a scheduler as much as one for a single task.

        Args:
            batch: tasks that travel together, of whichever stages.
            tries: how often the task of a key has failed.
        """
        of_stage: dict[str, list[Tasks]] = {}
        for tasks in batch:
            of_stage.setdefault(tasks[0].stage, []).append(tasks)
        for stage, some in of_stage.items():
            keys = [self._key(tasks[0].key, tries(tasks[0].key)) for tasks in some]
            how = {"memory": self._memory, "pure": False, "batch_size": PER_MESSAGE}
            with annotate(span=self._span(stage)):
                futures = self._client.map(attempt_all, some, key=keys, **how)
            yield from zip(some, futures, strict=True)

    def _key(self, key: str, tries: int) -> str:
        return self._names(key) + (f"#{tries + 1}" if tries else "")

    def _span(self, stage: str) -> Any:
        if stage not in self._spans:
            with distributed.span("tilestream", stage):
                self._spans[stage] = get_annotations()["span"]
        return self._spans[stage]


def _outcomes(tasks: Tasks, future: Any, workers: "_Workers") -> list[Outcome] | None:
    """What became of tasks on Dask; None where their result was lost and they run once more.

    A worker that was lost too often is a failure too, and may be passing: it may have died of
    another task. A result that was lost with its worker is waited for: Dask does the tasks again,
    which finds their work marked as done.
    """
    try:
        outcomes: list[Outcome] = future.result(timeout=RESULT_WITHIN)
    except TimeoutError:
        workers.require_scheduler()
        return None
    except Exception as error:  # noqa: BLE001 - `attempt` never raises, so this is Dask's own
        workers.require_scheduler()
        reason = f"lost by Dask: {error or future.status}"
        return in_turn(
            tasks, lambda task: Outcome(task.key, task.stage, reason=reason, passing=True)
        )
    return outcomes


class _Workers:
    """The workers of a scheduler: how many threads they have, and whether anybody is there."""

    def __init__(self, client: Any, patience: float, meet: Callable[[Sequence[str]], None]) -> None:
        self._client = client
        self._patience = patience
        self._meet = meet
        self._met: set[str] = set()
        self._address = client.scheduler.address
        self._threads = 0
        self._asked = -LOOK_EVERY
        self._seen = time.monotonic()
        self._told = False

    def threads(self) -> int:
        """Threads of all workers, at most a few seconds old.

        Raises:
            TaskError: the scheduler is lost, or has had no worker for longer than the patience.
            UsageError: a new one cannot be used.
        """
        now = time.monotonic()
        if now - self._asked < LOOK_EVERY:
            return self._threads
        self.require_scheduler()
        try:
            found = self._client.sync(self._client.scheduler.ncores, callback_timeout=ANSWER_WITHIN)
        except (OSError, TimeoutError, CommClosedError):
            raise self._lost() from None
        new = sorted(set(found) - self._met)
        if new:
            self._met.update(new)
            self._meet(new)
        self._asked, self._threads = now, sum(found.values())
        if self._threads:
            self._seen, self._told = now, False
        elif not self._told:
            self._told = True
            logger.info(
                "the scheduler at %s has no worker: waiting %.0f s for one",
                self._address,
                self._patience,
            )
        elif now - self._seen > self._patience:
            raise TaskError(
                f"the scheduler at {self._address} has had no worker for {self._patience:.0f} s: "
                "start workers, then run the same command again; it continues where it was"
            )
        return self._threads

    def require_scheduler(self) -> None:
        """Refuse to go on without the scheduler.

        Raises:
            TaskError: the client has lost it.
        """
        if self._client.status != "running":
            raise self._lost()

    def wait_for_orphans(self) -> None:
        """Wait until no worker is busy with a task of a run whose client is gone.

        It cannot be stopped, and would write the same tile as this run does.

        Raises:
            TaskError: the scheduler is lost, or a worker has not answered for the patience.
        """
        answered, told = time.monotonic(), ""
        while (busy := self._orphans()) != []:
            if busy is not None:
                answered = time.monotonic()
                awaited = f"{', '.join(busy)} of an earlier run to end"
            elif time.monotonic() - answered < self._patience:
                awaited = "a worker that is busy and does not answer yet"
            else:
                raise TaskError(
                    f"a worker of the scheduler at {self._address} has not answered for "
                    f"{self._patience:.0f} s: restart it, then run the same command again"
                )
            if awaited != told:
                logger.info("waiting for %s", awaited)
                told = awaited
            time.sleep(0.2)

    def _orphans(self) -> list[str] | None:
        """Keys of tasks of ours that nobody wants any more; None: a worker does not answer."""
        self.require_scheduler()
        within = min(RESULT_WITHIN, self._patience)
        try:
            found = self._client.run(_orphans, on_error="ignore", callback_timeout=within)
        except TimeoutError:
            return None
        except (OSError, CommClosedError):
            raise self._lost() from None
        return sorted(key for keys in found.values() for key in keys)

    def _lost(self) -> TaskError:
        return TaskError(
            f"the Dask scheduler at {self._address} is gone: run the same command again, with a "
            "scheduler that runs; what is done is marked, and it continues where it was"
        )


def _orphans(dask_worker: Any) -> list[str]:
    """Keys of the tasks of ours that a worker still runs although nobody wants them any more."""
    return [
        str(task.key)
        for task in dask_worker.state.executing
        if task.state == "cancelled" and f"-{OURS}" in str(task.key)
    ]
