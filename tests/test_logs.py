"""One conformance test over all formats of logs: the same scans and poses in, the same out, at any
slice, and as points of a map."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bags
import logs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import SECOND, START, pose
from points import points_of

from tilestream.errors import (
    CorruptSourceError,
    PoseError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    UsageError,
)
from tilestream.formats import open_source
from tilestream.formats.drive import open_drive
from tilestream.formats.logs import LOG_FORMATS, ScanSelection, is_log, open_log, write_log
from tilestream.formats.logs.poses import PoseStatus, transform
from tilestream.records import Scan, Trajectory
from tilestream.settings import LogOptions

Write = Callable[[Path, list[Scan], Trajectory], Path]
"""Writes scans and poses as a log in a folder, and says where."""
N = 12
TENTH = SECOND // 10


def write_with_ros(folder: Path, scans: list[Scan], poses: Trajectory) -> Path:
    track = zip(poses.stamps_ns.tolist(), poses.T_map_lidar, strict=True)
    messages = [logs.odometry_at(stamp, T) for stamp, T in track]
    for scan in scans:
        fields = {"intensity": scan.intensity, "ring": scan.ring, "time": scan.time_offset}
        kinds = {"intensity": "<f4", "ring": "<u2", "time": "<f4"}
        more = {name: v.astype(kinds[name]) for name, v in fields.items() if v is not None}
        cloud = logs.cloud(scan.stamp_ns, logs.xyz_rows(scan.points, **more))
        messages.append((scan.stamp_ns, "/points", "sensor_msgs/msg/PointCloud2", cloud))
    return logs.write(folder / "a.mcap", messages)


def write_ours(folder: Path, scans: list[Scan], poses: Trajectory) -> Path:
    write_log(folder / "a.mcap", scans, poses)
    return folder / "a.mcap"


def in_other(write: Callable[[Path, list[bags.Raw]], Path], name: str) -> Write:
    """The messages that ROS would have written, in another container."""

    def made(folder: Path, scans: list[Scan], poses: Trajectory) -> Path:
        whole = write_with_ros(folder, scans, poses)
        messages = bags.messages_of(whole)
        whole.unlink()
        return write(folder / name, messages)

    return made


CASES: dict[str, Write] = {
    "mcap": write_with_ros,
    "mcap, ours": write_ours,
    "mcap of ROS 1": in_other(
        lambda path, messages: bags.write_mcap(path, bags.as_ros1(messages), "ros1"), "a.mcap"
    ),
    "rosbag2, mcap": in_other(lambda path, messages: bags.split_in(path, messages, 3), "a"),
    "rosbag2, sqlite3": in_other(
        lambda path, messages: bags.split_in(path, messages, 2, "sqlite3"), "a"
    ),
    "db3": in_other(bags.write_db3, "a.db3"),
    "bag": in_other(bags.write_bag, "a.bag"),
    "bag, lz4": in_other(lambda p, messages: bags.write_bag(p, messages, "LZ4"), "a.bag"),
}


def street(count: int = N, seed: int = 5) -> tuple[list[Scan], Trajectory]:
    """Scans at 10 Hz from a lidar that drives 1 m per scan along x and turns, a pose each."""
    rng = np.random.default_rng(seed)
    stamps = START + np.arange(count) * TENTH
    T = np.array([pose(x=4e5 + i, yaw=0.02 * i) for i in range(count)])
    scans = [Scan(stamp, logs.street_points(rng)) for stamp in stamps.tolist()]
    return scans, Trajectory(stamps, T, "lidar")


def in_map(scans: list[Scan], poses: Trajectory) -> np.ndarray:
    pairs = zip(poses.T_map_lidar, scans, strict=True)
    return np.concatenate([scan.points @ T[:3, :3].T + T[:3, 3] for T, scan in pairs])


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: write(tmp_path_factory.mktemp("log"), *street()) for name, write in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_the_same_scans_and_poses(name: str, paths: dict[str, Path]) -> None:
    scans, poses = street()
    log = open_log(paths[name])
    assert len(log) == len(list(log.scans())) == N
    assert log.posed.all()
    assert log.notes == ()
    assert log.stamps_ns.tolist() == poses.stamps_ns.tolist()
    assert log.point_counts.tolist() == [len(scan.points) for scan in scans]
    assert log.trajectory.stamps_ns.tolist() == poses.stamps_ns.tolist()
    np.testing.assert_allclose(log.T_map_lidar, poses.T_map_lidar, rtol=0, atol=1e-9)
    for i, (scan, found) in enumerate(zip(scans, log.scans(), strict=True)):
        assert found.stamp_ns == scan.stamp_ns
        assert found.points.dtype == np.float64
        np.testing.assert_array_equal(found.points, scan.points)
        np.testing.assert_array_equal(found.T_map_lidar, log.T_map_lidar[i])
        assert found.intensity is found.ring is found.time_offset is None
        assert found.dropped == 0


@pytest.mark.parametrize("name", CASES)
def test_what_else_was_recorded_of_each_point(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    more = {
        "intensity": rng.uniform(0, 255, 200).astype(np.float32),
        "ring": rng.integers(0, 16, 200).astype(np.int32),
        "time_offset": rng.uniform(0, 0.1, 200).astype(np.float32).astype(float),
    }
    scans, poses = street(2)
    path = CASES[name](tmp_path, [replace(scans[1], **more)], poses)
    (found,) = open_log(path).scans()
    for field, values in more.items():
        np.testing.assert_array_equal(getattr(found, field), values)
        assert getattr(found, field).dtype == values.dtype


@pytest.mark.parametrize("name", CASES)
def test_any_scans_in_any_order(name: str, paths: dict[str, Path]) -> None:
    log, stamps = open_log(paths[name]), street()[1].stamps_ns
    whole = list(log.scans())
    for wanted in ([], [11], [7, 6, 5, 4], [0, 11, 3, 3]):
        for i, scan in zip(wanted, log.scans_at(wanted), strict=True):
            assert scan.stamp_ns == stamps[i]
            np.testing.assert_array_equal(scan.points, whole[i].points)
    assert [s.stamp_ns for s in log.scans(7, 3, -2)] == stamps[[7, 5]].tolist()


@pytest.mark.parametrize("name", CASES)
def test_what_is_in_a_log(name: str, paths: dict[str, Path]) -> None:
    log = open_log(paths[name])
    found = open_source(paths[name]).info()
    assert found == log.info()
    assert (found.path, found.format) == (str(paths[name]), log.format)
    assert (found.points, found.crs, found.bounds) == (N * 200, None, None)
    assert [field for field, _ in found.fields] == ["x", "y", "z"]
    assert found.size_bytes > 0
    assert found.resident_bytes >= 200 * 24
    text = "\n".join(found.contents)
    assert f"12 scans of {log.points_topic} over 1.1 s" in text
    assert f"12 with a pose from {log.pose_topic}, along 11.0 m" in text


@pytest.mark.parametrize("name", CASES)
def test_a_log_can_be_sent_to_another_process(name: str, paths: dict[str, Path]) -> None:
    source = open_drive(paths[name], range_max=25.0)
    sent = pickle.loads(pickle.dumps(source))
    span = source.spans(500)[1]
    for here, there in zip(source.blocks(span, 90), sent.blocks(span, 90), strict=True):
        np.testing.assert_array_equal(here.points, there.points)


@pytest.mark.parametrize("name", CASES)
def test_a_changed_log_is_read_anew(name: str, tmp_path: Path) -> None:
    path = CASES[name](tmp_path, *street(4))
    before = open_log(path)
    scans, poses = street(7)
    later = [replace(scan, stamp_ns=scan.stamp_ns + SECOND) for scan in scans]
    CASES[name](tmp_path, later, replace(poses, stamps_ns=poses.stamps_ns + SECOND))
    assert len(open_log(path)) == 7
    assert len(before) == 4
    with pytest.raises(SourceError, match=path.name):
        list(before.scans())


@pytest.mark.parametrize("name", CASES)
def test_a_log_that_is_gone(name: str, tmp_path: Path) -> None:
    log = open_log(CASES[name](tmp_path, *street(4)))
    shutil.rmtree(tmp_path)
    with pytest.raises(SourceNotFoundError, match="changed since it was opened"):
        list(log.scans())


@pytest.mark.parametrize("name", CASES)
def test_scans_between_poses_are_posed_and_others_skipped(name: str, tmp_path: Path) -> None:
    """A scan every half second; poses at 1, 2 and 5 s."""
    scans = [Scan(START + i * SECOND // 2, s.points) for i, s in enumerate(street()[0])]
    at = np.array([1, 2, 5])
    T = np.array([pose(x=2.0 * i) for i in at])
    path = CASES[name](tmp_path, scans, Trajectory(START + at * SECOND, T, "lidar"))
    log = open_log(path)
    before, posed, gap = PoseStatus.BEFORE, PoseStatus.POSED, PoseStatus.GAP
    expected = [*[before] * 2, *[posed] * 3, *[gap] * 5, posed, PoseStatus.AFTER]
    assert log.pose_status.tolist() == expected
    notes = "\n".join(log.notes)
    for told in ("2 of 12 scans skipped: before", "1 of 12 scans skipped: after", "5 of 12"):
        assert told in notes
    found = {(s.stamp_ns - START) / SECOND: s.T_map_lidar for s in log.scans()}
    assert list(found) == [1.0, 1.5, 2.0, 5.0]
    assert found[1.5] is not None
    np.testing.assert_allclose(found[1.5], pose(x=3.0), atol=1e-12)
    assert np.isnan(log.T_map_lidar[5]).all()
    assert open_drive(path).info().points == 4 * 200
    assert open_log(path, LogOptions(max_gap_s=3.0)).posed.sum() == 9


@pytest.mark.parametrize("name", CASES)
def test_poses_of_another_clock(name: str, tmp_path: Path) -> None:
    scans, _ = street(1)
    path = CASES[name](tmp_path, scans, Trajectory(np.array([5 * SECOND]), pose()[None], "lidar"))
    with pytest.raises(PoseError, match=r"none of the 1 scans.*5\.000.*same clock"):
        open_log(path)


@pytest.mark.parametrize("name", CASES)
def test_what_is_no_return_is_dropped_and_counted(name: str, tmp_path: Path) -> None:
    points = logs.street_points(np.random.default_rng(0), 9)
    points[1, 0], points[4, 2], points[6] = np.nan, -np.inf, 0.0
    points[7] = [3.0, -1.0, -2.0]  # sums to 0 and is a return
    kept = [0, 2, 3, 5, 7, 8]
    made = Scan(START, points, ring=np.arange(9, dtype=np.int32))
    path = CASES[name](tmp_path, [made], street(1)[1])
    scan = next(open_log(path).scans())
    np.testing.assert_array_equal(scan.points, points[kept])
    assert scan.dropped == 3
    assert scan.ring is not None
    assert scan.ring.tolist() == kept
    source = open_drive(path)
    blocks = [b for s in source.spans(4) for b in source.blocks(s, 4)]
    assert sum(b.dropped for b in blocks) == 3
    assert source.info().points == 9


@pytest.mark.parametrize("name", CASES)
def test_a_scan_without_points(name: str, tmp_path: Path) -> None:
    path = CASES[name](tmp_path, [Scan(START, np.zeros((0, 3)))], street(1)[1])
    assert next(open_log(path).scans()).points.shape == (0, 3)
    assert open_drive(path).spans(100) == []


# --- as points of a map


@pytest.mark.parametrize("name", CASES)
@given(points=st.integers(1, 3000), block=st.integers(1, 300))
@settings(deadline=None, max_examples=30)
def test_spans_and_blocks_hold_each_point_once_and_alike(
    name: str, points: int, block: int, paths: dict[str, Path]
) -> None:
    source = open_drive(paths[name])
    spans = source.spans(points)
    assert [s.start for s in spans[1:]] == [s.stop for s in spans[:-1]]
    assert all(s.stop - s.start <= max(points, 200) for s in spans)
    blocks = [b for s in reversed(spans) for b in list(source.blocks(s, block))[::-1]]
    assert all(len(b.points) <= block for b in blocks)
    found = np.concatenate([b.points for b in reversed(blocks)])
    np.testing.assert_allclose(found, in_map(*street()), rtol=0, atol=1e-9)
    alone = np.concatenate([b.points for s in source.spans(10**6) for b in source.blocks(s, 10**6)])
    assert found.tobytes() == alone.tobytes()


@pytest.mark.parametrize("name", CASES)
def test_range_max_leaves_out_what_is_far_from_the_lidar(name: str, paths: dict[str, Path]) -> None:
    log = open_log(paths[name])
    assert all(scan.T_map_lidar is not None for scan in log.scans())
    near = [
        transform(T, scan.points[np.linalg.norm(scan.points, axis=1) <= 15.0])
        for T, scan in zip(log.T_map_lidar, log.scans(), strict=True)
    ]
    source = open_drive(paths[name], range_max=15.0)
    blocks = [b for s in source.spans(1000) for b in source.blocks(s, 1000)]
    assert sum(b.dropped for b in blocks) == 0
    np.testing.assert_array_equal(np.concatenate([b.points for b in blocks]), np.concatenate(near))
    assert len(np.concatenate(near)) < N * 200
    with pytest.raises(UsageError, match="range_max"):
        open_drive(paths[name], range_max=-1.0)


@pytest.mark.parametrize("name", CASES)
def test_a_selection_of_scans_becomes_the_map(name: str, paths: dict[str, Path]) -> None:
    scans, poses = street()
    odd = replace(poses, T_map_lidar=poses.T_map_lidar[1::2], stamps_ns=poses.stamps_ns[1::2])
    found = points_of(paths[name], 500, 90, scans=ScanSelection(every=2, offset=1))
    np.testing.assert_allclose(found, in_map(scans[1::2], odd), rtol=0, atol=1e-9)
    with pytest.raises(PoseError, match="none of its 12 scans"):
        open_drive(paths[name], scans=ScanSelection(start=12))


# --- which scans


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (ScanSelection(), range(12)),
        (ScanSelection(start=3, stop=9, every=2, offset=1), [3, 5, 7]),
        (ScanSelection(until_s=0.5), range(5)),
        (ScanSelection(from_s=0.5), range(5, 12)),
        (ScanSelection(stop=0), []),
    ],
)
def test_a_selection(selection: ScanSelection, expected: list[int]) -> None:
    stamps = START + np.arange(12) * TENTH
    assert selection.indices(stamps).tolist() == list(expected)
    assert selection.indices(stamps[:0]).tolist() == []


@pytest.mark.parametrize("wrong", [{"every": 0}, {"offset": 1}, {"start": -1}, {"stop": -2}])
def test_a_selection_that_makes_no_sense_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(UsageError, match="scan selection"):
        ScanSelection(**wrong)


# --- which format


@pytest.mark.parametrize("name", CASES)
def test_a_log_is_known_by_its_name(name: str, paths: dict[str, Path]) -> None:
    assert is_log(str(paths[name]))
    if paths[name].is_file():
        assert is_log(str(paths[name].parent / f"*{paths[name].suffix.upper()}"))
    for other in ("a.pcd", "mcap", str(Path(__file__).parent)):
        assert not is_log(other)


def test_what_is_no_log_says_what_is(tmp_path: Path) -> None:
    known = LOG_FORMATS[0].short.replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(SourceNotFoundError, match="no such file"):
        open_log(tmp_path / "none.mcap")
    (tmp_path / "a.rrd").write_bytes(b"RRF2")
    for other in (tmp_path, tmp_path / "a.rrd"):
        with pytest.raises(UnknownFormatError, match=f"supported are {known}"):
            open_log(other)
    (tmp_path / "text.mcap").write_text("# .PCD v0.7\n")
    with pytest.raises(UnknownFormatError, match="its content is no MCAP"):
        open_log(tmp_path / "text.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(CorruptSourceError, match=r"ends at offset 0.*cut short"):
        open_log(tmp_path / "empty.mcap")
