"""Files of points in every format, and what they hold, read in pieces."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import logs
import numpy as np
import plyfile
import pytest
from numpy.typing import NDArray

from tilestream.formats import Block, open_source
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd

Points = NDArray[np.float64]
HALF_MM = 0.0005 + 1e-9
N = 1000
"""Points of each case."""
PCD_TEXT = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
1 2 3
4 5 6
"""
PLY_TEXT = """ply
format ascii 1.0
comment made by hand
obj_info nothing
element vertex 2
property float x
property float y
property float z
end_header
1 2 3
4 5 6
"""


def write_ply_lists(path: Path, points: np.ndarray) -> None:
    """A face first, and a list in each vertex."""
    vertex = np.empty(len(points), [(name, "f8") for name in "xyz"] + [("seen", object)])
    for axis, name in enumerate("xyz"):
        vertex[name] = points[:, axis]
    vertex["seen"] = [np.arange(i % 3, dtype="i4") for i in range(len(points))]
    face = np.array([((0, 1, 2),)], [("vertex_indices", "i4", (3,))])
    elements = [
        plyfile.PlyElement.describe(face, "face"),
        plyfile.PlyElement.describe(vertex, "vertex", val_types={"seen": "i4"}),
    ]
    plyfile.PlyData(elements, byte_order="<").write(str(path))


def write_ply(path: Path, points: np.ndarray, byte_order: str = "<", text: bool = False) -> None:
    vertex = plyfile.PlyElement.describe(np.rec.fromarrays(points.T, names="x,y,z"), "vertex")
    plyfile.PlyData([vertex], text=text, byte_order=byte_order).write(str(path))


def blocks_of(
    path: Path, span_points: int = 1000, block_points: int = 77, **options: object
) -> list[Block]:
    """Each span is read by a source of its own, as by another process."""
    return [
        block
        for span in open_source(path, **options).spans(span_points)
        for block in open_source(path, **options).blocks(span, block_points)
    ]


def points_of(
    path: Path, span_points: int = 1000, block_points: int = 77, **options: object
) -> np.ndarray:
    blocks = blocks_of(path, span_points, block_points, **options)
    return np.concatenate([np.empty((0, 3)), *(block.points for block in blocks)])


def write_e57(path: Path, points: Points) -> None:
    """Two scans with poses, as a scanner stores them: near its own origin, in single precision."""
    pye57 = pytest.importorskip("pye57")
    path.unlink(missing_ok=True)
    quarter = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    with pye57.E57(str(path), "w") as file:
        for part in np.array_split(points, 2):
            if len(part):
                place = np.round(part.mean(axis=0))
                east, north, up = (part - place).T
                scan = {"cartesianX": north, "cartesianY": -east, "cartesianZ": up}
                file.write_scan_raw(scan, translation=place, rotation=quarter)


def write_map_directory(path: Path, points: Points) -> None:
    (path / "pointcloud_map.pcd").mkdir(parents=True, exist_ok=True)
    lines = ["x_resolution: 20.0", "y_resolution: 20.0"]
    for i, part in enumerate(np.array_split(points, 3)):
        write_pcd(path / "pointcloud_map.pcd" / f"{i}.pcd", part, encoding="binary_compressed")
        lines.append(f"{i}.pcd: [{20 * i}, 0]")
    (path / "pointcloud_map_metadata.yaml").write_text("\n".join(lines))


def write_drive(path: Path, points: Points) -> None:
    """Four scans with poses: coordinates near the lidar, in double precision."""
    messages = []
    for i, part in enumerate(np.array_split(points, 4)):
        stamp = logs.START + i * logs.SECOND
        finite = part[np.isfinite(part).all(axis=1)]
        place = np.round(finite.mean(axis=0)) if len(finite) else np.zeros(3)
        messages.append(logs.odometry_at(stamp, logs.pose(*place)))
        cloud = logs.cloud(stamp, logs.xyz_rows(part - place, "<f8"))
        messages.append((stamp, "/points", "sensor_msgs/msg/PointCloud2", cloud))
    logs.write(path, messages)


@dataclass(frozen=True)
class Case:
    file: str
    write: Callable[[Path, Points], None]
    tolerance: float
    holds_nan: bool = True


CASES = {
    "pcd ascii": Case("a.pcd", functools.partial(write_pcd, encoding="ascii"), 0.0),
    "pcd binary": Case("b.pcd", write_pcd, 0.0),
    "pcd compressed": Case(
        "c.pcd", functools.partial(write_pcd, encoding="binary_compressed"), 0.0
    ),
    "ply ascii": Case("a.ply", functools.partial(write_ply, text=True), 0.0),
    "ply little": Case("l.PLY", write_ply, 0.0),
    "ply lists": Case("v.ply", write_ply_lists, 0.0),
    "ply big": Case("b.ply", functools.partial(write_ply, byte_order=">"), 0.0),
    "las": Case("a.las", write_las, HALF_MM, holds_nan=False),
    "laz": Case("a.laz", write_las, HALF_MM, holds_nan=False),
    "e57": Case("a.e57", write_e57, HALF_MM, holds_nan=False),
    "autoware": Case("map", write_map_directory, 0.0),
    "mcap": Case("a.mcap", write_drive, 1e-9),
}


def far_points(n: int) -> Points:
    """Points of a street block in UTM, 4,000,000 m from the origin."""
    rng = np.random.default_rng(n)
    return rng.uniform([4e6 - 60, 5e5 - 60, -3], [4e6 + 60, 5e5 + 60, 40], (n, 3))
