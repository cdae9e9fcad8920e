"""What a file of points holds, read in pieces."""

from pathlib import Path

import numpy as np
import plyfile

from tilestream.formats import Block, open_source

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
