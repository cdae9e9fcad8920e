"""What data passes on its way: the modules that a LAS point enters until it is in the report, and
those that a scan enters until it is a label.

python benchmarks/walk.py

Of a small job (tests/streets.py: one street as LAS, one drive) the first task of each stage and the
writing of the report are profiled: every call of a function of another module is a step. A way back
is a step into a module, or folder, that was left before; each pair counts once.
"""

import argparse

if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()

import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import numpy as np
import streets

import tilestream
from tilestream.formats.points.las import write_las
from tilestream.pipeline.engine import executor
from tilestream.pipeline.jobs import run as main_job

ROOT = Path(tilestream.__file__).parent
WAYS = {
    "LAS point": ("scatter", "merge", "cells", "terms", "factors", "predict", "report"),
    "scan": ("register", "label"),
}


@contextmanager
def noted(steps: list[str]) -> Iterator[None]:
    """Notes the modules that are entered inside, one after the other."""

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT):
            module = str(path.relative_to(ROOT))
            if steps[-1:] != [module]:
                steps.append(module)

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


def walked() -> dict[str, list[str]]:
    """The steps of the first task of each stage, and of the report."""
    steps: dict[str, list[str]] = {}

    def first(name: str, function: Callable[..., Any], *given: Any, **how: Any) -> Any:
        if name in steps:
            return function(*given, **how)
        with noted(steps.setdefault(name, [])):
            return function(*given, **how)

    attempt, write_report = executor.attempt, main_job.write_report
    executor.attempt = lambda task, memory=None: first(task.stage, attempt, task, memory)
    main_job.write_report = lambda *given, **how: first("report", write_report, *given, **how)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_las(folder / "map.las", np.round(streets.street("canyon", 1, 0.5), 3))
        drive = streets.write_drive(folder / "canyon.mcap", "canyon")
        job: dict[str, Any] = {
            "map": {"sources": [str(folder / "map.las")], "tile_size": 100.0},
            "drives": [{"log": str(drive)}],
            "observe": {"range_max": streets.REACH, "starts": 8},
            "model": {"recipe": "physics"},
            "label": {"starts": {"radius": 0.2, "step": 0.2}},
        }
        main_job.run(streets.job(folder, folder / "run", **job))
    executor.attempt, main_job.write_report = attempt, write_report
    return steps


def figures(way: Sequence[str]) -> tuple[int, int]:
    """How many rooms a way enters, and how many ways back it has."""
    left: set[str] = set()
    back = set()
    for here, there in itertools.pairwise(way):
        left.add(here)
        if there in left and there != here:
            back.add((here, there))
    return len(set(way)), len(back)


if __name__ == "__main__":
    found = walked()
    print(
        "| what | stages | modules | ways back | folders | ways back |\n|---|---|---|---|---|---|"
    )
    for what, stages in WAYS.items():
        way = [module for stage in stages for module in found[stage]]
        folders = [str(Path(m).parent) if "/" in m else m for m in way]
        folders = [f for n, f in enumerate(folders) if folders[n - 1 : n] != [f]]
        cells = (*figures(way), *figures(folders))
        print(f"| {what} | {', '.join(stages)} | {' | '.join(map(str, cells))} |")
