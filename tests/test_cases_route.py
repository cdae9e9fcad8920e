"""Files of routes that went wrong for others, each with its right value."""

import json
from pathlib import Path

import numpy as np
import pytest

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import CorruptSourceError, CrsError, PartialError
from tilestream.formats.routes import read_all_routes, read_route, read_routes, resample
from tilestream.pipeline.jobs.run_settings import RunSettings

Told = pytest.CaptureFixture[str]


@pytest.mark.parametrize("name", ["trailing_blank_line.csv", "semicolon.csv", "z_empty.csv"])
def test_csv_is_read_as_people_write_it(name: str, cases: Path) -> None:
    route = read_route(cases / "route" / name)
    np.testing.assert_array_equal(route.positions[:, :2], [[x, 0.0] for x in range(5, 36)])
    z = np.nan if name == "z_empty.csv" else 0.0
    np.testing.assert_array_equal(route.positions[:, 2], z)


@pytest.fixture(scope="module")
def street(cases: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The map that the routes lie in."""
    url = str(tmp_path_factory.mktemp("street") / "map.zarr")
    ts.ingest(cases / "street.pcd", url, tile_size=50.0)
    return url


def test_routes_of_one_name_get_names_of_their_own(cases: Path) -> None:
    read = read_all_routes(cases / "route" / "same_name_twice.geojson")
    assert [route.route_id for route in read.routes] == ["Main Street", "Main Street-2"]
    assert [route.arc_length[-1] for route in read.routes] == [14.0, 16.0]
    (note,) = read.notes
    assert "2 routes are named Main Street: here they are Main Street, Main Street-2" in note
    assert not read.lost


BAD_ONES = {
    "one_line_of_1_mm.geojson": ("long", 30.0, "tiny", "1 different points of 2"),
    "one_lanelet_without_bounds.osm": ("21-22", 30.0, "23", "lanelet 23 has no left bound"),
}


@pytest.mark.parametrize("name", BAD_ONES)
def test_one_bad_route_does_not_stop_the_good_ones(name: str, cases: Path) -> None:
    good, length, bad, why = BAD_ONES[name]
    read = read_all_routes(cases / "route" / name)
    (route,) = read.routes
    assert (route.route_id, route.arc_length[-1]) == (good, pytest.approx(length))
    assert [lost.route_id for lost in read.lost] == [bad]
    assert why in read.failures[f"route {bad}"]
    with pytest.raises(CorruptSourceError, match=why):
        read_routes(cases / "route" / name)


@pytest.mark.parametrize("name", BAD_ONES)
def test_factors_of_the_good_ones_and_the_bad_ones_listed(
    name: str, cases: Path, street: str, tmp_path: Path, capsys: Told
) -> None:
    _, _, bad, why = BAD_ONES[name]
    route = ["--route", str(cases / "route" / name), "--out", str(tmp_path / "out")]
    assert run(["factors", street, *route, "--json"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["done"] == 31
    assert f"route {bad}: " in told.err
    assert why in told.err


def test_what_else_failed_is_listed_with_the_bad_ones(
    cases: Path, street: str, tmp_path: Path, capsys: Told
) -> None:
    off = tmp_path / "off.csv"
    off.write_text("x,y\n5,0\n500,0\n")
    routes = ["--route", str(cases / "route" / "one_line_of_1_mm.geojson"), "--route", str(off)]
    assert run(["factors", street, *routes, "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "not every sample point has factors" in told
    assert "route tiny: " in told
    assert "sample points" in told


def test_factors_along_routes_of_one_name(
    cases: Path, street: str, tmp_path: Path, capsys: Told
) -> None:
    path = cases / "route" / "same_name_twice.geojson"
    out = ["--out", str(tmp_path / "out"), "--json"]
    assert run(["factors", street, "--route", str(path), *out]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["done"] == 15 + 17
    assert "2 routes are named Main Street" in facts["notes"][str(path)][0]


def test_a_comparison_along_the_good_ones(
    cases: Path, street: str, tmp_path: Path, capsys: Told
) -> None:
    path = cases / "route" / "one_line_of_1_mm.geojson"
    assert run(["compare", street, "--route", str(path), "--out", str(tmp_path / "cmp")]) == 1
    assert "route tiny: " in capsys.readouterr().err
    assert (tmp_path / "cmp" / "compare.html").is_file()


def test_a_job_along_the_good_ones_lists_the_bad_one(cases: Path, tmp_path: Path) -> None:
    path = cases / "route" / "one_line_of_1_mm.geojson"
    values: dict[str, object] = {
        "out": str(tmp_path / "run"),
        "map": {"sources": [str(cases / "street.pcd")], "tile_size": 50.0},
        "routes": [str(path)],
        "spacing": 5.0,
        "model": {"recipe": "physics"},
    }
    with pytest.raises(PartialError, match=r"route tiny: .*1 different points of 2"):
        ts.run(RunSettings(**values))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert told["state"] == "failed"
    assert list(told["failures"]) == ["route tiny"]
    assert any("route tiny is left out" in note for note in told["notes"]["routes"])
    assert "route tiny is left out" in (tmp_path / "run" / "report" / "index.html").read_text()


def test_what_an_editor_has_marked_as_deleted_is_not_there(cases: Path) -> None:
    route = read_route(cases / "route" / "josm_deleted.osm")
    assert route.route_id == "21-22"
    assert route.positions[[0, -1], 0].tolist() == [5.0, 35.0]


@pytest.mark.parametrize("project_to", [None, "EPSG:6677"])
def test_metres_as_latitudes_are_said_to_be_metres(project_to: str | None, cases: Path) -> None:
    with pytest.raises(CrsError, match=r"longitude 1679, latitude -802 .*look like metres"):
        read_routes(cases / "route" / "metres_in_lat.osm", project_to=project_to)


def test_standing_with_noise_adds_no_length(cases: Path) -> None:
    route = read_route(cases / "route" / "standstill_with_noise.tum")
    assert route.arc_length[-1] == pytest.approx(20.0, abs=0.1)
    assert len(resample(route).positions) in (20, 21)


def test_a_drive_recorded_in_two_pieces_is_two_routes(cases: Path) -> None:
    read = read_all_routes(cases / "route" / "gap_of_100_m.tum")
    assert [r.route_id for r in read.routes] == ["gap_of_100_m", "gap_of_100_m-2"]
    assert [r.arc_length[-1] for r in read.routes] == [pytest.approx(20.0)] * 2
    assert [r.positions[0, 0] for r in read.routes] == [0.0, 120.0]
    cut, named = read.notes
    assert "cut where nobody drove: at a gap of 100.0 m after (20.0, 0.0)" in cut
    assert "gap_of_100_m, gap_of_100_m-2" in named
    assert not read.lost
