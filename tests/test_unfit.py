"""A drive that does not fit the map is told, and nothing is learnt from it or judged by it."""

import json
from pathlib import Path

import pandas as pd
import pytest
from streets import job, street, write_drive

import tilestream as ts
from tilestream.cli import run as command
from tilestream.errors import PartialError
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs.run_folder import table_paths
from tilestream.pipeline.jobs.unfit import MANY, NVTL, unfit
from tilestream.tables import read_tables

OFF = 6.0
"""How far the poses of a log are beside those of its map [m]."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_pcd(folder / "map_canyon.pcd", street("canyon", 1, 0.3))
    write_drive(folder / "good.mcap", "canyon")
    write_drive(folder / "beside.mcap", "canyon", OFF)
    return folder


def test_such_a_drive_fails_and_its_labels_stand_nowhere(inputs: Path, tmp_path: Path) -> None:
    drives = [{"log": str(inputs / f"{name}.mcap")} for name in ("good", "beside")]
    seeing = {"range_max": 14.0, "starts": 8, "draws": 2, "worlds": 1}
    model = {"recipe": "physics", "offset": 0.0}
    how = {"drives": drives, "observe": seeing, "model": model, "spacing": 4.0}
    with pytest.raises(PartialError, match=r"drive beside: it does not fit the map"):
        ts.run(job(inputs, tmp_path / "run", **how))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(told["failures"]) == ["drive beside"]
    report = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    assert report["headline"]["labelled"] == report["worth"]["places"] > 5
    assert report["worth"]["drives"] == 1
    assert set(ts.read_run(tmp_path / "run")["drive"].dropna()) == {"good"}
    tables = [path for path in table_paths(tmp_path / "run", "errors") if "/beside/" in path]
    errors = read_tables(tables)
    assert errors["near_p_fail"].median() > MANY
    assert errors["near_nvtl"].median() < NVTL


def test_the_command_that_localizes_it_fails(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ts.ingest([inputs / "map_canyon.pcd"], tmp_path / "map.zarr")
    line = ["localize", str(tmp_path / "map.zarr"), "--spacing", "4", "--workers", "1"]
    line += ["--matcher", "default", "--radius", "0.4", "--step", "0.2"]
    for name, code in (("good", 0), ("beside", 1)):
        out = ["--out", str(tmp_path / name)]
        assert command([*line, str(inputs / f"{name}.mcap"), *out]) == code
        assert ("does not fit the map" in capsys.readouterr().err) == bool(code)


@pytest.mark.parametrize(
    ("fail", "nvtl", "told"),
    [(MANY, NVTL - 0.1, True), (MANY - 0.1, 1.0, False), (1.0, NVTL, False)],
)
def test_a_hard_street_is_not_another_map(fail: float, nvtl: float, told: bool) -> None:
    """Starts may fail where scan and map agree, and agree little where they do not fail."""
    rows = pd.DataFrame({"near_p_fail": fail, "near_nvtl": nvtl, "status": ["done"] * 5})
    strays = rows.assign(near_p_fail=1.0, near_nvtl=0.0)[:2]
    lost = strays.assign(status="failed")
    assert bool(unfit(pd.concat([rows, strays, lost, lost, lost]))) == told
    assert unfit(lost) == ""
