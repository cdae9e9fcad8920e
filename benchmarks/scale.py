"""What a tile costs as the city grows: time, memory of every process, tasks and graph, overhead.

python benchmarks/scale.py [--tiles 4 16 64 256] [--again 64] [--size 50]

A synthetic city (tests/city_tiles.py) is ingested and looked at along all of its streets, on a
scheduler in a process of its own. CPU time is what the workers, the client and the scheduler used,
warm, whatever else the machine did; wall times are only good on a quiet machine, so the load is
printed with them.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tiles", type=int, nargs="+", default=[4, 16, 64, 256])
    parser.add_argument("--again", type=int, default=64, help="also with one worker, this many")
    parser.add_argument("--size", type=float, default=50.0, help="edge of a tile [m]")
    parser.add_argument("--client", nargs=4, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from city_tiles import run_city, write_city
from elsewhere import scheduler_elsewhere

from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.frontier import Frontier
from tilestream.pipeline.engine.stage import Task

SPACING = 0.4
"""Of the points of a block [m]."""
REACH = 50.0
"""Range of the sensor [m]."""
WARM = 20.0
"""Edge of the tiles that the workers load their kernels with [m]."""
COLUMNS = (
    "tiles", "workers", "CPU s/tile", "of it framework", "wall s/tile", "waiting", "worker MB",
    "client MB", "scheduler MB", "tasks/tile", "graph kB/tile", "load",
)  # fmt: skip


def run_client(folder: str, n: int, size: float, address: str) -> dict[str, Any]:
    """The job as a client runs it, after a small one that warms the workers up."""
    seconds: Counter[str] = Counter()
    count, graph = 0, 0

    def add(frontier: Frontier, tasks: list[Task]) -> None:
        nonlocal count, graph
        count += len(tasks)
        graph += sum(len(pickle.dumps(task)) for task in tasks)
        added(frontier, tasks)

    def watch(outcome: Outcome, ended: int, total: int) -> None:  # noqa: ARG001
        assert outcome.ok, outcome.reason
        seconds[outcome.stage] += outcome.seconds

    with dask_client(address, None, 1) as client:
        run_city(f"{folder}/warm", f"{folder}/warmed", 2, WARM, reach=REACH, client=client)
        before = cpu_of(psutil.Process())
        print(json.dumps({"warm": True}), flush=True)
        input()  # the parent has looked at the other processes
        added, Frontier.add = Frontier.add, add  # type: ignore[method-assign]
        began = time.perf_counter()
        run_city(
            f"{folder}/city", f"{folder}/out", n, size, spacing=1.0, reach=REACH, client=client,
            watch=watch,
        )  # fmt: skip
        wall = time.perf_counter() - began
    return {
        "wall": wall,
        "cpu": cpu_of(psutil.Process()) - before,
        "peak": peak_of(os.getpid()),
        "seconds": dict(seconds),
        "tasks": count,
        "graph": graph,
    }


def measure(n: int, workers: int, size: float) -> dict[str, float]:
    """One case, in processes of its own."""
    with (
        tempfile.TemporaryDirectory() as folder,
        scheduler_elsewhere(workers) as (address, processes),
    ):
        write_city(Path(folder, "warm"), 2, WARM, SPACING)
        write_city(Path(folder, "city"), n, size, SPACING)
        command = [sys.executable, __file__, "--client", folder, str(n), str(size), address]
        client = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert client.stdin is not None
        assert client.stdout is not None
        client.stdout.readline()
        scheduler = psutil.Process(processes[0].pid)
        hands = [worker_of(process.pid) for process in processes[1:]]
        before = [cpu_of(process) for process in (scheduler, *hands)]
        told, _ = client.communicate("\n")
        after = [cpu_of(process) for process in (scheduler, *hands)]
        assert client.returncode == 0
        found = json.loads(told.splitlines()[-1])
        used = [b - a for a, b in zip(before, after, strict=True)]
        tiles = n * n
        framework = used[0] + found["cpu"]
        return {
            "tiles": tiles,
            "workers": workers,
            "CPU s/tile": (framework + sum(used[1:])) / tiles,
            "of it framework": framework / (framework + sum(used[1:])),
            "wall s/tile": found["wall"] / tiles,
            "waiting": 1.0 - sum(found["seconds"].values()) / (workers * found["wall"]),
            "worker MB": max(peak_of(process.pid) for process in hands) / 1e6,
            "client MB": found["peak"] / 1e6,
            "scheduler MB": peak_of(scheduler.pid) / 1e6,
            "tasks/tile": found["tasks"] / tiles,
            "graph kB/tile": found["graph"] / tiles / 1e3,
            "load": os.getloadavg()[0],
        }


def worker_of(nanny: int) -> psutil.Process:
    """The process that a nanny looks after."""
    (worker,) = (
        child
        for child in psutil.Process(nanny).children()
        if "spawn_main" in " ".join(child.cmdline())
    )
    return worker


def cpu_of(process: psutil.Process) -> float:
    """CPU seconds of a process so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def peak_of(pid: int) -> int:
    """Largest resident memory of a process so far [bytes]."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


def main(given: argparse.Namespace) -> None:
    """Measure every case, print the table."""
    if given.client:
        folder, n, size, address = given.client
        print(json.dumps(run_client(folder, int(n), float(size), address)))
        return
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    cases = [(tiles, 2) for tiles in given.tiles]
    if given.again in given.tiles:
        cases.insert(cases.index((given.again, 2)) + 1, (given.again, 1))
    for tiles, workers in cases:
        found = measure(round(tiles**0.5), workers, given.size)
        print(f"| {' | '.join(shown(name, found[name]) for name in COLUMNS)} |", flush=True)


def shown(name: str, value: float) -> str:
    """A figure as the table has it."""
    if name in ("of it framework", "waiting"):
        return f"{100.0 * value:.1f} %"
    if name in ("tiles", "workers") or name.endswith("MB"):
        return f"{value:,.0f}"
    return f"{value:.2f}"


if __name__ == "__main__":
    main(GIVEN)
