"""Frames of a log: poses come to the map and to the lidar, or are refused by name."""

from pathlib import Path

import logs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import SECOND, START, pose
from scipy.spatial.transform import Rotation

import tilestream as ts
from tilestream.errors import PoseError, SourceError
from tilestream.formats.logs import ScanLog, open_log
from tilestream.formats.logs.frames import Frames
from tilestream.formats.logs.pose_tracks import PoseTrack
from tilestream.formats.logs.poses import PoseStatus, interpolate, inverse
from tilestream.formats.logs.ros import TF, Pose
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs.localize import plan_localize
from tilestream.pipeline.jobs.run_inputs import inputs_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.records import Trajectory
from tilestream.settings import LogOptions

TENTH = SECOND // 10
SCANS = 11
STAMPS = START + np.arange(SCANS) * TENTH
MOUNT = pose(x=1.2, y=-0.3, z=1.8, yaw=0.7)
POSED = "geometry_msgs/msg/PoseStamped"


def moving(seed: int, stamps: np.ndarray = STAMPS, speed: float = 8.0) -> np.ndarray:
    """Poses of something that drives and turns, tilted a little."""
    rng = np.random.default_rng(seed)
    since = (stamps - STAMPS[0]) / 1e9
    start, turn = rng.uniform(-50, 50, 3), rng.uniform(-0.5, 0.5)
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    angles = np.column_stack([turn * since + rng.uniform(-3, 3), 0.02 * since, 0.01 * since])
    T[:, :3, :3] = Rotation.from_euler("zyx", angles).as_matrix()
    T[:, :3, 3] = start + since[:, None] * np.array([speed, 1.0, 0.1])
    return T


def clouds(frame: str = "lidar") -> list[logs.Message]:
    return [logs.cloud_at(t, frame=frame) for t in STAMPS.tolist()]


def odometries(T: np.ndarray, parent: str, child: str, topic: str = "/odom") -> list[logs.Message]:
    found = zip(STAMPS.tolist(), T, strict=True)
    return [logs.odometry_at(t, pose_, topic, frame=parent, child=child) for t, pose_ in found]


def stamped(T: np.ndarray, parent: str = "map") -> list[logs.Message]:
    found = zip(STAMPS.tolist(), T, strict=True)
    return [(t, "/pose", POSED, logs.pose_stamped(t, pose_, parent)) for t, pose_ in found]


def tf(
    T: np.ndarray, parent: str, child: str, topic: str = "/tf", stamps: np.ndarray = STAMPS
) -> list[logs.Message]:
    found = zip(stamps.tolist(), T, strict=True)
    return [logs.tf_at(t, parent, child, pose_, topic) for t, pose_ in found]


def opened(tmp_path: Path, *messages: list[logs.Message], **options: object) -> ScanLog:
    path = logs.write(tmp_path / "a.mcap", [message for part in messages for message in part])
    return open_log(path, LogOptions(**options))


def is_at(log: ScanLog, T: np.ndarray, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(log.T_map_lidar, T, rtol=0, atol=atol)


# --- the tree


@given(st.integers(0, 10**6), st.integers(2, 8))
def test_there_and_back_through_any_tree_is_where_one_was(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    track, static = PoseTrack("/tf", TF), PoseTrack("/tf_static", TF)
    for child in range(1, count):
        edge = [f"f{rng.integers(child)}", f"f{child}"]
        parent, child_ = edge if rng.random() < 0.7 else edge[::-1]
        moves = rng.random() < 0.5
        for stamp, T in zip(STAMPS.tolist(), moving(seed + child), strict=True):
            numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
            (track if moves else static).add([Pose(stamp, parent, child_, numbers)])
            if not moves:
                break
    frames = Frames("a", [track, static], LogOptions(), [])
    a, b, c = (f"f{i}" for i in rng.integers(count, size=3))
    ways = [frames.way(*pair) for pair in ((a, b), (b, a), (b, c), (a, c))]
    at = STAMPS[0] + rng.integers(0, STAMPS[-1] - STAMPS[0], 5)
    there, back, on, whole = (frames.along(way, at) for way in ways if way is not None)
    np.testing.assert_allclose(there @ back, np.tile(np.eye(4), (5, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(there @ on, whole, atol=1e-9)


def test_a_way_has_a_pose_where_all_that_moves_on_it_has_one(tmp_path: Path) -> None:
    slow = STAMPS[::2]
    log = opened(
        tmp_path,
        [logs.static_tf("base", "lidar", pose(z=2.0, yaw=0.5))],
        tf(np.array([pose(x=10.0, y=0.2 * i) for i in range(6)]), "map", "odom", stamps=slow),
        tf(np.array([pose(x=float(i)) for i in range(1, 9)]), "odom", "base", stamps=STAMPS[1:9]),
        clouds(),
    )
    before, after = PoseStatus.BEFORE, PoseStatus.AFTER
    assert log.pose_status.tolist() == [before, *[PoseStatus.POSED] * 8, after, after]
    expected = [pose(x=10.0 + i, y=0.1 * i, z=2.0, yaw=0.5) for i in range(1, 9)]
    np.testing.assert_allclose(log.T_map_lidar[1:9], expected, atol=1e-9)


def test_a_vehicle_that_stands_all_the_time(tmp_path: Path) -> None:
    T_map_base = pose(x=7.0, y=3.0, yaw=1.0)
    log = opened(
        tmp_path,
        [logs.static_tf("base", "lidar", MOUNT)],
        tf(np.tile(T_map_base, (SCANS, 1, 1)), "map", "base"),
        clouds(),
    )
    is_at(log, np.tile(T_map_base @ MOUNT, (SCANS, 1, 1)))
    assert log.trajectory.stamps_ns.tolist() == STAMPS.tolist()


# --- the map's side


@given(st.integers(0, 10**6))
@settings(max_examples=25)
def test_a_log_in_odom_is_the_log_in_the_map(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """The localizer's correction moves, at times of its own."""
    folder = tmp_path_factory.mktemp("log")
    own = STAMPS[0] - TENTH // 3 + np.arange(SCANS + 1) * TENTH
    corrections = Trajectory(own, moving(seed, own, speed=0.3))
    T_map_odom = interpolate(corrections, STAMPS, 1.0)[0]
    T_map_lidar = moving(seed + 1)
    in_odom = inverse(T_map_odom) @ T_map_lidar
    log = opened(
        folder,
        odometries(in_odom, "odom", "lidar"),
        tf(corrections.T_map_lidar, "map", "odom", stamps=own),
        clouds(),
    )
    is_at(log, T_map_lidar)
    assert log.notes == ("poses of /odom carried from odom to map by tf map -> odom",)
    is_at(opened(folder, odometries(T_map_lidar, "map", "lidar"), clouds()), T_map_lidar)


def test_poses_at_times_without_a_way_to_the_map_are_left_out(tmp_path: Path) -> None:
    T = moving(0)
    correction = tf(np.array([pose(x=i / 10) for i in range(6)]), "map", "odom", stamps=STAMPS[:6])
    log = opened(tmp_path, odometries(T, "odom", "lidar"), correction, clouds())
    assert log.posed.tolist() == [True] * 6 + [False] * 5
    assert "5 of 11 poses of /odom left out: no transform at their time" in log.notes
    late = tf(np.array([pose(), pose(x=1.0)]), "map", "odom", stamps=STAMPS[:2] + 100 * SECOND)
    with pytest.raises(PoseError, match="at no time of the 11 poses of /odom"):
        opened(tmp_path, odometries(T, "odom", "lidar"), late, clouds())


@pytest.mark.parametrize("parent", ["odom", "/odom", "robot/odom", "lidar_odom"])
def test_poses_of_odometry_alone_are_refused_unless_the_map_is_theirs(
    parent: str, tmp_path: Path
) -> None:
    T, bare = moving(0), parent.lstrip("/")
    poses = odometries(T, parent, "lidar")
    with pytest.raises(
        PoseError, match=rf"/odom has its poses in.*--map-frame {bare}\) if the map"
    ):
        opened(tmp_path, poses, clouds())
    log = opened(tmp_path, poses, clouds(), map_frame=parent)
    is_at(log, T)
    assert log.notes == ()
    with pytest.raises(PoseError, match="no transforms of the log lead from 'world'"):
        opened(tmp_path, poses, clouds(), map_frame="world")


def test_odometry_in_tf_alone_is_refused_too(tmp_path: Path) -> None:
    T = moving(0)
    with pytest.raises(PoseError, match=r"/tf has its poses in.*--map-frame odom\)"):
        opened(tmp_path, tf(T, "odom", "lidar"), clouds())
    is_at(opened(tmp_path, tf(T, "odom", "lidar"), clouds(), map_frame="odom"), T)


def test_the_one_root_is_the_map_and_it_is_said(tmp_path: Path) -> None:
    T, T_world_local = moving(0), pose(x=100.0, yaw=1.0)
    static = [logs.static_tf("world", "local", T_world_local)]
    log = opened(tmp_path, odometries(T, "local", "lidar"), static, clouds())
    is_at(log, T_world_local @ T)
    assert "no frame is called 'map': took world, the root of the frames, as the map's" in log.notes
    two = [logs.static_tf("site", "local", T_world_local)]
    with pytest.raises(PoseError, match=r"several roots: give map_frame.*site, world"):
        opened(tmp_path, odometries(T, "local", "lidar"), static, two, clouds())
    is_at(opened(tmp_path, odometries(T, "local", "lidar"), clouds(), map_frame="local"), T)


def test_a_map_that_lies_below_the_poses_frame(tmp_path: Path) -> None:
    T, T_earth_map = moving(0), pose(x=1000.0, y=7.0, yaw=2.0)
    static = [logs.static_tf("earth", "map", T_earth_map)]
    log = opened(tmp_path, odometries(T, "earth", "lidar"), static, clouds())
    is_at(log, inverse(T_earth_map) @ T)


def test_poses_that_name_no_frame(tmp_path: Path) -> None:
    poses = odometries(moving(0), "", "lidar")
    with pytest.raises(PoseError, match=r"/odom does not say in which frame.*--map-frame map"):
        opened(tmp_path, poses, clouds())
    is_at(opened(tmp_path, poses, clouds(), map_frame="map"), moving(0))


# --- the lidar's side


def test_static_transforms_lead_from_the_vehicle_to_the_lidar(tmp_path: Path) -> None:
    T_base_mast, T_mast_lidar = pose(x=1.0, z=1.5, yaw=0.2), pose(y=0.3, z=0.4, yaw=-0.1)
    T_lidar_mast = inverse(T_mast_lidar)  # recorded against the direction of the chain
    static = [
        logs.static_tf("base", "mast", T_base_mast),
        logs.static_tf("lidar", "mast", T_lidar_mast),
    ]
    log = opened(tmp_path, static, odometries(moving(0), "map", "base"), clouds())
    is_at(log, moving(0) @ T_base_mast @ T_mast_lidar)
    assert log.notes == ("poses of base carried to lidar by static transforms of the log",)


def test_the_mount_may_be_said_on_tf_again_and_again(tmp_path: Path) -> None:
    again = tf(np.tile(MOUNT, (3, 1, 1)), "base", "lidar", stamps=STAMPS[4:7])
    log = opened(tmp_path, odometries(moving(0), "map", "base"), again, clouds())
    is_at(log, moving(0) @ MOUNT)
    assert "base -> lidar is always the same on /tf: taken as static" in log.notes


def test_a_lidar_that_turns_on_the_vehicle(tmp_path: Path) -> None:
    turning = np.array([pose(z=2.0, yaw=0.1 * i) for i in range(SCANS)])
    log = opened(
        tmp_path, odometries(moving(0), "map", "base"), tf(turning, "base", "lidar"), clouds()
    )
    is_at(log, moving(0) @ turning)


def test_the_mount_that_is_given(tmp_path: Path) -> None:
    mount = "1.2,-0.3,1.8,0,0,40"
    T = moving(0) @ pose(x=1.2, y=-0.3, z=1.8, yaw=np.radians(40))
    poses = odometries(moving(0), "map", "base")
    with pytest.raises(PoseError, match=r"poses of base, and no transforms.*clouds' frame lidar"):
        opened(tmp_path, poses, clouds())
    log = opened(tmp_path, poses, clouds(), extrinsic=mount)
    is_at(log, T)
    assert log.notes[-1].startswith("the lidar is mounted on base as given: 1.2,-0.3,1.8,")
    is_at(opened(tmp_path, stamped(moving(0)), clouds(""), extrinsic=mount), T)
    by_tf = tf(moving(0), "map", "base")
    is_at(opened(tmp_path, by_tf, clouds(), extrinsic=mount, pose_frame="base"), T)
    with pytest.raises(PoseError, match=r"give pose_frame \(--pose-frame\), one of base, map"):
        opened(tmp_path, by_tf, clouds(), extrinsic=mount)
    wrong = [logs.static_tf("base", "lidar", pose(z=9.0))]
    is_at(opened(tmp_path, poses, wrong, clouds(), extrinsic=mount), T)


def test_frames_that_the_log_names_wrongly_or_not(tmp_path: Path) -> None:
    T = moving(0)
    poses = odometries(T, "map", "lidar")
    with pytest.raises(PoseError, match=r"clouds name no frame: give lidar_frame.*lidar if"):
        opened(tmp_path, poses, clouds(""))
    is_at(opened(tmp_path, poses, clouds(""), lidar_frame="lidar"), T)
    log = opened(tmp_path, poses, clouds("velodyne"), lidar_frame="lidar")
    is_at(log, T)
    assert log.notes == ("the clouds name the frame velodyne: taken as lidar, as given",)
    log = opened(tmp_path, odometries(T, "map", "base"), clouds(), pose_frame="lidar")
    is_at(log, T)
    assert log.notes == ("/odom says that it poses base: taken as lidar, as given",)


def test_clouds_that_somebody_moved_into_the_map_are_refused(tmp_path: Path) -> None:
    for frame in ("map", "odom"):
        poses = odometries(moving(0), "odom", "lidar")
        carried = tf(moving(3, speed=0.1), "map", "odom")
        with pytest.raises(PoseError, match=rf"the clouds are in '{frame}', in which the lidar"):
            opened(tmp_path, poses, carried, clouds(frame))


# --- whose poses those of a topic are that does not say it


def test_a_pose_that_does_not_say_whose_it_is_has_to_be_told(tmp_path: Path) -> None:
    T = moving(0)
    with pytest.raises(PoseError, match=r"/pose does not say.*one of lidar; lidar if they are"):
        opened(tmp_path, stamped(T), clouds())
    is_at(opened(tmp_path, stamped(T), clouds(), pose_frame="lidar"), T)
    mast = [logs.static_tf("mast", "lidar", MOUNT)]
    with pytest.raises(PoseError, match="one of lidar, mast"):
        opened(tmp_path, stamped(T), mast, clouds())
    is_at(opened(tmp_path, stamped(T), mast, clouds(), pose_frame="mast"), T @ MOUNT)


def test_it_is_the_vehicles_where_one_frame_is_called_so(tmp_path: Path) -> None:
    T = moving(0)
    base = [logs.static_tf("base_link", "lidar", MOUNT)]
    log = opened(tmp_path, stamped(T), base, clouds())
    is_at(log, T @ MOUNT)
    assert "took base_link, the vehicle by its name; pose_frame" in log.notes[0]
    two = [logs.static_tf("base_footprint", "base_link", pose(z=0.3))]
    with pytest.raises(PoseError, match="one of lidar, base_link, base_footprint"):
        opened(tmp_path, stamped(T), base, two, clouds())


def test_it_is_that_which_tf_has_at_the_same_place(tmp_path: Path) -> None:
    T = moving(0)
    static = [logs.static_tf("base_link", "lidar", MOUNT)]
    for frame, at in (("lidar", T @ MOUNT), ("base_link", T)):
        log = opened(tmp_path, stamped(at), tf(T, "map", "base_link"), static, clouds())
        is_at(log, T @ MOUNT)
        assert (
            log.notes[0]
            == f"/pose does not say which frame it poses: {frame}, which is there in tf"
        )
    elsewhere = stamped(T @ pose(x=5.0))
    with pytest.raises(PoseError, match="/pose does not say which frame it poses"):
        opened(tmp_path, elsewhere, tf(T, "map", "base_link"), static, clouds())


# --- two publishers


@pytest.mark.parametrize("same_time", [True, False])
def test_two_that_publish_other_poses_of_one_frame_are_noticed(
    same_time: bool, tmp_path: Path
) -> None:
    T, later = moving(0), 0 if same_time else TENTH // 2
    one = odometries(T, "map", "lidar")
    other = [
        logs.odometry_at(t + later, at @ pose(y=2.0), "/odom")
        for t, at in zip(STAMPS.tolist(), T, strict=True)
    ]
    with pytest.raises(PoseError, match=r"/odom has map -> lidar of two publishers.*by 2\.\d\d m"):
        opened(tmp_path, one, other, clouds())
    in_tf = tf(T, "map", "lidar"), tf(T @ pose(y=2.0), "map", "lidar", stamps=STAMPS + later)
    with pytest.raises(PoseError, match=r"/tf has map -> lidar of two publishers"):
        opened(tmp_path, *in_tf, clouds())
    # nobody needs it
    unused = tf(T, "lidar", "arm"), tf(T @ pose(y=2.0), "lidar", "arm", stamps=STAMPS + later)
    is_at(opened(tmp_path, one, *unused, clouds()), T)


def test_turning_round_and_swaying_is_no_other_publisher(tmp_path: Path) -> None:
    """A vehicle in a narrow place, a pose every second; a lidar that is carried, ten in one."""
    slow = START + np.arange(SCANS) * SECOND
    there_and_back = [pose(x=1.5 * (i % 2)) for i in range(SCANS)]
    swaying = [
        pose(x=0.1 * i, yaw=np.radians(2.0) * np.sin(6.0 * np.pi * i / 10)) for i in range(SCANS)
    ]
    for stamps, T in ((slow, there_and_back), (STAMPS, swaying)):
        log = opened(
            tmp_path,
            [logs.odometry_at(t, at) for t, at in zip(stamps.tolist(), T, strict=True)],
            [logs.cloud_at(t) for t in stamps.tolist()],
        )
        is_at(log, np.array(T))


def test_two_that_publish_the_same_are_one(tmp_path: Path) -> None:
    T = moving(0)
    one = odometries(T, "map", "lidar")
    is_at(opened(tmp_path, one, one, clouds()), T)
    log = opened(tmp_path, one, tf(T, "map", "lidar"), tf(T, "map", "lidar", "/other/tf"), clouds())
    is_at(log, T)
    told = "\n".join(log.notes)
    assert "map -> lidar is given by /odom and /other/tf, 0.000 m and 0.00 deg apart" in told
    assert "map -> lidar is given by /other/tf and /tf, 0.000 m" in told


def test_a_topic_and_tf_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    T, T_map_odom = moving(0), pose(x=30.0, yaw=0.5)
    wheels = odometries(T @ pose(x=0.5), "odom", "lidar", "/wheels")
    carried = tf(np.tile(T_map_odom, (SCANS, 1, 1)), "map", "odom")
    filtered = tf(T, "odom", "lidar")
    told = r"odom -> lidar is given by /wheels and by /tf, 0\.500 m and 0\.00 deg apart"
    for options in ({}, {"pose_topic": "/wheels"}):
        with pytest.raises(PoseError, match=told):
            opened(tmp_path, wheels, carried, filtered, clouds(), **options)
    log = opened(tmp_path, wheels, carried, filtered, clouds(), pose_topic="/tf")
    is_at(log, T_map_odom @ T)
    # poses in the map's frame that are named are taken as they are
    named = odometries(T @ pose(x=0.5), "map", "lidar", "/wheels"), tf(T, "map", "lidar"), clouds()
    with pytest.raises(PoseError, match="map -> lidar is given by /wheels and by /tf"):
        opened(tmp_path, *named)
    is_at(opened(tmp_path, *named, pose_topic="/wheels"), T @ pose(x=0.5))


def test_a_mount_that_is_given_twice(tmp_path: Path) -> None:
    poses = odometries(moving(0), "map", "base")
    once = [logs.static_tf("base", "lidar", MOUNT)]
    is_at(opened(tmp_path, poses, once, once, clouds()), moving(0) @ MOUNT)
    near = [logs.static_tf("base", "lidar", MOUNT @ pose(x=0.004))]
    log = opened(tmp_path, poses, once, near, clouds())
    is_at(log, moving(0) @ MOUNT)
    assert "/tf_static gives base -> lidar twice, 4.0 mm and 0.000 deg apart: took the first" in (
        log.notes
    )
    far = [logs.static_tf("base", "lidar", pose(z=1.0))]
    with pytest.raises(
        PoseError, match=r"twice, \(1\.200, -0\.300, 1\.800\) and \(0\.000, 0\.000, 1"
    ):
        opened(tmp_path, poses, once, far, clouds())


def test_a_frame_with_two_parents(tmp_path: Path) -> None:
    T, T_map_odom = moving(0), moving(5, speed=0.2)
    in_map, in_odom = tf(T, "map", "lidar"), tf(inverse(T_map_odom) @ T, "odom", "lidar", "/o/tf")
    log = opened(tmp_path, in_map, in_odom, clouds())
    is_at(log, T)
    assert "lidar has several parents: took the transforms from map, not from odom" in log.notes
    log = opened(tmp_path, in_map, in_odom, tf(T_map_odom, "map", "odom"), clouds())
    is_at(log, T, atol=1e-6)
    assert "map -> lidar is given by /tf and map -> odom -> lidar, 0.000 m" in "\n".join(log.notes)
    moved = tf(T_map_odom @ pose(x=3.0), "map", "odom")
    with pytest.raises(PoseError, match=r"given by /(o/)?tf and by .* -> lidar, 3\.\d+ m"):
        opened(tmp_path, in_map, in_odom, moved, clouds())


# --- how fast


def test_the_fastest_that_a_vehicle_drives_can_be_said(tmp_path: Path) -> None:
    T = np.array([pose(x=7.0 * i) for i in range(SCANS)])  # 70 m/s
    between = [logs.cloud_at(t + TENTH // 2) for t in STAMPS[:-1].tolist()]
    with pytest.raises(PoseError, match=r"a jump faster than 60 m/s"):
        opened(tmp_path, odometries(T, "map", "lidar"), between)
    log = opened(tmp_path, odometries(T, "map", "lidar"), between, max_speed_mps=80.0)
    assert log.posed.all()
    assert log.notes == ()


# --- every consumer


def test_a_job_reads_each_log_by_its_own_frames(tmp_path: Path) -> None:
    path = logs.write(tmp_path / "a.mcap", [*odometries(moving(0), "odom", "lidar"), *clouds()])
    write_pcd(tmp_path / "map.pcd", logs.STREET.astype(float))
    sources = {"sources": [str(tmp_path / "map.pcd")]}
    made = {"out": str(tmp_path / "out"), "model": {"recipe": "physics"}}
    drive = {"log": str(path), "map_frame": "odom"}
    of_drive = RunSettings(**made, map=sources, drives=[drive])
    of_map = RunSettings(**made, map={**sources, "map_frame": "odom"}, routes=[str(path)])
    for job in (of_drive, of_map):
        (route,) = inputs_of(job, None, None).routes
        np.testing.assert_allclose(route.positions[0, :2], moving(0)[0, :2, 3])
    neither = RunSettings(**made, map=sources, drives=[{"log": str(path)}])
    with pytest.raises(SourceError, match=r"--map-frame odom\) if the map"):
        inputs_of(neither, None, None)


def test_another_mount_makes_other_labels_and_another_map(tmp_path: Path) -> None:
    path = logs.write(tmp_path / "a.mcap", [*odometries(moving(0), "map", "base"), *clouds()])
    mounts = [LogOptions(extrinsic=f"0,0,{z},0,0,0") for z in (1.0, 1.5)]
    stores = [tmp_path / f"{i}.zarr" for i in range(2)]
    for mount, url in zip(mounts, stores, strict=True):
        ts.ingest(path, url, log_options=mount)
    z = [ts.open_store(url).tile_at(*moving(0)[0, :2, 3]).points()[:, 2].min() for url in stores]
    assert z[1] - z[0] == pytest.approx(0.5, abs=0.02)
    states = [ts.open_store(url).sources()[0]["state"] for url in stores]
    assert states[0] != states[1]
    plans = [
        plan_localize(
            MapPlan.of_store(ts.open_store(stores[0])),
            Reading(str(path), mount),
            tmp_path / "out",
            cell_size=2.0,
            spacing=1.0,
            registration=ts.RegistrationSettings(),
            starts=ts.StartSettings(),
            true_pose="log",
            scans=ts.ScanSelection(),
            starts_per_task=None,
            memory=10**9,
        )
        for mount in mounts
    ]
    a, b = ({task.identity for task in plan.tasks if task.stage == "label"} for plan in plans)
    assert a
    assert not a & b
