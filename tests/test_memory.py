"""What a task promises of memory is what it takes: small, normal, dense, and with stray points."""

import json
import os
import subprocess
import sys
from pathlib import Path

import memory
import pytest

STAGES = {
    *("scatter", "merge", "cells", "terms", "surfels", "above"),
    *("factors", "observe", "register", "label"),
}


@pytest.mark.skipif(sys.platform != "linux", reason="peaks of single tasks are told by Linux only")
@pytest.mark.parametrize(
    ("spacing", "strays"),
    [
        pytest.param(0.3, False, id="small"),
        pytest.param(0.3, True, id="strays"),
        pytest.param(0.04, False, id="normal", marks=pytest.mark.slow),
        pytest.param(0.0097, False, id="dense", marks=pytest.mark.slow),  # 20 million points
    ],
)
def test_no_task_takes_more_than_it_promises(tmp_path: Path, spacing: float, strays: bool) -> None:
    memory.write_map(tmp_path / "map.pcd", spacing, strays)
    command = [sys.executable, memory.__file__, str(tmp_path)]
    # as Dask starts its workers: what is free goes back to the system
    how = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
    for _ in range(2):  # compiling kernels is promised by no task
        told = subprocess.run(command, env=how, check=True, stdout=subprocess.PIPE, text=True)
        for name in ("map.zarr", "run"):
            (tmp_path / name).rename(tmp_path / f"{name}-{len(list(tmp_path.iterdir()))}")
    tasks = json.loads(told.stdout.splitlines()[-1])
    assert {task["stage"] for task in tasks} == STAGES
    assert [task["reason"] for task in tasks if not task["ok"]] == []
    broken = [task for task in tasks if task["peak"] > task["promised"]]
    assert broken == []
