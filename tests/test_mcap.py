"""Logs of scans: against the ROS library's own decoding, and every way a file can be made."""

from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest
from logs import SECOND, START, pose
from mcap.writer import CompressionType, IndexType
from scipy.spatial.transform import Rotation

from tilestream.errors import SourceError, UsageError
from tilestream.formats.drive import open_drive
from tilestream.formats.logs import ScanSelection, open_log
from tilestream.formats.logs.deskew import deskew
from tilestream.formats.logs.drivers import span_deg, time_offsets
from tilestream.formats.logs.mcap_file import McapFile
from tilestream.formats.logs.poses import PoseStatus
from tilestream.records import Scan
from tilestream.settings import LogOptions

MAKES: dict[str, dict[str, Any]] = {
    "zstd": {"chunk_size": 4096, "compression": CompressionType.ZSTD},
    "lz4": {"chunk_size": 4096, "compression": CompressionType.LZ4},
    "plain chunks": {"chunk_size": 4096, "compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 10**9},
    "no chunks": {"use_chunking": False},
    "no chunks, data crc": {"use_chunking": False, "enable_data_crcs": True},
    "no crc": {"enable_crcs": False},
    "no chunk index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no statistics": {"use_statistics": False},
    "no repeated channels": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}


def assert_same_scans(a: list[Scan], b: list[Scan]) -> None:
    assert [s.stamp_ns for s in a] == [s.stamp_ns for s in b]
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.T_map_lidar, other.T_map_lidar)


@pytest.fixture(scope="module")
def drive(shared_data: Path) -> Path:
    return shared_data / "kitti_drive" / "drive.mcap"


# --- the real drive


def test_the_real_drive_equals_an_independent_decoding(drive: Path) -> None:
    log = open_log(drive)
    clouds = logs.decode(drive, "/velodyne_points")
    poses = logs.decode(drive, "/odometry")
    assert len(log) == len(clouds) == 52
    assert log.posed.all()
    assert log.notes == ()
    assert (log.points_topic, log.pose_topic, log.frame) == (
        "/velodyne_points",
        "/odometry",
        "velodyne",
    )
    for scan, message, odometry in zip(log.scans(), clouds, poses, strict=True):
        expected = np.frombuffer(message.data, np.float32).reshape(-1, 4)
        np.testing.assert_array_equal(scan.points, expected[:, :3].astype(float))
        np.testing.assert_array_equal(scan.intensity, expected[:, 3])
        assert scan.dropped == 0
        stamp = message.header.stamp
        assert scan.stamp_ns == stamp.sec * SECOND + stamp.nanosec
        position, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        assert scan.T_map_lidar is not None
        assert tuple(scan.T_map_lidar[:3, 3]) == (position.x, position.y, position.z)
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        np.testing.assert_allclose(scan.T_map_lidar[:3, :3], R, atol=1e-15)


def test_the_real_drive_as_map_points(drive: Path) -> None:
    source = open_drive(drive)
    info = source.info()
    spans = source.spans(1_000_000)
    points = np.concatenate([b.points for s in spans for b in source.blocks(s, 200_000)])
    lowest, highest, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    poses = logs.decode(drive, "/odometry")
    for message, odometry in zip(logs.decode(drive, "/velodyne_points"), poses, strict=True):
        xyz = np.frombuffer(message.data, np.float32).reshape(-1, 4)[:, :3].astype(float)
        p, q = odometry.pose.pose.position, odometry.pose.pose.orientation
        moved = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(xyz) + np.array([p.x, p.y, p.z])
        lowest, highest = np.minimum(lowest, moved.min(0)), np.maximum(highest, moved.max(0))
        count += len(moved)
    assert info.points == len(points) == count == 6_317_377
    np.testing.assert_allclose(points.min(0), lowest, atol=1e-9)
    np.testing.assert_allclose(points.max(0), highest, atol=1e-9)
    text = "\n".join(info.contents)
    assert "52 scans" in text
    assert "52 with a pose" in text
    assert "71.4 m" in text or "71.5 m" in text


def test_every_second_scan_maps_and_the_others_localize(drive: Path) -> None:
    log = open_log(drive)
    maps, localizes = (ScanSelection(every=2, offset=i) for i in (0, 1))
    used = [s.indices(log.stamps_ns) for s in (maps, localizes)]
    assert sorted(np.concatenate(used)) == list(range(52))
    half = open_drive(drive, scans=maps).info()
    assert half.points == log.point_counts[::2].sum()
    assert "26 scans" in "\n".join(half.contents)


def test_a_slice_reads_only_its_chunks(drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = open_log(drive)
    chunks = set(log.reader.places[10:15, 1].tolist())
    read: list[int] = []
    unpack = McapFile.unpack

    def counting(self: McapFile, record: int) -> bytes:
        read.append(record)
        return unpack(self, record)

    monkeypatch.setattr(McapFile, "unpack", counting)
    scans = list(log.scans(10, 15))
    assert len(scans) == 5
    assert len(read) == len(chunks) < 4
    assert set(read) == chunks


# --- every make of file


@pytest.mark.parametrize("make", MAKES)
def test_the_make_of_the_file_does_not_matter(make: str, tmp_path: Path) -> None:
    source = logs.street_log(tmp_path / "source.mcap")
    other = logs.rewrite(source, tmp_path / "other.mcap", **MAKES[make])
    expected, found = open_log(source), open_log(other)
    assert len(found) == 12
    unchecked = make in ("no chunks", "no crc")
    assert found.notes == (
        ("has records without a CRC: damage to them cannot be seen",) * unchecked
    )
    assert [line.split()[1::2] for line in found.contents] == [
        ["/odometry:", "12"],
        ["/points:", "12"],
    ]
    assert_same_scans(list(expected.scans()), list(found.scans()))
    assert_same_scans(list(expected.scans(7, 3, -2)), list(found.scans(7, 3, -2)))


# --- clouds of every layout


def one_cloud(path: Path, rows: np.ndarray, **changes: Any) -> Scan:
    cloud = logs.cloud(START, rows, **changes)
    logs.write(
        path,
        [
            logs.odometry_at(START, pose()),
            (START, "/points", "sensor_msgs/msg/PointCloud2", cloud),
        ],
    )
    return next(open_log(path).scans())


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4", ">f8"])
def test_floats_of_either_size_and_byte_order(kind: str, tmp_path: Path) -> None:
    points = logs.street_points(np.random.default_rng(0), 50)
    ring = np.arange(50, dtype=kind[0] + "u2")
    scan = one_cloud(tmp_path / "a.mcap", logs.xyz_rows(points, kind, ring=ring))
    np.testing.assert_array_equal(scan.points, points)
    assert scan.points.dtype == np.float64
    assert scan.ring is not None
    assert scan.ring.tolist() == list(range(50))


def test_fields_in_any_order_with_gaps(tmp_path: Path) -> None:
    dtype = np.dtype(
        {
            "names": ["intensity", "z", "x", "y"],
            "formats": ["u1", "<f4", "<f8", "<f4"],
            "offsets": [1, 4, 24, 12],
            "itemsize": 40,
        }
    )
    rows = np.zeros(5, dtype)
    rows["x"], rows["y"], rows["z"], rows["intensity"] = [1, 2, 3, 4, 5], 6, 7, 200
    scan = one_cloud(tmp_path / "a.mcap", rows)
    np.testing.assert_array_equal(scan.points, [[x, 6, 7] for x in (1, 2, 3, 4, 5)])
    assert scan.intensity is not None
    assert scan.intensity.tolist() == [200] * 5


def test_an_organised_cloud_with_padded_rows(tmp_path: Path) -> None:
    points = logs.street_points(np.random.default_rng(0), 12)
    rows = logs.xyz_rows(points).reshape(3, 4)
    padded = b"".join(row.tobytes() + b"\xff" * 20 for row in rows)
    scan = one_cloud(tmp_path / "a.mcap", rows, row_step=4 * 12 + 20, data=padded)
    np.testing.assert_array_equal(scan.points, points)


@pytest.mark.parametrize("row_step", [0, 12, 100])
def test_rows_that_lie_side_by_side_are_read_whatever_the_row_step(
    row_step: int, tmp_path: Path
) -> None:
    points = logs.street_points(np.random.default_rng(0), 12)
    scan = one_cloud(tmp_path / "a.mcap", logs.xyz_rows(points).reshape(3, 4), row_step=row_step)
    np.testing.assert_array_equal(scan.points, points)


TIMES = np.array([0.0, 0.01, 0.05, 0.0999])


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("time", TIMES.astype("<f4")),
        ("time", (TIMES - 0.1).astype("<f4")),
        ("time", (TIMES * 1e3).astype("<f4")),
        ("time", (TIMES * 1e6).astype("<f4")),
        ("time", ((TIMES - 0.1) * 1e6).astype("<f8")),
        ("time", (TIMES * 1e9).astype("<f4")),
        ("t", (TIMES * 1e6).astype("<u4")),
        ("t", (TIMES * 1e9).astype("<u4")),
        ("offset_time", (TIMES * 1e9).astype("<u4")),
        ("time_stamp", (TIMES * 1e9).astype("<u4")),
        ("timestamp", (TIMES + START / 1e9).astype("<f8")),
        ("timestamp", (TIMES * 1e9 + START).astype("<f8")),
        ("timestamp", (TIMES * 1e6 + START / 1e3).astype("<f8")),
    ],
)
def test_times_of_points_come_as_seconds_after_the_stamp(
    name: str, values: np.ndarray, tmp_path: Path
) -> None:
    points = logs.street_points(np.random.default_rng(0), 4)
    scan = one_cloud(tmp_path / "a.mcap", logs.xyz_rows(points, **{name: values}))
    assert scan.time_offset is not None
    expected = TIMES - 0.1 if values[0] < 0 else TIMES
    np.testing.assert_allclose(scan.time_offset, expected, atol=1e-6)


@pytest.mark.parametrize(
    "values", [np.zeros(4), np.full(4, 12345.0), np.array([0, np.nan, 0.1, 0.2])]
)
def test_times_that_make_no_sense_are_no_times(values: np.ndarray, tmp_path: Path) -> None:
    points = logs.street_points(np.random.default_rng(0), 4)
    scan = one_cloud(tmp_path / "a.mcap", logs.xyz_rows(points, timestamp=values))
    assert scan.time_offset is None


@pytest.mark.parametrize("ticks", [10**3, 10**6, 10**9])
@pytest.mark.parametrize("since", [0, START])
def test_times_as_long_integers_keep_their_ticks(ticks: int, since: int) -> None:
    values = np.array([0, 10, 50, 100]) * ticks // 1000 + since // (10**9 // ticks)
    offsets = time_offsets(values, START, ticks)
    assert offsets is not None
    assert offsets.tolist() == [0.0, 0.01, 0.05, 0.1]


@pytest.mark.parametrize("span", [3.0, 3e-3, 3e12])
def test_times_that_span_no_turn_in_any_unit_are_said_and_not_used(
    span: float, tmp_path: Path
) -> None:
    points = logs.street_points(np.random.default_rng(0), 4)
    rows = logs.xyz_rows(points, time=np.array([0.0, 0.2, 0.5, 1.0]) * span)
    scan = one_cloud(tmp_path / "a.mcap", rows)
    assert scan.time_offset is None
    log = open_log(tmp_path / "a.mcap")
    assert f"times of points are not used: they span {span:g} in a scan" in log.notes[-1]
    with pytest.raises(UsageError, match="no time per point that can be used"):
        deskew(scan, log.trajectory)


def test_few_returns_are_in_the_unit_of_the_other_scans(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/PointCloud2"
    messages: list[logs.Message] = []
    for i, spans in enumerate([1.0, 1.0, 1e-4, 1.0]):
        stamp = START + i * SECOND // 10
        rows = logs.xyz_rows(logs.STREET[:4], t=(TIMES * spans * 1e9).astype("<u4"))
        cloud = (stamp, "/points", kind, logs.cloud(stamp, rows))
        messages += [logs.odometry_at(stamp, pose(x=i)), cloud]
    log = open_log(logs.write(tmp_path / "a.mcap", messages))
    assert log.time_ticks == 10**9
    offsets = [scan.time_offset for scan in log.scans()]
    assert offsets[2] is not None
    np.testing.assert_allclose(offsets[2], TIMES * 1e-4, atol=1e-9)


def test_no_scan_has_a_pose_over_a_jump(tmp_path: Path) -> None:
    messages: list[logs.Message] = []
    for i, x in enumerate([0.0, 0.0, 900.0, 901.0]):
        stamp = START + i * SECOND // 10
        messages += [logs.odometry_at(stamp, pose(x=x)), logs.cloud_at(stamp + SECOND // 20)]
    log = open_log(logs.write(tmp_path / "a.mcap", messages))
    posed, after, jump = PoseStatus.POSED, PoseStatus.AFTER, PoseStatus.JUMP
    assert log.pose_status.tolist() == [posed, jump, posed, after]
    assert log.T_map_lidar[[0, 2], 0, 3].tolist() == [0.0, 900.5]
    assert "1 of 4 scans skipped: where poses jump faster than 60 m/s" in log.notes
    assert "poses jump faster than 60 m/s at 1 of 3 steps, first by 900.0 m" in log.notes[-1]


# --- poses of every kind


@pytest.mark.parametrize(
    ("kind", "make", "frame"),
    [
        ("nav_msgs/msg/Odometry", logs.odometry, None),
        ("geometry_msgs/msg/PoseStamped", logs.pose_stamped, "lidar"),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", logs.pose_with_covariance, "lidar"),
        ("tf2_msgs/msg/TFMessage", lambda t, T: logs.transform(t, "map", "lidar", T), None),
    ],
)
def test_poses_of_every_type(kind: str, make: Any, frame: str | None, tmp_path: Path) -> None:
    times = [START + i * SECOND // 10 for i in range(5)]
    messages = [(t, "/where", kind, make(t, pose(x=t % 7, yaw=0.3))) for t in times]
    path = logs.write(tmp_path / "a.mcap", [*messages, *(logs.cloud_at(t) for t in times)])
    log = open_log(path, LogOptions(pose_frame=frame))
    assert log.pose_topic == "/where"
    assert log.posed.all()
    for t, T in zip(times, log.T_map_lidar, strict=True):
        np.testing.assert_allclose(T, pose(x=t % 7, yaw=0.3), atol=1e-12)


def test_poses_in_the_map_go_before_others_however_many(tmp_path: Path) -> None:
    path = logs.write(
        tmp_path / "a.mcap",
        [
            *(logs.odometry_at(START + i, pose(), "/wheels", frame="odom") for i in range(5)),
            logs.odometry_at(START, pose(x=5.0), "/localization"),
            logs.cloud_at(START),
        ],
    )
    log = open_log(path)
    assert log.pose_topic == "/localization"
    assert any("/wheels" in note for note in log.notes)
    assert (
        open_log(path, LogOptions(pose_topic="/wheels", map_frame="odom")).pose_topic == "/wheels"
    )


# --- which clouds are the lidar's


def turn(count: int, degrees: float = 360.0, seed: int = 0) -> np.ndarray:
    """Points that a lidar sees which looks so far round."""
    azimuth = np.radians(np.linspace(-degrees / 2, degrees / 2, count))
    r = np.random.default_rng(seed).uniform(3.0, 40.0, count)
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), np.ones(count)])


def several(path: Path, *topics: tuple[str, str, np.ndarray, int]) -> Path:
    """A log with so many clouds of the same points on each topic: name, frame, points."""
    messages = [logs.odometry_at(START + i * SECOND // 10, pose(x=i)) for i in range(10)]
    for topic, frame, points, count in topics:
        stamps = [START + i * SECOND // 10 for i in range(count)]
        messages += [logs.cloud_at(t, points, topic, frame=frame) for t in stamps]
    return logs.write(path, messages)


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (("/camera", "camera", turn(900, 80.0), 10), "/camera (10, 80 deg)"),
        (("/packets", "lidar", turn(900, 40.0), 10), "/packets (10, 40 deg)"),
        (("/map_cloud", "map", turn(900), 1), "/map_cloud (1, 360 deg)"),
        (("/radar", "radar", turn(60), 10), "/radar (10, 354 deg)"),
        (("/ground", "lidar", turn(199), 10), "/ground (10, 358 deg)"),
        (("/empty", "lidar", np.zeros((9, 3)), 10), "/empty (10, 0 deg)"),
    ],
)
def test_the_clouds_that_look_like_turns_of_a_lidar_are_taken(
    other: tuple[str, str, np.ndarray, int], told: str, tmp_path: Path
) -> None:
    lidar = ("/points", "lidar", turn(200), 10)
    for topics in ([lidar, other], [other, lidar]):
        log = open_log(several(tmp_path / "a.mcap", *topics))
        assert log.points_topic == "/points"
        assert log.notes == (f"of several topics of clouds took /points (10, 358 deg), not {told}",)


def test_clouds_that_are_equally_good_have_to_be_named(tmp_path: Path) -> None:
    left, right = (turn(200, seed=i) for i in range(2))
    tie = several(tmp_path / "a.mcap", ("/left", "left", left, 9), ("/right", "right", right, 10))
    with pytest.raises(SourceError, match=r"/left, /right; name one as points_topic"):
        open_log(tie)
    copies = several(tmp_path / "b.mcap", ("/b", "lidar", left, 9), ("/a", "lidar", left, 9))
    with pytest.raises(SourceError, match=r"/a, /b; name one as points_topic"):
        open_log(copies)
    assert len(open_log(copies, LogOptions(points_topic="/a"))) == 9


def test_a_scan_that_is_no_full_turn_is_noted(tmp_path: Path) -> None:
    log = open_log(several(tmp_path / "a.mcap", ("/points", "lidar", turn(500, 120.0), 10)))
    assert log.notes == ("scans span 120 degrees, not a full turn",)
    one_side = turn(500, 120.0) @ Rotation.from_euler("z", 170.0, degrees=True).as_matrix().T
    assert span_deg(one_side) == pytest.approx(120.0)
    assert span_deg(turn(500)[:1]) == 0.0


def test_scans_come_in_order_of_their_stamps(tmp_path: Path) -> None:
    points = logs.street_points(np.random.default_rng(0))
    late = [logs.cloud_at(START + i * SECOND // 10, points + i) for i in (2, 0, 1)]
    poses = [logs.odometry_at(START + i * SECOND // 10, pose(x=float(i))) for i in (2, 1, 0)]
    log = open_log(logs.write(tmp_path / "a.mcap", [*late, *poses]))
    assert [(s.stamp_ns - START) * 10 // SECOND for s in log.scans()] == [0, 1, 2]
    assert (np.diff(log.trajectory.stamps_ns) > 0).all()
