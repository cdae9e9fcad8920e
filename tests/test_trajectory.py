"""Poses between poses, what motion does to a scan, and what a simpler lidar would see."""

from dataclasses import replace

import logs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import SECOND, START, pose
from scipy.spatial.transform import Rotation, Slerp

from tilestream.errors import PoseError, UsageError
from tilestream.formats.logs import open_log
from tilestream.formats.logs.degrade import degraded
from tilestream.formats.logs.deskew import Sweep, deskew
from tilestream.formats.logs.poses import (
    PoseStatus,
    interpolate,
    inverse,
    jumps,
    path_between,
    transform,
)
from tilestream.formats.logs.poses import trajectory as ordered
from tilestream.records import Scan, Trajectory


def wandering(count: int, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = START + np.sort(rng.choice(count * 10**8, count, replace=False))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    T[:, :3, 3] = rng.uniform(-10, 10, (count, 3)) + np.array([3.7e5, 3.95e6, 40])
    return Trajectory(stamps, T, "lidar")


# --- interpolation


def test_between_poses_linear_and_slerp() -> None:
    poses = wandering(20)
    poses.T_map_lidar[:, :3, 3] *= 0.01  # slow enough
    rng = np.random.default_rng(1)
    times = rng.integers(poses.stamps_ns[0], poses.stamps_ns[-1], 200)
    T, status = interpolate(poses, times, 1e9)
    assert (status == PoseStatus.POSED).all()
    since = (poses.stamps_ns - START) / 1e9
    slerp = Slerp(since, Rotation.from_matrix(poses.T_map_lidar[:, :3, :3]))
    at = (times - START) / 1e9
    np.testing.assert_allclose(T[:, :3, :3], slerp(at).as_matrix(), atol=1e-6)
    for axis in range(3):
        expected = np.interp(at, since, poses.T_map_lidar[:, axis, 3])
        np.testing.assert_allclose(T[:, axis, 3], expected, atol=1e-6)


def test_at_a_pose_its_own_bits() -> None:
    poses = wandering(20)
    T, _ = interpolate(poses, poses.stamps_ns[::-1], 0.0)
    assert T.tobytes() == poses.T_map_lidar[::-1].tobytes()


def test_never_beyond_the_poses_nor_over_a_gap() -> None:
    stamps = START + np.array([0, 1, 4]) * SECOND
    poses = Trajectory(stamps, np.array([pose(x=float(i)) for i in range(3)]))
    times = START + (np.array([-0.1, 0, 0.5, 1, 2, 4, 4.1]) * SECOND).astype(np.int64)
    T, status = interpolate(poses, times, 1.0)
    before, posed, after, gap = (
        PoseStatus.BEFORE,
        PoseStatus.POSED,
        PoseStatus.AFTER,
        PoseStatus.GAP,
    )
    assert status.tolist() == [before, posed, posed, posed, gap, posed, after]
    assert np.isfinite(T[status == posed]).all()
    assert np.isnan(T[status != posed]).all()


def test_never_over_a_jump_that_no_vehicle_drives() -> None:
    stamps = START + np.array([0, 1, 2, 3, 4]) * SECOND // 10
    x = [0.0, 0.0, 900.0, 905.9, 912.0]  # 9000, 59 and 61 m/s
    poses = Trajectory(stamps, np.array([pose(x=at) for at in x]))
    assert jumps(poses).tolist() == [False, True, False, True]
    times = START + (np.array([0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.35, 0.4]) * SECOND).astype(np.int64)
    T, status = interpolate(poses, times, 1.0)
    posed, jump = PoseStatus.POSED, PoseStatus.JUMP
    assert status.tolist() == [posed, posed, posed, jump, posed, posed, jump, posed]
    assert np.isnan(T[status == jump]).all()
    shaking = Trajectory(START + np.arange(5), np.array([pose(x=0.4 * (i % 2)) for i in range(5)]))
    assert not jumps(shaking).any()


def test_one_pose_and_none() -> None:
    one = Trajectory(np.array([START]), pose(x=1.0)[None])
    assert interpolate(one, np.array([START - 1, START, START + 1]), 1.0)[1].tolist() == [1, 0, 2]
    none = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert interpolate(none, np.array([START]), 1.0)[1].tolist() == [PoseStatus.BEFORE]
    assert interpolate(one, np.zeros(0, np.int64), 1.0)[0].shape == (0, 4, 4)


def test_poses_are_put_in_order_and_what_is_unusable_is_counted() -> None:
    numbers = np.array([[float(i), 0, 0, 0, 0, 0, 1] for i in range(5)])
    numbers[3, 6] = 0.0
    poses, unusable = ordered(np.array([5, 3, 3, 9, 1]), numbers, "lidar")
    assert poses.stamps_ns.tolist() == [1, 3, 5]
    assert poses.T_map_lidar[:, 0, 3].tolist() == [4, 1, 0]
    assert unusable == 2


@given(st.integers(0, 10**6))
@settings(deadline=None)
def test_transform_is_rigid_and_the_same_for_a_point_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = wandering(1, seed).T_map_lidar[0]
    points = rng.uniform(-100, 100, (17, 3))
    moved = transform(T, points)
    np.testing.assert_allclose(moved, points @ T[:3, :3].T + T[:3, 3], atol=1e-8)
    assert moved[5:6].tobytes() == transform(T, points[5:6]).tobytes()
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-8)


def test_chains_of_frames() -> None:
    edges = [("map", "odom"), ("odom", "base"), ("base", "lidar"), ("base", "camera")]
    assert path_between(edges, "map", "base") == [("map", "odom"), ("odom", "base")]
    assert path_between(edges, "camera", "lidar") == [("camera", "base"), ("base", "lidar")]
    assert path_between(edges, "map", "map") == []
    assert path_between(edges, "map", "trailer") is None


# --- de-skew


def wall_seen_in_motion(
    velocity: float, yaw_rate: float, count: int = 400
) -> tuple[Scan, Trajectory]:
    """The wall x = 10 m as a lidar sees it in 0.1 s of a turn, stamped at its beginning."""
    times = np.linspace(0, 0.1, count)
    wall = np.column_stack([np.full(count, 10.0), np.linspace(8, -8, count), np.full(count, 1.0)])
    seen = np.empty_like(wall)
    for i, t in enumerate(times):
        T = pose(x=velocity * t, yaw=yaw_rate * t)
        seen[i] = transform(inverse(T), wall[i : i + 1])[0]
    stamps = START + np.arange(-1, 4) * SECOND // 10
    at = (stamps - START) / 1e9
    poses = np.array([pose(x=velocity * t, yaw=yaw_rate * t) for t in at])
    scan = Scan(START, seen, poses[1], time_offset=times)
    return scan, Trajectory(stamps, poses, "lidar")


def test_a_wall_seen_at_two_metres_per_second_is_flat_again() -> None:
    scan, poses = wall_seen_in_motion(velocity=2.0, yaw_rate=0.0)
    assert np.ptp(scan.points[:, 0]) == pytest.approx(0.2, abs=1e-9)
    np.testing.assert_allclose(deskew(scan, poses).points[:, 0], 10.0, atol=1e-9)


def test_a_turn_is_taken_out_at_utm_coordinates_too() -> None:
    scan, poses = wall_seen_in_motion(velocity=10.0, yaw_rate=0.5)
    assert np.ptp(scan.points[:, 0]) > 0.5
    far = poses.T_map_lidar.copy()
    far[:, :3, 3] += [3.7e5, 3.95e6, 0.0]
    straight = deskew(scan, replace(poses, T_map_lidar=far))
    # the poses go along x while the vehicle turns: straight lines between them are exact here
    np.testing.assert_allclose(straight.points[:, 0], 10.0, atol=1e-8)
    assert straight.time_offset is not None
    assert not straight.time_offset.any()
    again = deskew(straight, poses)
    np.testing.assert_allclose(again.points, straight.points, atol=1e-12)


def test_without_times_the_azimuth_tells_when_a_point_was_seen() -> None:
    scan, poses = wall_seen_in_motion(velocity=2.0, yaw_rate=0.0)
    bare = replace(scan, time_offset=None)
    with pytest.raises(UsageError, match="no time per point"):
        deskew(bare, poses)
    sweep = Sweep(duration_s=0.1, clockwise=True, start_deg=180.0, stamp_at=0.5)
    azimuths = np.radians([180 - 1e-9, 90, 0, -90, -180 + 1e-9])
    points = np.column_stack([np.cos(azimuths), np.sin(azimuths), azimuths * 0])
    expected = [-0.05, -0.025, 0.0, 0.025, 0.05]
    np.testing.assert_allclose(sweep.time_offsets(points), expected, atol=1e-9)
    against = replace(sweep, clockwise=False)
    np.testing.assert_allclose(against.time_offsets(points)[1:4], [0.025, 0.0, -0.025], atol=1e-9)
    offsets = sweep.time_offsets(bare.points)
    by_sweep = deskew(bare, poses, sweep=sweep)
    by_times = deskew(replace(bare, time_offset=offsets), poses)
    np.testing.assert_array_equal(by_sweep.points, by_times.points)


def test_a_scan_beyond_the_poses_is_not_guessed() -> None:
    scan, poses = wall_seen_in_motion(velocity=2.0, yaw_rate=0.0)
    until_stamp = Trajectory(poses.stamps_ns[:2], poses.T_map_lidar[:2])
    with pytest.raises(PoseError, match=r"without poses, from 0\.000 to 0\.100 s"):
        deskew(scan, until_stamp)


# --- a simpler lidar


def spinning(
    beams: int, columns: int = 900, seed: int = 0, low: float = -15.0, high: float = 15.0
) -> Scan:
    rng = np.random.default_rng(seed)
    azimuth = np.radians(np.repeat(np.arange(columns) * 360.0 / columns, beams))
    ring = np.tile(np.arange(beams), columns)
    elevation = np.radians(np.linspace(low, high, beams))[ring]
    r = rng.uniform(4, 60, len(ring))
    points = np.column_stack(
        [
            r * np.cos(elevation) * np.cos(azimuth),
            r * np.cos(elevation) * np.sin(azimuth),
            r * np.sin(elevation),
        ]
    )
    return Scan(START, points, np.eye(4), ring=ring.astype(np.int32), time_offset=azimuth / 60)


def elevations_deg(scan: Scan) -> np.ndarray:
    return np.degrees(np.arctan2(scan.points[:, 2], np.hypot(*scan.points[:, :2].T)))


@pytest.mark.parametrize(("recorded", "kept"), [(64, 16), (32, 16), (128, 64), (40, 16), (16, 16)])
def test_whole_rings_remain_evenly_spread(recorded: int, kept: int) -> None:
    scan = spinning(recorded, columns=90)
    rings = np.unique(degraded(scan, beams=kept).ring)
    assert len(rings) == kept
    assert set(np.diff(rings)) <= {recorded // kept, -(-recorded // kept)}
    assert np.array_equal(rings, recorded - 1 - rings[::-1]) or recorded % kept == 0


def test_rings_numbered_in_any_order_and_rings_without_returns() -> None:
    scan = spinning(32, columns=90)
    shuffle = np.random.default_rng(0).permutation(32).astype(np.int32)
    a, b = degraded(scan, beams=8), degraded(replace(scan, ring=shuffle[scan.ring]), beams=8)
    np.testing.assert_array_equal(a.points, b.points)
    open_sky = scan.ring < 25
    seen = replace(scan, points=scan.points[open_sky], ring=scan.ring[open_sky], time_offset=None)
    still = np.unique(degraded(seen, beams=8, recorded_beams=32).ring)
    assert set(still) == set(np.unique(a.ring)) & set(range(25))


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(("recorded", "kept"), [(64, 16), (32, 8)])
def test_without_rings_slices_of_elevation_remain(recorded: int, kept: int, told: bool) -> None:
    scan = replace(spinning(recorded), ring=None)
    simpler = degraded(scan, beams=kept, recorded_beams=recorded if told else None)
    left = elevations_deg(simpler)
    beams = np.unique(np.round(left, 3))
    assert abs(len(beams) - kept) <= 1
    gaps = np.diff(beams)
    assert gaps.max() < 2 * 30 / (kept - 1)
    assert len(simpler.points) == pytest.approx(len(scan.points) * kept / recorded, rel=0.15)


def test_range_and_blind_rear() -> None:
    scan = spinning(16)
    near = degraded(scan, range_max=30.0)
    inside = np.linalg.norm(scan.points, axis=1) <= 30.0
    np.testing.assert_array_equal(near.points, scan.points[inside])
    assert near.ring is not None
    assert near.time_offset is not None
    np.testing.assert_array_equal(near.ring, scan.ring[inside])
    np.testing.assert_array_equal(near.time_offset, scan.time_offset[inside])
    ahead = degraded(scan, blind_rear_deg=120.0)
    azimuth = np.degrees(np.arctan2(ahead.points[:, 1], ahead.points[:, 0]))
    assert np.abs(azimuth).max() < 120.0
    assert len(ahead.points) == pytest.approx(len(scan.points) * 240 / 360, rel=0.01)
    everything = degraded(scan)
    np.testing.assert_array_equal(everything.points, scan.points)


@pytest.mark.parametrize(
    "wrong",
    [
        {"beams": 0},
        {"beams": 17},
        {"range_max": 0.0},
        {"range_max": np.nan},
        {"blind_rear_deg": -1.0},
        {"blind_rear_deg": 360.0},
    ],
)
def test_what_no_lidar_is_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        degraded(spinning(16, columns=9), **wrong)


def test_the_real_drive_through_a_simpler_lidar(shared_data: logs.Path) -> None:
    log = open_log(shared_data / "kitti_drive" / "drive.mcap")
    for scan in log.scans(0, 52, 17):
        simpler = degraded(scan, beams=16, range_max=30.0, blind_rear_deg=120.0)
        assert 0.1 < len(simpler.points) / len(scan.points) < 0.2
        assert np.linalg.norm(simpler.points, axis=1).max() <= 30.0
        sixteen = degraded(scan, beams=16)
        assert 0.2 < len(sixteen.points) / len(scan.points) < 0.3
