"""What `info` says of everything that is read or made, on real files, with right values."""

import json
import os
import shutil
import socket
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pandas as pd
import pytest
from logs import SECOND, START, pose
from model_data import dataset
from pyproj import Geod

import tilestream as ts
from tilestream.apps.info import KINDS, info
from tilestream.cli import run
from tilestream.errors import CrsError, SourceNotFoundError, UnknownFormatError
from tilestream.formats.logs import open_log
from tilestream.formats.routes.lanelet2 import NOT_FOR_VEHICLES
from tilestream.lock import only_writer
from tilestream.marks import sealed, unsealed
from tilestream.model.dataset import made_with
from tilestream.model.file import save_model
from tilestream.model.training import train
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.store import POINTS

Told = pytest.CaptureFixture[str]
KEYS = {
    "path", "kind", "format", "state", "size_bytes", "crs", "unit", "frames", "bounds", "heights",
    "points", "fields", "coverage", "contents", "notes",
}  # fmt: skip


def told(path: Path | str, capsys: Told) -> dict[str, Any]:
    """What the command says as JSON; without it the same, for people."""
    assert run(["info", str(path), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert set(found) == KEYS
    assert run(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert found["format"] in shown
    return found


# --- What others have made


@pytest.mark.parametrize("name", ["lanelet2_kashiwanoha", "lanelet2_mapping_example_karlsruhe"])
def test_a_real_lanelet2_map(name: str, shared_data: Path, capsys: Told) -> None:
    path = shared_data / "lanelet2" / f"{name}.osm"
    found = told(path, capsys)
    assert (found["kind"], found["format"], found["unit"]) == ("routes", "Lanelet2", "degrees")
    assert found["crs"] == "OGC:CRS84"
    root = ET.parse(path).getroot()
    nodes = {n.get("id"): (float(n.get("lon")), float(n.get("lat"))) for n in root.iter("node")}  # type: ignore[arg-type]
    ways = {w.get("id"): [nd.get("ref") for nd in w.iter("nd")] for w in root.iter("way")}
    lengths, used = [], []
    for relation in root.iter("relation"):
        tags = {tag.get("k"): tag.get("v") for tag in relation.iter("tag")}
        if tags.get("type") != "lanelet" or tags.get("subtype") in NOT_FOR_VEHICLES:
            continue
        bounds = [
            np.array([nodes[ref] for ref in ways[member.get("ref")]])
            for member in relation.iter("member")
            if member.get("role") in ("left", "right")
        ]
        used += bounds
        lengths.append(np.mean([Geod(ellps="WGS84").line_length(*line.T) for line in bounds]))
    # the middle of two bounds is about as long as they are on average
    assert found["coverage"]["length_m"] == pytest.approx(sum(lengths), rel=0.02)
    corners = np.array(found["bounds"])[:, :2].astype(float)
    outer = np.concatenate(used)
    assert (corners[0] >= outer.min(axis=0) - 1e-9).all()
    assert (corners[1] <= outer.max(axis=0) + 1e-9).all()
    np.testing.assert_allclose(corners, [outer.min(axis=0), outer.max(axis=0)], atol=5e-4)  # 40 m
    has_z = name.endswith("kashiwanoha")
    assert (found["heights"] is not None) == has_z
    assert found["coverage"]["vertices_with_z"] == has_z * found["coverage"]["vertices"]


def test_a_real_drive(shared_data: Path, capsys: Told) -> None:
    found = told(shared_data / "kitti_drive" / "drive.mcap", capsys)
    assert (found["kind"], found["frames"]) == ("log", {"scans": "velodyne"})
    cover = found["coverage"]
    assert cover["length_m"] == pytest.approx(71.45, abs=0.1)
    assert (cover["scans"], cover["scans_with_pose"], cover["poses"]) == (52, 52, 52)
    began, ended = (pd.Timestamp(cover[end]) for end in ("from", "until"))
    assert (ended - began).total_seconds() == pytest.approx(15.3)
    assert found["points"] == 6_317_377
    assert found["heights"] == [found["bounds"][0][2], found["bounds"][1][2]]


def test_a_real_route(shared_data: Path, capsys: Told) -> None:
    found = told(shared_data / "shinjuku" / "route_nishishinjuku_local_m.csv", capsys)
    assert (found["kind"], found["format"], found["heights"]) == ("routes", "CSV", None)
    assert found["coverage"]["length_m"] == pytest.approx(2870.0, abs=10.0)
    table = pd.read_csv(shared_data / "shinjuku" / "route_nishishinjuku_local_m.csv")
    np.testing.assert_allclose(
        np.array(found["bounds"])[:, :2].astype(float),
        [table.iloc[:, 1:3].min(), table.iloc[:, 1:3].max()],
    )


def test_a_jump_is_no_way_that_was_driven(cases: Path, tmp_path: Path, capsys: Told) -> None:
    found = told(cases / "log" / "poses_start_at_origin.mcap", capsys)
    assert found["coverage"]["length_m"] == pytest.approx(9.0, abs=0.1)
    assert "along 9.0 m" in " ".join(found["contents"])
    stamps = [START + n * SECOND // 10 for n in range(20)]
    places = [pose(x=float(n) + 5000.0 * (n >= 10)) for n in range(20)]
    messages = [logs.odometry_at(*at) for at in zip(stamps, places, strict=True)]
    path = logs.write(tmp_path / "a.mcap", messages + [logs.cloud_at(at) for at in stamps])
    assert info(path).coverage["length_m"] == pytest.approx(18.0)
    log = open_log(path)
    assert log.length_m(np.arange(10)) == pytest.approx(9.0)
    assert log.length_m(np.arange(0)) == 0.0


def test_poses_and_their_gaps(cases: Path, capsys: Told) -> None:
    found = told(cases / "route" / "gap_of_100_m.tum", capsys)
    cover = found["coverage"]
    assert (found["format"], cover["routes"]) == ("poses", 2)
    assert cover["length_m"] == pytest.approx(40.0)
    assert cover["until"] - cover["from"] == pytest.approx(8.2, abs=0.1)
    assert any("cut where nobody drove" in note for note in found["notes"])


def test_a_bad_route_is_in_the_state(cases: Path, capsys: Told) -> None:
    found = told(cases / "route" / "one_line_of_1_mm.geojson", capsys)
    assert found["state"].startswith("1 of its routes")
    assert any("1 different points of 2" in note for note in found["notes"])
    with pytest.raises(CrsError, match="no place on earth"):
        info(cases / "route" / "metres_in_lat.osm")


def test_points_in_feet_are_told_in_metres(cases: Path, capsys: Told) -> None:
    found = told(cases / "map" / "us_survey_feet.las", capsys)
    assert (found["kind"], found["points"], found["unit"]) == ("points", 7715, "m")
    assert np.subtract(*reversed(found["bounds"]))[0] == pytest.approx(40.1, abs=0.1)
    assert any("US survey foot" in note for note in found["notes"])


def test_what_is_nothing_of_ours(tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError):
        info(tmp_path / "nothing.pcd")
    with pytest.raises(UnknownFormatError, match="run directories"):
        info(tmp_path)
    (tmp_path / "a.doc").write_text("hello")
    with pytest.raises(UnknownFormatError, match="models"):
        info(tmp_path / "a.doc")
    assert len({kind.name for kind in KINDS}) == len(KINDS) == 8


# --- What we have made


@pytest.fixture(scope="module")
def job(cases: Path, tmp_path_factory: pytest.TempPathFactory) -> RunSettings:
    folder = tmp_path_factory.mktemp("job")
    (folder / "route.csv").write_text("x,y\n5,0\n35,0\n")
    settings = RunSettings(
        out=str(folder / "run"),
        map={"sources": [str(cases / "street.pcd")], "tile_size": 50.0},
        routes=[str(folder / "route.csv")],
        spacing=5.0,
        model={"recipe": "physics"},
    )
    ts.run(settings)
    return settings


def test_a_tile_store(job: RunSettings, cases: Path, capsys: Told) -> None:
    found, points = told(job.store_url, capsys), told(cases / "street.pcd", capsys)
    assert (found["kind"], found["state"], found["crs"]) == ("map", "whole", None)
    np.testing.assert_allclose(found["bounds"], points["bounds"], atol=0.1)
    cover, marks = found["coverage"], ts.open_store(job.store_url).marks(POINTS)
    assert cover["tiles"] == cover["tiles_done"] == len(marks)
    assert cover["points_read"] == points["points"] == 7715
    assert found["points"] == sum(mark.facts["points"] for mark in marks.values())


def test_a_half_made_store_says_so(cases: Path, tmp_path: Path, capsys: Told) -> None:
    store = ts.ingest(cases / "street.pcd", tmp_path / "map.zarr", tile_size=50.0)
    store.remove(store.keys()[0])
    found = told(tmp_path / "map.zarr", capsys)
    assert found["state"].startswith("damaged, it has lost tile")
    assert found["coverage"]["tiles_missing"] == 1


def test_a_run_directory(job: RunSettings, capsys: Told) -> None:
    found = told(job.out, capsys)
    assert (found["kind"], found["state"]) == ("run", "whole")
    assert found["coverage"]["places"] == found["points"] == 7
    low, high = found["bounds"]
    assert (low[0], high[0]) == (5.0, 35.0)
    assert found["heights"] == pytest.approx([2.0, 2.0], abs=0.1)
    assert "table factors: 7 rows" in " ".join(found["contents"])
    record = Path(job.out) / "run.json"
    text = record.read_text()
    record.write_text(text.replace('"done"', '"none"'))
    try:
        assert run(["info", job.out]) == 1
        assert "run.json is damaged" in capsys.readouterr().err
    finally:
        record.write_text(text)


def test_a_run_whose_process_is_gone_says_so(
    job: RunSettings, tmp_path: Path, capsys: Told
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(job.out, copy)
    record = unsealed(json.loads((copy / "run.json").read_text()))
    (copy / "run.json").write_text(json.dumps(sealed(record | {"state": "running"})))
    with only_writer(copy):
        assert f"process {os.getpid()}" in told(copy, capsys)["state"]
    for lock in (None, {"host": socket.gethostname(), "process": 2**22 + 1}):
        if lock is not None:  # as SIGKILL leaves it
            now = time.time()
            left = {"since": now, "renewed": now, "token": "a", **lock}
            (copy / ".lock").write_text(json.dumps(left))
        assert "stopped before its end" in told(copy, capsys)["state"]
    assert run(["status", str(copy)]) == 1
    assert "stopped before its end" in capsys.readouterr().err
    assert run(["status", job.out, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["run"], found["whole"]) == ("whole", True)


def test_a_comparison_and_what_is_made_on_the_map_of_a_run(
    job: RunSettings, tmp_path: Path, capsys: Told
) -> None:
    out, route = tmp_path / "out", ["--route", job.routes[0], "--spacing", "15"]
    assert run(["compare", job.out, *route, "--range-max", "20,30", "--out", str(out)]) == 0
    capsys.readouterr()
    found = told(out, capsys)
    assert found["kind"] == "comparison"
    assert found["coverage"] == {"places": 3, "routes": 1, "choices": 2}
    assert sum(line.startswith("choice VLP16-") for line in found["contents"]) == 2
    (out / "compare.json").write_text("{")
    assert run(["info", str(out)]) == 1


def test_a_picture_for_foxglove_is_no_log(job: RunSettings, tmp_path: Path, capsys: Told) -> None:
    path = Path(job.out) / "report" / "foxglove.mcap"
    found = told(path, capsys)
    assert found["kind"] == "scene"
    assert any(line.startswith("/tilestream/places: ") for line in found["contents"])
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:2000])
    assert run(["info", str(tmp_path / "cut.mcap")]) == 1


def test_several_are_told_one_after_the_other(job: RunSettings, cases: Path, capsys: Told) -> None:
    street = str(cases / "street.pcd")
    assert run(["info", street, job.store_url, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["kind"] for one in found] == ["points", "map"]
    assert run(["info", "gone.pcd", street]) == 1
    said = capsys.readouterr()
    assert street in said.out.replace("\n", "")
    assert said.err.count("gone.pcd") == 1


def test_the_tables_of_a_command_alone(job: RunSettings, tmp_path: Path, capsys: Told) -> None:
    out = tmp_path / "out"
    command = ["factors", job.store_url, "--route", job.routes[0], "--out", str(out)]
    assert run([*command, "--spacing", "10", "--json"]) == 0
    capsys.readouterr()
    found = told(out, capsys)
    assert (found["format"], found["coverage"]["places_done"]) == ("tables", 4)
    next((out / "factors").glob("*.parquet")).unlink()
    assert "half-made or has lost tables" in told(out, capsys)["state"]


def test_a_model(tmp_path: Path, capsys: Told) -> None:
    places = dataset(lengths={"a": 150, "b": 150})
    made = made_with(places.columns, ts.VLP16, 2.0)
    model = train(replace(places, made_with=made), recipe="paper")
    save_model(model, tmp_path / "model.skops")
    found = told(tmp_path / "model.skops", capsys)
    assert found["coverage"] == {"factors": len(model.factors), "targets": len(model.regressors)}
    assert f"recipe: {model.facts['recipe']}" in found["contents"]
    assert "for VLP16" in found["contents"]
    assert "cell_size: 2.0" in found["contents"]
    assert found["size_bytes"] == (tmp_path / "model.skops").stat().st_size
