"""The options that say where the tasks of a command run, written once for all that have tasks."""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from tilestream.cli.fields import TASKS
from tilestream.cli.printing import err, say
from tilestream.errors import UsageError
from tilestream.pipeline.engine.cluster import LOOPBACK, TlsFiles, late_client
from tilestream.pipeline.engine.events import serve_page
from tilestream.pipeline.engine.late_client import around

WORKERS = "Worker processes on this machine; 1: this process does all."
AllCores = Annotated[
    int | None,
    typer.Option(min=1, help=WORKERS, show_default="one per core", rich_help_panel=TASKS),
]
Few = Annotated[int | None, typer.Option(min=1, help=WORKERS, rich_help_panel=TASKS)]


@dataclass(frozen=True)
class Cluster:
    """Where tasks run: in this process, on this machine, or on a scheduler elsewhere."""

    scheduler: str | None = None
    """Address of a scheduler; None: one of our own."""
    workers: int | None = None
    """Worker processes of our own; None: one per core; 1: this process."""
    host: str = LOOPBACK
    """Address that a scheduler of our own listens on."""
    tls: TlsFiles | None = None
    """Certificates; None: as Dask's own configuration says."""

    @contextmanager
    def client(self, memory: int) -> Iterator[Any | None]:
        """A client for tasks that use at most so much memory [bytes]; errors as `late_client`.

        As soon as it is made, says on stderr where to watch them.
        """
        where = late_client(self.scheduler, self.workers, memory, host=self.host, tls=self.tls)
        with where as client, around(client, _watched):
            yield client


@contextmanager
def _watched(client: Any) -> Iterator[None]:
    """Print where to watch what a client does, once the page is there."""
    page = serve_page(client)
    if page is not None:
        say(f"Watch it at {page}", to=err)
    yield


HERE, ALL_CORES = Cluster(workers=1), Cluster()
"""What a command that is asked for nothing else runs on."""


def cluster_of(
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Run on this Dask scheduler, e.g. tcp://10.0.0.1:8786.", rich_help_panel=TASKS
        ),
    ] = None,
    workers: AllCores = None,
    host: Annotated[
        str,
        typer.Option(
            help="Where a scheduler of our own listens, with its dashboard.", rich_help_panel=TASKS
        ),
    ] = LOOPBACK,
    tls_ca: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="Certificate of the authority (PEM).",
            rich_help_panel=TASKS,
        ),
    ] = None,
    tls_cert: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="The cluster's own certificate (PEM).",
            rich_help_panel=TASKS,
        ),
    ] = None,
    tls_key: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Its private key (PEM).", rich_help_panel=TASKS
        ),
    ] = None,
) -> Cluster:
    """The cluster that these options describe.

    Raises:
        UsageError: options that contradict each other, or would say nothing.
    """
    files = [path for path in (tls_ca, tls_cert, tls_key) if path is not None]
    if len(files) not in (0, 3):
        raise UsageError("--tls-ca, --tls-cert and --tls-key belong together: give all three")
    tls = TlsFiles(*(str(path.absolute()) for path in files)) if files else None
    if scheduler is not None and host != LOOPBACK:
        raise UsageError(f"--host {host} is for a scheduler of our own: leave out --scheduler")
    if scheduler is None and workers == 1 and (tls is not None or host != LOOPBACK):
        raise UsageError("one worker is this process, nobody listens: give --workers 2 or more")
    return Cluster(scheduler, workers, host, tls)


def on_cluster(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `cluster_of`; it gets what they say as `cluster`.

    The command's default for it, `HERE` or `ALL_CORES`, is the default of `--workers`.
    """
    own = dict(inspect.signature(command).parameters)
    usual: Cluster = own.pop("cluster").default
    told = dict(inspect.signature(cluster_of).parameters)
    if usual is HERE:
        told["workers"] = told["workers"].replace(default=usual.workers, annotation=Few)

    @functools.wraps(command)
    def wrapped(**values: Any) -> None:
        where = {name: values.pop(name) for name in told}
        command(cluster=cluster_of(**where), **values)

    signature = inspect.Signature([*own.values(), *told.values()])
    wrapped.__signature__ = signature  # type: ignore[attr-defined]
    return wrapped
