"""PLY: against plyfile, every property type, elements beside the vertices, headers that lie."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
from points import PLY_TEXT, points_of

from tilestream.errors import CorruptSourceError
from tilestream.formats import Span, open_source


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


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("lists", [(), ("before",), ("behind",), ("before", "between", "behind")])
def test_vertices_among_lists(
    text: bool, order: str, first: bool, lists: tuple[str, ...], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    names = ["before"] * ("before" in lists) + ["x", "y"]
    names += ["between"] * ("between" in lists) + ["z"] + ["behind"] * ("behind" in lists)
    vertex = np.empty(40, [(name, "f8" if name in "xyz" else object) for name in names])
    truth = rng.normal(0.0, 100.0, (40, 3))
    swapped = order == ">" and lists  # plyfile 1.1 does not swap numbers beside lists
    for name in names:
        if name in "xyz":
            column = np.ascontiguousarray(truth[:, "xyz".index(name)])
            vertex[name] = column.byteswap() if swapped else column
        else:
            vertex[name] = [rng.integers(0, 9, n).astype("i4") for n in rng.integers(0, 300, 40)]
    face = np.empty(7, [("vertex_indices", object), ("quality", "f4")])
    face["vertex_indices"] = [np.arange(n, dtype="i2") for n in (3, 4, 3, 0, 250, 3, 5)]
    face["quality"] = 1.0
    count = {"len_types": dict.fromkeys(lists, "i4"), "val_types": dict.fromkeys(lists, "i4")}
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex", **count),
        plyfile.PlyElement.describe(face, "face", val_types={"vertex_indices": "i2"}),
    ]
    path = tmp_path / "a.ply"
    ordered = elements if first else elements[::-1]
    plyfile.PlyData(ordered, text=text, byte_order=order).write(str(path))
    assert np.array_equal(points_of(path), truth)
    source = open_source(path)
    (span,) = source.spans(1000)
    blocks = [block.points for block in source.blocks(Span(5, span.stop), 7)]
    assert np.array_equal(np.concatenate(blocks), truth[5:])
    content = path.read_bytes()
    if not first:
        path.write_bytes(content[:-1] if not text else content[: content.rindex(b" ")])
        with pytest.raises(CorruptSourceError, match="cut short"):
            points_of(path)


def test_a_list_that_claims_more_than_the_file_is_cut_short(tmp_path: Path) -> None:
    head = PLY_TEXT[: PLY_TEXT.index("end_header")].replace("ascii", "binary_little_endian")
    head = head.replace(
        "element vertex 2", "element face 1\nproperty list uint int i\nelement vertex 2"
    )
    for count in (2**32 - 1, 1000, 6):
        data = count.to_bytes(4, "little") + bytes(24)
        (tmp_path / "a.ply").write_bytes(f"{head}end_header\n".encode() + data)
        with pytest.raises(CorruptSourceError, match=r"its element '(face|vertex)' ends behind it"):
            points_of(tmp_path / "a.ply")


def test_what_has_no_vertices_or_lists_of_coordinates_is_refused(tmp_path: Path) -> None:
    for old, new, told in (
        ("element vertex", "element point", "no element 'vertex'"),
        ("property float z", "property list uchar float z", "0 fields 'z'"),
        ("property float z", "property float z\nproperty list float int i", "unknown type"),
    ):
        (tmp_path / "a.ply").write_text(PLY_TEXT.replace(old, new))
        with pytest.raises(CorruptSourceError, match=told):
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
