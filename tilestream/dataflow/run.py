"""How tasks run: one by one in this process, or on Dask, with the same outcomes."""

import logging
import os
import queue
import signal
import ssl
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import dask.config
import distributed
from dask.base import annotate, get_annotations
from dask.system import CPU_COUNT
from distributed.comm.core import CommClosedError
from distributed.utils import silence_logging_cmgr

from tilestream.dataflow.plan import Task, megabytes
from tilestream.dataflow.tasks import NOT_RUN, Outcome, attempt
from tilestream.dataflow.telling import telling
from tilestream.errors import TaskError, UsageError

logger = logging.getLogger(__name__)

RETRIES = 2
"""How often a task is tried again whose failure may be passing."""
PATIENCE = 600.0
"""How long a scheduler may be without any worker before the run is given up [s]."""
LOOK_AHEAD = 64
"""Tasks among which one is looked for whose stage is not held by its first task."""
IN_FLIGHT_PER_THREAD = 4
"""Tasks handed to Dask at a time, per thread of its workers."""
LOOK_EVERY = 2.0
"""How often the scheduler is asked for its workers [s]."""
ANSWER_WITHIN = 30.0
"""How long a scheduler may take to answer before it is taken for lost [s]."""
RESULT_WITHIN = 5.0
"""How long a result of a task that has ended is waited for before a look at the scheduler [s]."""
OURS = "ts0"
"""How the part of a Dask key begins that names the run."""
LOOPBACK = "127.0.0.1"
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OPENBLAS", "OMP", "MKL", "VECLIB")
}
"""Environment of a worker: its process is its one thread."""

Watch = Callable[[Outcome, int, int], None]
"""Called after each task: its outcome, how much of its stage has ended, how much that is in all
(in what the stage counts: tiles, scans, points)."""


def execute(
    tasks: Sequence[Task],
    client: Any | None,
    watch: Watch | None,
    *,
    retries: int = RETRIES,
    patience: float = PATIENCE,
) -> list[Outcome]:
    """Run tasks, each as soon as those that it needs are done.

    A task that failed for a passing reason (a lost worker, the disk, the network, memory) is tried
    again after the others. A task whose need failed is not run: its outcome says which need and
    why. Everything else is finished.

    Args:
        tasks: each after the tasks that it needs; a need that is not among them counts as done.
        client: a Dask client; None: one by one in this process.
        watch: is told of each outcome.
        retries: how often a task is tried again.
        patience: how long to wait for a worker while the scheduler has none [s].

    Returns:
        The outcomes in the order of the tasks, whatever the order in which they ended.

    Raises:
        TaskError: the scheduler was lost, or has had no worker for too long. What is done is
            marked: the same command continues.
    """
    ended: dict[str, Outcome] = {}
    work = {task.key: task.work for task in tasks}
    total: Counter[str] = Counter()
    done: Counter[str] = Counter()
    for task in tasks:
        total[task.stage] += task.work
    frontier = Frontier(tasks, retries)
    names = DaskNames()
    with ExitStack() as stack:
        if client is None:
            running, tell = _run_here(frontier), None
        else:
            running = _run_on_dask(frontier, client, names, patience)
            tell = stack.enter_context(telling(client, tasks, names))
        for outcome in running:
            ended[outcome.key] = outcome
            done[outcome.stage] += work[outcome.key]
            if tell is not None:
                tell(outcome)
            if watch is not None:
                watch(outcome, done[outcome.stage], total[outcome.stage])
    return [ended[task.key] for task in tasks]


class Frontier:
    """The tasks that may run now, as outcomes come in.

    What others wait for comes in the order of the plan; what has just become possible comes first,
    so that a tile goes through all stages while its neighbourhood is at hand, and no stage waits
    for the end of another. A stage begins with one task alone: it compiles the stage's kernels for
    all workers that share a cache, while others begin with other stages.
    """

    def __init__(self, tasks: Sequence[Task], retries: int = RETRIES) -> None:
        self._tasks = {task.key: task for task in tasks}
        self._retries = retries
        self._tries: Counter[str] = Counter()
        self._begun: set[str] = set()
        self._tried: set[str] = set()
        self._ready: deque[Task] = deque()
        self._open: dict[str, int] = {}
        self._after: dict[str, list[Task]] = {}
        for task in tasks:
            needs = self._tasks.keys() & set(task.needs)
            if needs:
                self._open[task.key] = len(needs)
            else:
                self._ready.append(task)
            for need in needs:
                self._after.setdefault(need, []).append(task)

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
            after = self._after.pop(known.key, [])
            if known.ok:
                self._ready.extendleft(reversed([task for task in after if self._free(task)]))
            else:
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
        return Outcome(task.key, task.stage, None, reason)


def _run_here(frontier: Frontier) -> Iterator[Outcome]:
    while (task := frontier.take()) is not None:
        yield from frontier.learn(attempt(task))


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


def _run_on_dask(
    frontier: Frontier, client: Any, names: DaskNames, patience: float
) -> Iterator[Outcome]:
    """As `_run_here`, with a bounded number of tasks at Dask at any time."""
    workers = _Workers(client, patience)
    workers.wait_for_orphans()
    submit = _Submitter(client, names)
    running: dict[str, tuple[Task, Any]] = {}
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
    while True:
        window = IN_FLIGHT_PER_THREAD * max(1, workers.threads())
        while len(running) < window and (task := frontier.take()) is not None:
            future = submit(task, frontier.tries(task.key))
            running[future.key] = task, future
            future.add_done_callback(ended.put)
        if not running:
            return
        batch = _drain(ended)
        results = _gathered(batch, client)
        for future in batch:
            outcome = results.get(future.key) or _outcome(running[future.key][0], future, workers)
            if outcome is None:
                future.add_done_callback(ended.put)
            else:
                del running[future.key]
                future.release()
                yield from frontier.learn(outcome)


def _drain(ended: "queue.SimpleQueue[Any]") -> list[Any]:
    """What has ended by now; waits for the first a little."""
    found = []
    with suppress(queue.Empty):
        found.append(ended.get(timeout=LOOK_EVERY))
        while True:
            found.append(ended.get_nowait())
    return found


def _gathered(futures: Sequence[Any], client: Any) -> dict[str, Outcome]:
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

    def __init__(self, client: Any, names: DaskNames) -> None:
        self._client = client
        self._names = names
        self._spans: dict[str, Any] = {}

    def __call__(self, task: Task, tries: int) -> Any:
        """The future of a task that has failed `tries` times."""
        if task.stage not in self._spans:
            with distributed.span("tilestream", task.stage):
                self._spans[task.stage] = get_annotations()["span"]
        key = self._names(task.key) + (f"#{tries + 1}" if tries else "")
        with annotate(span=self._spans[task.stage]):
            return self._client.submit(attempt, task, key=key, pure=False)


def _outcome(task: Task, future: Any, workers: "_Workers") -> Outcome | None:
    """What became of a task on Dask; None where its result was lost and it runs once more.

    A worker that was lost too often is a failure too, and may be passing: it may have died of
    another task. A result that was lost with its worker is waited for: Dask does the task again,
    which finds its work marked as done.
    """
    try:
        outcome: Outcome = future.result(timeout=RESULT_WITHIN)
    except TimeoutError:
        workers.require_scheduler()
        return None
    except Exception as error:  # noqa: BLE001 - `attempt` never raises, so this is Dask's own
        workers.require_scheduler()
        reason = f"lost by Dask: {error or future.status}"
        return Outcome(task.key, task.stage, None, reason, passing=True)
    return outcome


class _Workers:
    """The workers of a scheduler: how many threads they have, and whether anybody is there."""

    def __init__(self, client: Any, patience: float) -> None:
        self._client = client
        self._patience = patience
        self._address = client.scheduler.address
        self._threads = 0
        self._asked = -LOOK_EVERY
        self._seen = time.monotonic()

    def threads(self) -> int:
        """Threads of all workers, at most a few seconds old.

        Raises:
            TaskError: the scheduler is lost, or has had no worker for longer than the patience.
        """
        now = time.monotonic()
        if now - self._asked < LOOK_EVERY:
            return self._threads
        self.require_scheduler()
        try:
            found = self._client.sync(self._client.scheduler.ncores, callback_timeout=ANSWER_WITHIN)
        except (OSError, TimeoutError, CommClosedError):
            raise self._lost() from None
        self._asked, self._threads = now, sum(found.values())
        if self._threads:
            self._seen = now
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


@dataclass(frozen=True)
class TlsFiles:
    """The certificates that client, scheduler and workers know each other by (PEM)."""

    ca: str
    """Path of the certificate of the authority that signed the others."""
    cert: str
    """Path of this cluster's certificate."""
    key: str
    """Path of its private key."""

    def security(self) -> Any:
        """As Dask takes them; nothing unencrypted is let in.

        Raises:
            UsageError: they cannot be read, or the key is not the certificate's.
        """
        try:
            ssl.create_default_context(cafile=self.ca).load_cert_chain(self.cert, self.key)
        except OSError as error:
            files = f"{self.ca}, {self.cert} and {self.key}"
            raise UsageError(f"{files} are no certificates that fit together: {error}") from error
        roles = ("client", "scheduler", "worker")
        named = {f"tls_{role}_cert": self.cert for role in roles}
        named |= {f"tls_{role}_key": self.key for role in roles}
        return distributed.Security(tls_ca_file=self.ca, require_encryption=True, **named)


class _DeafToInterrupts(distributed.WorkerPlugin):
    """Lets a worker of our own live through Ctrl-C, which a terminal sends to all its processes.

    The command ends, and takes its workers along; without them it would wait for others.
    """

    def setup(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """In a worker's main thread, also of one that was restarted."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def dask_client(
    scheduler: str | None,
    workers: int | None,
    memory: int,
    *,
    host: str = LOOPBACK,
    tls: TlsFiles | None = None,
) -> Iterator[Any | None]:
    """A Dask client, or None where the tasks run in this process.

    Args:
        scheduler: address of a running scheduler, e.g. `tcp://10.0.0.1:8786` or `tls://…`; None: a
            local one.
        workers: worker processes of the local cluster, one thread each; None: one per core; 1
            without a scheduler: no cluster, this process does the work.
        memory: what a task may use [bytes]. A worker of the local cluster is restarted when it
            comes near twice that: a broken promise ends in a reason, not in a machine that swaps.
        host: address that the local scheduler and its dashboard listen on.
        tls: certificates; None: as Dask's own configuration says (`distributed.comm.tls`).

    Raises:
        TaskError: nobody answers at the scheduler's address.
        UsageError: the scheduler's address is none, or certificates are missing or do not fit.
    """
    security = None if tls is None else tls.security()
    count = CPU_COUNT if workers is None else workers
    if scheduler is not None:
        logger.info("connecting to %s", scheduler)
        with silence_logging_cmgr(logging.CRITICAL), _connected(scheduler, security) as client:
            yield client
    elif count > 1:
        if host != LOOPBACK:
            risk = "run code here; use TLS, or a network that you trust"
            logger.warning(
                "scheduler and dashboard listen on %s: whoever reaches them can %s",
                host,
                risk if tls is None else "watch the run, though only certificates let them act",
            )
        logger.info("starting %d workers; the first time, they compile kernels for a minute", count)
        with (
            distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                memory_limit=2 * memory,
                host=host,
                dashboard_address=f"{host}:0",
                protocol="tcp://" if tls is None else "tls://",
                security=security,
                silence_logs=logging.CRITICAL,  # what failed is told once, by the outcomes
                env=ONE_THREAD,
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            client.register_plugin(_DeafToInterrupts())
            logger.debug("%d workers of %s each", count, megabytes(2 * memory))
            yield client
    else:
        yield None


class _Client(distributed.Client):
    """A client that is closed at once where it cannot connect.

    Left to the garbage collector it would close itself at any moment, even while its own thread
    holds the lock of Dask's event loops, and would wait for that lock for ever.
    """

    def start(self, **kwargs: Any) -> None:
        """Connect, as the constructor of Dask's client asks for."""
        try:
            super().start(**kwargs)  # type: ignore[no-untyped-call]
        except BaseException:
            self.close()  # type: ignore[no-untyped-call]
            self._loop_runner.stop()  # which is left running where Dask closed the client itself
            raise


@contextmanager
def _connected(scheduler: str, security: Any | None) -> Iterator[Any]:
    """A client of a scheduler that runs elsewhere."""
    encrypted = scheduler.startswith("tls:")
    if encrypted and security is None and not dask.config.get("distributed.comm.tls.ca-file"):
        raise UsageError(f"{scheduler} wants certificates: give --tls-ca, --tls-cert and --tls-key")
    try:
        client = _Client(scheduler, security=security)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, CommClosedError) as error:
        hint = ", or not to these certificates" if encrypted else ""
        raise TaskError(f"no Dask scheduler answers at {scheduler}{hint}: {error}") from error
    except (ValueError, TypeError, RuntimeError) as error:  # of certificates for an address that
        # takes none, or of an address that is none
        raise UsageError(f"{scheduler!r} is no scheduler that can be asked: {error}") from error
    with client:
        yield client


@contextmanager
def report_kept(client: Any | None, path: str | os.PathLike[str]) -> Iterator[None]:
    """Keep Dask's own performance report of what runs inside, as one HTML file.

    Args:
        client: a Dask client; None: there is nothing to report.
        path: the file, replaced; where Dask cannot make it any more (the scheduler is lost), a
            warning says so and nothing else is disturbed.
    """
    if client is None:
        yield
        return
    report = distributed.performance_report(filename=os.fspath(path), mode="inline")
    with client.as_current():
        report.__enter__()
        try:
            yield
        finally:
            try:
                report.__exit__(None, None, None)
            except Exception as error:  # noqa: BLE001 - a report must not hide what happened
                logger.warning("no Dask performance report at %s: %s", path, error or repr(error))
