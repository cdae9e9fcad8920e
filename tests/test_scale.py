"""A synthetic city: the same bits from any way of running, and a client that stays small."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import city_tiles
import distributed
import numpy as np
import pandas as pd
import pytest
from city_tiles import digest, run_city, write_city, write_drive
from elsewhere import scheduler_elsewhere
from patience import wait_until

import tilestream as ts
from tilestream.pipeline.engine.cluster import dask_client

N, SIZE = 2, 20.0


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("city")
    write_city(folder, N, SIZE, 0.4)
    write_drive(folder / "drive.mcap", SIZE, 0.6)
    return folder


@pytest.fixture(scope="module")
def serial(city: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("serial")
    run_city(city, str(out), N, SIZE)
    return digest(out)


def test_a_moved_block_holds_the_moved_points(city: Path) -> None:
    first, other = (
        city_tiles.points_of(city / "blocks" / f"{n}.laz") for n in ("000_000", "001_001")
    )
    np.testing.assert_allclose(other, first + np.array([SIZE, SIZE, 0.0]), atol=1e-9)
    assert len(first) > 4000
    with_bounds = ts.formats.describe(city / "blocks" / "001_001.laz")
    np.testing.assert_allclose(
        with_bounds.bounds, [other.min(axis=0), other.max(axis=0)], atol=1e-9
    )


def test_two_workers_over_tls_write_the_bytes_of_a_serial_run(
    city: Path, serial: dict[str, str], tmp_path: Path, workers: distributed.Client
) -> None:
    assert all(address.startswith("tls://") for address in workers.nthreads())
    run_city(city, str(tmp_path), N, SIZE, client=workers)
    assert len(serial) > 35
    assert digest(tmp_path) == serial


def test_workers_that_come_and_go_write_the_bytes_of_a_serial_run(
    city: Path, serial: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """An adaptive cluster: none is there before there is work, and they leave when it is done."""
    changes: list[str] = []

    class Changes(distributed.SchedulerPlugin):
        def add_worker(self, *_: Any, **__: Any) -> None:
            changes.append("came")

        def remove_worker(self, *_: Any, **__: Any) -> None:
            changes.append("went")

    with (
        distributed.LocalCluster(
            n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        cluster.scheduler.add_plugin(Changes(), name="changes")
        cluster.adapt(minimum=0, maximum=3, interval="100ms", wait_count=2)
        for _ in range(2):
            out = tmp_path_factory.mktemp("adaptive")
            run_city(city, str(out), N, SIZE, client=client)
            assert digest(out) == serial
            wait_until(lambda: not cluster.scheduler.workers, "the workers have left")
    assert changes.count("came") == changes.count("went") > 1


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_any_number_of_workers_writes_the_bytes_of_a_serial_run(
    city: Path, serial: dict[str, str], tmp_path_factory: pytest.TempPathFactory, workers: int
) -> None:
    tcp, local = (tmp_path_factory.mktemp(name) for name in ("tcp", "local"))
    with scheduler_elsewhere(workers) as (address, _), dask_client(address, None, 1) as client:
        run_city(city, str(tcp), N, SIZE, client=client)
    with dask_client(None, workers, 10**9) as client:
        run_city(city, str(local), N, SIZE, client=client)
    assert digest(tcp) == digest(local) == serial


@pytest.mark.slow
def test_a_job_over_the_s3_protocol_gives_the_same_store_and_tables(
    city: Path, tmp_path: Path, s3_bucket: str
) -> None:
    run_city(city, str(tmp_path), N, SIZE)
    with dask_client(None, 2, 10**9) as client:
        run_city(city, f"{s3_bucket}/run", N, SIZE, client=client)
    near, far = ts.open_store(f"{tmp_path}/map.zarr"), ts.open_store(f"{s3_bucket}/run/map.zarr")
    assert far.marks() == near.marks()
    for key in near.keys():
        np.testing.assert_array_equal(far.tile(key).points(), near.tile(key).points())
    tables = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.parquet"))
    assert {path.split("/")[0] for path in tables} == {"factors", "errors", "starts"}
    for path in tables:
        pd.testing.assert_frame_equal(
            pd.read_parquet(f"{s3_bucket}/run/{path}"),
            pd.read_parquet(tmp_path / path),
            check_exact=True,
        )


MEMORY = """
import sys, time
sys.path.insert(0, {tests!r})
from naps import MEMORY, Nap
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.plan import Plan
from tilestream.grid import TileKey

def resident():
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) * 1024

COUNT = 100_000
before = resident()
stages = [("", "cells"), ("cells", "terms"), ("terms", "factors"), ("factors", "predict")]
tiles = [TileKey(i % 250, i // 250) for i in range(COUNT // 4)]
tasks = [
    Nap(tile, stage, needs=(f"{{need}}-{{tile}}",) if need else ())
    for need, stage in stages
    for tile in tiles
]
planned = resident()
began = time.process_time()
outcomes = execute(Plan(tuple(tasks), MEMORY), None, None)
assert len(outcomes) == COUNT and all(outcome.ok for outcome in outcomes)
print((planned - before) / 1e6, (resident() - planned) / 1e6, time.process_time() - began)
"""


def test_a_hundred_thousand_tasks_are_little_memory_and_time(tmp_path: Path) -> None:
    script = tmp_path / "memory.py"
    script.write_text(MEMORY.format(tests=str(Path(__file__).parent)))
    told = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True)
    planned, executed, seconds = (float(value) for value in told.stdout.split())
    assert planned < 130.0, "MB of the tasks themselves"
    assert executed < 85.0, "MB beyond them"
    assert seconds < 60.0, "of CPU"
