"""Logs that are written: read back by us and by the ROS library."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest
from logs import SECOND, START, pose

from tilestream.errors import PoseError, UsageError
from tilestream.formats.logs import open_log, write_log
from tilestream.records import Scan, Trajectory
from tilestream.settings import LogOptions


def made_scan(stamp_ns: int, seed: int, **without: None) -> Scan:
    rng = np.random.default_rng(seed)
    n = 300
    more: dict[str, Any] = {
        "intensity": rng.uniform(0, 255, n).astype(np.float32),
        "ring": rng.integers(0, 16, n).astype(np.int32),
        "time_offset": rng.uniform(0, 0.1, n).astype(np.float32).astype(float),
    }
    return Scan(stamp_ns, logs.street_points(rng, n), **{**more, **without})


def made_poses(count: int = 5, step_ns: int = SECOND // 10) -> Trajectory:
    stamps = START + np.arange(count) * step_ns
    T = np.array([pose(x=3.9e6 + i, y=4e5, z=1.0, yaw=0.1 * i) for i in range(count)])
    return Trajectory(stamps, T, "lidar")


def test_a_written_log_reads_back(tmp_path: Path) -> None:
    path, poses = tmp_path / "a.mcap", made_poses()
    scans = [made_scan(int(stamp), i) for i, stamp in enumerate(poses.stamps_ns)]
    write_log(path, scans, poses)
    log = open_log(path)
    assert log.notes == ()
    np.testing.assert_allclose(log.T_map_lidar, poses.T_map_lidar, rtol=0, atol=1e-9)
    for scan, found in zip(scans, log.scans(), strict=True):
        np.testing.assert_array_equal(found.points, scan.points)
    assert all(m.header.frame_id == "lidar" for m in logs.decode(path, "/points"))
    odometry = logs.decode(path, "/odometry")[2]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "lidar")
    assert odometry.pose.pose.position.x == 3.9e6 + 2


def test_the_same_log_is_the_same_bytes(tmp_path: Path) -> None:
    poses = made_poses()
    contents = []
    for name in ("a.mcap", "b.mcap"):
        scans = [made_scan(int(stamp), i) for i, stamp in enumerate(poses.stamps_ns)]
        write_log(tmp_path / name, scans, poses, truth=poses)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_truth_is_a_topic_of_its_own_that_must_be_named(tmp_path: Path) -> None:
    path, poses = tmp_path / "a.mcap", made_poses()
    truth = Trajectory(poses.stamps_ns, poses.T_map_lidar + 0.0, "lidar")
    truth.T_map_lidar[:, 1, 3] += 0.25
    write_log(path, [made_scan(START, 0)], poses, truth=truth)
    with pytest.raises(PoseError, match=r"/ground_truth, /odometry; name one as pose_topic"):
        open_log(path)
    assert open_log(path, LogOptions(pose_topic="/odometry")).T_map_lidar[0, 1, 3] == 4e5
    assert open_log(path, LogOptions(pose_topic="/ground_truth")).T_map_lidar[0, 1, 3] == 4e5 + 0.25


def test_a_log_given_up_half_way_is_not_there(tmp_path: Path) -> None:
    def interrupted() -> Iterator[Scan]:
        for i in range(600):  # more than a chunk
            yield made_scan(START, i)
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        write_log(tmp_path / "a.mcap", interrupted(), made_poses())
    assert list(tmp_path.iterdir()) == []


def test_scans_out_of_order_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a scan of"):
        write_log(tmp_path / "a.mcap", [made_scan(START + 1, 0), made_scan(START, 1)], made_poses())
