"""The Dask cluster that tasks run on: one of our own on this machine, or one that is there."""

import logging
import os
import re
import signal
import socket
import ssl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import dask.config
import distributed
from dask.system import CPU_COUNT
from distributed.comm.addressing import get_address_host
from distributed.comm.core import CommClosedError
from distributed.utils import silence_logging_cmgr

from tilestream.counts import count_of
from tilestream.errors import TaskError, UsageError
from tilestream.kernels.cache import COMPILING, are_kept
from tilestream.pipeline.engine.late_client import LateClient, around
from tilestream.pipeline.engine.plan import megabytes
from tilestream.pipeline.engine.seen import require_blocking

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
PROTOCOLS = ("tcp", "tls", "ws", "wss", "ucx")
"""What Dask's addresses may begin with."""
ORIGINS = "distributed.scheduler.dashboard.bokeh-application.allow_websocket_origin"
"""Dask's setting of whose pages may open a WebSocket to a dashboard."""
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OPENBLAS", "OMP", "MKL", "VECLIB")
}
"""Environment of a worker: its process is its one thread."""


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
def late_client(
    scheduler: str | None,
    workers: int | None,
    memory: int,
    *,
    host: str = LOOPBACK,
    tls: TlsFiles | None = None,
) -> Iterator[Any | None]:
    """A client of a scheduler that runs, a late one of our own (`LateClient`), or None where the
    tasks run in this process.

    Args:
        scheduler: address of a running scheduler, e.g. `tcp://10.0.0.1:8786` or `tls://…`; None: a
            local one.
        workers: worker processes of the local cluster, one thread each; None: one per core; 1
            without a scheduler: no cluster, this process does the work.
        memory: what a task may use [bytes]. A worker of the local cluster is restarted when it
            comes near twice that: a broken promise ends in a reason, not in a machine that swaps.
        host: address that the local scheduler and its dashboard listen on.
        tls: certificates; None: a local cluster is encrypted with its own, which only its processes
            know; for a scheduler elsewhere, Dask's configuration says (`distributed.comm.tls`).

    Raises:
        TaskError: nobody answers at the scheduler's address.
        UsageError: the scheduler's address is none, certificates are missing or do not fit, or
            temporary files cannot be written.
    """
    security = None if tls is None else tls.security()
    count = CPU_COUNT if workers is None else workers
    if scheduler is not None:
        _require_address(scheduler, security)
        how = "" if scheduler.startswith("tls:") else ", not encrypted"
        logger.info("connecting to %s%s", scheduler, how)
        with silence_logging_cmgr(logging.CRITICAL), _connected(scheduler, security) as client:
            yield client
    elif count > 1:
        _require_scratch()
        with LateClient(count, partial(_own_workers, memory, host, security)) as late:
            yield late
    else:
        yield None


@contextmanager
def dask_client(
    scheduler: str | None,
    workers: int | None,
    memory: int,
    *,
    host: str = LOOPBACK,
    tls: TlsFiles | None = None,
) -> Iterator[Any | None]:
    """A Dask client, made at once, or None where the tasks run in this process.

    Arguments and errors as of `late_client` and `LateClient.for_tasks`.
    """
    with late_client(scheduler, workers, memory, host=host, tls=tls) as client:
        yield client.for_tasks(client.most) if isinstance(client, LateClient) else client


@contextmanager
def _own_workers(memory: int, host: str, security: Any | None, count: int) -> Iterator[Any]:
    """Start so many workers on this machine; a client of their cluster."""
    if host != LOOPBACK:
        logger.warning(
            "scheduler and dashboard listen on %s: whoever reaches them can watch the run, "
            "though only certificates let them act",
            host,
        )
    started = count_of(count, "worker")
    logger.info("starting %s, encrypted%s", started, "" if are_kept() else f"; {COMPILING}")
    with (
        _local_cluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=2 * memory,
            host=host,
            dashboard_address=f"{host}:0",
            security=security or distributed.Security.temporary(),
            silence_logs=logging.CRITICAL,  # what failed is told once, by the outcomes
            env=ONE_THREAD,
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        client.register_plugin(_DeafToInterrupts())
        logger.debug("%s of %s each", started, megabytes(2 * memory))
        yield client


@contextmanager
def _local_cluster(host: str, **how: Any) -> Iterator[Any]:
    """A cluster on this machine whose dashboard talks to its own pages alone.

    Dask's default, `*`, lets any site in the browser of someone who can reach it listen. Other
    names, of a proxy or a tunnel, can be given in Dask's configuration.
    """
    given = [origin for origin in dask.config.get(ORIGINS) if origin != "*"]
    with dask.config.set({ORIGINS: given}):
        try:
            cluster: Any = distributed.LocalCluster(host=host, **how)
        except RuntimeError as error:
            raise TaskError(f"no workers can be started here: {error}") from error
    with cluster:
        names = {"localhost", LOOPBACK}
        if host != LOOPBACK:
            reached = get_address_host(cluster.scheduler_address)
            names |= {host, reached, socket.gethostname().lower(), socket.getfqdn().lower()}
        port = cluster.scheduler.http_server.port
        for page in cluster.scheduler.http_application.applications:
            if hasattr(page, "websocket_origins"):  # it is Bokeh's, which is heavy to import
                page.websocket_origins.update(f"{name}:{port}" for name in names)
        yield cluster


def _require_scratch() -> None:
    """Refuse to start workers that could not keep temporary files.

    Raises:
        UsageError: there is no folder for them; says which one it would be.
    """
    folder = dask.config.get("temporary-directory", None)
    for where in dict.fromkeys((folder, None)):
        try:
            with tempfile.TemporaryFile(dir=where):
                pass
        except OSError as error:
            named = "Dask's temporary-directory" if where else "TMPDIR"
            raise UsageError(
                f"no temporary file can be written ({error}): set {named} to a folder that can be "
                "written, or give --workers 1"
            ) from None


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


def _require_address(scheduler: str, security: Any | None) -> None:
    """Refuse what is no address of a scheduler, before one waits for it to answer.

    Raises:
        UsageError: another protocol, no port, or certificates are missing.
    """
    protocol, _, rest = scheduler.rpartition("://")
    if (protocol or "tcp") not in PROTOCOLS or not re.search(r".:\d+/?$", rest):
        raise UsageError(
            f"{scheduler!r} is no scheduler's address: give one like tcp://10.0.0.1:8786"
        )
    known = security is not None or dask.config.get("distributed.comm.tls.ca-file")
    if protocol == "tls" and not known:
        raise UsageError(f"{scheduler} wants certificates: give --tls-ca, --tls-cert and --tls-key")


@contextmanager
def _connected(scheduler: str, security: Any | None) -> Iterator[Any]:
    """A client of a scheduler that runs elsewhere."""
    encrypted = scheduler.startswith("tls:")
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
        client: a Dask client, maybe a late one; None, or never made: there is nothing to report.
        path: the file, or its URL, replaced; where Dask cannot make it any more (the scheduler is
            lost), a warning says so and nothing else is disturbed.

    Raises:
        UsageError: the client is asynchronous.
    """
    with around(client, lambda made: _performance_report(made, path)):
        yield


@contextmanager
def _performance_report(client: Any, path: str | os.PathLike[str]) -> Iterator[None]:
    """The report of a client that is there, as `report_kept`."""
    require_blocking(client)
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
