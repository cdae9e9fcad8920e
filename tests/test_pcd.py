"""PCD: every field order and type, PCL's own bytes, headers that lie."""

import base64
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from points import PCD_TEXT, points_of

from tilestream.errors import CorruptSourceError
from tilestream.formats import Span, open_source
from tilestream.formats.points.pcd import write_pcd

# 40 points of XYZI that PCL 1.13 (pcl::PCDWriter::writeBinaryCompressed) wrote for this test:
# x = 0.5 (i // 4), y = -1.25 + i, z = 0.1 (i % 5), intensity = 7
WRITTEN_BY_PCL = base64.b64decode(
    "IyAuUENEIHYwLjcgLSBQb2ludCBDbG91ZCBEYXRhIGZpbGUgZm9ybWF0ClZFUlNJT04gMC43CkZJ"
    "RUxEUyB4IHkgeiBpbnRlbnNpdHkKU0laRSA0IDQgNCA0ClRZUEUgRiBGIEYgRgpDT1VOVCAxIDEg"
    "MSAxCldJRFRIIDQwCkhFSUdIVCAxClZJRVdQT0lOVCAwIDAgMCAxIDAgMCAwClBPSU5UUyA0MApE"
    "QVRBIGJpbmFyeV9jb21wcmVzc2VkCgcBAACAAgAAAQAA4AgAAD8gEeACAwCAIAvgAwMAwCAP4AMD"
    "AQBAIC/gAgMAICAL4AMDAEAgD+ADAwBgIA/gAwMAgCAP4AMDAJAgD+ADAwWgvwAAgL4gZiB3AOAg"
    "AwAwIB8AcCADAJggAwC4IAMA2CADAPggAwQMQQAAHCADACwgAwA8IAMATCADAFwgAwBsIAMAfCAD"
    "AIYgAwCOIAMAliADAJ4gAwCmIAMAriADALYgAwC+IAMAxiADAM4gAwDWIAMA3iADAOYgAwDuIAMA"
    "9iADAP4gAwQDQgAAByADAAsgAwAPIAMAEyADABcgAw0AAM3MzD3NzEw+mpmZPiALAD4gEuCCEwDg"
    "IRvgjwMB4EA="
)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "a.pcd"
    path.write_text(text)
    return path


def test_what_pcl_compressed(tmp_path: Path) -> None:
    path = tmp_path / "pcl.pcd"
    path.write_bytes(WRITTEN_BY_PCL)
    i = np.arange(40)
    tenth = (i % 5).astype(np.float32) * np.float32(0.1)
    assert np.array_equal(points_of(path), np.column_stack([0.5 * (i // 4), i - 1.25, tenth]))


CODES = {
    "F4": "f", "F8": "d",
    "I1": "b", "I2": "h", "I4": "i", "I8": "q",
    "U1": "B", "U2": "H", "U4": "I", "U8": "Q",
}  # fmt: skip
"""PCD's types and how Python's struct calls them."""


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_order_type_and_count_of_fields(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    encoding = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    others = data.draw(
        st.lists(st.tuples(st.sampled_from(sorted(CODES)), st.integers(1, 3)), max_size=4)
    )
    fields = [(f"f{i}" if i else "_", t, n) for i, (t, n) in enumerate(others)]
    fields += [(axis, data.draw(st.sampled_from(sorted(CODES))), 1) for axis in "xyz"]
    fields = data.draw(st.permutations(fields))
    rows = [
        [[(7 * r + 3 * c + k) % 100 for k in range(n)] for c, (_, _, n) in enumerate(fields)]
        for r in range(9)
    ]
    lines = [
        "VERSION .7",
        "FIELDS " + " ".join(name for name, _, _ in fields),
        "SIZE " + " ".join(t[1] for _, t, _ in fields),
        "TYPE " + " ".join(t[0] for _, t, _ in fields),
        "COUNT " + " ".join(str(n) for _, _, n in fields),
        "WIDTH 3", "HEIGHT 3", "POINTS 9", f"DATA {encoding}",
    ]  # fmt: skip
    codes = [f"{n}{CODES[t]}" for _, t, n in fields]
    if encoding == "ascii":
        content = "".join(
            " ".join(str(v) for cell in row for v in cell) + "\n" for row in rows
        ).encode()
    elif encoding == "binary":
        content = b"".join(
            struct.pack("<" + "".join(codes), *(v for cell in row for v in cell)) for row in rows
        )
    else:
        raw = b"".join(
            struct.pack("<" + code, *row[c]) for c, code in enumerate(codes) for row in rows
        )
        packed = b"".join(
            bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32)
        )
        content = struct.pack("<II", len(packed), len(raw)) + packed
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    path.write_bytes("".join(f"{line}\n" for line in lines).encode() + content)

    axes = [[name for name, _, _ in fields].index(axis) for axis in "xyz"]
    truth = np.array([[row[c][0] for c in axes] for row in rows], dtype=float)
    assert np.array_equal(points_of(path), truth)
    assert [name for name, _ in open_source(path).info().fields] == [name for name, _, _ in fields]


def test_float64_coordinates_arrive_exactly(tmp_path: Path) -> None:
    truth = np.array([[4123456.123456789, -0.1, 1e-300], [2.0**-40 + 5e5, np.pi, 3.0]])
    for encoding in ("ascii", "binary", "binary_compressed"):
        write_pcd(tmp_path / "a.pcd", truth, encoding=encoding)
        assert np.array_equal(points_of(tmp_path / "a.pcd"), truth)


def test_the_writer_takes_float32_where_that_loses_nothing_that_matters(tmp_path: Path) -> None:
    for offset, width in ((0.0, "float32"), (1e3, "float32"), (5e3, "float64"), (4e6, "float64")):
        points = np.random.default_rng(0).uniform(offset, offset + 100, (500, 3))
        write_pcd(tmp_path / "a.pcd", points, fields={"ring": np.arange(500, dtype=np.uint16)})
        found = open_source(tmp_path / "a.pcd").info()
        assert found.fields == (*((axis, width) for axis in "xyz"), ("ring", "uint16"))
        assert np.abs(points_of(tmp_path / "a.pcd") - points).max() <= 1e-4


def test_old_and_odd_headers(tmp_path: Path) -> None:
    truth = [[1.0, 2, 3], [4, 5, 6]]
    for old, new in (
        ("", ""),
        ("FIELDS", "COLUMNS"),
        ("COUNT 1 1 1\n", ""),
        ("WIDTH 2\nHEIGHT 1\n", ""),
        ("POINTS 2\n", ""),
        ("HEIGHT 1\n", "HEIGHT 1\n\n# a comment\n"),
        ("\n", "\r\n"),
        ("1 2 3\n", "  1\t2   3 \n\n"),
        ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 9 9 9 0.5 0.5 0.5 0.5"),
    ):
        path = written(tmp_path, PCD_TEXT)
        path.write_bytes(PCD_TEXT.replace(old, new).encode() if old else PCD_TEXT.encode())
        assert np.array_equal(points_of(path), truth), (old, new)


def test_compressed_sizes_are_checked_before_unpacking(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_pcd(path, np.random.default_rng(0).normal(size=(100, 3)), encoding="binary_compressed")
    content = path.read_bytes()
    data = content.index(b"compressed\n") + len(b"compressed\n")
    packed, unpacked = struct.unpack_from("<II", content, data)
    for sizes, message in (
        ((2**32 - 1, unpacked), "claims 4294967295 compressed bytes"),
        ((packed, 2**32 - 1), "claims 4294967295 bytes of points"),
        ((3, unpacked), "more than LZF can hold"),
        ((packed - 5, unpacked), "damaged at offset"),
    ):
        path.write_bytes(content[:data] + struct.pack("<II", *sizes) + content[data + 8 :])
        with pytest.raises(CorruptSourceError, match=message):
            points_of(path)


def test_bytes_behind_the_last_point_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_pcd(path, np.ones((3, 3)))
    path.write_bytes(path.read_bytes() + bytes(5))
    assert open_source(path).info().notes == ("5 bytes behind the last point are ignored",)
    assert np.array_equal(points_of(path), np.ones((3, 3)))


@pytest.mark.parametrize(
    "word",
    ["-nan(ind)", "nan(snan)", "-nan", "NaN", "1.#INF", "-1.#IND", "1.#QNAN0", "inf", "-1.#INF00"],
)
def test_words_for_what_is_not_finite(word: str, tmp_path: Path) -> None:
    path = written(tmp_path, PCD_TEXT.replace("1 2 3\n", f"1 {word} 3\n"))
    (block,) = open_source(path).blocks(Span(0, 2), 2)
    assert (block.points.tolist(), block.dropped) == ([[4.0, 5.0, 6.0]], 1)


@pytest.mark.parametrize("word", ["nan(", "1.#", "1.5#INF", "nano"])
def test_words_that_are_no_numbers_at_all(word: str, tmp_path: Path) -> None:
    path = written(tmp_path, PCD_TEXT.replace("1 2 3\n", f"1 {word} 3\n"))
    with pytest.raises(CorruptSourceError, match="point 0 is"):
        list(open_source(path).blocks(Span(0, 2), 2))
