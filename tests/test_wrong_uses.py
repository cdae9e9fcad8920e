"""Wrong uses of every command, and of the functions: one line that says what, where, what to do."""

import os
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import dask.config
import pytest
from wrong_uses import write_world

import tilestream as ts
from tilestream.cli import run
from tilestream.cli.app import COMMANDS
from tilestream.errors import TilestreamError
from tilestream.report import write_diff

LONG = "a" * 300
"""A name that no disk takes."""
INGEST, OF_LOG = "ingest street.pcd --store made.zarr", "ingest drive.mcap --store made.zarr"
ESTIMATE = "estimate map.zarr --route route.csv --out made --workers 1"
LOCALIZE = "localize map.zarr drive.mcap --out made"
FACTORS = "factors map.zarr --route route.csv --out made"
COMPARE = "compare map.zarr --route route.csv --out made"
SIMULATE = "simulate shinjuku --out made"
RUN = "run job.yaml --workers 1"

USES: list[tuple[str, int, str]] = [
    # the line, the exit code, and what its answer names, with commas between
    ("nonsense", 2, "nonsense, tilestream --help"),
    ("--nonsense", 2, "--nonsense"),
    # files and folders
    ("ingest", 2, "sources, ingest --help"),
    ("ingest street.pcd", 2, "--store"),
    ("ingest gone.pcd --store made.zarr", 2, "gone.pcd, check the path"),
    ("ingest none*.pcd --store made.zarr", 2, "none*.pcd, matches no file"),
    ("ingest empty --store made.zarr", 1, "empty, its files"),
    ("ingest route.csv --store made.zarr", 1, "route.csv, .csv, .laz"),
    ("ingest text.pcd --store made.zarr", 1, "text.pcd, no PCD"),
    ("ingest route.csv picture.png --store made.zarr", 1, "none of 2, picture.png"),
    ("ingest street.pcd --store full", 1, "full, choose another path"),
    ("ingest street.pcd --store route.csv", 2, "route.csv, is a file, another folder"),
    ("ingest street.pcd --store route.csv/map.zarr", 2, "route.csv, below one"),
    ("ingest street.pcd --store map.zarr --tile-size 50", 2, "tile_size, 20.0, 50.0"),
    ("ingest street.pcd --store other.zarr", 1, "other.zarr, schema, install the newer"),
    ("ingest street.pcd --store s3:/bucket/map.zarr", 2, "s3:/bucket/map.zarr, s3://"),
    ("ingest street.pcd --store gopher://a/b", 2, "gopher"),
    (f"ingest street.pcd --store {LONG}.zarr", 1, "File name too long, aaa.zarr, shorter"),
    # numbers and words
    (f"{INGEST} --tile-size -20", 2, "tile_size, -20, more than 0"),
    (f"{INGEST} --tile-size nan", 2, "--tile-size, nan"),
    (f"{INGEST} --tile-size inf", 2, "--tile-size, inf"),
    (f"{INGEST} --tile-size 20m", 2, "--tile-size, a valid"),
    (f"{INGEST} --map-leaf -1", 2, "--map-leaf, -1"),
    (f"{INGEST} --tile-sise 20", 2, "--tile-sise, --tile-size"),
    (f"{INGEST} --crs EPSG:99999999", 1, "EPSG:99999999"),
    (f"{INGEST} --crs EPSG:4326", 1, "EPSG:4326, degrees, project"),
    (f"{INGEST} --memory 2", 2, "--memory, '2', 2GB"),
    # where tasks run
    (f"{INGEST} --workers 0", 2, "--workers"),
    (f"{INGEST} --scheduler tcp://127.0.0.1:1", 1, "tcp://127.0.0.1:1, no Dask scheduler answers"),
    (f"{INGEST} --scheduler elsewhere", 2, "'elsewhere', tcp://10.0.0.1:8786"),
    (f"{INGEST} --scheduler http://127.0.0.1:1", 2, "http://127.0.0.1:1, tcp://"),
    (f"{INGEST} --scheduler tls://127.0.0.1:1", 2, "tls://127.0.0.1:1, --tls-ca"),
    (
        f"{INGEST} --workers 2 --tls-ca ca.pem --tls-cert ca.pem --tls-key ca.pem",
        2,
        "ca.pem, no certificates",
    ),
    (f"{INGEST} --workers 2 --tls-ca ca.pem", 2, "--tls-ca, --tls-key, all three"),
    (f"{INGEST} --workers 2 --tls-ca gone.pem", 2, "--tls-ca, gone.pem"),
    (f"{INGEST} --host 10.0.0.1", 2, "--workers 2"),
    # logs
    (f"{OF_LOG} --every 0", 2, "--every, 0"),
    (f"{OF_LOG} --every 2 --offset 2", 2, "every, offset"),
    (f"{OF_LOG} --from-s 5 --until-s 2", 2, "--from-s 5, --until-s 2, later"),
    (f"{OF_LOG} --from-s 500", 1, "drive.mcap, is selected, 500, last 2.0 s"),
    (f"{OF_LOG} --points-topic /camera", 1, "/camera, /points"),
    (f"{OF_LOG} --pose-topic /camera", 1, "/camera, /odometry"),
    (f"{OF_LOG} --map-frame moon", 1, "moon, --map-frame map"),
    (f"{OF_LOG} --pose-frame moon", 1, "moon, --extrinsic"),
    (f"{OF_LOG} --extrinsic 1,2,3", 2, "--extrinsic, 1,2,3, roll"),
    (f"{OF_LOG} --points-topic /a,/b --lidar-frame c", 2, "/a,/b, --lidar-frame, leave them out"),
    # what is there
    ("status gone.zarr", 2, "gone.zarr, tilestream ingest"),
    ("status empty", 2, "empty, no tile store, tilestream info"),
    ("status damaged", 1, "damaged/run.json is damaged, run the job again"),
    ("status street.pcd", 2, "street.pcd, is a file, tilestream ingest"),
    ("status other.zarr", 1, "other.zarr, schema"),
    ("status map.zarr route.csv", 2, "route.csv, status --help"),
    ("verify gone", 2, "gone, nothing to verify"),
    ("verify job.yaml", 2, "job.yaml, nothing to verify"),
    ("info gone.pcd", 2, "gone.pcd, check the path"),
    ("info empty", 1, "empty, supported are"),
    ("info picture.png", 1, "picture.png, supported are"),
    ("info damaged", 1, "damaged/run.json is damaged, run the job again"),
    ("info run --starts-of 99", 2, "run, no drive was localized"),
    ("info run run --starts-of 99", 2, "--starts-of, one run"),
    ("info street.pcd --colour", 2, "--colour, info --help"),
    # maps and routes
    ("estimate", 2, "MAP, estimate --help"),
    ("estimate gone.pcd --route route.csv", 2, "gone.pcd, check the path"),
    ("estimate map.zarr --workers 1", 2, "no routes, --route"),
    ("estimate map.zarr --route gone.csv", 2, "gone.csv, check the path"),
    ("estimate route.csv --route street.pcd", 1, "route.csv, supported are"),
    ("estimate map.zarr --route map.zarr --workers 1", 1, "map.zarr, files of routes"),
    ("estimate map.zarr --route street.pcd --workers 1", 1, "street.pcd, .geojson"),
    ("estimate map.zarr --route words.csv --workers 1", 1, "words.csv, x and y, here"),
    ("estimate map.zarr --route degrees.csv --workers 1", 1, "degrees.csv, degrees, project_to"),
    ("estimate map.zarr --route degrees.tum --workers 1", 1, "degrees.tum, degrees, project_to"),
    ("estimate map.zarr street.pcd --route route.csv", 2, "map.zarr, give it alone"),
    ("estimate empty --route route.csv", 1, "empty, its files"),
    (f"{ESTIMATE} --coarse 1", 2, "--coarse, 2"),
    (f"{ESTIMATE} --tolerance 0.1", 2, "--tolerance, --coarse"),
    (f"{ESTIMATE} --coarse 8 --tolerance 0", 2, "--tolerance"),
    (f"{ESTIMATE} --out route.csv", 2, "route.csv, another folder"),
    (f"{ESTIMATE} --out map.zarr", 2, "map.zarr, is a tile store, another folder"),
    (f"{ESTIMATE} --out=", 2, "--out a path is empty, name a"),
    (f"{ESTIMATE} --model gone.skops", 2, "gone.skops, --model physics"),
    (f"{ESTIMATE} --model street.pcd", 1, "street.pcd, no model file"),
    (f"{ESTIMATE} --matcher fast", 2, "--matcher fast, autoware"),
    (f"{ESTIMATE} --matcher picture.png", 2, "--matcher picture.png, autoware"),
    (f"{ESTIMATE} --matcher empty", 2, "--matcher empty, no such matcher"),
    (f"{ESTIMATE} --sensor VLP99", 2, "--sensor VLP99, VLP16"),
    (f"{ESTIMATE} --sensor sensor.yaml", 2, "--sensor sensor.yaml, range_mx, mean range_max"),
    (f"{ESTIMATE} --sensor-height tall", 2, "--sensor-height, a valid"),
    (f"{ESTIMATE} --spacing 0", 2, "--spacing, 0.0"),
    (f"{ESTIMATE} --spacing 1e-9", 2, "--spacing, 1e-09"),
    (f"{ESTIMATE} --range-max 7500", 2, "--range-max, 7500, 100 m"),
    (f"{ESTIMATE} --route-z sky", 2, "--route-z, sky, ground"),
    (f"{ESTIMATE} --fail-over nan", 2, "--fail-over, nan, above 0"),
    (f"{ESTIMATE} --fail-over 0.2 --measure worst", 2, "--measure, worst, across"),
    (f"{ESTIMATE} --project-to EPSG:4326", 1, "route.csv, EPSG:4326, metric"),
    # drives
    ("localize map.zarr gone.mcap --out made", 2, "gone.mcap, check the path"),
    ("localize map.zarr street.pcd --out made", 1, "street.pcd, .mcap"),
    ("localize drive.mcap map.zarr --out made", 2, "drive.mcap, a tile store is a folder"),
    (f"{LOCALIZE} --out map.zarr", 2, "map.zarr, is a tile store"),
    (f"{LOCALIZE} --radius -1", 2, "--radius, -1"),
    (f"{LOCALIZE} --beams 0", 2, "--beams, 0"),
    (f"{LOCALIZE} --true-pose gps", 2, "--true-pose, gps, refined"),
    (f"{LOCALIZE} --cell-size 3", 2, "3 m, 20 m, a cell size of 2 m"),
    # factors
    ("factors map.zarr --out made", 2, "--route"),
    ("factors map.zarr --route far.csv --out made", 1, "90000, map.zarr, another frame"),
    (f"{FACTORS} --out full/letters.txt", 2, "full/letters.txt, another folder"),
    (f"{FACTORS} --which best", 2, "--which, best, robust"),
    # comparisons
    (f"{COMPARE} --sensor VLP16 --sensor VLP16", 2, "VLP16, give each once"),
    (f"{COMPARE} --cell-size 2.0,3.0", 2, "3 m, 20 m, sizes that fit"),
    (f"{COMPARE} --cell-size two", 2, "--cell-size, two, numbers"),
    (f"{COMPARE} --range-max 500", 2, "VLP16 sees 100 m, 500"),
    (f"{COMPARE} --range-max nan", 2, "--range-max, nan"),
    (f"{COMPARE} --scan-leaf -1", 2, "--scan-leaf, -1"),
    (f"{COMPARE} --cap 0", 2, "--cap, 0.0"),
    (f"{COMPARE} --threshold nan", 2, "--threshold, nan"),
    (f"{COMPARE.replace('map.zarr', 'damaged')}", 1, "damaged/run.json is damaged"),
    # cities
    ("simulate osaka --out made", 2, "osaka, sendagaya"),
    (f"{SIMULATE} --preset rainy", 2, "rainy, physical"),
    (f"{SIMULATE} --preset route.csv", 2, "route.csv, settings of a simulation"),
    (f"{SIMULATE} --out route.csv", 2, "route.csv, another folder"),
    (f"{SIMULATE} --drive -1", 2, "--drive, -1"),
    # names
    ("explain rangemax", 2, "'rangemax', range_max"),
    ("template job.yaml", 2, "job.yaml, template --help"),
    ("warm map.zarr", 2, "map.zarr, warm --help"),
    # jobs
    ("run gone.yaml", 2, "gone.yaml, tilestream template"),
    ("run empty", 2, "empty, a directory, tilestream template"),
    ("run street.pcd", 2, "street.pcd, no text"),
    ("run list.yaml", 2, "list.yaml, tilestream template"),
    ("run tabs.yaml", 2, "tabs.yaml, line 3, spaces"),
    ("run twice.yaml", 2, "twice.yaml, line 5, 'out'"),
    ("run misspelt.yaml", 2, "misspelt.yaml, spaceing, mean spacing"),
    ("run unit.yaml", 2, "unit.yaml, spacing, '2 m', number"),
    ("run no_drives.yaml", 2, "no_drives.yaml, tilestream estimate, physics"),
    ("run no_map.yaml", 2, "gone.pcd, check the path"),
    ("run no_log.yaml", 2, "gone.mcap, check the path"),
    (f"{RUN} --set spacing", 2, "'spacing', key=value"),
    (f"{RUN} --set label.matchr=default", 2, "job.yaml, matchr, mean matcher"),
    (f"{RUN} --set spacing.x=2", 2, "job.yaml, spacing, number"),
    (f"{RUN} --set out=map.zarr", 2, "map.zarr, is a tile store"),
    (f"{RUN} --set factors=[factor.py]", 2, "factor, COLUMNS"),
    (f"{RUN} --set model.recipe=best", 2, "recipe, 'best', physics"),
    ("plan no_map.yaml", 2, "gone.pcd, check the path"),
    ("plan job.yaml --workers 2", 2, "--workers, plan --help"),
    # updates
    ("diff map.zarr gone.zarr", 2, "gone.zarr, no tile store"),
    ("diff gone gone2", 2, "gone:, gone2:, run directory, check the path"),
    ("diff gone", 2, "gone, no run directory, check the path"),
    ("diff damaged run", 1, "damaged/run.json is damaged, run the job again"),
    ("diff run route.csv", 2, "route.csv, is a file"),
    ("diff map.zarr other.zarr", 1, "other.zarr, schema"),
    ("diff run run --worse nan", 2, "worse, nan, metres"),
    ("diff run run --fail-worse nan", 2, "--fail-worse, nan, above 0"),
    ("diff run run --fail-worse 5cm", 2, "--fail-worse, a valid"),
    ("diff run run --fail-worse 0.1 --over roads", 2, "--over, roads, segments"),
    ("diff run run --fail-worse 0.1 --measure worst", 2, "--measure, worst, across"),
    ("diff run run --report route.csv", 2, "route.csv, another folder"),
    ("diff run run --report map.zarr", 2, "map.zarr, is a tile store, another folder"),
    ("diff run --report made", 2, "run, was not updated, name two"),
    # for filters
    ("advise", 2, "RUN, advise --help"),
    ("advise gone", 2, "gone, no tables"),
    ("advise map.zarr", 2, "map.zarr, no tables"),
    ("advise damaged --threshold 0.001", 1, "damaged/run.json is damaged, run the job again"),
    ("advise run --threshold 0", 2, "--threshold, 0.0"),
    ("advise run --threshold 0.001 --out map.zarr", 2, "map.zarr, is a tile store"),
    ("export", 2, "WHAT, export --help"),
    ("export covariance gone", 2, "gone, no tables"),
    ("export covariance map.zarr", 2, "map.zarr, no tables"),
    ("export covariance damaged", 1, "damaged/run.json is damaged, run the job again"),
    ("export errors run", 2, "errors, covariance"),
    ("export covariance run --format pdf", 2, "--format, pdf, autoware"),
    ("export covariance run --every 0", 2, "every, 0.0, above 0"),
    ("export covariance run --threshold nan", 2, "--threshold, nan"),
    ("export covariance run --lost 2", 2, "lost, 2.0, between 0 and 1"),
    ("export covariance run --route north", 2, "north, its routes are"),
    ("export covariance run --inflate", 2, "too few places, --inflate"),
    ("export covariance run --out full", 1, "full"),
    ("export covariance run --out full/letters.txt", 2, "letters.txt is there, another file"),
    ("export covariance run --out run/report/places.csv", 2, "places.csv is there"),
    # pictures
    ("view map.zarr", 1, "no display, --screenshot"),
    ("view damaged --screenshot v.png", 1, "damaged/run.json is damaged, run the job again"),
    ("view map.zarr --tile first", 2, "'first', 12_-3"),
    ("view map.zarr --screenshot picture.jpg", 2, "picture.jpg, .png"),
    ("demo --out route.csv", 2, "route.csv, another folder"),
    ("demo map.zarr", 2, "map.zarr, demo --help"),
]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    write_world(folder)
    return folder


@pytest.fixture
def here(world: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The world as where one is, without a display, in which nothing may be written."""
    monkeypatch.chdir(world)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    before = written(world)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        yield world
    assert written(world) == before


def written(folder: Path) -> dict[str, int]:
    """All that is below, and when each file was last changed."""
    return {
        str(path): 0 if path.is_dir() else path.lstat().st_mtime_ns for path in folder.rglob("*")
    }


@pytest.mark.parametrize(("line", "code", "names"), USES, ids=[use[0][:70] for use in USES])
def test_a_wrong_line_is_answered_in_one(
    line: str, code: int, names: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(shlex.split(line)) == code
    said = capsys.readouterr()
    *before, answer = said.err.splitlines()
    assert all(other.startswith("connecting to ") for other in before), "which may take a while"
    assert answer.startswith("error: ")
    for name in names.split(", "):
        assert name.lower() in answer.lower(), "each typer writes an argument's name its own way"
    assert said.out == ""


def test_every_command_is_used_wrongly() -> None:
    assert {line.split()[0] for line, _, _ in USES} >= set(COMMANDS)
    assert len(USES) >= 100


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_one_may_not_write_to(
    world: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(world)
    (world / "empty").chmod(0o500)
    try:
        assert run(shlex.split("ingest street.pcd --store empty/map.zarr")) == 1
    finally:
        (world / "empty").chmod(0o700)
    (answer,) = capsys.readouterr().err.splitlines()
    assert "Permission denied" in answer
    assert "another place" in answer
    assert "empty/map.zarr" in answer


CALLS: list[tuple[Callable[[], object], str]] = [
    (lambda: ts.open_store("gone.zarr"), "gone.zarr, tilestream ingest"),
    (lambda: ts.open_store("route.csv"), "route.csv, is a file"),
    (lambda: ts.open_run("gone"), "gone, no such run directory"),
    (lambda: ts.read_run("empty"), "empty, ts.run"),
    (lambda: ts.ingest("gone.pcd", "made.zarr"), "gone.pcd, check the path"),
    (lambda: ts.ingest("street.pcd", "made.zarr", tile_size=-1.0), "tile_size, -1"),
    (lambda: ts.read_route("degrees.csv"), "degrees.csv, degrees"),
    (lambda: ts.read_route("street.pcd"), "street.pcd, .geojson"),
    (lambda: ts.estimate("map.zarr", "gone.csv", out="made"), "gone.csv, check the path"),
    (lambda: ts.estimate("map.zarr", "route.csv", out="map.zarr"), "map.zarr, another folder"),
    (lambda: ts.estimate("map.zarr", "route.csv", sensor="VLP99"), "sensor VLP99, VLP16"),
    (lambda: ts.estimate("map.zarr", "route.csv", tolerance=0.1), "tolerance, coarse"),
    (lambda: ts.estimate("map.zarr", "route.csv", range_max=7500.0), "range_max, 7500, 100 m"),
    (lambda: ts.run("misspelt.yaml"), "misspelt.yaml, mean spacing"),
    (lambda: ts.run("map.zarr"), "map.zarr, tilestream template"),
    (lambda: ts.run(ts.RunSettings(out="made", maps={})), "maps, mean map"),
    (lambda: ts.plan("no_map.yaml"), "gone.pcd, check the path"),
    (lambda: ts.diff("map.zarr", "gone.zarr"), "gone.zarr, no tile store"),
    (lambda: ts.diff("run", "run", worse=-1.0), "worse, -1.0, metres"),
    (lambda: write_diff(ts.diff("run", "run"), "route.csv"), "route.csv, another folder"),
    (lambda: ts.explain("rangemax"), "'rangemax', range_max"),
    (lambda: ts.dataset("run"), "dataset, tilestream run"),
    (lambda: ts.train_over({}), "no run"),
    (lambda: ts.localize(ts.open_store("map.zarr"), "gone.mcap", "made"), "gone.mcap, check"),
    (lambda: ts.ScanSelection(from_s=5.0, until_s=2.0), "from_s, until_s, later"),
    (lambda: ts.verify("gone"), "gone, nothing to verify"),
    (lambda: ts.info("gone.pcd"), "gone.pcd, check the path"),
]


@pytest.mark.parametrize(("call", "names"), CALLS, ids=[names for _, names in CALLS])
def test_a_wrong_call_is_one_of_our_errors(
    call: Callable[[], object], names: str, here: Path
) -> None:
    with pytest.raises(TilestreamError) as told:
        call()
    assert "\n" not in str(told.value)
    for name in names.split(", "):
        assert name in str(told.value)
