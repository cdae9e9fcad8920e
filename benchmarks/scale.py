"""What a tile costs as the city grows: time, memory of every process, tasks and graph, overhead.

python benchmarks/scale.py [--tiles 4 16 64 256] [--again 64] [--size 50]
python benchmarks/scale.py --empty 8000      # tasks that do nothing, encryption off and on
python benchmarks/scale.py --done 256        # a job again whose tiles are all done
python benchmarks/scale.py --plan 200000     # planned, written down and read back

A synthetic city (tests/city_tiles.py) is ingested and looked at along all of its streets, on a
scheduler in a process of its own. CPU time is what the workers, the client and the scheduler used,
warm, whatever else the machine did; wall times are only good on a quiet machine, so the load is
printed with them. With `PYTHONPATH` at another commit, that one is measured.
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
    parser.add_argument("--empty", type=int, help="only so many tasks that do nothing")
    parser.add_argument("--done", type=int, help="only a job of so many tiles, again")
    parser.add_argument("--plan", type=int, help="only a plan of so many tiles")
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
import numpy as np
from city_tiles import run_city, write_city
from elsewhere import certificates, scheduler_elsewhere
from naps import MEMORY, Nap

import tilestream as ts
from tilestream.formats.routes import route_of
from tilestream.grid import TileKey
from tilestream.marks import hash_of
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.frontier import Frontier
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.along_routes import plan_factors, samples_along
from tilestream.pipeline.jobs.inventory import announce, inventory_of
from tilestream.pipeline.stages.factors import Looking
from tilestream.pipeline.stages.map_plan import MapPlan, TilePoints
from tilestream.settings import DEFAULT_MEMORY
from tilestream.store import Manifest, StoreSettings, TileStore

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


def measure_empty(count: int) -> None:
    """Tasks that do nothing, four a tile, each after the one before."""
    chain = ("cells", "terms", "factors", "predict")

    def naps(number: int, row: int) -> Plan:
        tasks: list[Task] = []
        for tile in (TileKey(i, row) for i in range(-(-number // len(chain)))):
            for before, stage in zip(("", *chain), chain, strict=False):
                tasks.append(Nap(tile, stage, needs=(f"{before}-{tile}",) if before else ()))
        return Plan(tuple(tasks), MEMORY)

    print("| | tasks/s | CPU ms/task of client | of scheduler | of both workers | load |")
    print("|---|---|---|---|---|---|")
    for kind in ("plain", "encrypted"):
        with tempfile.TemporaryDirectory() as folder:
            tls = None if kind == "plain" else certificates(Path(folder))
            with (
                scheduler_elsewhere(2, tls) as (address, processes),
                dask_client(address, None, 1, tls=tls) as client,
            ):
                client.wait_for_workers(2)
                execute(naps(200, -1), client, None)
                scheduler, *nannies = (psutil.Process(process.pid) for process in processes)
                hands = [worker_of(nanny.pid) for nanny in nannies]
                those = [[psutil.Process()], [scheduler], hands]
                plan, began = naps(count, 0), time.perf_counter()
                before = [sum(map(cpu_of, some)) for some in those]
                assert all(outcome.ok for outcome in execute(plan, client, None))
                seconds = time.perf_counter() - began
                used = [sum(map(cpu_of, some)) - b for some, b in zip(those, before, strict=True)]
                tasks = len(plan.tasks)
                shown = " | ".join(f"{1e3 * cpu / tasks:.2f}" for cpu in used)
                load = os.getloadavg()[0]
                print(f"| {kind} | {tasks / seconds:,.0f} | {shown} | {load:.1f} |", flush=True)


def measure_done(tiles: int, size: float) -> None:
    """A job in this process, then the same again, of which nothing is left to do."""
    n = round(tiles**0.5)
    with tempfile.TemporaryDirectory() as folder:
        write_city(Path(folder, "city"), n, size, SPACING)
        for call in ("first", "second", "third"):
            made = tasks = 0

            def watch(outcome: Outcome, ended: int, total: int) -> None:  # noqa: ARG001
                nonlocal made, tasks
                made, tasks = made + outcome.made, tasks + 1

            before = cpu_of(psutil.Process())
            run_city(f"{folder}/city", f"{folder}/out", n, size, watch=watch)
            spent = 1e3 * (cpu_of(psutil.Process()) - before) / n**2
            print(f"{call} call: {tasks} tasks, {made} made, {spent:.1f} ms of CPU a tile")


def measure_plan(tiles: int) -> None:
    """Factors along every street of a city whose points are there: twelve places a tile."""
    n, size = round(tiles**0.5), 100.0
    with tempfile.TemporaryDirectory() as folder:
        store = TileStore.create(f"{folder}/map.zarr", StoreSettings(size, 10.0, 0.2, None))
        keys = [TileKey(ix, iy) for ix in range(n) for iy in range(n)]
        points = {key: TilePoints(hash_of(key), "", 300_000) for key in keys}
        x = np.arange(1.0, n * size, size / 2.0)
        streets = [
            np.stack([x, np.full_like(x, (r + 0.5) * size), x * np.nan], 1) for r in range(n)
        ]
        routes = [route_of(f"street {r}", street) for r, street in enumerate(streets)]
        here, stood = psutil.Process(), peak_of(os.getpid())
        told = {}

        def note(what: str, began: float) -> float:
            now = cpu_of(here)
            told[what] = now - began
            return now

        now = cpu_of(here)
        places = samples_along(store, routes, 8.0)
        looking = Looking(ts.VLP16, 2.0, "all", 2.0)
        plan = plan_factors(MapPlan(store, points), places, folder, looking, DEFAULT_MEMORY)
        now = note("planned", now)
        grown = peak_of(os.getpid()) - stood
        store.begin(Manifest.of({key: (tile.identity, tile.count) for key, tile in points.items()}))
        announce(plan.tasks)
        now = note("written", now)
        assert len(inventory_of(f"{folder}/factors")) == n**2
        manifest = ts.open_store(store.url).manifest
        assert manifest is not None
        assert len(manifest.identities) == n**2
        note("read", now)
        seconds = ", ".join(f"{what} in {spent:.1f} s" for what, spent in told.items())
        count, every = len(plan.tasks), sum(map(len, places.values()))
        print(f"{n**2:,} tiles, {count:,} tasks, {every:,} places: {seconds} of CPU;")
        print(f"{grown / 1e6:,.0f} MB for the plan, {peak_of(os.getpid()) / 1e6:,.0f} MB in all")


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
    if given.empty or given.done or given.plan:
        if given.empty:
            measure_empty(given.empty)
        if given.done:
            measure_done(given.done, WARM)
        if given.plan:
            measure_plan(given.plan)
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
