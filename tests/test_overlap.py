"""A drive and its map: no error is measured with what the map was made of, or where it is not."""

import json
import shutil
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from logs import SECOND, START, pose

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import TileNotReadyError, UsageError
from tilestream.formats.logs import open_log
from tilestream.formats.routes import route_of
from tilestream.grid import Box, TileGrid
from tilestream.pipeline.jobs.along_routes import REACH, off_map
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.overlap import overlap, packed, unpacked
from tilestream.pipeline.jobs.run_settings import RunSettings

Told = pytest.CaptureFixture[str]
ONE = ts.StartSettings(radius=0.0)


@given(st.lists(st.tuples(st.integers(0, 2**62), st.integers(0, 10**7)), min_size=1, max_size=50))
def test_the_scans_of_a_map_are_kept_to_the_bit(scans: list[tuple[int, int]]) -> None:
    stamps, counts = np.array(sorted(scans), dtype=np.int64).T
    again = unpacked(packed(stamps, counts))
    np.testing.assert_array_equal(again[0], stamps)
    np.testing.assert_array_equal(again[1], counts)


def test_what_is_kept_of_an_hour_of_scans_is_small() -> None:
    rng = np.random.default_rng(0)
    stamps = START + np.arange(36_000) * SECOND // 10 + rng.integers(0, 10**6, 36_000)
    assert len(packed(stamps, rng.integers(20_000, 30_000, 36_000))) < 300_000


def drive(path: Path, first: int = 0, count: int = 12, points: int = 200, x: float = 0.0) -> Path:
    """Scans ten times a second, a metre apart."""
    rng = np.random.default_rng(points)
    messages: list[logs.Message] = []
    for i in range(first, first + count):
        messages.append(logs.odometry_at(START + i * SECOND // 10, pose(x=x + i)))
        messages.append(logs.cloud_at(START + i * SECOND // 10, logs.street_points(rng, points)))
    return logs.write(path, messages)


@pytest.mark.parametrize(
    ("name", "how", "every", "mapped", "source"),
    [
        ("the same", {}, 1, 6, True),
        ("the others", {}, 2, 0, True),
        ("copied", {}, 1, 6, True),
        ("later, of one time by chance", {"points": 190}, 1, 0, False),
        ("another day", {"first": 900}, 1, 0, False),
        ("cut to the same scans", {"first": 4, "count": 4}, 1, 2, True),
    ],
)
def test_scans_that_are_in_the_map_are_known_by_their_time(
    name: str, how: dict[str, int], every: int, mapped: int, source: bool, tmp_path: Path
) -> None:
    path = drive(tmp_path / "map.mcap", points=200)
    store = ts.ingest(path, tmp_path / "map.zarr", scans=ts.ScanSelection(every=2))
    if how:
        path = drive(tmp_path / "other.mcap", **how)  # type: ignore[arg-type]
    if "cut" in name:  # the points are random: take those of the map's
        path = cut(tmp_path)
    if name == "copied":
        path = Path(shutil.copy(path, tmp_path / "renamed.mcap"))
    log = open_log(path)
    scans = np.arange(len(log))[(every == 2) :: every].tolist()
    found = overlap(log, scans, store.sources())
    assert (found.mapped, found.scans) == (mapped, len(scans))
    assert bool(found.source) == source
    assert len(found.notes) == source
    if mapped:
        with pytest.raises(UsageError, match=f"{mapped} of {len(scans)} scans"):
            found.require_none()
    else:
        found.require_none()


def cut(folder: Path) -> Path:
    """The scans 4 to 7 of `drive`, with the same points."""
    rng = np.random.default_rng(200)
    clouds = [logs.street_points(rng, 200) for _ in range(12)]
    messages: list[logs.Message] = []
    for i in range(4, 8):
        messages.append(logs.odometry_at(START + i * SECOND // 10, pose(x=float(i))))
        messages.append(logs.cloud_at(START + i * SECOND // 10, clouds[i]))
    return logs.write(folder / "cut.mcap", messages)


# --- In the commands


@pytest.fixture(scope="module")
def log(cases: Path) -> str:
    return str(cases / "log" / "point_time_us_float.mcap")


@pytest.fixture(scope="module")
def store(log: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A map of every second scan."""
    url = str(tmp_path_factory.mktemp("store") / "map.zarr")
    ts.ingest(log, url, tile_size=50.0, scans=ts.ScanSelection(every=2))
    return url


def test_a_drive_that_is_in_the_map_is_refused(
    log: str, store: str, tmp_path: Path, capsys: Told
) -> None:
    command = ["localize", store, log, "--out", str(tmp_path / "out"), "--radius", "0"]
    assert run(command) == 2
    said = capsys.readouterr().err
    assert "scans to be localized are in the map" in said
    assert "--allow-overlap" in said
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="are in the map"):
        ts.localize(ts.open_store(store), log, tmp_path / "out", starts=ONE)
    assert run([*command, "--allow-overlap", "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"][log]
    assert any("their errors are too small" in note for note in notes)
    assert run([*command, "--every", "2", "--offset", "1", "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"][log]
    assert any("map and drive share one pass" in note for note in notes)


def test_a_job_that_would_label_with_its_map_is_refused_before_it_runs(
    log: str, tmp_path: Path
) -> None:
    values: dict[str, Any] = {
        "out": str(tmp_path / "run"),
        "map": {"sources": [log], "tile_size": 50.0},
        "drives": [{"log": log}],
        "label": {"starts": {"radius": 0.0}},
        "model": {"recipe": "physics"},
        "spacing": 4.0,
    }
    settings = RunSettings(**values)
    for refused in (ts.run, forecast):
        with pytest.raises(UsageError, match="are in the map"):
            refused(settings)
    assert not list((tmp_path / "run").rglob("*.parquet"))
    assert "are in the map" in json.loads((tmp_path / "run" / "run.json").read_text())["stopped_by"]
    values["label"]["allow_overlap"] = True
    allowed = RunSettings(**values)
    assert any("their errors are too small" in note for note in forecast(allowed).notes[log])
    ts.run(allowed)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert any("their errors are too small" in note for note in record["notes"][log])
    worth = json.loads((tmp_path / "run" / "report" / "report.json").read_text())["worth"]
    assert worth["warnings"][0].startswith("The map was made of scans that drives were measured")


def test_a_drive_that_is_not_where_its_map_is(store: str, tmp_path: Path) -> None:
    path = drive(tmp_path / "far.mcap", x=9000.0)
    with pytest.raises(TileNotReadyError, match=r"x 9000 to 9011, .* at x -50 to 50, .*CRS"):
        ts.localize(ts.open_store(store), path, tmp_path / "out", starts=ONE)


def test_a_route_that_is_not_where_its_map_is(store: str, tmp_path: Path, capsys: Told) -> None:
    (tmp_path / "far.csv").write_text("x,y\n9000,0\n9020,0\n")
    (tmp_path / "near.csv").write_text("x,y\n5,0\n25,0\n")
    out = ["--spacing", "10", "--out", str(tmp_path / "out")]
    far, near = (["--route", str(tmp_path / f"{name}.csv")] for name in ("far", "near"))
    for command in ("factors", "compare"):
        assert run([command, store, *far, *out]) == 1
        said = capsys.readouterr().err
        assert "x 9000 to 9020, y 0 to 0 m" in said
        assert "x -50 to 50" in said
        assert "another CRS" in said
    assert not list((tmp_path / "out").rglob("*.parquet"))
    assert run(["factors", store, *far, *near, *out, "--json"]) == 1
    told = capsys.readouterr()
    assert "3 sample points" in told.err  # of the far one; the near one has factors
    (note,) = json.loads(told.out)["notes"]["routes"]
    assert "within 250 m of far (x 9000 to 9020, y 0 to 0 m):" in note


@given(st.floats(-2000.0, 2000.0), st.floats(-2000.0, 2000.0), st.sampled_from([20.0, 50.0, 100.0]))
def test_a_route_in_reach_of_a_map_is_not_far_from_it(x: float, y: float, tile: float) -> None:
    """Tiles from 0 to 100 m; a tile of slack at both ends."""
    grid = TileGrid.of(tile, 10.0)
    keys = grid.keys_over(Box(0, 0, 100_000, 100_000))
    route = route_of("a", np.array([[x, y, 0.0], [x + 30.0, y, 0.0]]))
    away = max(-x - 30.0, x - 100.0, -y, y - 100.0)
    far = bool(off_map(keys, grid, [route]))
    if away < REACH:
        assert not far
    if away > REACH + 2.0 * tile:
        assert far
    assert off_map([], grid, [route]) == []
