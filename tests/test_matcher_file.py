"""The vehicle's matcher from Autoware's own files, and what is done to a scan before."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import streets
import yaml
from hypothesis import given
from hypothesis import strategies as st

import tilestream as ts
from tilestream.cli import run as command
from tilestream.errors import RegistrationError, UsageError
from tilestream.factors.hessian import hessian_factors
from tilestream.formats.routes import route_of
from tilestream.marks import canonical
from tilestream.matcher import CropSettings, RegistrationSettings
from tilestream.preprocessing import kept_of, preprocessed
from tilestream.sensor import Mount
from tilestream.settings import LabelSettings

NESTED: dict[str, Any] = {
    "frame": {"base_frame": "base_link", "ndt_base_frame": "ndt_base_link", "map_frame": "map"},
    "sensor_points": {"timeout_sec": 1.0, "required_distance": 12.0},
    "ndt": {
        "trans_epsilon": 0.02,
        "step_size": 0.2,
        "resolution": 3.0,
        "max_iterations": 25,
        "num_threads": 6,
        "regularization": {"enable": False, "scale_factor": 0.02},
    },
    "initial_pose_estimation": {"particles_num": 100, "n_startup_trials": 20},
    "validation": {"initial_pose_timeout_sec": 1.0, "skipping_publish_num": 4},
    "score_estimation": {
        "converged_param_type": 1,
        "no_ground_points": {"enable": True, "z_margin_for_ground_removal": 0.7},
    },
    "covariance": {"covariance_estimation": {"covariance_estimation_type": 2}},
    "dynamic_map_loading": {"update_distance": 15.0, "map_radius": 120.0, "lidar_radius": 90.0},
}
"""With numbers of its own; the names are Autoware's."""
FLAT: dict[str, Any] = {
    "use_dynamic_map_loading": True,
    "base_frame": "base_link",
    "input_sensor_points_queue_size": 1,
    "trans_epsilon": 0.02,
    "step_size": 0.2,
    "resolution": 3.0,
    "max_iterations": 25,
    "converged_param_type": 1,
    "neighborhood_search_method": 0,
    "num_threads": 6,
    "offset_array_x": [0.0, 0.5],
    "regularization_enabled": False,
    "dynamic_map_loading_map_radius": 120.0,
    "z_margin_for_ground_removal": 0.7,
}
"""The layout of before."""
BOX = {"min_x": -20.0, "max_x": 25.0, "min_y": -15.0, "max_y": 15.0, "min_z": -3.0, "max_z": 9.0}
WANTED = {"epsilon": 0.02, "step_max": 0.2, "iterations_max": 25}


def write(path: Path, parameters: dict[str, Any], node: str = "/**") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({node: {"ros__parameters": parameters}}))
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write(tmp_path / "config" / "ndt_scan_matcher.param.yaml", NESTED)


@pytest.fixture
def folder(file: Path) -> Path:
    below = file.parent / "pointcloud_preprocessor"
    frames = {"input_frame": "base_link", "output_frame": "base_link"}
    crop = {**BOX, **frames, "negative": False}
    write(below / "crop_box_filter_measurement_range.param.yaml", crop)
    edges = {f"voxel_size_{axis}": 1.5 for axis in "xyz"}
    write(below / "voxel_grid_filter.param.yaml", edges)
    write(below / "random_downsample_filter.param.yaml", {"sample_num": 700})
    return file.parent


@pytest.mark.parametrize("parameters", [NESTED, FLAT], ids=["nested", "flat"])
def test_a_file_is_a_matcher(parameters: dict[str, Any], tmp_path: Path) -> None:
    path = write(tmp_path / "a.yaml", parameters, "/localization/ndt_scan_matcher")
    found = LabelSettings(matcher=str(path)).registration
    distance = 12.0 if parameters is NESTED else 0.0
    wanted = RegistrationSettings.autoware(**WANTED, required_distance=distance)
    assert found.model_dump() == wanted.model_dump()
    assert found.resolution == 3.0
    (idle,) = [note for note in found.notes if "without effect here" in note]
    for key in ("num_threads", "map_radius", "converged_param_type", "z_margin_for_ground"):
        assert key in idle
    assert "resolution" not in idle


def test_keys_with_dots_are_the_same(tmp_path: Path) -> None:
    dotted = {"ndt.resolution": 3.0, "ndt.trans_epsilon": 0.02, "ndt": {"step_size": 0.2}}
    found = LabelSettings(matcher=str(write(tmp_path / "a.yaml", dotted))).registration
    assert (found.resolution, found.epsilon, found.step_max) == (3.0, 0.02, 0.2)
    assert found.iterations_max == 30
    assert any("says nothing of ndt.max_iterations" in note for note in found.notes)


@pytest.mark.parametrize(
    ("number", "neighbours"), [(0, "radius"), (2, "direct7"), (3, "direct1"), (1, None)]
)
def test_the_search_of_the_older_layout(
    number: int, neighbours: str | None, tmp_path: Path
) -> None:
    path = write(tmp_path / "a.yaml", {**FLAT, "neighborhood_search_method": number})
    if neighbours is None:
        with pytest.raises(UsageError, match="neighborhood_search_method 1 is not known here"):
            LabelSettings(matcher=str(path))
    else:
        assert LabelSettings(matcher=str(path)).registration.neighbours == neighbours


def changed(**changes: Any) -> dict[str, Any]:
    known = copy.deepcopy(NESTED)
    for name, value in changes.items():
        known["ndt"][name] = value
    return known


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (changed(resolutoin=3.0), "ndt.resolutoin is no parameter.*did you mean ndt.resolution"),
        ({**NESTED, "magic": 1}, "magic is no parameter that is known"),
        ({"sample_num": 3}, "has none of ndt.trans_epsilon"),
        (changed(step_size=-1.0), "step_max"),
        (changed(max_iterations="many"), "iterations_max"),
        (changed(resolution="$(var resolution)"), "which a launch file sets"),
        ({**NESTED, "ndt.resolution": 3.0}, "ndt.resolution is there twice"),
    ],
)
def test_what_is_not_known_is_named(parameters: Any, said: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.yaml", parameters)
    with pytest.raises(UsageError, match=said) as told:
        LabelSettings(matcher=str(path))
    assert str(path) in str(told.value)


@pytest.mark.parametrize("text", ["", "a: 1\n", "[1]\n", "a: {ros__parameters: {}}\nb: {}\n"])
def test_no_file_of_parameters(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(UsageError, match=r"a\.yaml: no parameters of one node"):
        LabelSettings(matcher=str(tmp_path / "a.yaml"))


def test_a_matcher_that_is_nowhere_is_refused() -> None:
    with pytest.raises(UsageError, match=r"magic: no such matcher or file.*autoware, default"):
        LabelSettings(matcher="magic")


def test_regularization_is_said(tmp_path: Path) -> None:
    path = write(tmp_path / "a.yaml", changed(regularization={"enable": True}))
    notes = LabelSettings(matcher=str(path)).registration.notes
    assert any("GNSS pose (regularization), which nothing here does" in note for note in notes)


def test_a_folder_brings_what_is_done_to_a_scan(folder: Path) -> None:
    found = LabelSettings(matcher=str(folder)).registration
    box = CropSettings(lowest=(-20.0, -15.0, -3.0), highest=(25.0, 15.0, 9.0))
    wanted = RegistrationSettings.autoware(
        **WANTED, required_distance=12.0, crop=box, scan_leaf=1.5, random_sample=700
    )
    assert found.model_dump() == wanted.model_dump()
    assert any("frame base_link" in note for note in found.notes)
    raised = LabelSettings(matcher={"file": str(folder), "mount": {"z": 1.9}}).registration
    assert raised.mount == Mount(z=1.9)
    assert raised.crop == box
    for name in ("voxel_grid_filter", "random_downsample_filter"):
        (folder / "pointcloud_preprocessor" / f"{name}.param.yaml").unlink()
    fewer = LabelSettings(matcher=str(folder)).registration
    assert (fewer.scan_leaf, fewer.random_sample) == (2.0, None)
    told = " ".join(fewer.notes)
    assert "thinned to scan_leaf, as it is set here" in told
    assert "all points of a thinned scan are used" in told
    assert "not cropped" not in told


def test_voxels_that_are_no_cubes_are_refused(folder: Path) -> None:
    below = folder / "pointcloud_preprocessor" / "voxel_grid_filter.param.yaml"
    write(below, {"voxel_size_x": 3.0, "voxel_size_y": 3.0, "voxel_size_z": 0.1})
    with pytest.raises(UsageError, match=r"voxel_size_z 0\.1: voxels here are cubes"):
        LabelSettings(matcher=str(folder))


def test_the_resolution_is_the_size_of_the_cells(file: Path, tmp_path: Path) -> None:
    def job(**more: Any) -> ts.RunSettings:
        job = {"out": "run", "map": {"sources": ["a.pcd"]}, "drives": [{"log": "a.mcap"}]}
        return ts.RunSettings(**(job | {"label": {"matcher": str(file)}} | more))

    assert job().cell_size == 3.0
    assert job(cell_size=3.0).cell_size == 3.0
    with pytest.raises(UsageError, match=r"cell_size 2\.0 and a matcher of 3\.0 m"):
        job(cell_size=2.0)
    assert job(label={"matcher": "autoware"}).cell_size == 2.0
    kept = job().model_dump(mode="json")
    again = ts.RunSettings(**kept)
    assert again.label.registration.model_dump() == job().label.registration.model_dump()
    assert again.cell_size == 3.0
    assert ts.RunSettings(**(kept | {"label": LabelSettings(matcher=str(file))})).cell_size == 3.0


def test_a_matcher_without_the_new_fields_has_the_identity_that_it_had() -> None:
    before = {
        "neighbours": "radius",
        "solver": "raw",
        "rotation": "euler",
        "covariance": "seeded",
        "step_max": 0.1,
        "epsilon": 0.01,
        "iterations_max": 30,
        "outlier_ratio": 0.55,
        "scan_leaf": 2.0,
    }
    assert canonical(RegistrationSettings.autoware()) == before
    assert canonical(RegistrationSettings.autoware(resolution=2.0)) == before
    sampled = canonical(RegistrationSettings.autoware(random_sample=100))
    assert sampled == before | {"random_sample": 100}
    assert (
        RegistrationSettings.autoware(random_sample=100).told == "autoware, but random_sample 100"
    )


SCAN = np.random.default_rng(3).uniform(-30.0, 30.0, (4000, 3))
NO_LEAF = {"scan_leaf": 0.0}


@pytest.mark.parametrize("negative", [False, True])
@pytest.mark.parametrize("mount", [Mount(), Mount(x=1.0, z=2.0, yaw_deg=90.0)])
def test_the_box_keeps_exactly_what_is_inside(negative: bool, mount: Mount) -> None:
    box = CropSettings(lowest=(-5.0, -10.0, -1.0), highest=(20.0, 10.0, 4.0), negative=negative)
    found = preprocessed(SCAN, RegistrationSettings(**NO_LEAF, crop=box, mount=mount))
    in_base = SCAN @ mount.T_base_lidar[:3, :3].T + mount.T_base_lidar[:3, 3]
    x, y, z = in_base.T
    inside = (x >= -5) & (x <= 20) & (y >= -10) & (y <= 10) & (z >= -1) & (z <= 4)
    wanted = SCAN[inside != negative]
    assert 30 < len(wanted) < 3970
    assert found.tolist() == sorted(wanted.tolist())


def test_the_faces_of_the_box_and_the_ends_of_the_range_are_inside() -> None:
    box = CropSettings(lowest=(0.0, 0.0, 0.0), highest=(1.0, 1.0, 1.0))
    corners = np.array([[0.0, 0, 0], [1, 1, 1], [1, 0, 1], [1.0 + 1e-9, 0, 0], [0, -1e-9, 0]])
    assert kept_of(corners, RegistrationSettings(crop=box)).tolist() == [True] * 3 + [False] * 2
    ranges = np.array([[1.0, 0, 0], [0.999, 0, 0], [0, 5.0, 0], [0, 0, 5.001]])
    limited = RegistrationSettings(range_min=1.0, range_max=5.0)
    assert kept_of(ranges, limited).tolist() == [True, False, True, False]
    assert kept_of(ranges, RegistrationSettings()) is None


@given(st.integers(0, 2**32), st.integers(10, 4000), st.integers(0, 2**63 - 1))
def test_a_sample_is_of_the_points_and_the_same_in_any_order(
    order: int, count: int, seed: int
) -> None:
    how = RegistrationSettings(**NO_LEAF, random_sample=count, random_seed=seed)
    found = preprocessed(SCAN, how)
    assert len(found) == count
    assert set(map(tuple, found)) <= set(map(tuple, SCAN))
    assert len(np.unique(found, axis=0)) == count
    shuffled = np.random.default_rng(order).permutation(SCAN)
    assert np.array_equal(preprocessed(shuffled, how), found)


def test_a_sample_is_spread_evenly_and_another_seed_takes_others() -> None:
    draws = [
        preprocessed(SCAN, RegistrationSettings(**NO_LEAF, random_sample=1000, random_seed=seed))
        for seed in range(40)
    ]
    times = np.zeros(len(SCAN))
    row = {tuple(point): number for number, point in enumerate(SCAN)}
    for draw in draws:
        times[[row[tuple(point)] for point in draw]] += 1
    assert times.mean() == 10.0
    # binomial: 40 draws of 1/4, variance 7.5
    assert 6.5 < times.var() < 8.5
    assert all(len({*map(tuple, draws[0])} & {*map(tuple, d)}) < 400 for d in draws[1:])


def test_the_steps_come_in_autowares_order() -> None:
    box = CropSettings(lowest=(-20.0, -20.0, -20.0), highest=(20.0, 20.0, 20.0))
    how = RegistrationSettings(crop=box, scan_leaf=3.0, random_sample=200)
    cropped = SCAN[(np.abs(SCAN) <= 20.0).all(axis=1)]
    voxels = preprocessed(cropped, RegistrationSettings(scan_leaf=3.0))
    found = preprocessed(SCAN, how)
    assert len(found) == 200
    assert set(map(tuple, found)) <= set(map(tuple, voxels))


def test_too_little_that_is_left_is_refused() -> None:
    nothing = CropSettings(lowest=(90.0, 90.0, 90.0), highest=(91.0, 91.0, 91.0))
    with pytest.raises(RegistrationError, match="0 of 4000 points in the crop box and range"):
        preprocessed(SCAN, RegistrationSettings(crop=nothing))
    near = SCAN / 10.0
    reach = float(np.linalg.norm(near, axis=1).max())
    with pytest.raises(RegistrationError, match=f"reaches {reach:.1f} m.*beyond 10 m"):
        preprocessed(near, RegistrationSettings(**NO_LEAF, required_distance=10.0))
    assert len(preprocessed(near, RegistrationSettings(**NO_LEAF, required_distance=reach))) == 4000
    with pytest.raises(UsageError, match="give lowest <= highest"):
        CropSettings(lowest=(1.0, 0.0, 0.0), highest=(0.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ts.TileStore]:
    folder = tmp_path_factory.mktemp("street")
    streets.write_inputs(folder)
    store = ts.ingest(folder / "map_canyon.pcd", folder / "map.zarr", tile_size=60.0)
    return folder, store


RECIPE = RegistrationSettings.autoware(
    crop=CropSettings(lowest=(-9.0, -9.0, -3.0), highest=(9.0, 9.0, 6.0)),
    scan_leaf=0.5,
    random_sample=150,
)


def test_real_and_virtual_scans_go_through_the_same_steps(
    street: tuple[Path, ts.TileStore], tmp_path: Path
) -> None:
    folder, store = street
    how = {"starts": ts.StartSettings(radius=0.2, step=0.2), "registration": RECIPE}
    log = folder / "canyon.mcap"
    few = {"scans": ts.ScanSelection(until_s=3.0)}
    labels = ts.localize(store, log, tmp_path / "a", **how, **few)
    assert (labels["status"] == "done").all()
    assert (labels["points"] == 150).all()
    split = ts.localize(store, log, tmp_path / "b", **how, **few, starts_per_task=2)
    assert labels.equals(split)
    route = route_of("r", np.array([[8.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    observed = ts.observe_along(
        store,
        [route],
        tmp_path / "c",
        registration=RECIPE,
        seeing=ts.VirtualSettings(starts=8, draws=2, worlds=1),
    )
    assert (observed["status"] == "done").all()
    assert (observed["ob_points"] == 150).all()


def test_the_hessian_is_of_the_points_that_are_registered(
    street: tuple[Path, ts.TileStore],
) -> None:
    _, store = street
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, 3] = 20.0, 0.0, 2.0
    scan = store.tile_at(20.0, 1.0).points() - T_map_lidar[:3, 3]
    cells = store.tile_at(20.0, 1.0).cells(2.0)
    whole = hessian_factors(cells, scan, T_map_lidar, RECIPE)
    by_hand = preprocessed(scan, RECIPE)
    bare = RegistrationSettings.autoware(scan_leaf=0.0)
    assert whole["ob_points"] == 150
    of_these = hessian_factors(cells, by_hand, T_map_lidar, bare)
    # the same points in another order, by x and not by voxel: sums round otherwise
    assert whole["ob_score"] == pytest.approx(of_these["ob_score"], rel=1e-6)
    assert whole["ob_nvtl"] == pytest.approx(of_these["ob_nvtl"], rel=1e-6)


def test_a_command_takes_the_file(
    street: tuple[Path, ts.TileStore],
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    inputs, store = street
    out = str(tmp_path / "run")
    line = ["localize", store.url, str(inputs / "canyon.mcap"), "--out", out, "--until-s", "1.5"]
    line += ["--radius", "0.2", "--matcher", str(folder), "--json"]
    assert command(line) == 0
    told = capsys.readouterr()
    assert "without effect here" in " ".join(told.err.split())
    assert json.loads(told.out)["matcher"].startswith("autoware, but step_max 0.2")
    assert store.tile_at(20.0, 1.0).mark("cells_3000").status == "done"
    assert command([*line, "--cell-size", "2.0"]) == 2
    assert "wants cells of 3 m" in " ".join(capsys.readouterr().err.split())
    assert command([*line, "--scan-leaf", "0.7", "--dry-run"]) == 0
    with pytest.raises(UsageError, match="give cell_size=3"):
        ts.localize(
            store, inputs / "canyon.mcap", out, registration=RegistrationSettings(resolution=3.0)
        )


def test_a_job_takes_the_folder(
    street: tuple[Path, ts.TileStore], folder: Path, tmp_path: Path
) -> None:
    inputs, _ = street
    (tmp_path / "r.csv").write_text("x,y\n10,0\n13,0\n")
    settings = ts.RunSettings(
        out=str(tmp_path / "run"),
        map={"sources": [str(inputs / "map_canyon.pcd")], "tile_size": 60.0},
        drives=[{"log": str(inputs / "canyon.mcap"), "until_s": 3.0}],
        routes=[str(tmp_path / "r.csv")],
        observe={"starts": 8, "draws": 2, "worlds": 1},
        label={"matcher": str(folder), "starts": {"radius": 0.2, "step": 0.2}},
        model={"recipe": "physics"},
    )
    ts.run(settings)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert any("without effect here" in note for note in record["notes"]["matcher"])
    report = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    matcher = report["facts"]["matcher"]
    assert (matcher["scan_leaf"], matcher["random_sample"]) == (1.5, 700)
    assert matcher["crop"]["highest"] == [25.0, 15.0, 9.0]
    store = ts.open_store(tmp_path / "run" / "map.zarr")
    assert len(store.keys("cells_3000")) == len(store.keys())
    assert not store.keys("cells_2000")
    done = [o.made for o in _outcomes(settings)]
    assert done
    assert not any(done)


def _outcomes(settings: ts.RunSettings) -> list[Any]:
    """What became of each task of a job that is run again."""
    found: list[Any] = []
    ts.run(settings, watch=lambda outcome, *_: found.append(outcome))
    return found
