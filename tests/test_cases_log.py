"""Logs that went wrong for others, each with its right value."""

from pathlib import Path

import numpy as np
import pytest
from logs import pose
from scipy.spatial.transform import Rotation

import tilestream as ts
from tilestream.errors import PoseError
from tilestream.formats.logs import open_log
from tilestream.formats.logs.deskew import deskew
from tilestream.formats.logs.poses import PoseStatus, interpolate
from tilestream.formats.routes import read_all_routes
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.settings import LogOptions


def test_an_organised_cloud_without_a_row_step_is_read(cases: Path) -> None:
    log = open_log(cases / "log" / "organized_row_step_0.mcap")
    for scan, count in zip(log.scans(), log.point_counts, strict=True):
        assert len(scan.points) + scan.dropped == count
        assert count > 3800
        assert np.linalg.norm(scan.points, axis=1).max() < 100.0


def test_times_in_microseconds_are_told_by_the_span_of_a_turn(cases: Path) -> None:
    log = open_log(cases / "log" / "point_time_us_float.mcap")
    assert log.time_ticks == 10**6
    scan = next(log.scans())
    assert scan.time_offset is not None
    assert (scan.time_offset.min(), scan.time_offset.max()) == (0.0, pytest.approx(0.099))
    straight = deskew(scan, log.trajectory)
    moved = scan.points[-1] - straight.points[-1]
    assert np.linalg.norm(moved) == pytest.approx(0.99, abs=0.02)  # 10 m/s


def test_no_pose_lies_half_way_over_a_jump(cases: Path) -> None:
    log = open_log(cases / "log" / "poses_start_at_origin.mcap")
    assert log.posed.all()  # each scan has a pose of its own
    assert log.notes == (
        "poses jump faster than 60 m/s at 1 of 13 steps, first by 3617.2 m after 1700000000.300 s",
    )
    between = log.trajectory.stamps_ns[:-1] + np.int64(5 * 10**7)
    T, status = interpolate(log.trajectory, between, 1.0)
    assert np.flatnonzero(status == PoseStatus.JUMP).tolist() == [3]
    assert np.isnan(T[3]).all()
    assert (status == PoseStatus.POSED).sum() == len(between) - 1


def test_the_way_of_a_log_begins_after_the_jump(cases: Path) -> None:
    read = read_all_routes(cases / "log" / "poses_start_at_origin.mcap")
    (route,) = read.routes
    assert route.positions[0, 0] == 3014.0
    assert route.arc_length[-1] < 20.0
    assert "1 of 2 parts are left out, the vehicle stands in them" in read.notes[0]


def driven(count: int, yaw: float = 0.0) -> np.ndarray:
    """Where the lidar of these logs was: 2 m above the made street, 1 m farther at each scan."""
    return np.array([pose(x=10.0 + i, z=2.0, yaw=yaw) for i in range(count)])


def test_poses_in_odom_are_carried_to_the_map(cases: Path) -> None:
    log = open_log(cases / "log" / "odom_frame_and_tf_to_map.mcap")
    np.testing.assert_allclose(log.T_map_lidar, driven(10), atol=1e-9)
    assert "poses of /odom carried from odom to map by tf map -> odom" in log.notes
    told = "odom -> lidar is given by /odom and /tf, 0.000 m and 0.00 deg apart: took /odom"
    assert told in log.notes
    by_tf = open_log(log.path, LogOptions(pose_topic="/tf"))
    np.testing.assert_allclose(by_tf.T_map_lidar, driven(10), atol=1e-9)


def test_the_mount_of_a_posed_vehicle_is_applied(cases: Path) -> None:
    path = cases / "log" / "pose_of_base_link.mcap"
    expected = driven(10, yaw=np.pi / 2)
    for options in ({}, {"pose_frame": "base_link"}, {"extrinsic": "1,0,1.8,0,0,90"}):
        log = open_log(path, LogOptions(**options))
        np.testing.assert_allclose(log.T_map_lidar, expected, atol=1e-9)
    lidars = open_log(path, LogOptions(pose_frame="lidar")).T_map_lidar
    np.testing.assert_allclose(lidars[:, 2, 3], 0.2, atol=1e-9)


def test_a_bag_in_two_files_is_one_log(cases: Path) -> None:
    """The mount is in the first only; the second drives the street again, at the same times."""
    log = open_log(cases / "log" / "split_bag")
    assert (log.format, len(log), log.points_topic) == ("rosbag2 mcap", 16, "/points")
    np.testing.assert_allclose(
        log.T_map_lidar, np.repeat(driven(8, np.pi / 2), 2, axis=0), atol=1e-9
    )
    assert sum(len(scan.points) for scan in log.scans()) > 60_000
    with pytest.raises(PoseError, match=r"lead from there.*one of the rosbag2 .*split_bag: give"):
        open_log(cases / "log" / "split_bag" / "rosbag2_2026_1.mcap")


def test_errors_are_those_of_the_street_wherever_the_poses_come_from(
    cases: Path, tmp_path: Path
) -> None:
    """The same scans from the same places: in odom, of the vehicle, in a folder of two files. Taken
    as the lidar's in the map, they were more than 1.8 m off.
    """
    store = ts.ingest(cases / "street.pcd", tmp_path / "map.zarr")
    means = []
    for name in ("odom_frame_and_tf_to_map.mcap", "pose_of_base_link.mcap", "split_bag"):
        log = cases / "log" / name
        errors = ts.localize(store, log, tmp_path / name, reading=Reading(str(log)), spacing=4.0)
        assert (errors["status"] == "done").all()
        means.append(errors["error_mean"].iloc[0])
        turned = Rotation.from_matrix(open_log(log).T_map_lidar[0, :3, :3]).magnitude()
        assert turned == pytest.approx(0.0 if "odom" in name else np.pi / 2)
    assert means == pytest.approx([means[0]] * 3, abs=1e-6)
    assert means[0] < 0.9
