"""What a view shows, in which colours, from where; and a real window on a display of its own."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hand_made import listed
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.image import imread
from scenes import scene

import tilestream as ts
from tilestream.apps import view as viewer
from tilestream.apps.camera import oblique
from tilestream.apps.scene import scene_of
from tilestream.cli import run
from tilestream.errors import StoreNotFoundError, TileNotReadyError, UsageError
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS
from tilestream.formats.points.pcd import write_pcd
from tilestream.marks import Mark
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.pipeline.stages.label import ERROR_COLUMNS
from tilestream.records import Column
from tilestream.report.colours import FIXED
from tilestream.store import POINTS, Tile
from tilestream.tables import write_table

OFFSET = (370_000.0, 3_950_000.0, 30.0)
MEASURED, ESTIMATED = [0.02, 0.30, 0.12], [0.50, 0.05, 0.40, np.nan]
"""Errors of three places that were measured, and of four of which the first is the same place."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    folder = tmp_path_factory.mktemp("map")
    write_pcd(folder / "street.pcd", scene("canyon", 1, offset=OFFSET))
    return ts.ingest(folder / "street.pcd", folder / "map.zarr", tile_size=20.0)


def write_places(
    path: Path, columns: tuple[Column, ...], x: list[float], store: ts.TileStore, **error: object
) -> None:
    rows = pd.DataFrame({"x": x}).add(OFFSET[0]).assign(y=OFFSET[1], z=OFFSET[2] + 2.0, **error)
    rows = rows.assign(status="done")
    write_table(str(path), rows, columns, Mark("done", facts={"store": store.url}))


@pytest.fixture(scope="module")
def run_dir(store: ts.TileStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables as the jobs leave them, and no map inside: they name it."""
    tables = tmp_path_factory.mktemp("run") / "tables"
    path = tables / "errors" / "drive" / "0.parquet"
    write_places(path, ERROR_COLUMNS, [5, 10, 15], store, error_mean=MEASURED)
    path, columns = tables / "predictions" / "0_0.parquet", (*PLACE_COLUMNS, *PREDICTION_COLUMNS)
    write_places(path, columns, [5.2, 20, 25, 30], store, estimate=ESTIMATED)
    columns = (*PLACE_COLUMNS, *STATUS_COLUMNS)
    write_places(tables / "factors" / "0_0.parquet", columns, [20, 35], store)
    listed(tables)
    return tables.parent


# --- What is shown


def test_a_store_is_its_points_grey_by_height(store: ts.TileStore) -> None:
    shown = scene_of(store.url)
    points = np.concatenate([store.tile(key).points() for key in store.keys()])
    assert len(shown.points) == shown.total == len(points)
    np.testing.assert_allclose(shown.points + shown.origin, points, atol=1e-6)
    assert np.abs(shown.points).max() < 1000.0  # float32 draws them
    assert len(shown.places) == 0
    rgb = shown.point_rgb()
    assert np.ptp(rgb, axis=1).max() < 0.1
    order = np.argsort(shown.points[:, 2])
    assert (np.diff(rgb[order], axis=0) >= 0.0).all()
    assert rgb[order[-1], 0] > rgb[order[0], 0] + 0.5


def test_a_larger_map_is_thinned_by_the_same_share_everywhere(store: ts.TileStore) -> None:
    shown = scene_of(store.url, points=500)
    again = scene_of(store.url, points=500)
    np.testing.assert_array_equal(shown.points, again.points)
    assert len(shown.points) == 500
    assert len(scene_of(store.url, points=1).points) == 1
    for key in store.keys():
        core = store.grid.core(key)
        at = np.round((shown.points + shown.origin)[:, :2] * 1000)
        here = ((at >= (core.x_lo, core.y_lo)) & (at < (core.x_hi, core.y_hi))).all(axis=1)
        share = len(store.tile(key).points()) / shown.total
        assert here.sum() == pytest.approx(500 * share, abs=1.0)
    with pytest.raises(UsageError, match="at least 1"):
        scene_of(store.url, points=0)


def test_places_have_their_measured_error_else_the_estimate_else_none(run_dir: Path) -> None:
    shown = scene_of(run_dir)
    x = np.round(shown.places[:, 0] + shown.origin[0] - OFFSET[0], 6)
    found = dict(zip(x.tolist(), zip(shown.error, shown.measured, strict=True), strict=True))
    assert found.keys() == {5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0}
    assert [found[at] for at in (5.0, 10.0, 15.0)] == [(error, True) for error in MEASURED]
    assert [found[at] for at in (20.0, 25.0)] == [(0.05, False), (0.40, False)]
    assert all(np.isnan(found[at][0]) and not found[at][1] for at in (30.0, 35.0))
    np.testing.assert_array_equal(shown.place_rgb(), FIXED.rgb(shown.error) / 255.0)
    assert np.ptp(shown.place_rgb()[np.isnan(shown.error)], axis=1).max() == 0.0  # grey
    assert (np.ptp(shown.place_rgb()[~np.isnan(shown.error)], axis=1) > 0.3).all()


def test_of_places_upon_each_other_the_worst_measured_is_drawn(
    run_dir: Path, store: ts.TileStore
) -> None:
    shown = scene_of(run_dir)
    assert shown.drawn().tolist() == list(range(len(shown.places)))
    twice = viewer.Scene(
        store, shown.tiles, shown.total, shown.origin, shown.points,
        np.repeat(shown.places[:1], 4, axis=0), np.array([0.1, 0.2, 0.9, np.nan]),
        np.array([True, True, False, False]), np.zeros(4, bool),
    )  # fmt: skip
    assert twice.drawn().tolist() == [1]


def test_one_tile_is_its_points_and_places(run_dir: Path, store: ts.TileStore) -> None:
    key = store.grid.key_at(OFFSET[0] + 10.0, OFFSET[1])
    shown = scene_of(run_dir, tile=key)
    np.testing.assert_allclose(shown.points + shown.origin, store.tile(key).points(), atol=1e-6)
    at = shown.places + shown.origin
    assert 0 < len(at) < len(scene_of(run_dir).places)
    assert {store.grid.key_at(x, y) for x, y, _ in at.tolist()} == {key}
    assert shown.tiles == (key,)


def test_a_tile_that_cannot_be_shown_is_named(store: ts.TileStore, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"no tile 7_7: it has .*{store.keys()[0]}"):
        scene_of(store.url, tile=(7, 7))
    copied = ts.open_store(str(shutil.copytree(store.url, tmp_path / "copy.zarr")))
    key = copied.keys()[0]
    Tile(copied, key).write_reason(POINTS, Mark("failed", "the disk is full"))
    with pytest.raises(TileNotReadyError, match="the disk is full"):
        scene_of(copied.url, tile=key)
    assert key not in scene_of(copied.url).tiles


def test_the_map_of_a_run_is_found_inside_it_or_by_its_tables(
    run_dir: Path, store: ts.TileStore, tmp_path: Path
) -> None:
    assert map_of(run_dir).url == map_of(store.url).url == store.url
    moved = tmp_path / "run"
    shutil.copytree(run_dir, moved)
    mark = Mark("done", facts={"store": str(tmp_path / "gone.zarr")})
    frame = pd.DataFrame({"x": [0.0], "y": [0.0], "z": [0.0]})
    write_table(str(moved / "tables" / "factors" / "0.parquet"), frame, PLACE_COLUMNS, mark)
    listed(moved)
    with pytest.raises(StoreNotFoundError, match=r"gone\.zarr.*link"):
        map_of(moved)
    (moved / "map.zarr").symlink_to(store.url)
    assert map_of(moved).keys() == store.keys()


@given(
    arrays(np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-500, 500)),
    st.floats(0.5, 3.0),
)
def test_the_camera_sees_everything_from_above(points: np.ndarray, aspect: float) -> None:
    camera = oblique(points, aspect, np.radians(60.0))
    assert camera.towards[2] > 0.5
    assert camera.up[2] > 0.5
    right = np.cross(camera.up, camera.towards)
    axes = np.stack([right, camera.up, camera.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    x, y, towards = axes @ (points - camera.centre - camera.distance * camera.towards).T
    assert (towards < 0.0).all()
    half = np.tan(np.radians(30.0))
    assert (np.abs(x) < -towards * half * aspect).all()
    assert (np.abs(y) < -towards * half).all()


# --- Where it cannot be shown


def one_line(told: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """What a command that must fail says, and nothing else."""
    told.readouterr()
    assert run(arguments) == 1
    shown = told.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    return line


def test_a_missing_library_is_a_line_that_names_its_package(
    store: ts.TileStore, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(viewer, "LIBRARIES", {"libmissing.so.9": "libmissing9"})
    line = one_line(capfd, ["view", store.url])
    assert line.startswith("error: Open3D cannot be loaded")
    assert line.endswith("apt-get install libmissing9")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a display has no name")
def test_a_missing_display_is_a_line(
    store: ts.TileStore, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("open3d", reason="Open3D's libraries are absent", exc_type=ImportError)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "no display" in one_line(capfd, ["view", store.url])


def test_a_screenshot_is_a_png(store: ts.TileStore) -> None:
    assert run(["view", store.url, "--screenshot", "map.jpg"]) == 2


# --- A real window


@pytest.fixture
def display(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """The name of an X display that nobody else uses, and the file that holds its pixels."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb: apt-get install xvfb")
    pytest.importorskip("open3d", reason="Open3D's libraries are absent", exc_type=ImportError)
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1400x900x24", "-fbdir", str(tmp_path)],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as number:
            yield f":{number.readline().strip()}", tmp_path / "Xvfb_screen0"
    finally:
        server.terminate()
        server.wait()


def pixels_of(dump: Path) -> np.ndarray:
    """(h, w, 3) of an X window dump, in [0, 1]."""
    content = dump.read_bytes()
    head = np.frombuffer(content, ">u4", 25)
    width, height, line = (int(head[k]) for k in (4, 5, 12))
    rows = np.frombuffer(content, np.uint8, height * line, int(head[0] + 12 * head[19]))
    return rows.reshape(height, line // 4, 4)[:, :width, 2::-1] / 255.0


def map_and_route(picture: np.ndarray) -> tuple[int, int]:
    """How many pixels are grey on the dark ground, and how many have a colour."""
    coloured = np.ptp(picture, axis=2) > 0.3
    return int(((picture.min(axis=2) > 0.2) & ~coloured).sum()), int(coloured.sum())


def test_the_window_shows_map_and_route_until_it_is_closed(
    run_dir: Path, display: tuple[str, Path]
) -> None:
    name, screen = display
    command = [sys.executable, "-m", "tilestream", "view", str(run_dir)]
    process = subprocess.Popen(
        command,
        env=os.environ | {"DISPLAY": name},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in background
    )
    try:
        until = time.monotonic() + 600.0
        while min(map_and_route(pixels_of(screen))) < 300 and process.poll() is None:
            assert time.monotonic() < until, "no picture within ten minutes"
            time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        told, _ = process.communicate(timeout=600.0)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "3 places measured (large), 2 estimated (small), 2 neither (grey)" in told
    assert "error [cm]: ██ 5 ██ 10 ██ 15 ██ 20 ██ 25 ██ 50 ██" in told


def test_a_screenshot_has_map_and_route_in_the_colours_of_the_report(
    run_dir: Path, display: tuple[str, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("DISPLAY", display[0])
    shown = ts.view(run_dir, screenshot=tmp_path / "view.png")
    picture = imread(tmp_path / "view.png")[:, :, :3]
    assert picture.shape == (viewer.HEIGHT, viewer.WIDTH, 3)
    grey, coloured = map_and_route(picture)
    assert grey > 10_000
    assert coloured > 300
    for rgb in shown.place_rgb():
        assert (np.abs(picture - rgb).max(axis=2) < 0.02).any(), rgb
