"""Runs the stages of a map, of routes and of drives over `map.pcd` in a folder, in one process, and
prints what each task promised and what it took.

    python tests/memory.py FOLDER
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from logs import SECOND, START, cloud_at, odometry_at, pose, write
from scenes import PLACES

import tilestream as ts
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import route_of
from tilestream.pipeline.engine import attempt as attempts
from tilestream.pipeline.engine import executor
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import BASE_BYTES
from tilestream.pipeline.stages.map_plan import MapPlan

LENGTH = 44.0
MOST = 10**11
"""What a task may use here: all that it promises [bytes]."""


def peak_bytes() -> int:
    """The most that this process held since `forget`."""
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024


def forget() -> None:
    """From here on, the peak is what is held now."""
    Path("/proc/self/clear_refs").write_text("5")


def watched(tasks: list[dict[str, Any]]) -> Any:
    """`attempt` that notes what each task promised and what it took."""
    plain = executor.attempt

    def noted(task: Any, memory: int | None = None) -> Any:
        counts = attempts._read_counts(task)
        forget()
        outcome = plain(task, memory)
        promised = BASE_BYTES + task.applies.memory(counts)
        told = {"stage": task.stage, "promised": promised, "peak": peak_bytes()}
        tasks.append(told | {"ok": outcome.ok, "reason": outcome.reason})
        return outcome

    return noted


def street(spacing: float, seed: int) -> np.ndarray:
    """A canyon within one tile, about 1,900 / spacing^2 points [m]."""
    points = PLACES["canyon"](np.random.default_rng(seed), LENGTH, spacing)
    return points + np.array([10.0, 50.0, 0.0])


def write_drive(path: Path) -> Path:
    """Some scans along it."""
    seen, messages = street(0.7, 100), []
    for i in range(4):
        T_map_lidar = pose(x=20.0 + 6.0 * i, y=50.0, z=2.0)
        points = seen - T_map_lidar[:3, 3]
        messages.append(odometry_at(START + i * SECOND, T_map_lidar))
        near = points[np.linalg.norm(points, axis=1) < 14.0]
        messages.append(cloud_at(START + i * SECOND, near))
    return write(path, messages)


def write_map(path: Path, spacing: float, strays: bool) -> None:
    """The street, and two points 990 km apart."""
    points = street(spacing, 1)
    if strays:
        points = np.concatenate([points, [[-3.5e5, -3.5e5, 0.0], [3.5e5, 3.5e5, 0.0]]])
    write_pcd(path, points)


def main(folder: Path) -> None:
    """Ingest, factors, observability, pictures and labels, each task in this process."""
    tasks: list[dict[str, Any]] = []
    executor.attempt = watched(tasks)
    store = ts.ingest(folder / "map.pcd", str(folder / "map.zarr"), map_leaf=0.0, memory=MOST)
    along = np.linspace(15.0, 45.0, 31)
    route = route_of("way", np.column_stack([along, np.full(31, 50.0), np.full(31, 2.0)]))
    how: dict[str, Any] = {"spacing": 10.0, "memory": MOST}
    ts.factors_along(store, [route], str(folder / "run"), **how)
    ts.observe_along(store, [route], str(folder / "run"), **how)
    starts = ts.StartSettings(radius=0.4, step=0.2)
    drive = write_drive(folder / "drive.mcap")
    map_plan = MapPlan.of_store(store)
    pictures = Plan.of([map_plan.above(key) for key in store.keys()], MOST)
    executor.execute(pictures, None, None)
    ts.localize(store, drive, str(folder / "run"), starts=starts, **how)
    print(json.dumps(tasks))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
