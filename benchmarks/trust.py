"""What it costs that what is stored can be trusted: a job with checksums, syncs and locks, and
without, in turns, in one process.

The job ingests blocks of a made city, makes the factors along its streets, and reads all back.

    python benchmarks/trust.py --blocks 4 --rounds 5
"""

import argparse


def options() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--blocks", type=int, default=4, help="along an edge of the city")
    parser.add_argument("--rounds", type=int, default=5, help="of each way")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pyarrow.parquet as pq

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from city_tiles import run_city, write_city

import tilestream as ts

SIZE = 20.0
"""Edge of a block [m]."""


@contextmanager
def without_syncs() -> Iterator[None]:
    """Nothing waits for the disk."""
    with mock.patch("os.fsync", return_value=None):
        yield


def _plain_writer(*given: Any, write_page_checksum: bool, **how: Any) -> Any:  # noqa: ARG001
    return pq.ParquetWriter(*given, **how)


def _plain_file(source: Any, page_checksum_verification: bool) -> Any:  # noqa: ARG001
    return pq.ParquetFile(source)


PLAIN = SimpleNamespace(ParquetWriter=_plain_writer, ParquetFile=_plain_file)
"""Parquet without checksums of pages."""
ZERO = SimpleNamespace(crc32=lambda _: 0, value=lambda _: 0)
"""Every checksum."""
CHECKSUMS = {
    "tilestream.marks.zlib": ZERO,
    "tilestream.marks._seal_of": lambda _: "",
    "tilestream.tables.zlib": ZERO,
    "tilestream.tables.pq": PLAIN,
    "zarr.codecs.crc32c_.google_crc32c": ZERO,
    "tilestream.pipeline.stages.merge.prints_of": lambda *_: [(0, 0)],
    "tilestream.pipeline.stages.merge.Pieces._require_all": lambda *_: None,
}
"""What computes them: of marks, of tables, of chunks, of a tile's points."""


@contextmanager
def without_checksums() -> Iterator[None]:
    """None is computed."""
    with ExitStack() as stack:
        for name, instead in CHECKSUMS.items():
            stack.enter_context(mock.patch(name, instead))
        yield


@contextmanager
def without_locks() -> Iterator[None]:
    """Nobody is asked who else writes."""
    with ExitStack() as stack:
        for module in ("ingest", "inventory"):
            name = f"tilestream.pipeline.jobs.{module}.only_writer"
            stack.enter_context(mock.patch(name, return_value=nullcontext()))
        yield


@contextmanager
def without_any() -> Iterator[None]:
    """As if this were not."""
    with without_syncs(), without_checksums(), without_locks():
        yield


WAYS: dict[str, Callable[[], Any]] = {
    "all of it": nullcontext,
    "no syncs": without_syncs,
    "no checksums": without_checksums,
    "no locks": without_locks,
    "none of it": without_any,
}


def job(folder: Path, blocks: int) -> None:
    """Ingest, factors, and every tile read once more."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    run_city(folder, str(out), blocks, SIZE)
    store = ts.open_store(str(out / "map.zarr"))
    for key in store.keys():
        store.tile(key).points_mm(halo=True)
        store.tile(key).cells()


def main(blocks: int, rounds: int) -> None:
    """Do the job in each way in turns; medians, and their ratios to the job without any."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in WAYS}
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as temporary:
        folder = Path(temporary)
        write_city(folder, blocks, SIZE, 0.2)
        job(folder, blocks)  # compiles
        for number in range(rounds):
            names = list(WAYS)
            for name in names[number % len(names) :] + names[: number % len(names)]:
                began, spent = time.perf_counter(), time.process_time()
                with WAYS[name]():
                    job(folder, blocks)
                taken[name].append((time.perf_counter() - began, time.process_time() - spent))
    print(f"{blocks**2} tiles, {rounds} rounds on {os.cpu_count()} cores")
    print(f"{'':14}{'wall [s]':>10}{'CPU [s]':>10}{'of none of it: wall':>22}{'CPU':>8}")
    for name, rows in taken.items():
        wall, work = (statistics.median(column) for column in zip(*rows, strict=True))
        pairs = list(zip(rows, taken["none of it"], strict=True))
        ratios = [statistics.median(mine[k] / bare[k] for mine, bare in pairs) for k in (0, 1)]
        print(f"{name:14}{wall:10.2f}{work:10.2f}{ratios[0]:22.3f}{ratios[1]:8.3f}")


if __name__ == "__main__":
    main(GIVEN.blocks, GIVEN.rounds)
