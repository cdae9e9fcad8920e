"""Where the starts of a place began and ended: as its table has it, told, and drawn."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import logs
import numpy as np
import pandas as pd
import pytest
from logs import SECOND, START, pose
from matplotlib.collections import PatchCollection, PathCollection
from report_findings import ends_of, whole
from scenes import scene

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import SourceNotFoundError, StoreError, UsageError
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.stages.register import START_COLUMNS
from tilestream.report import write_report
from tilestream.report.ends import ends_figure
from tilestream.report.segments import APART, MEASURED, worst_measured
from tilestream.settings import StartSettings
from tilestream.tables import read_mark, read_tables, write_table

HOW = StartSettings(radius=0.4, step=0.2, yaw=(-0.02, 0.02), z=(0.0, 0.1))
STARTS = 13 * 4
TURN = 0.4
"""Heading of the drive, so that the lattice is turned against it [rad]."""


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables of a drive of three scans, the last one too thin to be registered."""
    folder = tmp_path_factory.mktemp("ends")
    write_pcd(folder / "map.pcd", scene("canyon", 1))
    store = ts.ingest(folder / "map.pcd", folder / "map.zarr", tile_size=20.0)
    points, messages = scene("canyon", 2), []
    for i in range(3):
        T = pose(x=6.0 + 2.0 * i, y=0.1 * i, z=2.0, yaw=TURN)
        seen = (points - T[:3, 3]) @ T[:3, :3]
        stamp = START + i * SECOND
        cloud = logs.cloud(stamp, logs.xyz_rows(seen if i < 2 else seen[:5]))
        messages += [
            logs.odometry_at(stamp, T),
            (stamp, "/points", "sensor_msgs/msg/PointCloud2", cloud),
        ]
    log = logs.write(folder / "drive.mcap", messages)
    ts.localize(store, log, folder / "out", starts=HOW, starts_per_task=20)
    return folder / "out"


def test_the_starts_of_a_place_are_those_of_the_table_with_where_they_were(tables: Path) -> None:
    files = [str(path) for path in (tables / "starts").glob("*.parquet")]
    table = read_tables(files).sort_values(["sample", "start"])
    errors = read_tables([str(path) for path in (tables / "errors").glob("*.parquet")])
    for sample in (0, 1):
        found = ts.starts_of(tables, sample)
        own = table[table["sample"] == sample].reset_index(drop=True)
        pd.testing.assert_frame_equal(found[list(own)], own, check_exact=True)
        assert found["start"].tolist() == list(range(STARTS))
        heading = errors.set_index("sample")["heading"][sample]
        assert heading == pytest.approx(TURN)
        starts = ts.start_poses(pose(yaw=heading), HOW)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        np.testing.assert_allclose(found["from_along"], starts[:, :2, 3] @ ahead, atol=1e-12)
        np.testing.assert_allclose(found["from_across"], starts[:, :2, 3] @ left, atol=1e-12)
        np.testing.assert_allclose(found["from_up"], starts[:, 2, 3], atol=1e-12)
        assert found["from_yaw"].to_numpy()[:2] == pytest.approx(HOW.yaw)
        parts = found[["from_along", "from_across", "from_up"]]
        np.testing.assert_allclose(np.linalg.norm(parts, axis=1), found["distance"], atol=1e-9)
        assert found["error"].mean() == pytest.approx(
            errors.set_index("sample")["error_mean"][sample]
        )


def test_a_place_that_was_not_measured_says_why(tables: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match=r"sample 2 has no ends: .*points"):
        ts.starts_of(tables, 2)
    with pytest.raises(SourceNotFoundError, match="sample 7 is not among the labels"):
        ts.starts_of(tables, 7)
    with pytest.raises(SourceNotFoundError, match="no drive was localized"):
        ts.starts_of(tmp_path, 0)
    with pytest.raises(UsageError, match="no drive 'noon'"):
        ts.starts_of(tables, 0, "noon")


def test_tables_of_an_older_version_are_refused_by_name(tables: Path, tmp_path: Path) -> None:
    old = tmp_path / "starts"
    shutil.copytree(tables / "starts", old)
    (first, *_) = sorted(old.glob("*.parquet"))
    mark = read_mark(str(first))
    facts = {"samples" if name == "scans" else name: fact for name, fact in mark.facts.items()}
    rows = read_tables([str(first)])
    write_table(str(first), rows, START_COLUMNS, replace(mark, facts=facts))
    with pytest.raises(StoreError, match=rf"{first.name} is of an older version"):
        ts.starts_of(tmp_path, 0)


def test_of_several_drives_one_is_named(tables: Path, tmp_path: Path) -> None:
    below = tmp_path / "tables" / "starts"
    shutil.copytree(tables / "starts", below / "morning")
    expected = ts.starts_of(tables, 1)
    pd.testing.assert_frame_equal(ts.starts_of(tmp_path, 1), expected)
    shutil.copytree(tables / "starts", below / "noon")
    pd.testing.assert_frame_equal(ts.starts_of(tmp_path, 1, "noon"), expected)
    with pytest.raises(UsageError, match="name a drive; there are morning, noon"):
        ts.starts_of(tmp_path, 1)


def test_the_command_tells_each_start(tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(tables), "--starts-of", "1", "--json"]) == 0
    told = pd.DataFrame(json.loads(capsys.readouterr().out))
    expected = ts.starts_of(tables, 1)
    np.testing.assert_allclose(told[list(expected)].astype(float), expected.astype(float))
    assert run(["info", str(tables), "--starts-of", "1"]) == 0
    failed = (expected["error"] > 0.5).sum()
    assert f"{STARTS} starts of sample point 1, {failed} failed" in capsys.readouterr().out
    assert run(["info", str(tables), "--starts-of", "2"]) == 2


# --- Drawn


def test_a_picture_shows_every_start_and_every_end() -> None:
    rows = ends_of("morning", 3)
    far = rows.assign(along=np.where(rows["along"] > 1.0, 7.0, rows["along"]))
    figures = [ends_figure("one", rows), ends_figure("far", far)]
    above, below = zip(*(figure.axes[:2] for figure in figures), strict=True)
    fail = rows["error"].to_numpy() > 0.5
    for axes in above:
        (squares,) = (c for c in axes.collections if isinstance(c, PatchCollection))
        assert len(squares.get_paths()) == len(rows)
        black = (squares.get_facecolor()[:, :3] < 0.1).all(axis=1)
        np.testing.assert_array_equal(black, fail)
        centres = np.array(
            [path.get_extents().get_points().mean(axis=0) for path in squares.get_paths()]
        )
        np.testing.assert_allclose(centres, rows[["from_along", "from_across"]], atol=1e-9)
    for axes, table in zip(below, (rows, far), strict=True):
        (dots,) = (c for c in axes.collections if isinstance(c, PathCollection))
        ends = table[["along", "across"]].to_numpy()
        shown = np.asarray(dots.get_offsets())
        inside = ends[np.abs(ends).max(axis=1) <= 3.0]
        np.testing.assert_allclose(np.sort(shown, axis=0), np.sort(inside, axis=0))
        low, high = axes.get_xlim()
        assert low <= shown.min()
        assert shown.max() <= high
        assert f"{fail.sum()} of {len(rows)} failed" in axes.texts[0].get_text()
    assert f"{fail.sum()} beyond" in below[1].texts[0].get_text()


def test_the_worst_measured_places_are_drawn_and_lie_apart(tmp_path: Path) -> None:
    found = whole()
    content = write_report(found, tmp_path)
    assert [name for name in content["figures"] if name.startswith("ends")] == [
        f"ends_{number:02d}.png" for number in range(1, MEASURED + 1)
    ]
    rows = worst_measured(found.labels)
    chosen = found.labels.iloc[rows]
    assert len(rows) == MEASURED
    assert chosen["error_mean"].is_monotonic_decreasing
    assert chosen["error_mean"].iloc[0] == found.labels["error_mean"].max()
    for _, of_path in chosen.groupby("path"):
        along = np.sort(of_path["arc_length"].to_numpy())
        assert (np.diff(along) >= APART).all()
    told = content["worst_measured"]
    assert [place["error_mean"] for place in told] == chosen["error_mean"].tolist()
    assert [place["sample"] for place in told] == chosen["sample"].tolist()
