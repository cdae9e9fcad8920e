"""Three short streets, far apart on one map, and a drive along each: a whole job in miniature."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import logs
import numpy as np
import pytest
from logs import SECOND, START, pose
from scenes import PLACES, in_map

from tilestream.formats.points.pcd import write_pcd
from tilestream.model import forest, registry
from tilestream.model.forest import Growth, PaperForest
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.report import pictures

STREETS = {"canyon": 0.0, "tunnel": 400.0, "crossing": 800.0}
"""Kind of each street, and where it begins [m, map x]."""
LENGTH = 44.0
SCANS = 26
"""One per metre of a drive."""
REACH = 14.0
"""How far its lidar sees [m]."""


def street(kind: str, seed: int, spacing: float) -> np.ndarray:
    points = PLACES[kind](np.random.default_rng(seed), LENGTH, spacing)
    return in_map(points, (STREETS[kind], 0.0, 0.0))


def write_drive(path: Path, kind: str, off: float = 0.0) -> Path:
    """The log of a drive whose poses are so far off to the side [m]."""
    messages: list[logs.Message] = []
    seen = street(kind, 100, 0.7) + np.array([0.0, off, 0.0])
    for i in range(SCANS):
        T_map_lidar = pose(x=STREETS[kind] + 8.0 + i, y=0.1 * np.sin(i), z=2.0)
        stamp = START + i * SECOND
        points = (seen - T_map_lidar[:3, 3]) @ T_map_lidar[:3, :3]
        near = points[np.linalg.norm(points, axis=1) < REACH]
        messages.append(logs.odometry_at(stamp, T_map_lidar))
        messages.append(logs.cloud_at(stamp, near))
    return logs.write(path, messages, chunk_size=200_000)


def write_inputs(folder: Path) -> None:
    """`map_<kind>.pcd` and `<kind>.mcap` of every street."""
    for kind in STREETS:
        write_pcd(folder / f"map_{kind}.pcd", street(kind, 1, 0.3))
        write_drive(folder / f"{kind}.mcap", kind)


def job(folder: Path, out: Path, **changes: object) -> RunSettings:
    """The settings of the job over `write_inputs`."""
    values: dict[str, object] = {
        "out": str(out),
        "map": {"sources": [str(folder / "map_*.pcd")], "tile_size": 50.0},
        "drives": [{"log": str(folder / f"{kind}.mcap")} for kind in STREETS],
        "observe": None,
        "label": {"matcher": "default", "starts": {"radius": 0.4, "step": 0.2}},
        "model": {"recipe": "forest"},
    }
    return RunSettings(**(values | changes))


@contextmanager
def small(cache: Path) -> Iterator[None]:
    """Five trees instead of a hundred, coarse pictures: for tests that are about the job. What they
    learn of costs stays in a folder of their own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setattr(PaperForest, "defaults", asdict(Growth(trees=5)))
        patch.setattr(forest, "CANDIDATES", (Growth(trees=4, leaf=2, log=True),))
        patch.delitem(registry.COMPETITORS, "mlp")  # a thousand passes over the data
        patch.setattr(pictures.png, "__defaults__", (20,))
        yield
