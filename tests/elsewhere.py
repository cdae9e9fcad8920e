"""A Dask scheduler and workers in processes of their own, reached over TCP on loopback."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import distributed

from tilestream.pipeline.engine.cluster import ONE_THREAD, TlsFiles


def certificates(folder: Path) -> TlsFiles:
    """Certificates of an authority of a test's own, as files."""
    made = distributed.Security.temporary()
    texts = {"ca": made.tls_ca_file, "cert": made.tls_scheduler_cert, "key": made.tls_scheduler_key}
    for name, text in texts.items():
        (folder / f"{name}.pem").write_text(text)
    return TlsFiles(*(str(folder / f"{name}.pem") for name in texts))


@contextmanager
def scheduler_elsewhere(
    workers: int,
    tls: TlsFiles | None = None,
    *,
    plain: bool = False,
    prefixes: Sequence[Sequence[str]] = (),
    of_workers: Mapping[str, str] | None = None,
) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """Address and processes of a scheduler in another process, and of its workers.

    With nannies and a dashboard, which a `plain` one goes without: it starts sooner. `prefixes` are
    the commands that start the workers; `of_workers` is in their environment, empty: it is not.
    """
    flags = [] if tls is None else ["--tls-ca-file", tls.ca, "--tls-cert", tls.cert]
    flags += [] if tls is None else ["--tls-key", tls.key]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    protocol = "tcp" if tls is None else "tls"
    address = f"{protocol}://127.0.0.1:{port}"
    common = ["--host", "127.0.0.1", *flags]
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    shown = ["--no-dashboard"] if plain else ["--dashboard-address", "127.0.0.1:0"]
    commands = [[*program, *common, "--port", str(port), *shown]]
    program = [sys.executable, "-m", "distributed.cli.dask_worker"]
    one = ["--nthreads", "1", "--no-dashboard", *(["--no-nanny"] if plain else [])]
    for number in range(workers):
        begun_by = prefixes[number] if prefixes else ()
        commands.append([*begun_by, *program, address, *common, *one])
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(Path(__file__).parent)}
    environment |= of_workers or {}
    environment = {name: value for name, value in environment.items() if value}
    processes = [
        subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for command in commands
    ]
    try:
        yield address, processes
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait(20)
