"""The main job: from map and drives to estimates; nothing done twice, nothing mixed, all told."""

import hashlib
import html
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sklearn
import streets
import yaml
from chromium import TIPS, calm, chromium_page, opened, point_at
from report_json import charts, source
from streets import SCANS, STREETS, job

import tilestream as ts
from tilestream.apps.verbs import stage_rows
from tilestream.cli import run as command
from tilestream.cli.jobs import lost_labels, require_within
from tilestream.errors import (
    LimitError,
    ModelError,
    PartialError,
    SourceNotFoundError,
    UsageError,
)
from tilestream.factors.along_route import averaged_along
from tilestream.files import Files
from tilestream.model import evaluation, registry, training
from tilestream.model.dataset import TARGETS
from tilestream.model.file import load_model, save_model
from tilestream.model.intervals import coverage
from tilestream.model.prediction import predict
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.costs import calibration_file, core_hours, learn
from tilestream.pipeline.engine.outputs import TileArrays
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs import run_story
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run import dataset_of
from tilestream.pipeline.jobs.run_book import Book
from tilestream.pipeline.jobs.run_inputs import inputs_of
from tilestream.pipeline.jobs.run_making import check_model, making_of
from tilestream.pipeline.jobs.run_plan import plan_estimate, plan_measure
from tilestream.pipeline.jobs.run_settings import ModelSettings, RunSettings, read_settings
from tilestream.pipeline.stages import predict as predict_stage
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.terms import terms
from tilestream.report.evaluation import MODELS
from tilestream.settings import (
    CoarseSettings,
    DriveSettings,
    LabelSettings,
    MapSettings,
    ReportSettings,
    SimulateSettings,
    VirtualSettings,
)
from tilestream.simulation.settings import load_preset

PIPELINES = Path(__file__).resolve().parents[1] / "pipelines"


SEEING = {"range_max": 14.0, "starts": 8, "draws": 2, "worlds": 1}
"""Virtual drives of few scans and starts."""
LEARNT = ("samples", "evaluate", "importance", "train", "predict")
"""Stages after measuring."""


class Told:
    """What a run tells of its tasks."""

    def __init__(self) -> None:
        self.outcomes: list[Outcome] = []

    def __call__(self, outcome: Outcome, ended: int, total: int) -> None:
        assert 0 < ended <= total
        self.outcomes.append(outcome)

    def worked(self) -> set[str]:
        """Stages of which a task after measuring wrote something."""
        late = ("register", "label", "factors", *LEARNT)
        return {o.stage for o in self.outcomes if o.stage in late and o.made}


@pytest.fixture(scope="module", autouse=True)
def small_forests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with streets.small(tmp_path_factory.mktemp("cache")):
        yield


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    streets.write_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def done(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Told]:
    told = Told()
    folder = tmp_path_factory.mktemp("done") / "run"
    assert ts.run(job(inputs, folder), watch=told) == folder
    return folder, told


@pytest.fixture
def copy(done: tuple[Path, Told], tmp_path: Path) -> Path:
    """The run directory at its own place again, so that a test may change it."""
    kept = tmp_path / "kept"
    shutil.copytree(done[0], kept)
    yield done[0]
    shutil.rmtree(done[0])
    shutil.move(kept, done[0])


def hashes(folder: Path) -> dict[str, str]:
    """Of every table; the model is judged by its estimates, which are among them."""
    files = sorted((folder / "tables").rglob("*.parquet"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


# --- What a run directory holds


def test_every_sample_point_has_an_estimate_with_its_interval(done: tuple[Path, Told]) -> None:
    places = pd.read_parquet(done[0] / "report" / "places.parquet")
    assert len(places) == len(STREETS) * SCANS
    assert set(places["route_id"]) == set(STREETS)
    assert (places["status"] == "done").all()
    assert (places["low"] <= places["estimate"]).all()
    assert (places["estimate"] <= places["high"]).all()
    assert {column.name for column in PREDICTION_COLUMNS} <= set(places)


def test_the_dataset_is_the_join_of_factors_and_errors(done: tuple[Path, Told]) -> None:
    dataset = dataset_of(done[0])
    rows = dataset.rows
    assert len(rows) == len(STREETS) * SCANS
    assert dataset.losses == {}
    errors = pd.concat(
        pd.read_parquet(path).assign(group=path.parent.name)
        for path in (done[0] / "tables" / "errors").rglob("*.parquet")
    ).reset_index(drop=True)
    for row in rows.itertuples():
        near = errors[errors["group"] == row.group]
        nearest = ((near["x"] - row.x) ** 2 + (near["y"] - row.y) ** 2).idxmin()
        assert row.error_mean == near.loc[nearest, "error_mean"]
    assert len(errors) == len(rows)
    assert dataset.made_with["sensor"]["name"] == "VLP16"
    assert set(dataset.data_sets) == set(STREETS)


def test_the_run_tells_what_it_did(done: tuple[Path, Told]) -> None:
    told = json.loads((done[0] / "run.json").read_text())
    assert told["state"] == "done"
    assert told["failures"] == {}
    assert told["labelled"] == len(STREETS) * SCANS
    stages = told["stages"]
    assert stages["register"]["work"] == len(STREETS) * SCANS
    assert stages["predict"]["work"] == len(STREETS) * SCANS
    assert stages["train"] | {"core_seconds": 0} == {
        "tasks": 1,
        "failed": 0,
        "work": 1,
        "made": 1,
        "core_seconds": 0,
    }
    assert "above the ground of the map" not in str(told["notes"])
    effective = yaml.safe_load((done[0] / "config.yaml").read_text())
    assert RunSettings(**effective) == RunSettings(**effective | {"spacing": 1.0})
    assert effective["label"]["starts"]["radius"] == 0.4


def test_the_page_says_what_makes_the_same_figures_again(done: tuple[Path, Told]) -> None:
    facts = json.loads((done[0] / "report" / "report.json").read_text())["facts"]
    assert facts["python"] == platform.python_version()
    assert facts["numpy"] == np.__version__
    assert facts["scikit-learn"] == sklearn.__version__
    assert facts["cores"] == os.cpu_count()
    assert facts["wall time, all calls [s]"] > 0.0
    model = facts["model"]
    assert (model["from"], model["recipe"], model["trees"]) == ("trained here", "forest", 4)
    assert (model["seed"], model["points"]) == (0, len(STREETS) * SCANS)
    effective = yaml.safe_load((done[0] / "config.yaml").read_text())
    assert facts["settings"] | {"out": str(done[0]), "drives": effective["drives"]} == effective
    assert list(facts["drives"]) == sorted(STREETS, key=list(STREETS).index)
    page = (done[0] / "report" / "index.html").read_text()
    assert '<th scope="row">label.starts.radius</th><td>0.4</td>' in page


def test_the_evaluation_has_every_protocol_and_opponent(done: tuple[Path, Told]) -> None:
    found = json.loads((done[0] / "tables" / "evaluation.json").read_text())
    protocols = pd.DataFrame(found["protocols"])
    judged = protocols[protocols["reason"] == ""]
    assert set(judged["model"]) == set(registry.COMPETITORS) - set(registry.OF_VIRTUAL_DRIVES)
    assert {"paper", "path"} <= set(judged["protocol"])
    assert set(protocols["protocol"]) == {"paper", "path", "blocks"}
    blocks = protocols[protocols["protocol"] == "blocks"]
    assert set(blocks["model"]) == set(judged["model"])
    assert (blocks["reason"] != "").all() or np.isfinite(blocks["mae"]).all()
    for row in judged.itertuples():
        assert 0.0 <= row.mae <= row.rmse
    sets = set(pd.DataFrame(found["table_iv"])["factors"])
    assert sets == {"FS", "FS+RQ", "FS+RQ+LY", "FS+RQ+LY+LS", "all + robust"}
    parts = pd.DataFrame(found["parts"])
    assert set(parts["target"]) == set(TARGETS) - {"error_mean"}
    assert set(parts["model"]) == {"forest", "training median"}
    on_paths = parts[parts["protocol"] == "path"].set_index("target")
    assert on_paths.loc["error_tail", "reason"].str.contains("nothing to learn").all()
    assert (on_paths.drop("error_tail")["mae"] >= 0.0).all()  # all starts here are within 1 m
    assert found["ceilings"] == {}


def test_held_out_estimates_stand_beside_the_labels(done: tuple[Path, Told]) -> None:
    report = json.loads((done[0] / "report" / "report.json").read_text())
    assert {path["path"] for path in report["paths"]} == set(STREETS)
    held = pd.read_parquet(done[0] / "tables" / "judged" / "error_mean-forest-all.parquet")
    part = held[held["protocol"] == "path"]
    assert len(part) == len(STREETS) * SCANS
    for fold, rows in part.groupby("fold"):
        assert fold == f"path {rows['path'].iloc[0]}"
        assert set(rows["path"]) == {fold.removeprefix("path ")}


def test_tiles_do_not_wait_for_each_other(done: tuple[Path, Told]) -> None:
    order = [outcome.key for outcome in done[1].outcomes]
    merges = [n for n, key in enumerate(order) if key.startswith("merge-")]
    cells = [n for n, key in enumerate(order) if key.startswith("cells-")]
    assert merges
    assert cells
    # One process runs them in the order of the plan; what counts is that nothing but its own tile
    # stands between a cells task and its start.
    tasks = {key: n for n, key in enumerate(order)}
    for key in order:
        if key.startswith("cells-"):
            tile = key.split("-", 2)[2]
            assert tasks[f"merge-{tile}"] < tasks[key]


# --- Again


def test_a_second_run_redoes_nothing(inputs: Path, copy: Path) -> None:
    before, told = hashes(copy), Told()
    cost = json.loads((copy / "run.json").read_text())
    ts.run(job(inputs, copy), watch=told)
    assert told.worked() == set()
    assert hashes(copy) == before
    again = json.loads((copy / "run.json").read_text())
    assert again["calls"] == cost["calls"] + 1
    assert again["seconds_of_all_calls"] >= cost["seconds_of_all_calls"] + again["seconds"] - 0.2
    assert set(again["stages"]) == set(cost["stages"])
    for stage, row in cost["stages"].items():
        assert again["stages"][stage]["core_seconds"] >= row["core_seconds"] > 0.0, stage
    assert again["stages"]["merge"]["tasks"] == 0  # the map is there
    assert again["stages"]["register"]["tasks"] == cost["stages"]["register"]["tasks"]


@pytest.mark.slow
def test_another_seed_redoes_the_models_only(inputs: Path, copy: Path) -> None:
    told = Told()
    ts.run(job(inputs, copy, model={"recipe": "forest", "seed": 7}), watch=told)
    assert told.worked() == set(LEARNT) - {"samples"}


@pytest.mark.slow
def test_another_matcher_redoes_the_labels_and_what_is_learnt(inputs: Path, copy: Path) -> None:
    told = Told()
    label = {"matcher": "autoware", "starts": {"radius": 0.4, "step": 0.2}}
    ts.run(job(inputs, copy, label=label), watch=told)
    assert told.worked() == {"register", "label", *LEARNT}
    assert dataset_of(copy).data_sets["canyon"]["registration"]["solver"] == "raw"


@pytest.mark.slow
def test_a_drive_that_is_left_out_leaves_nothing_behind(inputs: Path, copy: Path) -> None:
    drives = [{"log": str(inputs / f"{kind}.mcap")} for kind in ("canyon", "tunnel")]
    ts.run(job(inputs, copy, drives=drives))
    table = ts.dataset(copy)
    assert set(table["group"]) == {"canyon", "tunnel"}
    pd.testing.assert_frame_equal(table, dataset_of(copy).rows)
    assert table.attrs["features"] == dataset_of(copy).names
    for kind in ("errors", "starts", "drives"):
        assert {p.name for p in (copy / "tables" / kind).iterdir()} == {"canyon", "tunnel"}
    places = pd.read_parquet(copy / "report" / "places.parquet")
    assert set(places["route_id"]) == {"canyon", "tunnel"}


def test_a_changed_block_redoes_what_sees_it(
    inputs: Path, done: tuple[Path, Told], tmp_path: Path
) -> None:
    changed = tmp_path / "changed"
    shutil.copytree(inputs, changed)
    settings = job(changed, tmp_path / "run", model={"use": str(done[0] / "model.skops")})
    ts.run(settings)
    streets.write_pcd(changed / "map_tunnel.pcd", streets.street("tunnel", 2, 0.3))
    told = Told()
    ts.run(settings, watch=told)
    redone = {o.key.split("-")[1] for o in told.outcomes if o.stage == "register" and o.made}
    assert redone == {"tunnel"}
    tiles = {
        int(o.key.split("-", 1)[1].split("_")[0])
        for o in told.outcomes
        if o.stage == "factors" and o.made
    }
    assert tiles
    assert tiles <= {7, 8, 9}  # the tunnel begins at x = 400 m; tiles are 50 m wide


# --- What fails


def test_a_task_that_fails_keeps_nothing_else_from_its_end(
    inputs: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = predict_stage.predicted

    def failing(model: training.Model, factors: pd.DataFrame, made: object) -> pd.DataFrame:
        if (factors["route_id"] == "tunnel").any():
            raise ModelError("cannot be estimated here")
        return plain(model, factors, made)

    monkeypatch.setattr(predict_stage, "predicted", failing)
    with pytest.raises(PartialError, match="cannot be estimated here"):
        ts.run(job(inputs, copy, model={"seed": 3, "recipe": "paper"}))
    told = json.loads((copy / "run.json").read_text())
    assert told["state"] == "failed"
    assert all(key.startswith("predict-") for key in told["failures"])
    places = pd.read_parquet(copy / "report" / "places.parquet").set_index("route_id")
    assert places.loc["tunnel", "estimate"].isna().all()
    assert places.loc["tunnel", "reason"].str.contains("task failed").all()
    assert places.loc[["canyon", "crossing"], "estimate"].notna().all()
    the_recipe_in_use_is_evaluated(copy, "paper")


def the_recipe_in_use_is_evaluated(folder: Path, recipe: str) -> None:
    """Held-out lines, intervals, parts and the verdict are of the model that made the estimates."""
    report = json.loads((folder / "report" / "report.json").read_text())
    assert report["model"] == recipe
    assert {row["model"] for row in report["parts"]} == {recipe, "training median"}
    judged = pd.read_parquet(folder / "tables" / "judged" / f"error_mean-{recipe}-all.parquet")
    judged = judged[judged["protocol"] == "path"]
    for path in report["paths"]:
        here = judged[judged["path"] == path["path"]]
        assert path["mae"] == pytest.approx((here["actual"] - here["estimate"]).abs().mean())
    expected = coverage(judged).set_index("path")["width"]
    widths = {row["path"]: row["width"] for row in report["coverage"]}
    assert widths == pytest.approx(expected.to_dict(), nan_ok=True)
    page = html.unescape((folder / "report" / "index.html").read_text())
    assert re.search(rf"The model of these estimates \([\d.]+.cm, {MODELS[recipe]}\)", page)


def test_too_few_places_are_no_model(inputs: Path, tmp_path: Path) -> None:
    drives = [{"log": str(inputs / "canyon.mcap")}]
    with pytest.raises(PartialError, match=r"26 labelled points, and a model needs 50"):
        ts.run(job(inputs, tmp_path / "run", drives=drives))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert "train-model" in told["failures"]
    text = html.unescape((tmp_path / "run" / "report" / "index.html").read_text())
    page = " ".join(text.split())
    assert "no estimate" in page
    # What was measured is shown all the same.
    assert "26 labels of one drive" in page
    assert "no model was trained without this path, so there is no estimate to show" in page
    report = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    assert report["headline"]["labelled"] == 26
    assert (report["paths"][0]["judged"], report["paths"][0]["mae"]) == (0, None)


# --- A model that is there


def test_a_model_is_applied_to_another_map(
    inputs: Path, done: tuple[Path, Told], tmp_path: Path
) -> None:
    use = {"use": str(done[0] / "model.skops")}
    told = Told()
    routes = [str(inputs / "canyon.mcap")]
    settings = job(inputs, tmp_path / "run", model=use, drives=[], routes=routes)
    ts.run(settings, watch=told)
    assert not {o.stage for o in told.outcomes} & {"register", "samples", "train", "evaluate"}
    here = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet")
    there = pd.read_parquet(done[0] / "report" / "places.parquet")
    there = there[there["route_id"] == "canyon"].reset_index(drop=True)
    pd.testing.assert_series_equal(here["estimate"], there["estimate"], check_exact=True)


@pytest.fixture
def elsewhere(inputs: Path, done: tuple[Path, Told], tmp_path: Path) -> dict[str, object]:
    """A job that uses the model of `done`, which it may do."""
    routes = [str(inputs / "canyon.mcap")]
    return {"drives": [], "routes": routes, "model": {"use": str(done[0] / "model.skops")}}


def refused(settings: RunSettings, error: type[Exception], said: str) -> None:
    """The job is refused by `run` and by `plan`, and nothing is begun."""
    told = Told()
    with pytest.raises(error, match=said):
        ts.run(settings, watch=told)
    with pytest.raises(error, match=said):
        forecast(settings)
    assert told.outcomes == []
    assert not settings.folder.there()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sensor": "OS1_128"}, r"sensor does not match in .*name.*VLP16.*OS1_128"),
        ({"cell_size": 1.0}, r"cell_size does not match: .* 2\.0, .* 1\.0"),
        ({"sensor_height": 2.5}, r"sensor_height does not match: .* 2\.0, .* 2\.5"),
        ({"map_leaf": 0.1}, r"map_leaf does not match: .* 0\.2, .* 0\.1"),
        ({"observe": {"range_max": 20.0}}, r"seeing does not match in range_max: .* 14\.0.* 20\.0"),
        ({"label": {"matcher": "autoware"}}, r"matcher does not match in .*solver"),
        ({"observe": None}, "needs the virtual drive: give observe in the config"),
    ],
)
def test_a_model_of_another_making_is_refused_by_name(
    inputs: Path,
    elsewhere: dict[str, object],
    tmp_path: Path,
    changes: dict[str, object],
    said: str,
) -> None:
    seen = {"observe": {"range_max": 14.0}, "label": {"matcher": "default"}}
    fitting = job(inputs, tmp_path / "run", **(elsewhere | seen))
    path = tmp_path / "seeing.skops"
    made = load_model(fitting.model.use)
    save_model(replace(made, made_with=json.loads(json.dumps(making_of(fitting)))), path)
    elsewhere |= seen | {"model": {"use": str(path)}}
    check_model(job(inputs, tmp_path / "run", **elsewhere))
    if "map_leaf" in changes:
        sources = {"sources": [str(inputs / "map_*.pcd")], "tile_size": 50.0}
        changes = {"map": sources | changes}
    refused(job(inputs, tmp_path / "run", **(elsewhere | changes)), ModelError, f"{path}: .*{said}")


def test_a_model_without_the_virtual_drive_says_so(
    inputs: Path, elsewhere: dict[str, object], tmp_path: Path
) -> None:
    settings = job(inputs, tmp_path / "run", **elsewhere, observe={})
    refused(settings, ModelError, r"without the virtual drive: give observe: null")


def test_an_old_a_foreign_and_a_missing_model_are_refused_before_anything_runs(
    inputs: Path, elsewhere: dict[str, object], tmp_path: Path
) -> None:
    path = tmp_path / "other.skops"
    settings = job(inputs, tmp_path / "run", **(elsewhere | {"model": {"use": str(path)}}))
    refused(settings, SourceNotFoundError, rf"{path}: no such model file; see model\.use")
    path.write_bytes(b"\x80\x04K\x01.")
    refused(settings, ModelError, rf"^{path}: no model file of tilestream")
    made = load_model(str(elsewhere["model"]["use"]))
    old = {k: v for k, v in made.made_with.items() if k not in ("map_leaf", "sensor_height")}
    save_model(replace(made, made_with=old), path)
    refused(settings, ModelError, "does not say for which map_leaf and sensor_height .*train it ag")


def test_the_thinning_of_a_map_that_is_there_counts(
    done: tuple[Path, Told], elsewhere: dict[str, object], tmp_path: Path
) -> None:
    store = {"store": str(done[0] / "map.zarr"), "map_leaf": 0.7}
    settings = RunSettings(out=str(tmp_path / "run"), observe=None, map=store, **elsewhere)
    assert making_of(settings)["map_leaf"] == 0.2  # as the store has it
    check_model(settings)


# --- The virtual drive


def test_observability_joins_the_factors(inputs: Path, copy: Path) -> None:
    told = Told()
    model = {"recipe": "corrected"}
    ts.run(job(inputs, copy, observe=SEEING, model=model), watch=told)
    assert {"surfels", "observe"} <= {outcome.stage for outcome in told.outcomes}
    assert told.worked() == set(LEARNT)
    dataset = dataset_of(copy)
    assert len(dataset) == len(STREETS) * SCANS
    assert {"vd_mean", "ob_info_along", "feature_count"} <= set(dataset.names)
    found = json.loads((copy / "tables" / "evaluation.json").read_text())
    rows = [r for r in found["table_iv"] if (r["model"], r["protocol"]) == ("paper", "path")]
    assert [row["factors"] for row in rows] == list(evaluation.factor_sets(dataset.columns))
    assert rows[-1]["factors"] == "all + robust + observability"
    weights = pd.read_parquet(copy / "tables" / "judged" / "weights.parquet")
    own = weights[weights["factor"] != ""].groupby("model")["factor"].agg(list)
    assert own["used"] == list(load_model(copy / "model.skops").factors)
    assert own["paper"] == [c.name for c in dataset.columns if c.factor_set == "faithful"]
    assert "physics" in {row["model"] for row in found["protocols"]}
    report = json.loads((copy / "report" / "report.json").read_text())
    assert report["model"] == "corrected"
    assert {row["model"] for row in report["parts"]} == {"corrected", "physics", "training median"}
    compared = {(row["target"], row["protocol"]) for row in found["differences"]}
    assert {("error_mean", "path"), ("across_mean", "path")} <= compared
    used = load_model(copy / "model.skops")
    assert report["facts"]["model"]["averaged along the route over [m]"] == used.width
    seen = pd.concat(map(pd.read_parquet, (copy / "tables" / "observability").glob("*.parquet")))
    seen = averaged_along(seen.reset_index(drop=True), used.width).set_index(["route_id", "sample"])
    places = pd.read_parquet(copy / "report" / "places.parquet").set_index(["route_id", "sample"])
    np.testing.assert_array_equal(places["vd_mean"], seen.loc[places.index, "vd_mean"])
    again = predict(used, places)
    pd.testing.assert_series_equal(again["estimate"], places["estimate"], check_exact=True)


def test_nothing_is_learnt_or_estimated_without_the_virtual_drive_that_was_asked_for(
    inputs: Path, tmp_path: Path
) -> None:
    settings = job(inputs, tmp_path / "run", observe={"range_max": 14.0})
    found = inputs_of(settings, None, None)
    store = ts.ingest(settings.map.sources, settings.store_url, tile_size=settings.map.tile_size)
    measure = plan_measure(settings, found, MapPlan.of_store(store))
    observe = [task.key for task in measure.tasks if task.stage == "observe"]

    def planned(lost: list[str]) -> dict[str, list[Task]]:
        outcomes = [
            Outcome(task.key, task.stage, reason="lost" if task.key in lost else "")
            for task in measure.tasks
        ]
        stages: dict[str, list[Task]] = {}
        for task in plan_estimate(settings, store.grid, measure, outcomes).tasks:
            stages.setdefault(task.stage, []).append(task)
        return stages

    tiles = [key.removeprefix("observe-") for key in observe]
    assert [str(task.tile) for task in planned([])["predict"]] == tiles
    some = planned(observe[:1])
    assert [str(task.tile) for task in some["predict"]] == tiles[1:]
    (joined,) = some["samples"]
    assert len(joined.reads["routes"]) == len(tiles) - 1
    own = [task.key for task in measure.tasks if task.stage == "observe_drive"]
    (joined,) = planned(own[:1])["samples"]
    assert len(joined.reads["observed"]) == len(own) - 1
    assert len(joined.reads["factors"]) == len(own)  # whose labels are counted as lost
    assert planned(observe) == {}


def test_physics_needs_no_drive(inputs: Path, tmp_path: Path) -> None:
    routes = [str(inputs / "canyon.mcap"), str(inputs / "tunnel.mcap")]
    model = {"recipe": "physics", "offset": 0.01}
    settings = job(
        inputs,
        tmp_path / "run",
        drives=[],
        routes=routes,
        observe=SEEING,
        model=model,
        label={"matcher": "default"},
    )
    told = Told()
    ts.run(settings, watch=told)
    assert not {o.stage for o in told.outcomes} & {"register", "samples", "train", "evaluate"}
    places = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet")
    tiles = list((tmp_path / "run" / "tables" / "predictions").glob("*.parquet"))
    assert len(tiles) == 4  # the routes weave over y = 0: neighbours lie in another tile
    assert (places["estimate"] == places["vd_mean"] + 0.01).all()
    assert (places["p_fail"] == places["vd_p_fail"]).all()
    assert places["in_domain"].isna().all()
    assert ((places["reason"] != "") == (places["estimate"] > 0.1)).all()
    middle = places.groupby("route_id")["along"].median()
    assert middle["tunnel"] > 1.5 * middle["canyon"]  # nothing holds a scan along a tunnel


def test_physics_of_a_short_drive_is_the_virtual_drive_as_it_is_and_says_so(
    inputs: Path, tmp_path: Path
) -> None:
    """With 26 places nothing is fitted, and what was measured stands beside the estimates."""
    drives = [{"log": str(inputs / "canyon.mcap")}]
    model = {"recipe": "physics"}
    ts.run(job(inputs, tmp_path / "run", drives=drives, observe=SEEING, model=model))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert any("26 places are measured" in note for note in told["notes"]["job"])
    places = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet")
    assert (places["estimate"] == places["vd_mean"]).all()
    report = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    assert report["paths"][0]["judged"] == 26
    assert "train" not in told["stages"]


def test_what_needs_a_virtual_drive_is_refused_without(inputs: Path, tmp_path: Path) -> None:
    for recipe in ("physics", "corrected"):
        with pytest.raises(UsageError, match=f"{recipe}, which needs observe.*paper, forest"):
            job(inputs, tmp_path / "run", model={"recipe": recipe})


# --- The settings


JOB = "out: run\nmap: {sources: [a.pcd]}\n"
LEARNING = "out: run\nmap: {sources: [a.pcd]}\nroutes: [r.csv]\nsimulate: {}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("out: run\nmapp: {}", r"mapp is no setting: did you mean map"),
        ("out: run\nmap: {tile_sise: 50}", r"tile_sise is no setting: did you mean tile_size"),
        (
            "out: run\nlabel: {starts: {radios: 1}}",
            r"radios is no setting: did you mean radius",
        ),
        ("out: run\nmap: {sources: [a.pcd]}", r"nothing to learn from"),
        ("out: run\ndrives: [{log: a.mcap}]", r"has no map"),
        (
            "out: run\nmap: {sources: [a.pcd]}\ndrives: [{log: x/a.mcap}, {log: y/a.mcap}]",
            r"two drives named a",
        ),
        (
            "out: run\nmap: {sources: [a.pcd]}\ndrives: [{log: a.mcap, name: ../../etc}]",
            r"name",
        ),
        (JOB + "drives: [{log: /a/..mcap}]", r"'/a/\.\.mcap' cannot name"),
        (JOB + "drives: [{log: /a/...mcap}]", r"'/a/\.\.\.mcap' cannot name"),
        (JOB + "drives: [{log: drives/-a.mcap}]", r"-a\.mcap' cannot name"),
        (JOB + "drives: [{log: a.mcap}, {log: /}]", r"'/' cannot name"),
        (
            "out: run\nmap: {sources: [a.pcd]}\ndrives: [{log: a.mcap}]\nsensor: VLP-16",
            r"known are VLP16",
        ),
        (JOB + "drives: [{log: a.mcap, beam: 16}]", r"drives\.0: beam is no .*did you mean beams"),
        (JOB + "simulate: {prset: paper}", r"simulate: prset is no .*did you mean preset"),
        (LEARNING + "observe: {range_mx: 3}", r"observe: range_mx is no .*did you mean range_max"),
        (LEARNING + "model: {recip: paper}", r"model: recip is no .*did you mean recipe"),
        (LEARNING + "model: {recipe: best}", r"recipe is 'best': choose from paper, .*physics"),
        (LEARNING + "report: {treshold: 1}", r"report: treshold is no .*did you mean threshold"),
        (LEARNING + "label: {matcher: {solvr: raw}}", r"matcher.*: solvr is no .*mean solver"),
        (LEARNING + "label: {matcher: {solver: best}}", r"matcher.*: solver is 'best'.* or 'raw'"),
        (
            LEARNING + "label: {matcher: fast}",
            r"matcher fast: no such matcher or file.*autoware, default",
        ),
        (LEARNING + "sensor: {name: x, range_mx: 3}", r"range_mx is no .*did you mean range_max"),
        (LEARNING + "sensor: {name: x}", r"sensor.*: range_max is missing"),
        (LEARNING + "drives: {log: a.mcap}", r"drives is .*valid tuple"),
        ("just words", r"give the fields of a job"),
        ("out: [", r"no readable YAML"),
    ],
)
def test_settings_that_cannot_be_are_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "job.yaml").write_text(text)
    with pytest.raises(UsageError, match=said):
        read_settings(tmp_path / "job.yaml")


def test_changes_come_on_top_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text("out: run\nmap: {sources: [a.pcd]}\nroutes: [r.csv]\n")
    found = read_settings(
        tmp_path / "job.yaml", ["model.use=/m.skops", "map.tile_size=40", "spacing=2.5"]
    )
    assert (found.model.use, found.map.tile_size, found.spacing) == ("/m.skops", 40.0, 2.5)
    with pytest.raises(UsageError, match="give key=value"):
        read_settings(tmp_path / "job.yaml", ["spacing"])
    with pytest.raises(UsageError, match="out holds a value"):
        read_settings(tmp_path / "job.yaml", ["out.x=1"])


def test_the_template_is_a_job_and_explains_every_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["template"]) == 0
    text = capsys.readouterr().out
    (tmp_path / "job.yaml").write_text(text)
    assert read_settings(tmp_path / "job.yaml").out == str(Path("my-city").absolute())
    groups = [RunSettings, SimulateSettings, MapSettings, DriveSettings, VirtualSettings]
    groups += [CoarseSettings, LabelSettings, ModelSettings, ReportSettings]
    settings = {name for group in groups for name in group.model_fields}
    explained = set(re.findall(r"^[ #-]*\{?(\w+):", text, flags=re.MULTILINE))
    assert explained == settings


def test_a_run_directory_that_is_a_file_is_named(inputs: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    for out in (tmp_path / "taken", tmp_path / "taken" / "run"):
        with pytest.raises(UsageError, match=f"{out} is a file, or below one"):
            ts.run(job(inputs, out))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drives": [{"log": "nowhere.mcap"}]}, r"nowhere\.mcap: no such (log|file)"),
        ({"routes": ["nowhere.geojson"]}, r"nowhere\.geojson: no such file; check the path"),
        ({"map": {"sources": ["nowhere.laz"]}}, r"nowhere\.laz: no such file .*check the path"),
        (
            {"map": {"sources": ["nowhere_*.laz"]}},
            r"nowhere_\*\.laz: no such file or directory, and as a pattern it matches no file",
        ),
        (
            {"model": {"use": "nowhere.skops"}},
            r"nowhere\.skops: no such model file; see model\.use",
        ),
    ],
)
def test_a_file_that_is_not_there_is_named_and_nothing_is_measured(
    inputs: Path, tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    told = Told()
    with pytest.raises(SourceNotFoundError, match=said):
        ts.run(job(inputs, tmp_path / "run", **changes), watch=told)
    assert told.outcomes == []
    assert not (tmp_path / "run").exists()


def test_where_run_json_cannot_be_written_the_reason_is_told_all_the_same(tmp_path: Path) -> None:
    book = Book(Files.at(tmp_path / "gone"))
    with pytest.raises(ValueError, match="why it ended"), book.closed():
        raise ValueError("why it ended")


def test_a_config_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match=r"job\.yaml: no such config; `tilestream templ"):
        ts.run(tmp_path / "job.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["shinjuku", "drive", "city"])
def test_a_pipeline_that_ships_is_a_job(name: str) -> None:
    settings = read_settings(PIPELINES / f"{name}.yaml")
    assert settings.out
    assert settings.label.matcher == "autoware"
    assert settings.model.use in (None, "shipped"), "a job that ships needs the output of no other"
    assert {p.stem for p in PIPELINES.glob("*.yaml")} == {"shinjuku", "drive", "city", "retrain"}


# --- Routes that were drawn


def lane(number: int, line: list[tuple[float, float]], ele: bool) -> str:
    """A lanelet 3 m wide along a line, with its nodes and ways."""
    nodes, ways = [], []
    for side, shift in ((1, 1.5), (2, -1.5)):
        names = [100 * number + 10 * side + k for k in range(len(line))]
        for name, (x, y) in zip(names, line, strict=True):
            height = '<tag k="ele" v="0"/>' if ele else ""
            nodes.append(
                f'<node id="{name}" lat="35" lon="139"><tag k="local_x" v="{x}"/>'
                f'<tag k="local_y" v="{y + shift}"/>{height}</node>'
            )
        refs = "".join(f'<nd ref="{name}"/>' for name in names)
        ways.append(f'<way id="{10 * number + side}">{refs}</way>')
    return "".join([*nodes, *ways]) + (
        f'<relation id="{number}"><member type="way" role="left" ref="{10 * number + 1}"/>'
        f'<member type="way" role="right" ref="{10 * number + 2}"/>'
        '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/></relation>'
    )


@pytest.fixture
def autoware(inputs: Path, tmp_path: Path) -> Path:
    """A map directory as Autoware lays it out: three lanes, one too short, one off the map."""
    folder = tmp_path / "map"
    folder.mkdir()
    for kind in STREETS:
        shutil.copy(inputs / f"map_{kind}.pcd", folder)
    parts = "".join(f"map_{kind}.pcd: [{x}, 0]\n" for kind, x in STREETS.items())
    (folder / "pointcloud_map_metadata.yaml").write_text(
        f"x_resolution: 400.0\ny_resolution: 400.0\n{parts}"
    )
    lanes = [
        lane(1, [(8.0, 0.0), (30.0, 0.0)], ele=True),
        lane(2, [(420.0, 0.0), (420.5, 0.0)], ele=True),
        lane(3, [(430.0, 5000.0), (460.0, 5000.0)], ele=True),
    ]
    (folder / "lanelet2_map.osm").write_text(f"<osm>{''.join(lanes)}</osm>")
    return folder


def test_without_routes_all_streets_of_the_map_are_estimated(
    autoware: Path, elsewhere: dict[str, object], inputs: Path, tmp_path: Path
) -> None:
    changes = elsewhere | {"map": {"sources": [str(autoware)], "tile_size": 50.0}, "routes": []}
    settings = job(inputs, tmp_path / "run", **changes)
    note = f"all streets of the map, 2 lanes of {autoware}/lanelet2_map.osm; 1 shorter than"
    assert any(note in told for told in forecast(settings).notes["job"])
    with pytest.raises(UsageError, match=r"all 3 lanes of .* shorter than the spacing, 50 m"):
        forecast(settings.model_copy(update={"spacing": 50.0}))
    ts.run(settings)
    places = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet").set_index("route_id")
    assert set(places.index) == {"1", "3"}
    assert places.loc["1", "estimate"].notna().all()
    assert places.loc["3", "estimate"].isna().all()
    assert places.loc["3", "reason"].str.contains("no estimate").all()
    assert note in html.unescape((tmp_path / "run" / "report" / "index.html").read_text())
    copy = ET.parse(tmp_path / "run" / "report" / "lanelets.osm").getroot()
    tags = {
        relation.get("id"): {str(tag.get("k")): str(tag.get("v")) for tag in relation.iter("tag")}
        for relation in copy.iter("relation")
    }
    mean = places.loc["1", "estimate"].mean()
    assert float(tags["1"]["tilestream:error"]) == pytest.approx(mean, abs=6e-4)
    assert tags["1"]["tilestream:places"] == str(len(places.loc["1"]))
    assert "shorter than their spacing" in tags["2"]["tilestream:reason"]
    assert "no estimate" in tags["3"]["tilestream:reason"]
    told = json.loads((tmp_path / "run" / "report" / "report.json").read_text())
    assert told["not_written"] == {}
    assert told["foxglove"]["map_points"] > 1000
    (autoware / "lanelet2_map.osm").unlink()
    with pytest.raises(UsageError, match=r"no routes: give files of routes.*lanelet2_map\.osm"):
        forecast(settings)


def test_a_route_that_leaves_the_map_is_estimated_as_far_as_it_is_mapped(
    elsewhere: dict[str, object], inputs: Path, tmp_path: Path
) -> None:
    line = {"type": "LineString", "coordinates": [[8.0, 0.0], [130.0, 0.0]]}
    (tmp_path / "drawn.geojson").write_text(
        json.dumps({"type": "Feature", "properties": {"route_id": "out"}, "geometry": line})
    )
    (tmp_path / "drawn.osm").write_text(
        f"<osm>{lane(7, [(808.0, 0.0), (930.0, 0.0)], ele=False)}</osm>"
    )
    routes = [str(tmp_path / "drawn.geojson"), str(tmp_path / "drawn.osm")]
    ts.run(job(inputs, tmp_path / "run", **(elsewhere | {"routes": routes})))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (told["state"], told["failures"]) == ("done", {})
    places = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet")
    assert places.groupby("route_id").size().tolist() == [123, 123]
    near, far = places[places["arc_length"] < 30.0], places[places["arc_length"] > 60.0]
    assert near["estimate"].notna().all()
    assert far["estimate"].isna().all()
    assert far["reason"].str.contains("ground|map").all(), far["reason"].unique()


# --- The page as a person gets it


def test_the_page_of_a_run_answers_to_the_mouse(done: tuple[Path, Told]) -> None:
    page = done[0] / "report" / "index.html"
    data = source(charts(page)["city-map"], "in_domain")
    top = len(data["arc"]) - 1
    with chromium_page() as tab:
        opened(tab, page)
        assert tab.evaluate("document.documentElement.dataset.charts") == str(1 + 2 * len(STREETS))
        point_at(tab, "city-map", "in_domain", top)
        tip = tab.wait_for(TIPS)
        words = [data[name][top] for name in ("shown", "interval", "fail", "axes", "starts")]
        for told in words:
            assert told.replace("\u00a0", " ") in tip
        assert re.search(r"starts that fail: [\d.]+ %", tip)
        assert re.search(r"along [\d.]+, across [\d.]+, up [\d.]+ cm", tip)
        calm(tab)


# --- The commands


@pytest.fixture
def config(inputs: Path, done: tuple[Path, Told], tmp_path: Path) -> Path:
    path = tmp_path / "job.yaml"
    path.write_text(yaml.safe_dump(job(inputs, done[0]).model_dump(mode="json")))
    return path


def test_the_command_prints_the_headline_and_gates(
    inputs: Path, elsewhere: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    routes = {"routes": [str(inputs / f"{kind}.mcap") for kind in STREETS]}
    settings = job(inputs, tmp_path / "run", **(elsewhere | routes))
    config = tmp_path / "job.yaml"
    config.write_text(yaml.safe_dump(settings.model_dump(mode="json")))
    assert command(["run", str(config), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "The report is at" in said
    assert "of road, 78 sample points" in said
    assert re.search(r" cm +median estimated error", said)
    assert command(["run", str(config), "--workers", "1", "--fail-over", "1e-6"]) == 1
    assert "mean: 78 of 78 sample points are above 1e-06 m" in capsys.readouterr().err
    assert command(["run", str(config), "--workers", "1", "--fail-over", "99"]) == 0
    assert "0 of 78 sample points without an estimate" in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["0", "-0.25", "nan"])
def test_a_limit_that_cannot_be_is_refused_before_the_job(
    config: Path, capsys: pytest.CaptureFixture[str], limit: str
) -> None:
    before = (Path(yaml.safe_load(config.read_text())["out"]) / "run.json").stat().st_mtime_ns
    assert command(["run", str(config), "--fail-over", limit]) == 2
    assert "give metres above 0" in capsys.readouterr().err
    after = (Path(yaml.safe_load(config.read_text())["out"]) / "run.json").stat().st_mtime_ns
    assert after == before


def test_a_gate_does_not_open_on_places_that_nobody_estimated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report").mkdir()
    estimate = [0.1] * 90 + [None] * 10
    places = pd.DataFrame({"route_id": "a", "arc_length": range(100), "estimate": estimate})
    places["status"] = "done"
    places.to_parquet(tmp_path / "report" / "places.parquet")
    (tmp_path / "report" / "report.json").write_text(json.dumps({"drives": []}))
    with pytest.raises(LimitError, match="10 of 100 sample points without an estimate"):
        require_within(Files.at(tmp_path), 0.25)
    places.iloc[:92].to_parquet(tmp_path / "report" / "places.parquet")
    require_within(Files.at(tmp_path), 0.25)
    assert "2 of 92 sample points without an estimate" in capsys.readouterr().err


def test_labels_that_are_lost_are_told_with_their_reasons() -> None:
    lost = [
        {"reason": "no sample point near", "count": 20, "detail": "8 m away"},
        {"reason": "label failed", "count": 1, "detail": ""},
    ]
    report = {"headline": {"labelled": 60}, "lost_labels": lost}
    assert lost_labels(report) == [
        "21 of 81 measured places not used:",
        "  20 no sample point near: 8 m away",
        "  1 label failed",
    ]
    assert lost_labels(report | {"lost_labels": []}) == []


def test_the_plan_tells_stages_memory_and_cost(
    config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["plan", str(config), "--json"]) == 0
    stages = {row["stage"]: row for row in json.loads(capsys.readouterr().out)["stages"]}
    assert stages["factors"]["work"] == len(STREETS) * SCANS
    assert stages["label"]["after"] == ["register"]
    assert stages["predict"]["after"] == ["factors", "train"]
    assert all(row["promised_bytes"] > 0 and row["core_hours"] >= 0 for row in stages.values())
    assert command(["run", str(config), "--dry-run"]) == 0
    assert "core-hours" in capsys.readouterr().out


def test_a_plan_before_anything_is_there_reads_headers_only(inputs: Path, tmp_path: Path) -> None:
    expected = forecast(job(inputs, tmp_path / "run"))
    assert {"scatter", "cells", "terms", "factors", "register"} <= {t.stage for t in expected.tasks}
    assert not (tmp_path / "run").exists()
    assert any("bounds" in n or "where the points" in n for n in expected.notes["plan"])


def test_a_city_that_is_not_simulated_yet_is_planned_first(tmp_path: Path) -> None:
    small = {"paths": ("III",), "size": "small", "drives": 2, "preset": "paper"}
    settings = RunSettings(out=str(tmp_path / "run"), simulate=small)
    stages = {row["stage"]: row for row in stage_rows(forecast(settings).tasks)}
    one_survey = load_preset("paper").survey.passes * 40
    assert {name: row["work"] for name, row in stages.items()} == {
        "survey": one_survey,
        "scan": 2 * 40,
        "log": 2 * 40,
    }
    assert stages["log"]["after"] == ["scan"]
    assert all(float(row["core_hours"]) > 0.0 for row in stages.values())
    assert not (tmp_path / "run").exists()


def test_a_job_that_does_not_fit_is_refused_before_it_runs(
    config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["run", str(config), "--workers", "1", "--set", "memory=400000000"]) == 2
    assert "needs" in capsys.readouterr().err


# --- What a job costs


def test_costs_are_learnt_from_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    task = Task(terms, "1", TileArrays("nowhere", ts.TileKey(0, 0), "terms"), work=4)
    before = core_hours([task])["terms"]
    assert before == pytest.approx(4 * terms.seconds / 3600.0)
    learn([task], [Outcome("terms-1", "terms", made=False, seconds=80.0)])
    assert core_hours([task])["terms"] == before
    learn([task], [Outcome("terms-1", "terms", made=True, seconds=80.0)])
    learnt = core_hours([task])["terms"]
    assert learnt == pytest.approx((before * 80.0 / 3600.0) ** 0.5)
    small = Task(terms, "2", TileArrays("nowhere", ts.TileKey(0, 0), "terms"), work=1)
    learn([small], [Outcome("terms-2", "terms", made=True, seconds=0.1)])  # a hundredth of enough
    assert 0.98 * learnt < core_hours([task])["terms"] < learnt
    calibration_file().write_text("{broken")
    assert core_hours([task])["terms"] == before


# --- On Dask


@pytest.mark.slow
def test_dask_makes_the_same_tables(inputs: Path, tmp_path: Path) -> None:
    """In processes of their own, since here the forests are small."""
    for name, workers in (("here", "1"), ("there", "2")):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(job(inputs, tmp_path / name).model_dump(mode="json")))
        line = [sys.executable, "-m", "tilestream", "run", str(path), "--workers", workers]
        subprocess.run(line, check=True, capture_output=True)
    assert hashes(tmp_path / "here") == hashes(tmp_path / "there")
    one, two = (
        pd.read_parquet(tmp_path / name / "report" / "places.parquet") for name in ("here", "there")
    )
    pd.testing.assert_frame_equal(one, two, check_exact=True)


@pytest.mark.slow
def test_many_places_are_learnt_by_all_workers(
    inputs: Path, done: tuple[Path, Told], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_story, "LARGE", 10)
    with dask_client(None, 2, 1_500_000_000) as client:
        ts.run(job(inputs, tmp_path / "run"), client)
    one, two = (
        pd.read_parquet(f / "report" / "places.parquet") for f in (done[0], tmp_path / "run")
    )
    pd.testing.assert_series_equal(one["estimate"], two["estimate"], check_exact=True)
