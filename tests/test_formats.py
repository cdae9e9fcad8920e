"""One conformance test over all formats: the same points in, the same points out, or an error."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from points import CASES, HALF_MM, PCD_TEXT, PLY_TEXT, N, Points, blocks_of, far_points

from tilestream.errors import (
    CorruptSourceError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    UsageError,
)
from tilestream.formats import FORMATS, describe, expand_sources, open_source
from tilestream.formats.points import pcd, rows
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd

IN_ONE_FILE = [name for name in CASES if name != "autoware"]
ALL_OR_NOTHING = [name for name in IN_ONE_FILE if name != "mcap"]
"""Formats that are not read if the file is cut short: of a log, the scans that are whole are."""


def read(path: Path, span_points: int = N, block_points: int = N) -> tuple[Points, int]:
    blocks = blocks_of(path, span_points, block_points)
    points = np.concatenate([np.empty((0, 3)), *(block.points for block in blocks)])
    return points, sum(block.dropped for block in blocks)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("formats")
    for case in CASES.values():
        case.write(folder / case.file, far_points(N))
    return {name: folder / case.file for name, case in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_same_points_in_same_points_out(name: str, files: dict[str, Path]) -> None:
    points, dropped = read(files[name])
    assert points.dtype == np.float64
    assert dropped == 0
    assert points.shape == (N, 3)
    assert np.abs(points - far_points(N)).max() <= CASES[name].tolerance


@pytest.mark.parametrize("name", CASES)
def test_info_agrees_with_the_content(name: str, files: dict[str, Path]) -> None:
    found = describe(files[name])
    paths = [p for p in files[name].rglob("*.pcd") if p.is_file()] or [files[name]]
    assert found.path == str(files[name])
    assert found.points == N
    assert found.size_bytes == sum(p.stat().st_size for p in paths)
    assert found.crs is None
    assert found.fields
    assert found.bounds is not None
    for edge, truth in zip(found.bounds, (np.min, np.max), strict=True):
        assert np.abs(edge - truth(far_points(N), axis=0)).max() <= HALF_MM


@pytest.mark.parametrize("name", CASES)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.differing_executors])
@given(
    span_points=st.integers(1, N + 300), block_points=st.integers(1, N + 300), seed=st.integers()
)
def test_spans_and_blocks_are_the_file_in_pieces(
    name: str, files: dict[str, Path], span_points: int, block_points: int, seed: int
) -> None:
    spans = open_source(files[name]).spans(span_points)
    assert [s.start for s in spans] == [0, *(s.stop for s in spans[:-1])]
    assert spans[-1].stop == N
    assert all(s.start < s.stop for s in spans)

    parts: dict[int, Points] = {}
    order = np.random.default_rng(abs(seed)).permutation(len(spans))[:20]
    for i in order:
        blocks = list(open_source(files[name]).blocks(spans[i], block_points))
        assert all(len(b.points) + b.dropped <= block_points for b in blocks)
        parts[i] = np.concatenate([b.points for b in blocks])
    whole = read(files[name])[0]
    for i, part in parts.items():
        assert np.array_equal(part, whole[spans[i].start : spans[i].stop])


@pytest.mark.parametrize("name", ["pcd binary", "ply little", "ply big", "las"])
def test_formats_of_equal_rows_read_any_span(name: str, files: dict[str, Path]) -> None:
    assert len(open_source(files[name]).spans(10)) == N // 10


@pytest.mark.parametrize("name", ALL_OR_NOTHING)
def test_a_file_cut_anywhere_is_an_error(name: str, files: dict[str, Path], tmp_path: Path) -> None:
    content = files[name].read_bytes()
    rng = np.random.default_rng(1)
    cuts = {*range(0, 400, 7), *rng.integers(0, len(content), 60).tolist()}
    cuts |= {len(content) - k for k in (1, 2, 3, 4, 8, 16, 1024)}
    cut = tmp_path / files[name].name
    for length in sorted(k for k in cuts if 0 <= k < len(content)):
        cut.write_bytes(content[:length])
        with pytest.raises(CorruptSourceError, match=cut.name):
            read(cut)


@pytest.mark.parametrize("name", IN_ONE_FILE)
def test_a_damaged_file_is_an_error_or_numbers_and_no_crash(
    name: str, files: dict[str, Path], tmp_path: Path
) -> None:
    content = files[name].read_bytes()
    rng = np.random.default_rng(2)
    damaged, refusals = tmp_path / files[name].name, []
    for i in range(120):
        flipped = bytearray(content)
        reach = 400 if i % 2 else len(content)
        flipped[int(rng.integers(reach))] ^= int(rng.integers(1, 256))
        damaged.write_bytes(flipped)
        try:
            points, dropped = read(damaged)
        except SourceError as error:
            refusals.append(str(error))
        else:
            assert len(points) + dropped <= N
            assert np.isfinite(points).all()
    assert refusals
    assert [r for r in refusals if damaged.name not in r or "\n" in r] == []


@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.holds_nan])
def test_points_that_are_not_finite_are_dropped_and_counted(name: str, tmp_path: Path) -> None:
    points = far_points(N)
    points[7, 0], points[500, 1], points[999, 2] = np.nan, np.inf, -np.inf
    points[600] = np.nan
    path = tmp_path / CASES[name].file
    CASES[name].write(path, points)
    kept, dropped = read(path, block_points=77)
    assert dropped == 4
    finite = points[np.isfinite(points).all(axis=1)]
    assert np.abs(kept - finite).max() <= CASES[name].tolerance
    assert "4 points are not finite" in describe(path).notes


@pytest.mark.parametrize("name", CASES)
def test_a_file_without_points_is_a_source_without_spans(name: str, tmp_path: Path) -> None:
    path = tmp_path / CASES[name].file
    CASES[name].write(path, np.empty((0, 3)))
    assert open_source(path).spans(10) == []
    assert describe(path).points == 0
    assert describe(path).bounds is None


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        ("pcd", "TYPE F F F", "TYPE F F Q", r"field 'z' has the unknown type TYPE Q SIZE 4"),
        ("pcd", "SIZE 4 4 4", "SIZE 4 2 4", r"field 'y' has the unknown type TYPE F SIZE 2"),
        ("pcd", "SIZE 4 4 4", "SIZE 4 4", r"SIZE in its PCD header has 2 values for 3 FIELDS"),
        ("pcd", "SIZE 4 4 4", "SIZE 4 -4 4", r"SIZE '-4' in its PCD header is no whole number"),
        ("pcd", "FIELDS x y z", "FIELDS x y intensity", r"has 0 fields 'z' among x y intensity"),
        ("pcd", "FIELDS x y z", "FIELDS x y x", r"has 2 fields 'x'"),
        ("pcd", "COUNT 1 1 1", "COUNT 1 1 2", r"field 'z' has COUNT 2"),
        ("pcd", "WIDTH 2", "WIDTH 3", r"POINTS 2 in its PCD header is not WIDTH x HEIGHT = 3"),
        ("pcd", "DATA ascii", "DATA zip", r"DATA 'zip'"),
        (
            "pcd",
            "DATA ascii",
            "DATUM ascii",
            r"unknown keyword 'DATUM' in its PCD header at offset \d+",
        ),
        ("pcd", "HEIGHT 1", "HEIGHT 1\nHEIGHT 1", r"HEIGHT twice"),
        ("pcd", "POINTS 2", "POINTS 3\n", r"POINTS 3 in its PCD header is not"),
        ("pcd", "4 5 6\n", "4.25 5.25\n", r"point 1 is b'4.25 5.25\\n', not 3 numbers"),
        ("pcd", "4 5 6\n", "4 five 6\n", r"point 1 is b'4 five 6\\n', not 3 numbers"),
        ("pcd", "1 2 3\n4 5 6\n", "1 2 3 0\n4 5 6 0\n", r"point 0 is b'1 2 3 0\\n', not 3 numbers"),
        ("pcd", "4 5 6\n", "4 5 6.25", r"point 1 does not end with a newline"),
        ("pcd", "4 5 6\n", "4 5 6\n7 8 9\n", r"more rows than the 2 points .* b'7 8 9\\n'"),
        ("ply", "float z", "half z", r"property 'half z' of element 'vertex' has an unknown type"),
        ("ply", "float z", "float w", r"has 0 fields 'z' among x y w"),
        ("ply", "float z", "float x", r"has 2 fields 'x'"),
        ("ply", "vertex 2", "vertex two", r"cannot read b'element vertex two\\n' at offset \d+"),
        ("ply", "ascii 1.0", "morse 1.0", r"cannot read b'format morse"),
        ("ply", "format ascii 1.0\n", "", r"has no format line"),
        ("ply", "end_header\n", "", r"cannot read b'1 2 3\\n'"),
        ("ply", "4 5 6\n", "", r"at least \d+ bytes, but the file ends"),
        ("ply", "4 5 6\n", "4.25 5.25\n", r"point 1 is b'4.25 5.25\\n', not 3 numbers"),
        ("ply", "4 5 6\n", "4 5 6.5", r"point 1 does not end with a newline"),
        ("ply", "4 5 6\n", "4 5 6\n7 8 9\n", r"more rows than the 2 points"),
        ("ply", "ascii", "binary_little_endian", r"claims 2 points of 12 bytes"),
    ],
)
def test_a_header_or_row_that_lies_is_named(
    kind: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    text = {"pcd": PCD_TEXT, "ply": PLY_TEXT}[kind]
    assert old in text
    (tmp_path / f"a.{kind}").write_text(text.replace(old, new))
    with pytest.raises(CorruptSourceError, match=message):
        read(tmp_path / f"a.{kind}")


@pytest.mark.parametrize("name", IN_ONE_FILE)
def test_a_file_that_shrinks_after_it_was_opened_is_an_error(
    name: str, files: dict[str, Path], tmp_path: Path
) -> None:
    path = tmp_path / files[name].name
    path.write_bytes(files[name].read_bytes())
    source = open_source(path)
    span = source.spans(N)[0]
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(CorruptSourceError, match=path.name):
        list(source.blocks(span, 100))


HUGE = 10**12
CLAIMS: dict[str, Callable[[bytes], bytes]] = {
    "pcd ascii": lambda b: b.replace(b"1000\n", b"%d\n" % HUGE),
    "pcd binary": lambda b: b.replace(b"1000\n", b"%d\n" % HUGE),
    "pcd compressed": lambda b: b.replace(b"1000\n", b"%d\n" % HUGE),
    "ply ascii": lambda b: b.replace(b"vertex 1000\n", b"vertex %d\n" % HUGE),
    "ply little": lambda b: b.replace(b"vertex 1000\n", b"vertex %d\n" % HUGE),
    "ply big": lambda b: b.replace(b"vertex 1000\n", b"vertex %d\n" % HUGE),
    "las": lambda b: b[:247] + HUGE.to_bytes(8, "little") + b[255:],
    "laz": lambda b: b[:247] + HUGE.to_bytes(8, "little") + b[255:],
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_header_that_claims_too_much_is_refused_before_allocating(
    name: str, files: dict[str, Path], tmp_path: Path
) -> None:
    path = tmp_path / files[name].name
    content = files[name].read_bytes()
    path.write_bytes(CLAIMS[name](content))
    assert path.read_bytes() != content
    tracemalloc.start()
    with pytest.raises(CorruptSourceError, match=str(HUGE)):
        open_source(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000


@pytest.mark.parametrize("error", [KeyError("x"), OverflowError("too large"), RecursionError()])
def test_what_a_library_raises_is_named_with_its_file_and_cause(
    error: Exception, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise error

    source = open_source(files["pcd binary"])
    monkeypatch.setattr(rows, "finite_block", fails)
    with pytest.raises(CorruptSourceError, match=rf"b\.pcd: .*{type(error).__name__}") as caught:
        list(source.blocks(source.spans(N)[0], N))
    assert caught.value.__cause__ is error
    monkeypatch.setattr(pcd, "crs_beside", fails)
    with pytest.raises(CorruptSourceError, match=rf"b\.pcd: .*{type(error).__name__}"):
        open_source(files["pcd binary"])


def test_what_does_not_fit_into_memory_when_it_is_opened_is_named(
    files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(pcd, "crs_beside", fails)
    with pytest.raises(CorruptSourceError, match=r"b\.pcd: claims more than fits into memory"):
        open_source(files["pcd binary"])


@pytest.mark.parametrize("name", IN_ONE_FILE)
def test_a_wrong_ending_says_what_the_content_is(
    name: str, files: dict[str, Path], tmp_path: Path
) -> None:
    right = files[name].suffix.lower()
    content = files[name].read_bytes()
    known = next(f for f in FORMATS if right in f.endings)
    for wrong in (".pcd", ".las", ".ply", ".e57", ".mcap", ".txt", ""):
        if wrong in known.endings:
            continue
        path = tmp_path / f"wrong{wrong}"
        path.write_bytes(content)
        with pytest.raises(UnknownFormatError, match=f"looks like {known.name}, rename|; rename"):
            open_source(path)


def test_content_of_no_format_is_refused(tmp_path: Path) -> None:
    for name in ("a.pcd", "a.laz", "a.ply", "a.e57", "a.mcap", "a.csv", "a"):
        (tmp_path / name).write_text("x,y,z\n1,2,3\n")
        with pytest.raises(UnknownFormatError, match=name):
            open_source(tmp_path / name)
    with pytest.raises(UnknownFormatError, match="supported are PCD"):
        open_source(tmp_path / "a.csv")


def test_an_empty_file_is_cut_short(tmp_path: Path) -> None:
    for ending in (ending for format_ in FORMATS for ending in format_.endings):
        path = tmp_path / f"a{ending}"
        path.write_bytes(b"")
        with pytest.raises(CorruptSourceError, match="empty or cut short"):
            open_source(path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    for path in (tmp_path / "no.pcd", tmp_path / "*.laz"):
        with pytest.raises(SourceNotFoundError, match=path.name.replace("*", r"\*")):
            expand_sources(path)
    with pytest.raises(SourceNotFoundError, match=r"no\.pcd"):
        open_source(tmp_path / "no.pcd")


def test_sources_are_sorted_and_each_once(tmp_path: Path, files: dict[str, Path]) -> None:
    for name in ("b.pcd", "a.pcd", "c[1].pcd", "d.las"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "deep" / "er" / "e.pcd").write_bytes(b"x")
    (tmp_path / "link.pcd").symlink_to(tmp_path / "a.pcd")

    def names(*patterns: str) -> list[str]:
        found = expand_sources([tmp_path / p for p in patterns])
        return [str(Path(f).relative_to(tmp_path)) for f in found]

    assert names("*.pcd", "a.pcd", "d.las") == ["a.pcd", "b.pcd", "c[1].pcd", "d.las"]
    assert names("deep/../b.pcd", "b.pcd") == ["deep/../b.pcd"]
    assert names("**/*.pcd") == ["a.pcd", "b.pcd", "c[1].pcd", "deep/er/e.pcd"]
    assert names("c[1].pcd") == ["c[1].pcd"]
    parts = expand_sources(files["autoware"])
    assert [Path(p).name for p in parts] == ["0.pcd", "1.pcd", "2.pcd"]
    assert expand_sources([f"{files['autoware'].parent}/m*", *parts]) == parts


def test_options_go_to_the_format_that_takes_them(files: dict[str, Path]) -> None:
    assert open_source(files["las"], points_topic="/lidar").info().points == N
    with pytest.raises(UsageError, match="colour"):
        open_source(files["las"], colour="red")


def test_a_span_outside_of_the_source_is_refused(files: dict[str, Path]) -> None:
    for path in files.values():
        source = open_source(path)
        beyond = type(source.spans(10)[0])(0, N + 1)
        with pytest.raises(UsageError, match="is not inside"):
            list(source.blocks(beyond, 10))


def test_a_writer_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    for name in ("las", "laz"):
        with pytest.raises(UsageError, match="NaN"):
            write_las(tmp_path / CASES[name].file, np.full((1, 3), np.nan))
    with pytest.raises(UsageError, match="4,294 km"):
        write_las(tmp_path / "a.las", np.array([[0.0, 0, 0], [5e6, 0, 0]]))
    with pytest.raises(UsageError, match="shape"):
        write_pcd(tmp_path / "a.pcd", np.zeros((3, 2)))
    with pytest.raises(UsageError, match="one per point"):
        write_pcd(tmp_path / "a.pcd", np.zeros((3, 3)), fields={"i": np.zeros(2)})
    with pytest.raises(UsageError, match="not x, y or z"):
        write_pcd(tmp_path / "a.pcd", np.zeros((3, 3)), fields={"x": np.zeros(3)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["pcd binary", "las", "laz"])
def test_a_writer_that_fails_leaves_the_old_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disk_full(_: int) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / CASES[name].file
    CASES[name].write(path, far_points(10))
    before = path.read_bytes()
    monkeypatch.setattr("os.fsync", disk_full)
    with pytest.raises(OSError, match="No space"):
        CASES[name].write(path, far_points(20))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_formats_print_for_a_help_text() -> None:
    assert str(FORMATS[0]) == "PCD (.pcd): ascii, binary, binary_compressed"
    assert {ending for f in FORMATS for ending in f.endings} == {
        ".pcd",
        ".las",
        ".laz",
        ".ply",
        ".e57",
        ".mcap",
        ".db3",
        ".bag",
    }


@pytest.mark.parametrize(
    "recording",
    [
        "pcd/hdl64_street.pcd",
        "pcd/vls128_street.pcd",
        "scan_pair/251370668.pcd",
        "scan_pair/251371071.pcd",
    ],
)
def test_real_recordings_against_a_plain_parse(shared_data: Path, recording: str) -> None:
    path = shared_data / recording
    content = path.read_bytes()
    start = content.index(b"DATA binary\n") + len(b"DATA binary\n")
    width = 4 if b"FIELDS x y z intensity" in content[:start] else 3
    count = int(content[:start].split(b"POINTS ")[1].split()[0])
    stored = np.frombuffer(content, "<f4", count * width, start)
    truth = stored.reshape(-1, width)[:, :3].astype(float)
    truth = truth[np.isfinite(truth).all(axis=1)]
    points, dropped = read(path, span_points=50_000, block_points=7_777)
    assert np.array_equal(points, truth)
    found = describe(path)
    assert found.points == len(truth) + dropped
    assert found.bounds == (tuple(truth.min(axis=0)), tuple(truth.max(axis=0)))
