"""Maps as people have them: each of the small inputs with its right value."""

import json
import re
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest

import tilestream as ts
from tilestream.apps.diff import diff
from tilestream.cli import run
from tilestream.crs import projection, same
from tilestream.errors import CrsError, SourceError, SourceNotFoundError
from tilestream.formats import describe
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import read_all_routes, read_route

STREET = 7715
"""Points of the made street: 40 m, its lowest corner at (-0.027, -9.561, -0.068) m."""
LOW, HIGH = (-0.027, -9.561, -0.068), (40.068, 9.559, 5.66)


@pytest.fixture
def map_cases(cases: Path) -> Path:
    return cases / "map"


def made(source: Path | list[Path], tmp_path: Path, **how: object) -> ts.TileStore:
    return ts.ingest(source, tmp_path / "map.zarr", map_leaf=0.0, **how)  # type: ignore[arg-type]


def points_of(store: ts.TileStore) -> np.ndarray:
    return np.concatenate([tile.points() for tile in (store.tile(key) for key in store.keys())])


def planned(folder: Path, tmp_path: Path) -> int:
    """The exit code of a plan for all streets of a map folder."""
    job = {
        "out": str(tmp_path / "job"),
        "map": {"sources": [str(folder)]},
        "model": {"recipe": "physics"},
        "observe": {},
    }
    (tmp_path / "job.yaml").write_text(json.dumps(job))
    return run(["plan", str(tmp_path / "job.yaml")])


def notes_of(store: ts.TileStore) -> str:
    return "\n".join(note for source in store.sources() for note in source["notes"])


def test_feet_are_brought_to_metres(map_cases: Path, tmp_path: Path) -> None:
    store = made(map_cases / "us_survey_feet.las", tmp_path)
    points = points_of(store)
    assert len(points) == STREET
    size = np.subtract(HIGH, LOW)
    np.testing.assert_allclose(np.ptp(points, axis=0), size, atol=0.002)
    np.testing.assert_allclose(points.min(axis=0)[0], 989999.910 * 1200 / 3937, atol=0.001)
    assert same(str(store.settings.crs), "EPSG:32118")  # the same projection in metres
    assert "US survey foot" in notes_of(store)


def test_degrees_are_refused(map_cases: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"degrees\.las: its CRS EPSG:4326 .* in degrees"):
        made(map_cases / "degrees.las", tmp_path)
    with pytest.raises(CrsError, match=r"EPSG:4326 .* in degrees: project"):
        made(map_cases / "same_crs_epsg.las", tmp_path, crs="EPSG:4326")


def test_a_crs_with_heights_is_the_same_map(map_cases: Path, tmp_path: Path) -> None:
    store = made([map_cases / "same_crs_epsg.las", map_cases / "same_crs_compound.las"], tmp_path)
    assert store.settings.crs == "EPSG:32654"
    assert len(points_of(store)) == 2 * STREET
    assert "EGM2008 height" in notes_of(store)


def test_all_points_of_a_legacy_count(map_cases: Path, tmp_path: Path) -> None:
    assert describe(map_cases / "las14_legacy_count_only.las").points == STREET
    assert len(points_of(made(map_cases / "las14_legacy_count_only.las", tmp_path))) == STREET


@pytest.mark.parametrize("name", ["nan_bounds.las", "zero_bounds.las"])
def test_impossible_bounds_are_read_from_the_points(
    name: str, map_cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(map_cases / name), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(found["bounds"], [LOW, HIGH], atol=1e-9)
    assert any("the bounds in its header" in note for note in found["notes"])


def test_a_plan_does_not_believe_impossible_bounds(
    map_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "way.csv").write_text("x,y,z\n5,0,0\n35,0,0\n")
    job = {
        "out": str(tmp_path / "job"),
        "map": {"sources": [str(map_cases / "zero_bounds.las")], "tile_size": 10.0},
        "routes": [str(tmp_path / "way.csv")],
        "model": {"recipe": "physics"},
        "observe": {},
    }
    (tmp_path / "job.yaml").write_text(json.dumps(job))
    assert run(["plan", str(tmp_path / "job.yaml")]) == 0
    assert "at most 12 tiles" in " ".join(capsys.readouterr().out.split())


def test_noise_and_withheld_points_are_left_out(
    map_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, url = map_cases / "noise_and_withheld.laz", str(tmp_path / "map.zarr")
    asked = ["ingest", str(file), "--store", url, "--map-leaf", "0"]
    assert run(asked) == 0
    assert points_of(ts.open_store(url))[:, 2].max() < 10.0
    las = laspy.read(file)
    bad = np.isin(las.classification, (7, 18)) | (np.asarray(las.withheld) == 1)
    assert len(points_of(ts.open_store(url))) == STREET - bad.sum()
    told = " ".join(capsys.readouterr().out.split())
    assert f"{bad.sum():,} points of a class of noise (7 or 18) or withheld are left out" in told
    assert run([*asked, "--keep-noise"]) == 0
    assert len(points_of(ts.open_store(url))) == STREET
    assert "noise (7" not in capsys.readouterr().out
    assert run(asked) == 0
    assert len(points_of(ts.open_store(url))) == STREET - bad.sum()


def test_a_zero_point_among_utm_coordinates_is_left_out(map_cases: Path, tmp_path: Path) -> None:
    store = made(map_cases / "utm_with_zero_point.pcd", tmp_path)
    assert len(points_of(store)) == STREET
    assert np.ptp(points_of(store), axis=0).max() < 50.0
    (source,) = store.sources()
    assert source["points"] == STREET
    assert "10 km from all others: 1 of 7,716 points, 1 near (0, 0) m: left out" in notes_of(store)


def test_words_of_other_c_libraries_are_not_finite(map_cases: Path, tmp_path: Path) -> None:
    words = (map_cases / "nan_ind.pcd").read_text().split("DATA ascii\n")[1].splitlines()
    bad = sum("(" in line or "#" in line for line in words)
    (source,) = made(map_cases / "nan_ind.pcd", tmp_path).sources()
    assert (source["points"], source["dropped"]) == (300 - bad, bad)
    assert bad > 0


def test_ply_as_other_programs_write_it(map_cases: Path, tmp_path: Path) -> None:
    assert describe(map_cases / "list_in_vertex.ply").points == 3
    assert len(points_of(made(map_cases / "list_in_vertex.ply", tmp_path / "a"))) == 3
    points = points_of(made(map_cases / "faces_first.ply", tmp_path / "b"))
    assert len(points) == STREET
    np.testing.assert_allclose(points.min(axis=0), LOW, atol=0.001)
    np.testing.assert_allclose(points.max(axis=0), HIGH, atol=0.001)


def test_fill_values_of_a_log_are_left_out_of_its_map(cases: Path, tmp_path: Path) -> None:
    store = made(cases / "log" / "fill_values_1e9.mcap", tmp_path)
    assert "outside of the tile grid: 600 of 26,382 points, first (1e+09, " in notes_of(store)
    assert np.abs(points_of(store)).max() < 100.0


def test_a_crs_that_cannot_be_read_gives_way_to_what_the_user_says(
    map_cases: Path, tmp_path: Path
) -> None:
    store = made(map_cases / "vendor_wkt.las", tmp_path / "a")
    assert store.settings.crs is None
    assert "cannot be read" in notes_of(store)
    assert made(map_cases / "vendor_wkt.las", tmp_path / "b", crs="EPSG:32654").settings.crs
    assert run(["info", str(map_cases / "vendor_wkt.las")]) == 0


def test_the_map_s_own_projector_serves_its_lanes(
    map_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = map_cases / "autoware_mgrs_latlon"
    store = made(given, tmp_path)
    crs = str(store.settings.crs)
    drawn = read_route(given / "lanelet2_map.osm", map_crs=crs)
    assert drawn.arc_length[-1] == pytest.approx(30.0, abs=0.05)
    assert drawn.crs == crs
    # the lanes of this input lie one square of MGRS further east than its points: brought there
    folder = shutil.copytree(given, tmp_path / "map", copy_function=shutil.copyfile)
    lanes = folder / "lanelet2_map.osm"
    to_degrees = projection(crs, "EPSG:4326", "lanes")
    to_map = projection("EPSG:4326", crs, "lanes")

    def moved(found: re.Match[str]) -> str:
        x, y = to_map.transform(float(found[2]), float(found[1]))
        longitude, latitude = to_degrees.transform(x - 100_000.0, y)
        return f"lat='{latitude:.9f}' lon='{longitude:.9f}'"

    lanes.write_text(re.sub(r"lat='(\S+)' lon='(\S+)'", moved, lanes.read_text()))
    asked = ["--route", str(lanes), "--out", str(tmp_path / "run"), "--json"]
    assert run(["factors", store.url, *asked]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["sample_points"], told["done"]) == (31, 31)
    (note,) = told["notes"][str(lanes)]
    assert "brought from degrees" in note
    assert planned(folder, tmp_path) == 0
    assert "1 lane of" in " ".join(capsys.readouterr().out.split())


def test_a_map_of_one_cloud_is_a_map_folder(
    map_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = map_cases / "autoware_single_pcd"
    store = made(folder, tmp_path)
    assert len(points_of(store)) == STREET
    assert store.settings.crs is None
    assert "projector_type: local" in notes_of(store)
    assert run(["info", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == STREET
    assert planned(folder, tmp_path) == 0
    assert "1 lane of" in " ".join(capsys.readouterr().out.split())


def test_a_folder_of_clouds_without_metadata_is_a_map_folder(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    (folder / "pointcloud_map.pcd").mkdir(parents=True)
    with pytest.raises(SourceNotFoundError, match="holds no PCD file"):
        describe(folder)
    for i in range(2):
        write_pcd(folder / "pointcloud_map.pcd" / f"{i}.pcd", np.full((3, 3), float(i)))
    (folder / "map_projector_info.yaml").write_text("projector_type: MGRS\nmgrs_grid: 54SUE\n")
    found = describe(folder)
    assert found.points == 6
    assert found.crs is not None
    store = made(folder, tmp_path)
    assert store.settings.crs == found.crs
    assert len(store.sources()) == 2


def test_a_route_in_another_zone_is_projected(
    cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = cases / "route" / "other_zone_EPSG_6676.geojson"
    alone = read_route(file)
    assert alone.crs == "EPSG:6676"
    route = read_route(file, map_crs="EPSG:6677")
    to_map = projection("EPSG:6676", "EPSG:6677", "route")
    expected = np.column_stack(to_map.transform(*alone.positions[:, :2].T))
    np.testing.assert_allclose(route.positions[:, :2], expected, atol=1e-6)
    assert route.crs == "EPSG:6677"
    assert "projected from EPSG:6676" in read_all_routes(file, map_crs="EPSG:6677").notes[0]
    write_pcd(tmp_path / "road.pcd", route.positions)
    store = ts.ingest(tmp_path / "road.pcd", tmp_path / "map.zarr", crs="EPSG:6677")
    with pytest.raises(CrsError, match=r"EPSG:6676 and .*EPSG:6677"):
        ts.factors_along(store, [alone], tmp_path / "run")
    code = run(
        ["factors", store.url, "--route", str(file), "--out", str(tmp_path / "run"), "--dry-run"]
    )
    assert code == 0
    assert "projected from EPSG:6676" in capsys.readouterr().err


def test_maps_of_two_crs_are_not_compared(cases: Path, tmp_path: Path) -> None:
    for name, crs in (("a", "EPSG:6677"), ("b", "EPSG:6676"), ("c", "urn:ogc:def:crs:EPSG::6677")):
        ts.ingest(cases / "street.pcd", tmp_path / name, crs=crs)
    with pytest.raises(CrsError, match=r"EPSG:6677 and .*EPSG:6676"):
        diff(tmp_path / "a", tmp_path / "b")
    assert diff(tmp_path / "a", tmp_path / "c").same > 0


def test_metres_of_a_projection_in_feet(tmp_path: Path) -> None:
    """What was in metres all along has no note."""
    write_las(tmp_path / "a.las", np.zeros((1, 3)), crs="EPSG:32118")
    assert describe(tmp_path / "a.las").notes == ()
