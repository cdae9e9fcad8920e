"""The job that measures a drive: the same labels however the work is cut, and nothing stale."""

import os
import shutil
from pathlib import Path
from typing import Any

import distributed
import logs
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from killed import killed_after
from logs import SECOND, START, pose
from scenes import PLACES, in_map

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import PoseError, TileNotReadyError, UsageError
from tilestream.formats.logs import open_log
from tilestream.formats.logs.degrade import degraded
from tilestream.formats.motion import along
from tilestream.formats.points.pcd import write_pcd
from tilestream.label import refined_pose, start_errors, start_poses
from tilestream.marks import Mark
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.drive_measured import drive_measured
from tilestream.pipeline.jobs.localize import REACH
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.pipeline.jobs.sample_scans import choose_samples
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.pipeline.stages.label import ERROR_COLUMNS
from tilestream.pipeline.stages.register import START_COLUMNS
from tilestream.records import Cells
from tilestream.report.log_poses import note_of_log_poses
from tilestream.settings import StartSettings
from tilestream.store import POINTS, Tile
from tilestream.tables import read_mark, read_tables

LENGTH = 80.0
FEW = StartSettings(radius=0.4, step=0.2)
"""13 starts."""
MATCHER = ts.RegistrationSettings.autoware()
SCANS = 16
SPACING = 3.0
"""Metres between the scans of the drive."""


def street(seed: int, spacing: float) -> np.ndarray:
    return in_map(PLACES["canyon"](np.random.default_rng(seed), LENGTH, spacing))


def lidar_at(i: int) -> np.ndarray:
    return pose(x=17.0 + SPACING * i, y=0.2 * np.sin(i), z=2.0, yaw=0.01 * i)


def seen_from(T_map_lidar: np.ndarray, seed: int, reach: float = 16.0) -> np.ndarray:
    """A scan: another sampling of the street, in the lidar frame; it never sees the street's end,
    where direct7 pulls a scan into the map.
    """
    points = (street(seed, 0.7) - T_map_lidar[:3, 3]) @ T_map_lidar[:3, :3]
    return points[np.linalg.norm(points, axis=1) < reach]


def rows_of(points: np.ndarray) -> np.ndarray:
    """With the number of the beam: 16 of them, up to 30 degrees up."""
    up = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    return logs.xyz_rows(points, ring=np.clip((up + 30.0) / 60.0 * 16, 0, 15).astype("<u2"))


def write_drive(
    path: Path, scans: dict[int, np.ndarray], poses: dict[int, np.ndarray], period_s: float = 0.5
) -> Path:
    messages: list[logs.Message] = []
    for i, T in poses.items():
        stamp = START + round(i * period_s * SECOND)
        messages.append(logs.odometry_at(stamp, T))
        cloud = logs.cloud(stamp, rows_of(scans[i]))
        messages.append((stamp, "/points", "sensor_msgs/msg/PointCloud2", cloud))
    return logs.write(path, messages, chunk_size=200_000)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "street.pcd"
    write_pcd(path, street(1, 0.25))
    return path


@pytest.fixture(scope="module")
def store(cloud: Path, tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    return ts.ingest(cloud, tmp_path_factory.mktemp("store") / "map.zarr", tile_size=16.0)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = {i: lidar_at(i) for i in range(SCANS)}
    scans = {i: seen_from(T, 100 + i) for i, T in poses.items()}
    return write_drive(tmp_path_factory.mktemp("drive") / "drive.mcap", scans, poses)


@pytest.fixture(scope="module")
def plain(
    store: ts.TileStore, drive: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[pd.DataFrame, Path]:
    """The labels of the drive, and the folder of their tables."""
    out = tmp_path_factory.mktemp("plain")
    return ts.localize(store, drive, out, starts=FEW), out


@pytest.fixture(scope="module")
def all_cells(store: ts.TileStore) -> Cells:
    return ts.cells_of(np.concatenate([store.tile(key).points() for key in store.keys()]))


def tables(out: Path, kind: str) -> pd.DataFrame:
    """All rows that lie in a folder of tables, in the order of the drive."""
    rows = read_tables([str(path) for path in sorted((out / kind).glob("*.parquet"))])
    by = ["sample", "start"] if kind == "starts" else ["sample"]
    return rows.sort_values(by, ignore_index=True)


def same_tables(a: Path, b: Path) -> None:
    for kind in ("errors", "starts"):
        pd.testing.assert_frame_equal(tables(a, kind), tables(b, kind), check_exact=True)


class Redone:
    """Tells which tasks wrote rows."""

    def __init__(self) -> None:
        self.registers: list[str] = []
        self.kept: list[str] = []

    def __call__(self, outcome: Outcome, *_: int) -> None:
        if outcome.stage == "register":
            (self.registers if outcome.made else self.kept).append(outcome.key)


# --- The labels


def test_every_label_is_that_of_localization_error(
    drive: Path, plain: tuple[pd.DataFrame, Path], all_cells: Cells
) -> None:
    labels, out = plain
    log = open_log(drive)
    assert labels["scan"].tolist() == list(range(SCANS))
    assert (labels["status"] == "done").all()
    starts = tables(out, "starts")
    offsets = ts.disc_starts(0.4, 0.2)
    for row, scan in zip(labels.to_dict("records"), log.scans(), strict=True):
        assert scan.T_map_lidar is not None
        expected = ts.localization_error(
            all_cells, scan.points, scan.T_map_lidar, offsets, settings=MATCHER
        )
        for name in ("error_mean", "p_fail", "mean_held", "median_held", "p95_held"):
            np.testing.assert_array_equal(row[name], getattr(expected, name))  # NaN: all failed
        for name in ("along", "across", "up", "roll", "pitch", "yaw"):
            assert row[f"{name}_mean"] == getattr(expected, f"{name}_mean")
        assert (row["error_floor"], row["error_tail"]) == (
            expected.error_floor,
            expected.error_tail,
        )
        assert (row["x"], row["y"], row["z"]) == tuple(scan.T_map_lidar[:3, 3])
        assert row["lidar_height"] == pytest.approx(2.0, abs=0.15)
        assert row["stamp_ns"] == scan.stamp_ns
        assert row["starts"] == 13
        assert row["points"] == expected.registrations.points
        mine = starts[starts["sample"] == row["sample"]]
        axes = ("along", "across", "up", "roll", "pitch", "yaw_vector", "yaw")
        for name in (*axes, "error", "converged", "iterations"):
            np.testing.assert_array_equal(mine[name], getattr(expected, name))
        for name in ("score", "nvtl", "hits"):
            np.testing.assert_array_equal(mine[name], getattr(expected.registrations, name))


def test_a_simpler_sensor_changes_the_labels_and_is_recorded(
    store: ts.TileStore,
    drive: Path,
    plain: tuple[pd.DataFrame, Path],
    all_cells: Cells,
    tmp_path: Path,
) -> None:
    simpler = Reading(str(drive), beams=8, range_max=12.0, blind_rear_deg=120.0)
    labels = ts.localize(store, drive, tmp_path, starts=FEW, reading=simpler)
    assert set(labels["as_sensor"]) == {"8 beams, 12 m, rear blind 120 deg"}
    assert set(plain[0]["as_sensor"]) == {"as recorded"}
    assert (labels["points"] < plain[0]["points"] / 2).all()
    assert not (labels["error_mean"] == plain[0]["error_mean"]).any()
    scan = next(open_log(drive).scans_at([7]))
    assert scan.T_map_lidar is not None
    less = degraded(scan, beams=8, range_max=12.0, blind_rear_deg=120.0)
    expected = ts.localization_error(
        all_cells, less.points, scan.T_map_lidar, ts.disc_starts(0.4, 0.2), settings=MATCHER
    )
    assert labels["error_mean"][7] == expected.error_mean
    for path in tmp_path.rglob("*.parquet"):
        mark = read_mark(str(path))
        assert mark.facts["data_set"]["as_sensor"] == "8 beams, 12 m, rear blind 120 deg"


def test_the_tables_name_their_map(store: ts.TileStore, plain: tuple[pd.DataFrame, Path]) -> None:
    assert map_of(plain[1]).url == store.url


def test_a_refined_true_pose_is_recorded_and_used(
    store: ts.TileStore, drive: Path, plain: tuple[pd.DataFrame, Path], tmp_path: Path
) -> None:
    scans = ts.ScanSelection(every=8, offset=3)
    labels = ts.localize(store, drive, tmp_path, starts=FEW, scans=scans, true_pose="refined")
    assert labels["true_pose"].tolist() == ["refined"] * 2
    assert set(plain[0]["true_pose"]) == {"log"}
    fine = ts.cells_of(np.concatenate([store.tile(k).points() for k in store.keys()]), 1.0)
    for row, scan in zip(labels.itertuples(), open_log(drive).scans_at([3, 11]), strict=True):
        assert scan.T_map_lidar is not None
        T = refined_pose(fine, scan.points, scan.T_map_lidar)
        assert (row.x, row.y, row.z) == tuple(T[:3, 3])
        assert (row.x, row.y) != tuple(scan.T_map_lidar[:2, 3])
        off = start_errors(T, scan.T_map_lidar[None])
        for name in ("along", "across", "up", "yaw"):
            assert getattr(row, f"log_{name}") == off[name][0]
    (told,) = note_of_log_poses(labels)
    far = np.linalg.norm(labels[["log_along", "log_across", "log_up"]], axis=1)
    assert f"are {100 * np.median(far):.1f} cm from the refined ones (median of 2 scans" in told
    assert f"{100 * labels['log_across'].median():+.1f} cm across" in told
    own = plain[0].filter(regex="^log_")
    assert own.shape[1] == 4
    assert own.isna().all(axis=None)
    assert note_of_log_poses(plain[0]) == []


def test_one_scan_is_chosen_per_metre_of_the_drive(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    along = np.cumsum(rng.uniform(0.05, 0.6, 60))
    poses = {i: pose(x=float(x)) for i, x in enumerate(along)}
    path = write_drive(
        tmp_path / "dense.mcap", dict.fromkeys(poses, np.ones((1, 3))), poses, period_s=0.1
    )
    log = open_log(path)
    used = np.arange(1, 60, 2)
    for spacing in (1.0, 2.5):
        chosen = choose_samples(log, ts.ScanSelection(every=2, offset=1), spacing)
        arc = along[used] - along[used][0]
        nearest = {
            int(used[np.argmin(np.abs(arc - at))]) for at in np.arange(0.0, arc[-1], spacing)
        }
        assert nearest <= {sample.scan for sample in chosen}
        assert len(chosen) <= arc[-1] / spacing + 2
        for number, sample in enumerate(chosen):
            assert sample.number == number
            assert sample.arc_length == pytest.approx(along[sample.scan] - along[1])
            assert sample.stamp_ns == log.stamps_ns[sample.scan]


@given(
    steps=st.lists(st.sampled_from([0.0, 0.05, 0.3, 0.7, 1.6]), min_size=1, max_size=25),
    per_point=st.integers(1, 5),
    spacing=st.sampled_from([0.6, 1.0, 2.5]),
)
@settings(max_examples=25, deadline=None)
def test_other_scans_of_a_sample_point_are_the_nearest_and_of_no_other(
    steps: list[float], per_point: int, spacing: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    x = np.cumsum([0.0, *steps])
    poses = {i: pose(x=float(at)) for i, at in enumerate(x)}
    path = tmp_path_factory.mktemp("dense") / "dense.mcap"
    write_drive(path, dict.fromkeys(poses, np.ones((1, 3))), poses, period_s=0.1)
    log = open_log(path)
    one = choose_samples(log, ts.ScanSelection(), spacing)
    several = choose_samples(log, ts.ScanSelection(), spacing, per_point)
    scans = [sample.scan for sample in several]
    assert len(set(scans)) == len(scans)
    arc = dict(enumerate(along(log.T_map_lidar[:, :3, 3])))
    for own in one:
        here = [sample for sample in several if sample.number == own.number]
        assert here[0] == own
        assert 1 <= len(here) <= per_point
        away = [abs(arc[sample.scan] - arc[own.scan]) for sample in here]
        assert away == sorted(away)
        assert away[-1] <= 0.5
        for scan in set(range(len(log))) - set(scans):  # one as near as the last would be taken
            nearest = min(abs(arc[scan] - arc[other.scan]) for other in one)
            mine = abs(arc[scan] - arc[own.scan])
            if mine == nearest and mine < 0.5 - 1e-9 and len(here) < per_point:
                others = [o for o in one if abs(arc[scan] - arc[o.scan]) == nearest]
                assert len(others) > 1
    assert [sample.number for sample in several] == sorted(sample.number for sample in several)


def test_a_label_of_several_scans_is_the_mean_of_their_labels(
    store: ts.TileStore, drive: Path, plain: tuple[pd.DataFrame, Path], tmp_path: Path
) -> None:
    """Scans 10 cm apart, three at each place; one of the second place is too thin."""
    poses, scans = {}, {}
    for k in range(6):
        poses[k] = lidar_at(4 + 2 * (k // 3))
        poses[k][0, 3] += 0.1 * (k % 3)
        scans[k] = seen_from(poses[k], 300 + k)
    scans[5] = scans[5][:4]
    log = write_drive(tmp_path / "dense.mcap", scans, poses, period_s=0.5)
    how: dict[str, Any] = {"starts": FEW, "spacing": 5.9}
    each = ts.localize(store, log, tmp_path / "each", starts=FEW, spacing=0.09)
    assert each["scan"].tolist() == list(range(6))
    mean = ts.localize(store, log, tmp_path / "mean", **how, scans_per_point=3)
    assert mean["scans"].tolist() == [3, 2]
    assert mean["starts"].tolist() == [39, 26]
    for row, of in zip(mean.to_dict("records"), ([0, 1, 2], [3, 4]), strict=True):
        own = each[each["scan"].isin(of)]
        for name in ("error_mean", "p_fail", "along_mean", "roll_mean", "error_floor", "nvtl"):
            assert row[name] == pytest.approx(own[name].mean()), name
        assert row["scan_spread"] == pytest.approx(own["error_mean"].std())
        assert row["scan"] in of
        at = own[own["scan"] == row["scan"]].iloc[0]
        assert (row["x"], row["y"], row["heading"]) == (at["x"], at["y"], at["heading"])
    assert each["scan_spread"].isna().all()
    starts = ts.starts_of(tmp_path / "mean", 1)
    assert starts["scan"].unique().tolist() == [3, 4]
    measured = drive_measured("d", open_log(log), ts.ScanSelection(), 5.9, mean, 3)
    assert measured.measured == 2
    assert measured.reasons == {"beside another scan of the same sample point": 4}
    split = ts.localize(store, log, tmp_path / "split", **how, scans_per_point=3, starts_per_task=5)
    pd.testing.assert_frame_equal(split, mean, check_exact=True)
    with pytest.raises(UsageError, match="scans_per_point"):
        ts.localize(store, log, tmp_path / "none", **how, scans_per_point=0)


def test_a_drive_that_stands_is_sampled_there_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    x = np.r_[np.arange(0, 5, 0.25), np.full(300, 5.0), np.arange(5.25, 10.25, 0.25)]
    y = rng.normal(0, 0.02, len(x))
    poses = {i: pose(x=x[i], y=y[i]) for i in range(len(x))}
    path = write_drive(
        tmp_path / "waits.mcap", dict.fromkeys(poses, np.ones((1, 3))), poses, period_s=0.1
    )
    chosen = choose_samples(open_log(path), ts.ScanSelection(), 1.0)
    assert [round(x[sample.scan]) for sample in chosen] == list(range(11))


def test_every_column_is_documented_in_the_files(plain: tuple[pd.DataFrame, Path]) -> None:
    for kind, known in (("errors", ERROR_COLUMNS), ("starts", START_COLUMNS)):
        for path in (plain[1] / kind).glob("*.parquet"):
            schema = pq.read_schema(path)
            assert schema.names == [column.name for column in known]
            for field in schema:
                assert field.metadata[b"meaning"].endswith(b".")
                text = field.metadata[b"unit"] == b""
                assert text == (field.name in {"true_pose", "as_sensor", "status", "reason"})
            mark = read_mark(str(path))
            assert mark.facts["data_set"]["registration"]["neighbours"] == "radius"
            assert mark.facts["data_set"]["starts"]["radius"] == 0.4
            assert mark.facts["data_set"]["true_pose"] == "log"


# --- However the work is cut


@pytest.mark.parametrize("starts_per_task", [1, 5, 13, 100])
def test_starts_split_over_tasks_give_the_same_tables(
    store: ts.TileStore,
    drive: Path,
    plain: tuple[pd.DataFrame, Path],
    tmp_path: Path,
    starts_per_task: int,
) -> None:
    if starts_per_task == 1:  # the slowest: one slice tells
        scans, expected = ts.ScanSelection(stop=3), plain[0][:3]
    else:
        scans, expected = ts.ScanSelection(), plain[0]
    labels = ts.localize(
        store, drive, tmp_path, starts=FEW, scans=scans, starts_per_task=starts_per_task
    )
    pd.testing.assert_frame_equal(labels, expected, check_exact=True)
    if starts_per_task > 1:
        same_tables(tmp_path, plain[1])


@pytest.mark.slow
def test_dask_workers_give_the_same_tables(
    store: ts.TileStore,
    drive: Path,
    plain: tuple[pd.DataFrame, Path],
    tmp_path: Path,
    workers: distributed.Client,
) -> None:
    labels = ts.localize(store, drive, tmp_path, starts=FEW, starts_per_task=7, client=workers)
    pd.testing.assert_frame_equal(labels, plain[0], check_exact=True)
    same_tables(tmp_path, plain[1])


# --- Resumed, and redone


@pytest.mark.slow
def test_a_killed_run_continues_and_redoes_only_what_was_missing(
    store: ts.TileStore, drive: Path, tmp_path: Path
) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    scans = ts.ScanSelection(until_s=4.0)
    ts.localize(store, drive, whole, scans=scans)
    how = "scans=ts.ScanSelection(until_s=4.0), starts_per_task=32, watch=watch"
    call = f"ts.localize(ts.open_store(sys.argv[1]), *sys.argv[2:], {how})"
    killed_after(3, "register", call, store.url, str(drive), str(broken))
    before = {path: path.stat().st_mtime_ns for path in broken.rglob("*.parquet")}
    redone = Redone()
    ts.localize(store, drive, broken, scans=scans, starts_per_task=32, watch=redone)
    assert len(redone.kept) == 3
    assert len(redone.registers) == 7
    assert all(path.stat().st_mtime_ns == at for path, at in before.items())
    assert not list(broken.rglob("*.part"))
    same_tables(broken, whole)
    again = Redone()
    ts.localize(store, drive, broken, scans=scans, starts_per_task=32, watch=again)
    assert again.registers == []


def test_a_changed_tile_redoes_the_slices_that_see_it(
    cloud: Path, drive: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "street.pcd"
    shutil.copy(cloud, copy)
    store = ts.ingest(copy, tmp_path / "map.zarr", tile_size=16.0)
    near = Reading(str(drive), range_max=10.0)
    out = tmp_path / "out"
    before = ts.localize(store, drive, out, starts=FEW, reading=near)
    points = street(1, 0.25)
    points[(points[:, 0] > 8.0) & (points[:, 0] < 15.0), 2] += 0.5
    write_pcd(copy, points)
    store = ts.ingest(copy, tmp_path / "map.zarr", tile_size=16.0)
    redone = Redone()
    after = ts.localize(store, drive, out, starts=FEW, reading=near, watch=redone)
    assert (redone.registers, redone.kept) == (["register-0-0"], ["register-8-0"])
    assert (after["error_mean"] != before["error_mean"]).tolist()[:2] == [True, True]
    pd.testing.assert_frame_equal(after[8:], before[8:], check_exact=True)
    fresh = ts.localize(store, drive, tmp_path / "fresh", starts=FEW, reading=near)
    pd.testing.assert_frame_equal(after, fresh, check_exact=True)


def test_another_setting_or_log_redoes_all_and_leaves_nothing_behind(
    store: ts.TileStore, drive: Path, tmp_path: Path
) -> None:
    log = tmp_path / "drive.mcap"
    shutil.copy(drive, log)
    out = tmp_path / "out"
    few: dict[str, Any] = {"starts": FEW, "scans": ts.ScanSelection(stop=9)}
    ts.localize(store, log, out, **few, starts_per_task=4)
    direct1 = ts.RegistrationSettings(neighbours="direct1")
    changes: list[dict[str, Any]] = [
        {"registration": direct1},
        {"starts": StartSettings(radius=0.2)},
        {"scans": ts.ScanSelection(start=1, stop=9)},  # the same scans under other numbers
        {"cell_size": 1.0},
        {},
    ]
    for change in changes:
        redone = Redone()
        labels = ts.localize(store, log, out, **(few | change), watch=redone)
        assert redone.registers
        assert redone.kept == []
        pd.testing.assert_frame_equal(tables(out, "errors"), labels, check_exact=True)
        assert len(tables(out, "starts")) == labels["starts"].sum()
        assert labels["arc_length"][0] == 0.0
    stat = log.stat()
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns + SECOND))
    redone = Redone()
    ts.localize(store, log, out, **few, watch=redone)
    assert redone.kept == []


# --- What cannot be measured


def test_scans_that_cannot_be_registered_are_rows_that_say_why(
    store: ts.TileStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = {i: lidar_at(i) for i in range(4)}
    scans = {i: seen_from(T, 100 + i) for i, T in poses.items()}
    poses[1] = pose(x=9000.0, z=2.0)
    scans[2] = scans[2][:9]
    log = write_drive(tmp_path / "odd.mcap", scans, poses)
    labels = ts.localize(store, log, tmp_path / "out", starts=FEW)
    assert labels["status"].tolist() == ["done", "failed", "failed", "done"]
    assert "no cell" in labels["reason"][1]
    assert "the scan has 9 points" in labels["reason"][2]
    assert labels["x"].tolist() == [poses[i][0, 3] for i in range(4)]
    numbers = [c.name for c in ERROR_COLUMNS if c.criterion == "label" and c.dtype == "float64"]
    numbers.remove("scan_spread")  # of several scans only
    assert labels.loc[1:2, numbers].isna().all(axis=None)
    assert labels.loc[[0, 3], numbers].notna().all(axis=None)
    assert labels["starts"].tolist() == [13, 0, 0, 13]
    split = ts.localize(store, log, tmp_path / "split", starts=FEW, starts_per_task=6)
    told = split.pop("reason").str.split(":").str[0]  # the place in it is that of the batch
    assert (told[[0, 2, 3]] == labels.pop("reason").str.split(":").str[0][[0, 2, 3]]).all()
    pd.testing.assert_frame_equal(split, labels, check_exact=True)
    arguments = ["localize", store.url, str(log), "--out", str(tmp_path / "cli"), "--radius", "0.4"]
    assert run([*arguments, "--json"]) == 1
    told = capsys.readouterr().err
    assert f"error: {log}: 2 of 4 scans failed" in told
    assert "scan 2: the scan has 9 points" in told
    sparse = Reading(str(log), beams=8)
    labels = ts.localize(store, log, tmp_path / "sparse", starts=FEW, reading=sparse)
    assert labels["status"].tolist() == ["done", "failed", "failed", "done"]


def test_a_failed_tile_fails_its_readers_and_no_others(
    cloud: Path, drive: Path, tmp_path: Path
) -> None:
    store = ts.ingest(cloud, tmp_path / "map.zarr", tile_size=16.0)
    Tile(store, ts.TileKey(0, 0)).write_reason(POINTS, Mark("failed", "the disk was full"))
    near = Reading(str(drive), range_max=10.0)
    labels = ts.localize(store, drive, tmp_path / "out", starts=FEW, reading=near)
    sees = labels["reason"].str.contains("the disk was full")
    assert (labels["status"] == np.where(sees, "failed", "done")).all()
    assert sees[:8].any()
    assert not sees[8:].any()


def test_a_log_without_poses_is_named(store: ts.TileStore, tmp_path: Path) -> None:
    log = logs.write(tmp_path / "blind.mcap", [logs.cloud_at(START, np.ones((20, 3)))])
    with pytest.raises(PoseError, match=r"blind\.mcap"):
        ts.localize(store, log, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_drive_elsewhere_is_named_with_its_place(store: ts.TileStore, tmp_path: Path) -> None:
    away = LENGTH + REACH + 30.0
    poses = {i: pose(x=away + i) for i in range(3)}
    log = write_drive(tmp_path / "away.mcap", dict.fromkeys(poses, np.ones((20, 3))), poses)
    with pytest.raises(
        TileNotReadyError, match=rf"away\.mcap: lies at x {away:.0f} to .*no tile within"
    ):
        ts.localize(store, log, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"spacing": 0.0}, "spacing"),
        ({"spacing": float("nan")}, "spacing"),
        ({"spacing": float("inf")}, "spacing"),
        ({"starts_per_task": 0}, "starts_per_task"),
        ({"cell_size": 3.0}, "does not divide"),
        ({"cell_size": 0.0}, "cell"),
        ({"scans": ts.ScanSelection(start=500)}, "no scan"),
        ({"starts": StartSettings(radius=0.0005)}, "radius"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_anything_is_written(
    store: ts.TileStore, drive: Path, tmp_path: Path, wrong: dict[str, Any], says: str
) -> None:
    with pytest.raises(UsageError, match=says):
        ts.localize(store, drive, tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"range_max": -1.0},
        {"blind_rear_deg": 360.0},
        {"beams": 0},
        {"deskew": True, "sweep_s": 0.0},
    ],
)
def test_a_sensor_that_cannot_be_is_refused_at_once(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Reading("drive.mcap", **wrong)


# --- The real drive


def test_the_real_drive_localizes_within_centimetres(shared_data: Path, tmp_path: Path) -> None:
    log = shared_data / "kitti_drive" / "drive.mcap"
    store = ts.ingest(log, tmp_path / "map.zarr", scans=ts.ScanSelection(every=2))
    odd = ts.ScanSelection(start=9, stop=42, every=16, offset=9)
    starts = StartSettings(radius=1.0, step=0.5)
    labels = ts.localize(store, log, tmp_path / "out", scans=odd, starts=starts)
    assert labels["scan"].tolist() == [9, 25, 41]
    assert (labels["starts"] == len(start_poses(np.eye(4), starts))).all()
    assert labels["error_mean"].mean() < 0.06
    assert (labels["p_fail"] == 0.0).all()
    assert labels["lidar_height"].between(1.6, 1.9).all()  # KITTI's is mounted at 1.73 m
    less = Reading(str(log), beams=16, range_max=30.0, blind_rear_deg=120.0)
    simpler = ts.localize(store, log, tmp_path / "less", scans=odd, starts=starts, reading=less)
    assert simpler["error_mean"].mean() > labels["error_mean"].mean()
