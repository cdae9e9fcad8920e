"""Real drives, maps and lanes through every command: each works, and says the same of them."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tilestream.cli import run
from tilestream.cli.app import COMMANDS

pytestmark = pytest.mark.slow
Told = pytest.CaptureFixture[str]

LENGTHS = {"kitti_drive": 71.5, "kitti_0009": 55.0, "kitti_04": 69.2}
"""How far each drive leads [m], to a tenth of it; the lidar is mounted at 1.73 m."""
HEIGHT = ["--sensor-height", "1.73"]
MADE_OF_NOTHING = {"simulate", "demo", "template", "explain", "view", "warm"}
"""Commands that read no map and no drive, and the one that needs a display."""


class Commands:
    """A command line at a time; remembers which were tried."""

    def __init__(self, capsys: Told) -> None:
        self.capsys = capsys
        self.tried: set[str] = set()

    def __call__(self, *arguments: object, code: int = 0) -> str:
        """What it printed."""
        self.capsys.readouterr()
        line = [str(argument) for argument in arguments]
        self.tried.add(line[0])
        ended = run(line)
        told = self.capsys.readouterr()
        assert ended == code, f"{line}: {told.err}"
        return told.out

    def found(self, *arguments: object, code: int = 0) -> Any:
        """What it printed for machines."""
        return json.loads(self(*arguments, "--json", code=code))


@pytest.fixture
def command(capsys: Told) -> Commands:
    return Commands(capsys)


@pytest.mark.parametrize("name", LENGTHS)
def test_a_real_drive(name: str, shared_data: Path, tmp_path: Path, command: Commands) -> None:
    log, store, long = shared_data / name / "drive.mcap", tmp_path / "map.zarr", LENGTHS[name]
    told = command.found("info", log)
    assert told["coverage"]["length_m"] == pytest.approx(long, rel=0.1)
    assert told["coverage"]["scans_with_pose"] == told["coverage"]["scans"] > 50

    command("ingest", log, "--store", store, "--every", "2")
    command("status", store)
    command("verify", store)
    assert command.found("info", store)["points"] > 100_000

    route = ["--route", log, *HEIGHT]
    factors = command.found("factors", store, *route, "--spacing", "5", "--out", tmp_path / "f")
    assert factors["done"] == factors["sample_points"] > 10

    drive = [store, log, "--every", "2", "--offset", "1", "--spacing", "10", "--radius", "0.4"]
    labels = command.found("localize", *drive, "--out", tmp_path / "l")
    assert labels["mean_m"] < 0.1

    ranges = ["--range-max", "30,60", "--spacing", "20", "--sensor", "HDL64"]
    compared = command.found("compare", store, *route, *ranges, "--out", tmp_path / "c")
    assert all(choice["estimated"] > 0 for choice in compared["choices"])

    vehicle = ["--sensor", "HDL64", *HEIGHT, "--range-max", "60"]
    alone = ["estimate", log, "--every", "2", *vehicle, "--spacing", "20", "--model", "physics"]
    answer = command.found(*alone, "--workers", "1", "--out", tmp_path / "e")
    assert answer["headline"]["estimated"] == answer["headline"]["places"] > 2
    advised = command.found("advise", tmp_path / "e", "--threshold", "9")
    assert advised["stretches"] == []
    wanted = ["export", "covariance", tmp_path / "e", "--format", "autoware"]
    assert command.found(*wanted)["places"] == answer["headline"]["places"]
    assert answer["worth"]["checked"] == "nowhere"

    job = {
        "out": str(tmp_path / "run"),
        "map": {"sources": [str(log)], "every": 2},
        "drives": [{"log": str(log), "every": 2, "offset": 1}],
        "spacing": 5.0,
        "sensor": "HDL64",
        "sensor_height": 1.73,
        "label": {"starts": {"radius": 0.4, "step": 0.4}},
        "observe": {"starts": 8, "draws": 2, "worlds": 1, "range_max": 60.0},
        "model": {"recipe": "physics", "offset": 0.0},
    }
    config = tmp_path / "job.yaml"
    config.write_text(yaml.safe_dump(job))
    assert command.found("plan", config)["stages"]
    command("run", config, "--workers", "1")
    report = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    (measured,) = report["drives"]
    lost = sum(one["count"] for one in report["lost_labels"])
    assert report["headline"]["labelled"] + lost == measured["measured"] > 5
    assert lost <= 2  # of a place that looks as if inside a wall
    command("verify", tmp_path / "run")
    assert command.found("info", tmp_path / "run")["state"] == "whole"

    sparse = tmp_path / "sparse.zarr"
    command("ingest", log, "--store", sparse, "--every", "8")
    assert command.found("diff", store, sparse)
    assert command.tried >= set(COMMANDS) - MADE_OF_NOTHING


@pytest.mark.parametrize("layout", ["autoware_single_pcd", "autoware_mgrs_latlon"])
def test_a_map_as_autoware_has_it(
    layout: str, cases: Path, tmp_path: Path, command: Commands
) -> None:
    folder, store = cases / "map" / layout, tmp_path / "map.zarr"
    assert command.found("info", folder)["points"] > 1000
    assert command.found("info", folder / "lanelet2_map.osm")["coverage"]["routes"] >= 1
    command("ingest", folder, "--store", store)
    command("status", store)
    command("verify", store)


@pytest.mark.parametrize("name", ["251370668", "251371071"])
def test_a_scan_as_a_map(name: str, shared_data: Path, tmp_path: Path, command: Commands) -> None:
    scan, store = shared_data / "scan_pair" / f"{name}.pcd", tmp_path / "map.zarr"
    points = command.found("info", scan)["points"]
    command("ingest", scan, "--store", store, "--map-leaf", "0")
    assert command.found("info", store)["points"] == points > 50_000
    command("verify", store)


@pytest.mark.parametrize(
    ("name", "routes"),
    [("lanelet2_kashiwanoha", 1), ("lanelet2_mapping_example_karlsruhe", 1)],
)
def test_lanes_elsewhere(
    name: str, routes: int, shared_data: Path, tmp_path: Path, command: Commands
) -> None:
    lanes = shared_data / "lanelet2" / f"{name}.osm"
    told = command.found("info", lanes)
    assert told["coverage"]["routes"] >= routes
    assert told["coverage"]["length_m"] > 100.0
    store = tmp_path / "map.zarr"
    command("ingest", shared_data / "pcd" / "hdl64_street.pcd", "--store", store)
    far = ["--route", lanes, "--project-to", "EPSG:32632", "--out", tmp_path / "out"]
    command("factors", store, *far, code=1)
    assert not (tmp_path / "out").exists()
