"""A simulation of a tiny city from settings to logs: sameness, resuming, refusals, reading back."""

import json
import re
import shutil
import subprocess
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import pytest
import yaml
from killed import killed_after
from scipy.spatial import cKDTree

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import PlanError, UsageError
from tilestream.formats.logs import ScanSelection, open_log
from tilestream.formats.logs.poses import transform
from tilestream.pipeline.engine.stage import BASE_BYTES
from tilestream.pipeline.jobs.simulate import plan_simulation, simulate
from tilestream.pipeline.jobs.simulation_record import Size
from tilestream.pipeline.stages import simulated
from tilestream.records import Scan
from tilestream.settings import LogOptions, StartSettings
from tilestream.simulation.city import City, build_city
from tilestream.simulation.drive import motion_of, scans, traffic_of
from tilestream.simulation.settings import (
    CitySettings,
    SimulationSettings,
    SurveySettings,
    TrafficSettings,
    load_preset,
)
from tilestream.simulation.survey import survey

A, B = 70, 30
"""Sample points of the driven street and of the one that is only mapped."""
RECORDS = ("simulation.yaml", "routes.geojson")
SIMULATE = (
    "import sys; from tilestream.pipeline.jobs.simulate import simulate; "
    "from tilestream.simulation.settings import SimulationSettings; "
    "simulate(SimulationSettings.model_validate_json(sys.argv[1]), sys.argv[2])"
)
"""Simulates the settings of the first argument into the folder of the second."""


def block(x: float, y: float, width: float, depth: float, height: float) -> dict[str, Any]:
    ring = [[x, y], [x + width, y], [x + width, y + depth], [x, y + depth], [x, y]]
    return {
        "type": "Feature",
        "properties": {"height": height},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }


def street(
    name: str, x: float, y: float, points: int, driven: bool, spots: list[Any]
) -> dict[str, Any]:
    line = [[x + i, y] for i in range(points)]
    return {
        "type": "Feature",
        "properties": {"name": name, "kind": "tiny", "driven": driven, "spots": spots},
        "geometry": {"type": "LineString", "coordinates": line},
    }


def collection(path: Path, features: list[dict[str, Any]]) -> str:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(path)


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> SimulationSettings:
    """Two rows of houses along a street of 14 m, trees on one side, a side street."""
    folder = tmp_path_factory.mktemp("tiny")
    rows = [(25.0 * i, y, 20.0, 18.0, 6.0 + 4 * i) for i in range(5) for y in (-18.0, 14.0)]
    houses = collection(folder / "houses.geojson", [block(*row) for row in rows])
    spots = [{"kind": "one-sided", "begin": 5, "end": 60, "side": "left"}]
    routes = collection(
        folder / "routes.geojson",
        [street("A", 20.0, 6.0, A, True, spots), street("Abcd2", 20.0, 8.0, B, False, [])],
    )
    return SimulationSettings(
        preset="tiny",
        note="for tests",
        city=CitySettings(footprints=houses, routes=routes),
        survey=SurveySettings(rays_per_m=1500),
        traffic=TrafficSettings(cars_per_100m=6.0, people_per_100m=12.0),
    )


@pytest.fixture(scope="module")
def city(settings: SimulationSettings) -> City:
    return build_city(settings)


@pytest.fixture(scope="module")
def made(settings: SimulationSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(settings, tmp_path_factory.mktemp("made") / "sim")


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def changed(settings: SimulationSettings, part: str, **values: object) -> SimulationSettings:
    known = getattr(settings, part)
    return settings.model_copy(update={part: known.model_copy(update=values)})


# --- Sameness


def test_a_simulation_leaves_map_logs_and_records_and_nothing_else(made: Path) -> None:
    surveys = [f"survey/A_{way}_{at:05d}.laz" for way in (0, 1) for at in (0, 50)]
    surveys += [f"survey/Abcd2_{way}_00000.laz" for way in (0, 1)]
    assert sorted(files(made)) == sorted([*surveys, "logs/drive0/A.mcap", *RECORDS])


@pytest.mark.slow
def test_two_dask_workers_write_the_same_bytes(
    settings: SimulationSettings, made: Path, tmp_path: Path, workers: distributed.Client
) -> None:
    there = simulate(settings, tmp_path / "dask", client=workers)
    assert files(there) == files(made)


def test_a_killed_run_goes_on_to_the_same_bytes(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    call = (
        "from tilestream.pipeline.jobs.simulate import simulate; "
        "from tilestream.simulation.settings import SimulationSettings; "
        "settings = SimulationSettings.model_validate_json(sys.argv[1]); "
        "simulate(settings, sys.argv[2], watch=watch)"
    )
    killed_after(1, "scan", call, settings.model_dump_json(), str(out))
    before = files(out)
    assert before.keys() != files(made).keys()
    simulate(settings, out)
    assert files(out) == files(made)


def test_where_open3d_cannot_be_imported_the_same_bytes_are_written(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    pytest.importorskip("embreex", reason="no wheel of embreex here: Open3D casts the rays")
    code = f"import sys; sys.modules['open3d'] = None; {SIMULATE}"
    arguments = (settings.model_dump_json(), str(tmp_path / "sim"))
    subprocess.run([sys.executable, "-c", code, *arguments], check=True)
    assert files(tmp_path / "sim") == files(made)


def test_another_drive_adds_its_log_and_leaves_the_rest(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "two"
    shutil.copytree(made, folder)
    written = {path: path.stat().st_mtime_ns for path in folder.rglob("*.*") if path.is_file()}
    simulate(settings.model_copy(update={"drive": 1}), folder)
    assert written == {path: path.stat().st_mtime_ns for path in written}
    after = files(folder)
    second = after.pop("logs/drive1/A.mcap")
    assert after == files(made)
    assert second != after["logs/drive0/A.mcap"]


# --- Every phenomenon has a stream of its own


def scan_of(city: City, settings: SimulationSettings, point: int = 30) -> Scan:
    other = replace(city, settings=settings)
    return next(iter(scans(other, city.street("A"), range(point, point + 1))))


def by_ray(scan: Scan) -> dict[tuple[int, float], np.ndarray]:
    assert scan.ring is not None
    assert scan.time_offset is not None
    keys = zip(scan.ring.tolist(), scan.time_offset.tolist(), strict=True)
    return dict(zip(keys, scan.points, strict=True))


@pytest.mark.parametrize(
    ("part", "value", "others"),
    [
        ("vegetation", 0.0, ("lamp", "bollard", "rail", "sign", "parking")),
        ("furniture", 0.0, ("tree", "hedge", "parking")),
        ("relief", 0.0, ("lamp", "bollard", "rail", "sign", "tree", "hedge", "parking")),
    ],
)
def test_what_is_left_out_of_a_street_moves_nothing_else(
    city: City, settings: SimulationSettings, part: str, value: float, others: tuple[str, ...]
) -> None:
    without = build_city(changed(settings, "city", **{part: value}))
    assert sum(len(city.furnished.kinds[kind].xy) for kind in others) > 5
    for kind in others:
        for field in ("xy", "yaw", "size"):
            here, there = (getattr(c.furnished.kinds[kind], field) for c in (city, without))
            np.testing.assert_array_equal(here, there, err_msg=kind)


def test_cars_and_people_move_on_their_own(city: City, settings: SimulationSettings) -> None:
    whole = traffic_of(city.street("A"), settings, 1)
    no_cars = traffic_of(city.street("A"), changed(settings, "traffic", cars_per_100m=0.0), 1)
    no_people = traffic_of(city.street("A"), changed(settings, "traffic", people_per_100m=0.0), 1)
    assert len(whole.cars) > 5
    assert (len(no_cars.cars), len(no_people.people)) == (0, 0)
    np.testing.assert_array_equal(no_cars.people, whole.people)
    np.testing.assert_array_equal(no_people.cars, whole.cars)
    other = traffic_of(city.street("Abcd2"), settings, 1)
    assert not np.isin(other.cars[:, 3], whole.cars[:, 3]).any()


def test_without_moving_things_the_other_rays_are_the_same(
    city: City, settings: SimulationSettings
) -> None:
    empty = changed(settings, "traffic", cars_per_100m=0.0, people_per_100m=0.0)
    busy_rays, empty_rays = by_ray(scan_of(city, settings)), by_ray(scan_of(city, empty))
    both = busy_rays.keys() & empty_rays.keys()
    reach = [
        (np.linalg.norm(busy_rays[key]), np.linalg.norm(empty_rays[key]))
        for key in both
        if not np.array_equal(busy_rays[key], empty_rays[key])
    ]
    assert 0 < len(reach) < 0.5 * len(both)
    assert all(near < far for near, far in reach)  # what differs is hidden by something nearer


def test_the_blind_sector_takes_rays_and_leaves_the_others(
    city: City, settings: SimulationSettings
) -> None:
    half = by_ray(scan_of(city, changed(settings, "lidar", blind_deg=180.0)))
    full = by_ray(scan_of(city, changed(settings, "lidar", blind_deg=0.0)))
    assert 0.3 * len(full) < len(half) < 0.8 * len(full)
    assert half.keys() <= full.keys()
    for key, point in half.items():
        np.testing.assert_array_equal(point, full[key])


@pytest.mark.parametrize("knob", [{"beam_bias": 0.0}, {"quantum": 0.0}, {"range_max": 40.0}])
def test_how_ranges_are_measured_does_not_change_which_rays_return(
    city: City, settings: SimulationSettings, knob: dict[str, float]
) -> None:
    usual, other = (scan_of(city, s) for s in (settings, changed(settings, "lidar", **knob)))
    if "range_max" in knob:
        assert by_ray(other).keys() < by_ray(usual).keys()
        assert np.linalg.norm(other.points, axis=1).max() < 40.1
    else:
        assert by_ray(other).keys() == by_ray(usual).keys()
        assert np.abs(other.points - usual.points).max() < 0.06


def test_drift_shifts_the_points_of_a_place_and_draws_no_others(
    city: City, settings: SimulationSettings
) -> None:
    still = replace(city, settings=changed(settings, "survey", drift=0.0))
    for at in (5, 40):
        drifted = survey(city, city.street("A"), (at, at + 1), 0)
        shift = drifted - survey(still, city.street("A"), (at, at + 1), 0)
        assert len(shift) > 500
        assert np.abs(shift).max() > 0.002
        assert np.ptp(shift, axis=0).max() < 0.0011  # one millimetre of rounding


# --- Fewer scans, and the survey of another simulation


def test_every_third_point_gives_the_same_scans_where_it_is_scanned(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    """But for single rays whose range is on the edge of two steps: the stretch from 50 on begins
    between two scans, so its scene has another origin.
    """
    few = simulate(settings, tmp_path / "few", every=3, survey_of=made)
    one, other = (open_log(folder / "logs/drive0/A.mcap") for folder in (made, few))
    assert len(one) == A
    assert other.stamps_ns.tolist() == one.stamps_ns[::3].tolist()
    scans = zip(one.scans_at(range(0, A, 3)), other.scans_at(range(len(other))), strict=True)
    for a, b in scans:
        assert abs(len(a.points) - len(b.points)) < 0.002 * len(a.points)
        away, _ = cKDTree(a.points).query(b.points)
        assert (away > 1e-4).mean() < 0.002
    assert not list((few / "survey").iterdir())


def test_more_metres_between_scans_than_a_stretch_has(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    few = simulate(settings, tmp_path / "few", every=60, survey_of=made)
    assert len(open_log(few / "logs/drive0/A.mcap")) == 2


def test_another_lidar_drives_in_the_survey_of_the_first(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    before = files(made)
    lidar = {"sensor": ts.VLP16.with_beams(4), "range_max": 20.0}
    other = changed(settings, "lidar", **lidar)
    lesser = simulate(other, tmp_path / "lesser", every=10, survey_of=made)
    scan = next(iter(open_log(lesser / "logs/drive0/A.mcap").scans_at([0])))
    assert len(np.unique(scan.ring)) <= 4
    assert np.linalg.norm(scan.points, axis=1).max() < 20.5
    assert files(made) == before


def test_a_survey_of_another_city_or_of_half_of_it_is_refused(
    settings: SimulationSettings, made: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="no simulation is there"):
        simulate(settings, tmp_path / "a", survey_of=tmp_path)
    with pytest.raises(UsageError, match="another city, with seed 0"):
        simulate(settings.model_copy(update={"seed": 1}), tmp_path / "a", survey_of=made)
    thin = changed(settings, "survey", rays_per_m=1000)
    with pytest.raises(UsageError, match="another city, with survey"):
        simulate(thin, tmp_path / "a", survey_of=made)
    half = tmp_path / "half"
    shutil.copytree(made, half)
    (half / "survey" / "A_1_00050.laz").unlink()
    with pytest.raises(UsageError, match=r"1 of 6 blocks.*A-1-50"):
        simulate(settings, tmp_path / "a", survey_of=half)
    assert not (tmp_path / "a").exists()


# --- The plan


def test_the_plan_is_made_without_building_or_writing_anything(
    settings: SimulationSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a plan builds no city")

    monkeypatch.setattr(simulated, "build_city", never)
    plan = plan_simulation(settings, tmp_path / "out")
    stages = {stage: (count, bytes_) for stage, count, bytes_ in plan.describe()}
    assert {stage: count for stage, (count, _) in stages.items()} == {
        "survey": 6,
        "scan": 2,
        "log": 1,
    }
    assert all(bytes_ > BASE_BYTES for _, bytes_ in stages.values())
    assert sum(task.work for task in plan.tasks if task.stage == "survey") == 2 * (A + B)
    dense = changed(settings, "survey", rays_per_m=10**6)
    assert plan_simulation(dense, "out").promised_bytes > plan.promised_bytes + 10**9
    assert not (tmp_path / "out").exists()
    small = plan_simulation(settings, tmp_path / "out", paths=["A"], size="small")
    assert [task.work for task in small.tasks] == [40] * 4


@pytest.mark.parametrize("count", [0, 65])
def test_turns_per_point_are_bounded(settings: SimulationSettings, count: int) -> None:
    with pytest.raises(UsageError, match="give 1 to 64"):
        plan_simulation(settings, "out", scans_per_point=count)


def test_every_is_a_count(settings: SimulationSettings) -> None:
    with pytest.raises(UsageError, match="give 1 or more"):
        plan_simulation(settings, "out", every=0)


# --- Refusals


@pytest.mark.parametrize(
    ("other", "options", "named"),
    [
        ({}, {"scans_per_point": 2}, "scans_per_point 1"),
        ({}, {"size": "small"}, "size full"),
        ({"seed": 1}, {}, "settings"),
        ({"odometry_error": 0.1}, {}, "odometry_error"),
    ],
)
def test_two_simulations_are_never_mixed(
    settings: SimulationSettings,
    made: Path,
    other: dict[str, Any],
    options: dict[str, Any],
    named: str,
) -> None:
    before = files(made)
    with pytest.raises(UsageError, match=f"holds another simulation.*{named}"):
        simulate(settings.model_copy(update=other), made, **options)
    assert files(made) == before


def test_an_edited_city_is_another_simulation(settings: SimulationSettings, tmp_path: Path) -> None:
    routes = tmp_path / "routes.geojson"
    shutil.copy(settings.city.routes, routes)
    moved = changed(settings, "city", routes=str(routes))
    simulate(moved, tmp_path / "sim", paths=["Abcd2"])
    collection(routes, [street("Abcd2", 20.0, 8.5, B, False, [])])
    with pytest.raises(UsageError, match="inputs_sha256"):
        simulate(moved, tmp_path / "sim")


def test_a_note_is_no_setting(settings: SimulationSettings, made: Path) -> None:
    assert simulate(settings.model_copy(update={"note": "another"}), made) == made
    record = yaml.safe_load((made / "simulation.yaml").read_text())
    assert record["note"] == "another"
    assert record["scans_per_point"] == 1
    assert record["settings"]["seed"] == 0
    simulate(settings, made)


def test_a_full_disk_is_said_before_anything_is_written(
    settings: SimulationSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9, 1000))
    with pytest.raises(PlanError, match="are free"):
        simulate(settings, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_driven_is_refused_and_nothing_is_written(
    settings: SimulationSettings, tmp_path: Path
) -> None:
    def routed(*streets: dict[str, Any]) -> SimulationSettings:
        path = collection(tmp_path / "routes.geojson", list(streets))
        return changed(settings, "city", routes=path)

    out = tmp_path / "out"
    with pytest.raises(UsageError, match=r"route X comes within .* of a building at \d+ m"):
        simulate(routed(street("X", 20.0, -4.0, 30, True, [])), out)
    spot = [{"kind": "volcano", "begin": 0, "end": 10}]
    with pytest.raises(UsageError, match="volcano"):
        simulate(routed(street("X", 20.0, 6.0, 30, True, spot)), out)
    with pytest.raises(UsageError, match="no street is called Z; there are A, Abcd2"):
        simulate(settings, out, paths=["Z"])
    assert not out.exists()


def test_unknown_sensors_and_their_fields_are_named(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    for lidar, named in (
        ({"sensor": "VLP32"}, "VLP32"),
        ({"sensor": {"name": "mine", "beams": 4}}, "beams"),
        ({"blind_deg": 360.0}, "blind_deg"),
    ):
        mine.write_text(yaml.safe_dump({"lidar": lidar}))
        with pytest.raises(UsageError, match=named):
            load_preset(str(mine))


# --- Read back as if it were recorded


def test_routes_are_read_by_their_names(made: Path, city: City) -> None:
    routes = ts.read_routes(made / "routes.geojson")
    assert [route.route_id for route in routes] == ["A", "Abcd2"]
    road = motion_of(city.street("A"), city.settings, 0.0).pose(
        city.ground, np.arange(A, dtype=float)
    )
    np.testing.assert_allclose(routes[0].positions, road[:, :3, 3], atol=1e-3)


def test_readers_take_the_true_poses_and_not_the_odometry(made: Path, city: City) -> None:
    log = made / "logs" / "drive0" / "A.mcap"
    found, believed = open_log(log), open_log(log, LogOptions(pose_topic="/odometry"))
    assert found.pose_topic == "/ground_truth"
    assert len(found) == A
    assert found.posed.all()
    assert believed.posed.all()
    motion = motion_of(city.street("A"), city.settings, city.settings.lidar.height)
    true = motion.pose(city.ground, np.arange(A, dtype=float))
    np.testing.assert_allclose(found.T_map_lidar, true, atol=1e-6)
    gap = np.linalg.norm(believed.T_map_lidar[:, :2, 3] - true[:, :2, 3], axis=1)
    assert 0.5 * city.settings.odometry_error < np.sqrt((gap**2).mean())
    assert np.sqrt((gap**2).mean()) < 2.0 * city.settings.odometry_error


@pytest.mark.parametrize(("size", "end"), [("full", A), ("small", 40)])
def test_a_drive_back_passes_the_same_places_on_its_right(
    settings: SimulationSettings, tmp_path: Path, size: Size, end: int
) -> None:
    back = changed(settings, "survey", passes=1).model_copy(update={"reverse": True, "side": 1.0})
    made = simulate(back, tmp_path / "back", paths=["A"], size=size)
    assert {path.stem[:4] for path in (made / "survey").iterdir()} == {"A_0_"}  # one way only
    log = open_log(made / "logs" / "drive0" / "A.mcap")
    places = log.T_map_lidar[:, :3, 3]
    np.testing.assert_allclose(places[:, 0], 20.0 + np.arange(end)[::-1], atol=1e-6)
    np.testing.assert_allclose(places[:, 1], 7.0, atol=1e-6)  # the street is at 6 m, along x
    np.testing.assert_allclose(log.T_map_lidar[:, 0, 0], -1.0, atol=1e-3)
    scan = next(iter(log.scans_at([end // 2])))
    assert scan.T_map_lidar is not None
    points = transform(scan.T_map_lidar, scan.points)
    for wall, inwards in ((0.0, -1.0), (14.0, 1.0)):
        deep = (points[:, 1] - wall) * inwards
        near = deep[np.abs(deep) < 1.0]
        assert len(near) > 500
        assert 0.0 < np.median(near) < settings.city.relief
    route, ahead = ts.read_routes(made / "routes.geojson")[0].positions, np.arange(end)
    np.testing.assert_allclose(route[:, :2], np.column_stack([20.0 + ahead, 6.0 + 0 * ahead]))


def test_the_command_makes_what_is_ingested_and_localized(
    settings: SimulationSettings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "tiny.yaml"
    preset.write_text(yaml.safe_dump(settings.model_dump(mode="json")))
    out = tmp_path / "sim"
    command = ["simulate", "shinjuku", "--preset", str(preset), "--out", str(out)]
    assert run([*command, "--size", "small", "--dry-run"]) == 0
    assert re.search(r"survey\s+4 .*scan\s+1 .*log\s+1 ", capsys.readouterr().out, re.DOTALL)
    assert not out.exists()
    assert run([*command, "--size", "small"]) == 0
    store = ts.ingest(str(out / "survey" / "*.laz"), tmp_path / "map.zarr")
    table = ts.localize(
        store,
        out / "logs" / "drive0" / "A.mcap",
        tmp_path / "labels",
        starts=StartSettings(radius=0.4, step=0.2),
        scans=ScanSelection(every=10),
    )
    assert list(table["status"]) == ["done"] * 4
    assert table["error_mean"].max() < 0.5
    assert table["true_pose"].eq("log").all()


@pytest.mark.slow
def test_the_shipped_city_is_simulated_whole_in_small(tmp_path: Path) -> None:
    out = tmp_path / "sim"
    command = ["simulate", "shinjuku", "--preset", "paper", "--out", str(out)]
    assert run([*command, "--size", "small", "--paths", "III"]) == 0
    assert len(open_log(out / "logs" / "drive0" / "III.mcap")) == 40
    record = yaml.safe_load((out / "simulation.yaml").read_text())
    assert "prove" in record["note"]
    assert "PLATEAU" in record["attribution"]
