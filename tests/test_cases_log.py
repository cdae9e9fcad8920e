"""Logs that went wrong for others, each with its right value."""

from pathlib import Path

import numpy as np
import pytest

from tilestream.formats.logs import open_log
from tilestream.formats.logs.deskew import deskew
from tilestream.formats.logs.poses import PoseStatus, interpolate
from tilestream.formats.routes import read_all_routes


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
