"""LAS and LAZ: scale and offset, CRS, chunks of any size, claims of the header."""

import io
import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pyproj
import pytest
from fuzz_bombs import of_laz
from points import points_of

from tilestream.errors import CorruptSourceError, CrsError
from tilestream.formats import describe, open_source
from tilestream.formats.points.las import open_las, write_las


def record_of(
    point_format: int, version: str, n: int = 1000
) -> tuple[laspy.LasHeader, laspy.ScaleAwarePointRecord]:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.01, 0.00025, 0.1], [4e6, -123456.789, 0.0]
    record = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    rng = np.random.default_rng(point_format)
    for name in "XYZ":
        record[name] = rng.integers(-(2**31), 2**31, n)
    record["intensity"] = rng.integers(0, 2**16, n)
    return header, record


@pytest.mark.parametrize(
    ("point_format", "version"),
    [
        (0, "1.2"),
        (1, "1.2"),
        (3, "1.2"),
        (3, "1.3"),
        (2, "1.4"),
        (6, "1.4"),
        (7, "1.4"),
        (8, "1.4"),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_scale_and_offset_to_the_bit(
    point_format: int, version: str, packed: bool, tmp_path: Path
) -> None:
    header, record = record_of(point_format, version)
    path = tmp_path / ("a.laz" if packed else "a.las")
    laspy.LasData(header, record).write(path)
    truth = np.column_stack(
        [
            record[name] * s + o
            for name, s, o in zip("XYZ", header.scales, header.offsets, strict=True)
        ]
    )
    assert np.array_equal(points_of(path), truth)
    found = open_source(path).info()
    assert found.format == f"{'laz' if packed else 'las'} {version}"
    assert found.bounds is not None
    assert np.allclose(found.bounds, [truth.min(axis=0), truth.max(axis=0)], rtol=0, atol=0.1)


def test_our_files_read_with_laspy(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform([4e6, 5e5, 0], [4e6 + 99, 5e5 + 99, 9], (70_000, 3))
    for name in ("a.las", "a.laz"):
        write_las(tmp_path / name, points, crs="EPSG:6677")
        las = laspy.read(tmp_path / name)
        assert np.abs(las.xyz - points).max() <= 0.0005 + 1e-9
        assert las.header.parse_crs() == pyproj.CRS("EPSG:6677")
        assert (las.header.offsets == np.round(las.header.offsets)).all()


def test_crs_of_wkt_and_geotiff_keys(tmp_path: Path) -> None:
    for point_format, version in ((3, "1.2"), (6, "1.4")):
        header, record = record_of(point_format, version)
        header.add_crs(pyproj.CRS("EPSG:32654"))
        laspy.LasData(header, record).write(tmp_path / "a.las")
        assert open_source(tmp_path / "a.las").info().crs == "EPSG:32654"

    own = "+proj=tmerc +lat_0=35.6 +lon_0=139.7 +k=0.9996 +datum=WGS84 +units=m +type=crs"
    write_las(tmp_path / "own.las", np.zeros((1, 3)), crs=own)
    crs = open_source(tmp_path / "own.las").info().crs
    assert crs is not None
    assert pyproj.CRS(crs) == pyproj.CRS(pyproj.CRS(own).to_wkt())
    with pytest.raises(CrsError, match="EPSG:0"):
        write_las(tmp_path / "no.las", np.zeros((1, 3)), crs="EPSG:0")


def test_a_crs_that_cannot_be_read_or_is_unnamed_is_a_note(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    write_las(path, np.zeros((1, 3)), crs="EPSG:32654")
    path.write_bytes(path.read_bytes().replace(b"PROJCRS[", b"PROJJUNK"))
    found = open_source(path).info()
    assert found.crs is None
    assert "its CRS cannot be read" in found.notes[0]

    header, record = record_of(3, "1.2")
    header.add_crs(pyproj.CRS("EPSG:32654"))
    laspy.LasData(header, record).write(path)
    key = struct.pack("<4H", 3072, 0, 1, 32654)
    content = path.read_bytes()
    assert content.count(key) == 1
    path.write_bytes(content.replace(key, struct.pack("<4H", 3072, 0, 1, 32767)))
    found = open_source(path).info()
    assert found.crs is None
    assert any("no CRS by a code" in note for note in found.notes)


def test_a_unit_that_nothing_tells_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    assumed = "names no unit of length: taken to be in metres"
    for crs in (None, "EPSG:32654"):  # what we write is in metres
        write_las(path, np.zeros((1, 3)), crs=crs)
        assert open_source(path).info().notes == ()
    header, record = record_of(3, "1.2")
    laspy.LasData(header, record).write(path)
    assert assumed in open_source(path).info().notes
    # The keys of GeoTIFF may name a unit and no CRS.
    header.add_crs(pyproj.CRS("EPSG:32654"))
    laspy.LasData(header, record).write(path)
    unknown = struct.pack("<4H", 3072, 0, 1, 32767)
    without = path.read_bytes().replace(struct.pack("<4H", 3072, 0, 1, 32654), unknown)
    unit = struct.pack("<2H", 1024, 0)
    at = without.index(unit)  # the key of the kind of CRS makes room for that of the unit
    for code, said in ((9001, False), (9002, False), (9999, True)):
        key = struct.pack("<4H", 3076, 0, 1, code)
        path.write_bytes(without[:at] + key + without[at + 8 :])
        assert (assumed in open_source(path).info().notes) is said, code


def laz_of_chunks(edges: list[int]) -> tuple[bytes, np.ndarray]:
    """A LAZ file whose chunks end where they are told to, as in COPC."""
    header, record = record_of(7, "1.4", edges[-1])
    stream = io.BytesIO()
    laspy.LasData(header, record).write(stream, do_compress=True)
    content = stream.getvalue()
    start = laspy.LasHeader.read_from(io.BytesIO(content)).offset_to_point_data
    vlr = lazrs.LazVlr.new_for_compression(7, 0, True)
    fixed = lazrs.LazVlr.new_for_compression(7, 0, False).record_data()
    head = content[:start]
    assert head.count(fixed) == 1
    stream = io.BytesIO()
    stream.write(head.replace(fixed, vlr.record_data()))
    packer = lazrs.LasZipCompressor(stream, vlr)
    packer.reserve_offset_to_chunk_table()
    for a, b in zip([0, *edges[:-1]], edges, strict=True):
        packer.compress_many(np.frombuffer(record.array[a:b].tobytes(), np.uint8))
        packer.finish_current_chunk()
    packer.done()
    truth = np.column_stack(
        [record[n] * s + o for n, s, o in zip("XYZ", header.scales, header.offsets, strict=True)]
    )
    return stream.getvalue(), truth


def test_chunks_of_any_size_as_copc_has_them(tmp_path: Path) -> None:
    content, truth = laz_of_chunks([10, 400, 401, 1000])
    path = tmp_path / "a.copc.laz"
    path.write_bytes(content)
    source = open_las(str(path))
    assert [(s.start, s.stop) for s in source.spans(300)] == [(0, 400), (400, 1000)]
    for span in reversed(source.spans(1)):
        part = np.concatenate([b.points for b in source.blocks(span, 37)])
        assert np.array_equal(part, truth[span.start : span.stop])


def test_spans_are_whole_chunks(tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", np.random.default_rng(0).normal(size=(120_000, 3)))
    spans = open_source(tmp_path / "a.laz").spans(10)
    assert [(s.start, s.stop) for s in spans] == [
        (0, 50_000),
        (50_000, 100_000),
        (100_000, 120_000),
    ]


def test_a_chunk_that_claims_more_than_it_has_is_refused(tmp_path: Path) -> None:
    content, _ = laz_of_chunks([10, 100])
    header = laspy.LasHeader.read_from(io.BytesIO(content))
    layers_at = header.offset_to_point_data + 8 + header.point_format.size + 4
    path = tmp_path / "a.laz"
    path.write_bytes(content[:layers_at] + struct.pack("<I", 2**31) + content[layers_at + 4 :])
    with pytest.raises(CorruptSourceError, match=r"a\.laz: .*its layers claim \[2147483648, "):
        points_of(path)
    for forged in of_laz(content):
        path.write_bytes(forged)
        with pytest.raises(CorruptSourceError, match=r"a\.laz: "):
            points_of(path)


def test_claims_of_the_header_are_checked(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    write_las(tmp_path / "a.las", points)
    write_las(tmp_path / "a.laz", points)
    table_at = int.from_bytes((tmp_path / "a.laz").read_bytes()[429 + 40 :][:8], "little")
    for name, offset, value, message in (
        ("a.las", 131, struct.pack("<d", np.nan), "scale"),
        ("a.las", 139, struct.pack("<d", 0.0), "scale"),
        ("a.las", 155, struct.pack("<d", np.inf), "offset"),
        ("a.las", 96, struct.pack("<I", 2**31), "from offset 2147483648"),
        ("a.las", 100, struct.pack("<I", 2**32 - 1), "4294967295 VLRs"),
        ("a.las", 243, struct.pack("<I", 5), "extended record"),
        ("a.laz", table_at + 4, struct.pack("<I", 2**32 - 1), "claims 4294967295 chunks"),
        ("a.laz", 247, struct.pack("<Q", 50_001), "claims 50001 points"),
    ):
        content = bytearray((tmp_path / name).read_bytes())
        content[offset : offset + len(value)] = value
        path = tmp_path / f"damaged_{name}"
        path.write_bytes(content)
        with pytest.raises(CorruptSourceError, match=message):
            open_source(path)


@pytest.mark.parametrize("point_format", range(11))
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_noise_is_left_out_whatever_the_point_format(
    point_format: int, name: str, tmp_path: Path
) -> None:
    if name.endswith("laz") and point_format in (4, 5, 9, 10):
        pytest.skip("lazrs packs no wave packets")
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(8.0)
    las.classification = np.array([0, 7, 2, 18, 1, 6, 2, 7], np.uint8)
    las.withheld = np.array([0, 0, 1, 0, 0, 0, 0, 1])
    las.synthetic = las.key_point = np.array([1, 0, 0, 0, 0, 1, 0, 0])
    las.write(tmp_path / name)
    source = open_source(tmp_path / name)
    (block,) = source.blocks(source.spans(8)[0], 8)
    assert block.points[:, 0].tolist() == [0.0, 4.0, 5.0, 6.0]
    assert (block.left_out, block.dropped) == (4, 0)
    source = open_source(tmp_path / name, keep_noise=True)
    (block,) = source.blocks(source.spans(8)[0], 8)
    assert (len(block.points), block.left_out) == (8, 0)


@pytest.mark.parametrize(
    "bounds",
    [
        (np.nan,) * 6,
        (0.0,) * 6,
        (-np.inf, np.inf) * 3,
        (np.finfo(float).min, np.finfo(float).max) * 3,
        (7e5, 6e5, 7e5, 6e5, 7e5, 6e5),
    ],
)
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_bounds_that_cannot_be_are_those_of_the_points(
    bounds: tuple[float, ...], name: str, tmp_path: Path
) -> None:
    write_las(tmp_path / name, [[5.0, 6.0, 7.0], [8.0, 9.0, 10.0]])
    content = bytearray((tmp_path / name).read_bytes())
    assert describe(tmp_path / name).notes == ()
    content[179:227] = struct.pack("<6d", *bounds)  # highest and lowest, of x, y and z
    (tmp_path / name).write_bytes(content)
    assert open_source(tmp_path / name).info().bounds is None
    found = describe(tmp_path / name)
    assert found.bounds == ((5.0, 6.0, 7.0), (8.0, 9.0, 10.0))
    assert "the bounds in its header" in found.notes[0]


def test_the_same_points_have_the_same_bytes_on_any_day(tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", np.arange(30.0).reshape(10, 3))
    day = laspy.read(tmp_path / "a.laz").header.creation_date
    assert day is not None
    assert (day.year, day.month, day.day) == (1970, 1, 1)
