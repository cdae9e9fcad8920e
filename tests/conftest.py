"""Fixtures that all tests share."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from patience import PATIENCE, wait_until

# A busy machine is slow, which is no fault of the code: no test is timed.
settings.register_profile("calm", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("calm")

LONG = (
    "registration",  # compiles half of the kernels
    "factors_against_literal",  # compiles the other half
    "main_job",
    "map_update",
    "cli",
    "dashboard",
    "estimate",
    "simulation_run",
    "places_entered",
    "report",
    "ingest",
    "stored",
    "report_page",
    "over_runs",
    "places",
    "model_physics",
    "run",
    "one_bad_thing",
    "surroundings",
    "kernel_cache",
    "scale",
    "fuzz",
    "memory",
    "map_diff",
    "model_intervals",
    "notes",
    "model_file",
    "model_regressors",
    "readme",
    "localize_drive",
    "compare",
    "advise",
    "info",
    "store",
    "diff_page",
    "ghosts",
    "observe_route",
    "matcher_file",
    "completion",
    "cases_route",
    "factors_route",
    "model_figures",
    "model_evaluation",
    "starts_of",
    "pairs",
    "degraded_drives",
    "unfit",
    "export",
)
"""Files of ten seconds and more, the longest first: what is begun last must be short, or one of
the processes that the tests run in would wait for another. By default they are left out, so that
tests take three minutes; `-m long` runs them, as CI does."""


@pytest.hookimpl(tryfirst=True)  # before -m looks at the marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {f"test_{name}.py": number for number, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
    for item in items:
        if item.path.name in order:
            item.add_marker(pytest.mark.long)


def shared(name: str, variable: str, what: str) -> Path:
    """A folder beside the project's; who asks for it is skipped where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / name
    folder = Path(os.environ.get(variable, default))
    if not folder.is_dir():
        pytest.skip(f"no {what} at {folder}: set {variable} to their folder")
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings."""
    return shared("data", "TILESTREAM_DATA", "real recordings")


@pytest.fixture(scope="session")
def cases() -> Path:
    """The folder of small inputs that went wrong."""
    return shared("cases", "TILESTREAM_CASES", "small inputs")


@pytest.fixture(scope="session")
def _workers() -> Iterator[Any]:
    # not imported above: the process that only hands tests out reads this file too, and must wait
    with import_module("tilestream.pipeline.engine.cluster").dask_client(
        None, 2, 2 * 10**9
    ) as client:
        yield client


@pytest.fixture
def workers(_workers: Any) -> Any:
    """A client of two worker processes of our own, which all tests of a session share."""
    _workers.wait_for_workers(2, timeout=PATIENCE)  # a test before may have killed one
    return _workers


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def s3_bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket of a real S3 server process on loopback."""
    s3fs = pytest.importorskip("s3fs", reason="needs the extra s3")
    pytest.importorskip("moto.server", reason="needs moto's S3 server")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
    }.items():
        monkeypatch.setenv(name, value)
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: listens(port), "the S3 server listens")
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("bucket")
        yield "s3://bucket"
    finally:
        server.kill()
        server.wait()
        s3fs.S3FileSystem.clear_instance_cache()
