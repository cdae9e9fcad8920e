"""A vehicle of several lidars in a log: their scans make one each, wherever they are mounted."""

from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest
from logs import SECOND, START, cloud_at, odometry_at, pose, static_tf
from scenes import PLACES, in_map

import tilestream as ts
from tilestream.errors import SourceError, UsageError
from tilestream.formats.logs import open_log
from tilestream.formats.logs.together import APART_NS
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs.run_inputs import inputs_of
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.settings import LogOptions

FRONT, REAR = pose(x=1.2, z=0.3), pose(x=-0.8, y=0.1, yaw=np.pi)
"""Where the two lidars are, in the frame of the vehicle."""
SCANS = 8
LATER = 20_000_000
"""How much later the rear lidar's scan is [ns]."""


def street(seed: int, spacing: float) -> np.ndarray:
    return in_map(PLACES["canyon"](np.random.default_rng(seed), 44.0, spacing))


def vehicle_at(stamp_ns: int) -> np.ndarray:
    """2 m above the road, at 5 m/s along x."""
    seconds = (stamp_ns - START) / SECOND
    return pose(x=12.0 + 5.0 * seconds, y=0.1, z=2.0)


def seen(T_map_lidar: np.ndarray, ahead: bool | None) -> np.ndarray:
    """The points near a place of the map x > or < that of the vehicle's middle, or all."""
    points = street(100, 0.5)
    here = points[np.linalg.norm(points - T_map_lidar[:3, 3], axis=1) < 14.0]
    if ahead is not None:
        here = here[(here[:, 0] > T_map_lidar[0, 3]) == ahead]
    return (here - T_map_lidar[:3, 3]) @ T_map_lidar[:3, :3]


def two_lidars(path: Path, later: int = LATER, missing: tuple[int, ...] = ()) -> Path:
    """A log of a vehicle whose lidars look ahead and back, and of its own poses."""
    messages = [static_tf("base", "front", FRONT), static_tf("base", "rear", REAR)]
    for i in range(SCANS):
        stamp = START + i * SECOND // 5
        moments = (stamp, stamp + SECOND // 10)
        messages += [odometry_at(moment, vehicle_at(moment), child="base") for moment in moments]
        ahead = seen(vehicle_at(stamp) @ FRONT, True)
        messages.append(cloud_at(stamp, ahead, topic="/front", frame="front"))
        if i not in missing:
            back = seen(vehicle_at(stamp + later) @ REAR, False)
            back[0] = 0.0  # as drivers write what never came back
            messages.append(cloud_at(stamp + later, back, topic="/rear", frame="rear"))
    return logs.write(path, messages)


def test_points_of_all_lidars_lie_where_they_are_in_the_map(tmp_path: Path) -> None:
    path = two_lidars(tmp_path / "two.mcap")
    log = open_log(path, LogOptions(points_topic="/front, /rear"))
    front, rear = (open_log(path, LogOptions(points_topic=topic)) for topic in ("/front", "/rear"))
    assert len(log) == SCANS
    np.testing.assert_array_equal(log.T_map_lidar, front.T_map_lidar)
    for one, ahead, back in zip(log.scans(), front.scans(), rear.scans(), strict=True):
        assert len(one.points) == len(ahead.points) + len(back.points)
        assert one.dropped == ahead.dropped + back.dropped == 1
        np.testing.assert_array_equal(one.points[: len(ahead.points)], ahead.points)
        in_the_map = [
            scan.points @ scan.T_map_lidar[:3, :3].T + scan.T_map_lidar[:3, 3]
            for scan in (one, ahead, back)
        ]
        np.testing.assert_allclose(in_the_map[0], np.concatenate(in_the_map[1:]), atol=1e-9)
        assert one.points[:, 0].min() < -10.0 < 10.0 < one.points[:, 0].max()
    assert any("make one each" in note for note in log.notes)


def test_any_scans_in_any_order(tmp_path: Path) -> None:
    log = open_log(two_lidars(tmp_path / "two.mcap"), LogOptions(points_topic="/front,/rear"))
    whole = list(log.scans())
    for index, scan in zip((5, 0, 3), log.scans_at([5, 0, 3]), strict=True):
        np.testing.assert_array_equal(scan.points, whole[index].points)


def test_a_scan_without_a_partner_is_left_out_and_noted(tmp_path: Path) -> None:
    path = two_lidars(tmp_path / "two.mcap", missing=(2, 3))
    log = open_log(path, LogOptions(points_topic="/front,/rear"))
    assert len(log) == SCANS - 2
    assert "2 of 8 scans left out" in log.notes[-1]
    assert log.info().points == log.point_counts.sum()


def test_lidars_that_never_scan_together_are_refused(tmp_path: Path) -> None:
    path = two_lidars(tmp_path / "two.mcap", later=APART_NS + SECOND // 50)
    with pytest.raises(SourceError, match="/front, /rear"):
        open_log(path, LogOptions(points_topic="/front,/rear"))


def test_a_lidar_that_is_named_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="named twice"):
        open_log(two_lidars(tmp_path / "two.mcap"), LogOptions(points_topic="/front,/front"))


@pytest.mark.parametrize("how", [{"beams": 8}, {"deskew": True, "sweep_s": 0.1}])
def test_what_only_one_lidar_knows_is_refused(how: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="name one topic"):
        Reading("two.mcap", LogOptions(points_topic="/front,/rear"), **how)


def test_a_vehicle_is_labelled_by_the_cloud_of_its_lidars(tmp_path: Path) -> None:
    write_pcd(tmp_path / "map.pcd", street(1, 0.3))
    store = ts.ingest(tmp_path / "map.pcd", str(tmp_path / "map.zarr"), tile_size=50.0)
    drive = str(two_lidars(tmp_path / "two.mcap"))
    how = {"spacing": 2.0, "starts": ts.StartSettings(radius=0.4, step=0.2)}
    points = {}
    for topic in ("/front,/rear", "/front"):
        folder = tmp_path / f"of-{len(topic)}"
        labels = ts.localize(
            store, drive, str(folder), reading=Reading(drive, LogOptions(points_topic=topic)), **how
        )
        assert set(labels["status"]) == {"done"}
        assert labels["error_mean"].max() < 0.2
        points[topic] = labels["points"].mean()
    assert points["/front,/rear"] > 1.5 * points["/front"]


def test_a_drive_of_fewer_lidars_than_the_vehicle_is_said_to_be(tmp_path: Path) -> None:
    drive = str(two_lidars(tmp_path / "two.mcap"))
    values: dict[str, Any] = {"out": str(tmp_path), "map": {"store": "map.zarr"}}
    for topic, sensors, notes in (("/front", 2, 1), ("/front,/rear", 2, 0), ("/front", 1, 0)):
        drives = [{"log": drive, "points_topic": topic}]
        lidars = [{"name": "VLP16", "mount": {"x": float(i)}} for i in range(sensors)]
        job = ts.RunSettings(**values, drives=drives, sensor=lidars)
        assert len(inputs_of(job, None, None).notes.get("job", [])) == notes
