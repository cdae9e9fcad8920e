"""What it costs that a cluster of our own is encrypted: its start, its tasks, a small job.

python benchmarks/encryption.py [--rounds 8] [--turns 6] [--tasks 300] [--tiles 3]

Each round starts two clusters of two workers, one with Dask's temporary certificates and one
without, which of them first alternates. Then they take turns, within seconds of one another: some
tasks that do nothing, through our executor, and a small synthetic city (tests/city_tiles.py), after
a smaller one that has loaded the kernels. What encryption costs is the median of the ratios of all
pairs of turns, with its quartiles: a machine that others use changes from one minute to the next.
CPU is that of client, scheduler and workers.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--turns", type=int, default=6, help="of each cluster in a round")
    parser.add_argument("--tasks", type=int, default=300, help="of a turn, that do nothing")
    parser.add_argument("--tiles", type=int, default=3, help="along an edge of the city")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import distributed
import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from city_tiles import run_city, write_city
from naps import MEMORY, Nap

from tilestream.grid import TileKey
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.plan import Plan

SIZE = 20.0
"""Edge of a tile [m]."""
SPACING = 0.3
"""Of the points of a tile [m]."""
KINDS = ("plain", "encrypted")
Figures = dict[str, dict[str, list[float]]]
"""By what was measured and by kind: a figure per turn [s]."""


def main(given: argparse.Namespace) -> None:
    """Measure round by round, print the table."""
    found: Figures = defaultdict(lambda: {kind: [] for kind in KINDS})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_city(folder / "warm", 1, SIZE, SPACING)
        write_city(folder / "city", given.tiles, SIZE, SPACING)
        for number in range(given.rounds):
            take_turns(found, folder, given, KINDS if number % 2 else KINDS[::-1])
    print(f"| | {' | '.join(KINDS)} | encrypted / plain |\n|---|---|---|---|")
    for what, figures in found.items():
        plain, encrypted = (np.array(figures[kind]) for kind in KINDS)
        shown = (spread(values) for values in (plain, encrypted, encrypted / plain))
        print(f"| {what} | {' | '.join(shown)} |")
    turns = given.rounds * given.turns
    print(
        f"\nmedian (quartiles); {given.rounds} starts, {turns} turns, load {os.getloadavg()[0]:.1f}"
    )


def take_turns(
    found: Figures, folder: Path, given: argparse.Namespace, kinds: tuple[str, ...]
) -> None:
    """One round: start a cluster of each kind, let them work in turns."""
    with ExitStack() as stack:
        clients = {}
        for kind in kinds:
            with noted(found, "start", kind):
                clients[kind] = stack.enter_context(cluster(kind))
        for client in clients.values():
            naps(client, 100)
            city(client, folder, "warm", 1)
        for turn in range(given.turns):
            for kind in kinds if turn % 2 else kinds[::-1]:
                with noted(found, f"{given.tasks} empty tasks", kind):
                    naps(clients[kind], given.tasks)
            for kind in kinds if turn % 2 else kinds[::-1]:
                with noted(found, "job", kind):
                    city(clients[kind], folder, "city", given.tiles)


@contextmanager
def cluster(kind: str) -> Iterator[distributed.Client]:
    """A cluster of our own."""
    how: Callable[[], distributed.Security]
    how = distributed.Security if kind == "plain" else distributed.Security.temporary
    with ExitStack() as stack:
        with patch.object(distributed.Security, "temporary", how):
            client = stack.enter_context(dask_client(None, 2, 2 * MEMORY))
        assert client.scheduler.address.startswith("tcp:" if kind == "plain" else "tls:")
        yield client


@contextmanager
def noted(found: Figures, what: str, kind: str) -> Iterator[None]:
    """Note the wall and CPU seconds of what runs inside."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    yield
    found[f"{what}, wall [s]"][kind].append(time.perf_counter() - wall)
    found[f"{what}, CPU [s]"][kind].append(cpu_seconds() - cpu)


def naps(client: distributed.Client, count: int) -> None:
    """Run tasks that do nothing."""
    tasks = tuple(Nap(TileKey(number, 0)) for number in range(count))
    assert all(outcome.ok for outcome in execute(Plan(tasks, MEMORY), client, None))


def city(client: distributed.Client, folder: Path, name: str, tiles: int) -> None:
    """Run a small job."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        run_city(folder / name, out, tiles, SIZE, client=client)


def cpu_seconds() -> float:
    """Of this process, the scheduler's too, and of the workers and their nannies, so far."""
    this = psutil.Process()
    times = [process.cpu_times() for process in (this, *this.children(recursive=True))]
    return sum(time.user + time.system for time in times)


def spread(values: np.ndarray) -> str:
    """Median and quartiles."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


if __name__ == "__main__":
    main(GIVEN)
