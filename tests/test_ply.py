"""PLY: against plyfile, every property type, elements beside the vertices, headers that lie."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
from points import PLY_TEXT, points_of

from tilestream.errors import CorruptSourceError, UnknownFormatError
from tilestream.formats import open_source


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"])
@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_what_plyfile_writes(dtype: str, text: bool, order: str, tmp_path: Path) -> None:
    vertex = np.zeros(
        50, [("quality", "f4"), ("z", dtype), ("y", dtype), ("t", "u1"), ("x", dtype)]
    )
    rng = np.random.default_rng(0)
    for axis in "xyz":
        vertex[axis] = rng.integers(0, 100, 50)
    face = np.zeros(3, [("vertex_indices", "i4", (3,))])
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face"),
    ]
    plyfile.PlyData(elements, text=text, byte_order=order).write(str(tmp_path / "a.ply"))
    truth = np.column_stack([vertex[axis] for axis in "xyz"]).astype(float)
    assert np.array_equal(points_of(tmp_path / "a.ply"), truth)
    assert open_source(tmp_path / "a.ply").info().notes == ("element 'face' (3 rows) is ignored",)


def test_lines_of_either_end(tmp_path: Path) -> None:
    for end in ("\n", "\r\n"):
        (tmp_path / "a.ply").write_bytes(PLY_TEXT.replace("\n", end).encode())
        assert np.array_equal(points_of(tmp_path / "a.ply"), [[1, 2, 3], [4, 5, 6]])


def test_vertices_come_first_and_have_no_lists(tmp_path: Path) -> None:
    for old, new in (
        ("element vertex 2", "element face 0\nelement vertex 2"),
        ("float z\n", "float z\nproperty list uchar int near\n"),
    ):
        (tmp_path / "a.ply").write_text(PLY_TEXT.replace(old, new))
        with pytest.raises(UnknownFormatError, match="vertices first and without lists"):
            open_source(tmp_path / "a.ply")


def test_a_binary_file_that_ends_within_its_faces_is_cut_short(tmp_path: Path) -> None:
    vertex = np.zeros(5, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    edge = np.zeros(9, [("a", "i4"), ("b", "i4")])
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(edge, "edge"),
    ]
    path = tmp_path / "a.ply"
    plyfile.PlyData(elements, text=False, byte_order="<").write(str(path))
    assert len(points_of(path)) == 5
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CorruptSourceError, match="9 rows of element 'edge'"):
        open_source(path)
