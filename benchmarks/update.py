"""What an update of a map costs: tasks made again by stage, and CPU against a run from nothing.

python benchmarks/update.py [--edge 6] [--replaced 1 4 9] [--size 50] [--spacing 5]

A synthetic city (tests/city_tiles.py), a file a tile, is estimated along all of its streets, from
the map alone. Then some files, as many as are given, side by side from a corner, are replaced by
others, and the same job is called again. CPU time is of this one process, warm.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--edge", type=int, default=6, help="tiles along an edge of the city")
    parser.add_argument("--replaced", type=int, nargs="+", default=[1, 4, 9], help="files, squares")
    parser.add_argument("--size", type=float, default=50.0, help="edge of a tile [m]")
    parser.add_argument("--spacing", type=float, default=5.0, help="of the places [m]")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import math
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from city_tiles import block, moved_las, routes, write_city

import tilestream as ts
from tilestream.formats.points.las import write_las
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.run_settings import RunSettings

DENSITY = 0.4
"""Spacing of the points of a block [m]."""
REACH = 30.0
"""Range of the lidar [m]."""
STAGES = ("scatter", "merge", "cells", "terms", "surfels", "factors", "observe", "predict")


class Made:
    """What was made, and what is there, by stage."""

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self.all: Counter[str] = Counter()

    def __call__(self, outcome: Outcome, *_: int) -> None:
        """Take an outcome."""
        self.made[outcome.stage] += outcome.made
        self.all[outcome.stage] += 1


def job(folder: Path, out: Path, size: float, spacing: float) -> RunSettings:
    """The whole city, from the map alone."""
    return RunSettings(
        out=str(out),
        map={"sources": [str(folder / "blocks" / "*.laz")], "tile_size": size},
        routes=sorted(str(path) for path in folder.glob("*.csv")),
        spacing=spacing,
        sensor=ts.VLP16.model_copy(update={"name": "city", "range_max": REACH}),
        observe={"range_max": REACH},
        model={"recipe": "physics", "offset": 0.0},
    )


def run(settings: RunSettings) -> tuple[float, Made]:
    """The CPU time of a job [s], and what it made."""
    made, began = Made(), time.process_time()
    ts.run(settings, watch=made)
    return time.process_time() - began, made


def replace(folder: Path, count: int, size: float) -> None:
    """Put other blocks in place of a square of so many from a corner of the city."""
    write_las(folder / "other.laz", block(size, DENSITY, seed=100 + count))
    file, edge = (folder / "other.laz").read_bytes(), math.isqrt(count)
    for ix in range(edge):
        for iy in range(edge):
            moved = moved_las(file, ix * size, iy * size)
            (folder / "blocks" / f"{ix:03d}_{iy:03d}.laz").write_bytes(moved)


def row(name: str, seconds: float, whole: float, made: Made, tiles: int, edge: int) -> None:
    """A line of the table; tasks as made of all."""
    counts = []
    for stage in STAGES:
        every = {"scatter": edge**2, "merge": edge**2}.get(stage, made.all[stage])
        counts.append(f"{made.made[stage]}/{every}")
    share = f"{tiles / edge**2:.0%}"
    print(f"| {name} | {share} | {' | '.join(counts)} | {seconds:.1f} | {seconds / whole:.0%} |")


def main(edge: int, replaced: list[int], size: float, spacing: float) -> None:
    """The table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_city(folder, edge, size, DENSITY)
        for route in routes(edge, size):
            lines = [f"{x},{y}\n" for x, y in route.positions[:, :2].tolist()]
            (folder / f"{route.route_id.replace(' ', '_')}.csv").write_text(
                "x,y\n" + "".join(lines)
            )
        run(job(folder, folder / "warm", size, spacing * 3))
        print(f"| files replaced | tiles | {' | '.join(STAGES)} | CPU s | of the whole |")
        print("|---" * (len(STAGES) + 4) + "|")
        whole, made = run(job(folder, folder / "run", size, spacing))
        row("from nothing", whole, whole, made, edge**2, edge)
        for count in (0, *replaced):
            replace(folder, count, size)
            seconds, made = run(job(folder, folder / "run", size, spacing))
            row(str(count), seconds, whole, made, count, edge)


if __name__ == "__main__":
    main(GIVEN.edge, GIVEN.replaced, GIVEN.size, GIVEN.spacing)
