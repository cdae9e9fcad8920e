"""Kill anything at any time: the same command continues, and ends with the same bytes."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
import pytest
from city_tiles import digest, run_city, write_city, write_drive
from elsewhere import scheduler_elsewhere
from patience import PATIENCE

N, SIZE = 3, 20.0
WORKERS = 2
KILLS = {"worker": 13, "client": 4, "machine": 3}
"""A worker is replaced by its nanny; a client is started again; a machine takes client, scheduler
and workers with it, and all are started again."""

CLIENT = """
import sys
sys.path.insert(0, {tests!r})
from city_tiles import run_city
from tilestream.pipeline.engine.cluster import dask_client

with dask_client(sys.argv[1], None, 10**9) as client:
    run_city({folder!r}, {out!r}, {n}, {size}, client=client)
"""


class Machine:
    """A scheduler, its workers and the client of one job, all of which can be killed."""

    def __init__(self, script: Path) -> None:
        self._script = script
        self._stack = ExitStack()
        self.start()

    def start(self) -> None:
        self._address, self._processes = self._stack.enter_context(scheduler_elsewhere(WORKERS))
        self.start_client()

    def start_client(self) -> None:
        self.client = subprocess.Popen([sys.executable, self._script, self._address])

    def kill(self, what: str, rng: random.Random) -> None:
        if what == "worker":
            self._kill_worker(rng)
        else:
            self.client.kill()
            self.client.wait()
            if what == "client":
                self.start_client()
            else:
                self._stack.close()  # kills them all
                self.start()

    def _kill_worker(self, rng: random.Random) -> None:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            with suppress(psutil.NoSuchProcess, ProcessLookupError):  # it may end meanwhile
                nannies = [psutil.Process(process.pid) for process in self._processes[1:]]
                workers = [
                    child
                    for nanny in nannies
                    for child in nanny.children()
                    if "spawn_main" in " ".join(child.cmdline())
                ]
                if workers:
                    os.kill(rng.choice(workers).pid, signal.SIGKILL)
                    return
            time.sleep(0.05)
        pytest.fail("no worker came back")

    def close(self) -> None:
        self.client.kill()
        self.client.wait()
        self._stack.close()


def written(out: Path) -> int:
    """Files that are there, but for those that an ingest removes in the end."""
    return sum(len(files) for folder, _, files in os.walk(out) if "/fragments" not in folder)


@pytest.mark.slow
def test_twenty_kills_change_nothing(tmp_path: Path) -> None:
    write_city(tmp_path, N, SIZE, 0.4)
    write_drive(tmp_path / "drive.mcap", SIZE, 0.6)
    run_city(tmp_path, str(tmp_path / "calm"), N, SIZE)
    calm = digest(tmp_path / "calm")

    out = tmp_path / "chaos"
    out.mkdir()
    script = tmp_path / "client.py"
    tests = str(Path(__file__).parent)
    script.write_text(
        CLIENT.format(tests=tests, folder=str(tmp_path), out=str(out), n=N, size=SIZE)
    )
    rng = random.Random(7)
    victims = rng.sample(list(KILLS), counts=list(KILLS.values()), k=sum(KILLS.values()))
    moments = sorted(rng.uniform(0.01, 0.97) * len(calm) for _ in victims)
    machine = Machine(script)
    until = time.monotonic() + PATIENCE
    try:
        for moment, victim in zip(moments, victims, strict=True):
            while written(out) < moment:
                assert machine.client.poll() is None, "the client ended by itself"
                assert time.monotonic() < until, "no progress"
                time.sleep(0.02)
            time.sleep(rng.uniform(0.0, 0.3))  # anywhere in a task, not only at its end
            machine.kill(victim, rng)
        assert machine.client.wait(PATIENCE) == 0
    finally:
        machine.close()
    assert digest(out) == calm
