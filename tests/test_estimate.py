"""The answer in one command: a map in, estimates and what they are worth out."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import stand_in
import streets
import yaml
from streets import job, write_drive

import tilestream as ts
from tilestream.cli import run as command
from tilestream.errors import ModelError, PartialError, SourceNotFoundError, UsageError
from tilestream.model import shipped
from tilestream.model.file import load_model
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.estimate import estimate_settings
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.inventory import tables_in
from tilestream.pipeline.jobs.run_before import say_other_map
from tilestream.pipeline.jobs.run_inputs import inputs_of
from tilestream.pipeline.jobs.run_making import as_far_as_known
from tilestream.pipeline.jobs.run_settings import ModelSettings, RunSettings
from tilestream.pipeline.stages import observe as observe_stage
from tilestream.pipeline.stages import samples as samples_stage
from tilestream.report import pictures
from tilestream.report.worth import ELSEWHERE, HERE, NOWHERE
from tilestream.settings import (
    LabelSettings,
    MapSettings,
    PlaceSettings,
    ReportSettings,
    VirtualSettings,
)

Told = pytest.CaptureFixture[str]
SEEING = {"range_max": 14.0, "starts": 8, "draws": 2, "worlds": 1}
"""A virtual drive that is made fast."""


@pytest.fixture(scope="module", autouse=True)
def own_caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What these tests learn of costs stays here; their pictures are coarse."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(pictures.png, "__defaults__", (20,))
        yield


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    streets.write_inputs(folder)
    return folder


@pytest.fixture
def nothing_ships(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installation that no model came with; the folder where one would be."""
    folder = tmp_path / "installed"
    folder.mkdir()
    monkeypatch.setattr(shipped, "DATA", folder)
    return folder


def asked(
    sources: list[Path], routes: list[Path], out: Path, model: str | None = None, **places: Any
) -> RunSettings:
    """The job of an estimate with the settings that `estimate` has when nothing else is given."""
    return estimate_settings(
        [str(one) for one in sources],
        [str(one) for one in routes],
        out,
        model,
        PlaceSettings(**places),
        VirtualSettings(range_max=14.0),
        LabelSettings(),
        MapSettings(),
        ReportSettings(),
    )


def report_of(folder: Path) -> Any:
    return json.loads((folder / "report" / "report.json").read_text())


def places_of(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "report" / "places.parquet")


# --- One command


def test_one_command_answers_and_says_first_what_the_answer_is_worth(
    inputs: Path, nothing_ships: Path, tmp_path: Path, capsys: Told
) -> None:
    sources, routes = [inputs / "map_canyon.pcd"], [inputs / "canyon.mcap"]
    own = asked(sources, routes, tmp_path / "own", "physics", spacing=8.0)
    model = stand_in.write(nothing_ships / "model.skops", own, stand_in.CHECKED)
    line = ["estimate", str(sources[0]), "--route", str(routes[0]), "--spacing", "8"]
    line += ["--range-max", "14", "--workers", "1", "--out"]
    assert command([*line, str(tmp_path / "run")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert 0 <= said.index("431 places, 5 drives") < said.index("median estimated error")
    report = report_of(tmp_path / "run")
    worth = report["worth"]
    assert (worth["checked"], worth["places"], worth["spearman_low"]) == (ELSEWHERE, 431, 0.3)
    assert worth["mae"] == 0.024  # of what was held out, where estimates are worst
    assert worth["trained_places"] == 2 * 720
    places = places_of(tmp_path / "run")
    assert len(places) == 4
    assert places["estimate"].notna().all()
    assert worth["median"] in set(places["estimate"])
    assert worth["outside"] == (~places["in_domain"]).mean()

    told = " ".join(worth["told"])
    files = tmp_path / "run" / "report"
    assert pq.read_schema(files / "places.parquet").metadata[b"worth"].decode() == told
    assert json.loads((files / "over_threshold.geojson").read_text())["worth"] == told
    assert f"# {told}\n".encode() in (files / "map.pcd").read_bytes()
    page = (files / "index.html").read_text()
    assert page.index("431 places, 5 drives") < page.index('<section id="headline">')
    evaluation = json.loads((tmp_path / "run" / "tables" / "evaluation.json").read_text())
    assert evaluation["worth"] == worth

    again = asked(sources, routes, tmp_path / "named", str(model), spacing=8.0)
    ts.run(again)
    pd.testing.assert_frame_equal(places_of(tmp_path / "named"), places, check_exact=True)
    assert command([*line, str(tmp_path / "run"), "--fail-over", "1e-6"]) == 1
    assert command([*line, str(tmp_path / "run"), "--dry-run"]) == 0


def test_where_no_model_ships_the_virtual_drive_answers_and_that_is_said(
    inputs: Path, nothing_ships: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    routes = inputs / "canyon.mcap"
    how = {"out": tmp_path / "run", "range_max": 14.0, "spacing": 12.0}
    assert ts.estimate(inputs / "map_canyon.pcd", routes, **how) == tmp_path / "run"
    assert "no model comes with this installation" in caplog.text
    places = places_of(tmp_path / "run")
    assert (places["estimate"] == places["vd_mean"]).all()
    worth = report_of(tmp_path / "run")["worth"]
    assert (worth["checked"], worth["mae"], worth["digits"]) == (NOWHERE, None, 2)
    with pytest.raises(SourceNotFoundError, match=r"no model comes with .*--model physics"):
        ts.estimate(inputs / "map_canyon.pcd", routes, **how, model="shipped")


def test_a_shipped_model_that_does_not_fit_is_refused_and_leads_on(
    inputs: Path, nothing_ships: Path, tmp_path: Path
) -> None:
    own = asked([inputs / "map_canyon.pcd"], [inputs / "canyon.mcap"], tmp_path / "run", "physics")
    stand_in.write(nothing_ships / "model.skops", own)
    with pytest.raises(ModelError, match=r"^shipped: cell_size does not match.*model physics"):
        ts.run(asked(list(own.map.sources), list(own.routes), tmp_path / "run", cell_size=1.0))
    assert not (tmp_path / "run").exists()


def test_where_no_place_can_be_estimated_nothing_reads_as_done(
    inputs: Path, tmp_path: Path, capsys: Told
) -> None:
    """A route beside the map: exit code, reason, and what the gate says."""
    beside = tmp_path / "beside.csv"
    beside.write_text("x,y,z\n0,60,0\n12,60,0\n")
    line = ["estimate", str(inputs / "map_canyon.pcd"), "--route", str(beside), "--spacing", "4"]
    line += ["--model", "physics", "--workers", "1", "--out", str(tmp_path / "run")]
    assert command([*line, "--fail-over", "0.5"]) == 1
    said = capsys.readouterr()
    assert "4 of 4 places have no estimate: no ground" in said.out
    assert "the gate is closed: no estimate at all on beside" in said.err
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert told["state"] == "failed"
    assert told["failures"]["estimates"].startswith("no place has one: no ground")


# --- Where


def test_a_store_is_a_map_alone_and_nothing_beside_it(inputs: Path, tmp_path: Path) -> None:
    store = tmp_path / "map.zarr"
    ts.ingest(inputs / "map_canyon.pcd", store)
    settings = asked([store], [inputs / "canyon.mcap"], tmp_path / "run", "physics")
    assert (settings.map.sources, settings.map.store) == ((), str(store))
    with pytest.raises(UsageError, match="give it alone"):
        asked([store, inputs / "map_tunnel.pcd"], [], tmp_path / "run", "physics")


@pytest.mark.parametrize("of_store", [False, True])
def test_without_a_route_the_survey_of_a_log_is_followed(
    inputs: Path, tmp_path: Path, of_store: bool
) -> None:
    log = write_drive(tmp_path / "survey.mcap", "canyon")
    if of_store:
        ts.ingest(log, tmp_path / "map.zarr")
    settings = asked([tmp_path / "map.zarr" if of_store else log], [], tmp_path / "run", "physics")
    found = inputs_of(settings, None, None)
    (route,) = found.routes
    assert route.arc_length[-1] == pytest.approx(25.0, abs=1.0)
    assert any("the way of its survey" in note for note in found.notes["job"])


def test_without_a_route_the_lanes_beside_the_sources_of_a_store_are_taken(
    shared_data: Path, inputs: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "map" / "pointcloud_map"
    folder.mkdir(parents=True)
    shutil.copy(inputs / "map_canyon.pcd", folder)
    lanes = folder.parent / "lanelet2_map.osm"
    shutil.copy(shared_data / "lanelet2" / "lanelet2_kashiwanoha.osm", lanes)
    ts.ingest(folder / "map_canyon.pcd", tmp_path / "map.zarr")
    how = {"model": "physics", "project_to": "EPSG:6677"}
    found = inputs_of(asked([tmp_path / "map.zarr"], [], tmp_path / "run", **how), None, None)
    assert found.routes
    assert any(str(lanes) in note for note in found.notes["job"])


def test_a_map_without_lanes_or_survey_asks_for_a_route(
    inputs: Path, tmp_path: Path, capsys: Told
) -> None:
    line = ["estimate", str(inputs / "map_canyon.pcd"), "--model", "physics"]
    line += ["--workers", "1", "--out", str(tmp_path / "run")]
    assert command(line) == 2
    assert "--route" in capsys.readouterr().err
    assert command([*line, "--dry-run"]) == 2


# --- As soon as possible


def order_of(settings: RunSettings) -> list[Outcome]:
    outcomes: list[Outcome] = []
    ts.run(settings, watch=lambda outcome, *_: outcomes.append(outcome))
    return outcomes


def test_first_places_are_estimated_before_the_last_tile_is_merged(
    inputs: Path, tmp_path: Path
) -> None:
    routes = [str(inputs / f"{kind}.mcap") for kind in streets.STREETS]
    how = {"drives": [], "routes": routes, "observe": SEEING, "spacing": 6.0}
    settings = job(inputs, tmp_path / "run", **how, model={"recipe": "physics", "offset": 0.0})
    keys = [outcome.key for outcome in order_of(settings)]
    predicted, merged = (
        [n for n, key in enumerate(keys) if key.startswith(f"{stage}-")]
        for stage in ("predict", "merge")
    )
    assert predicted[0] < merged[-1]
    assert len(set(keys)) == len(keys)
    places = places_of(tmp_path / "run")
    assert (places["estimate"] == places["vd_mean"]).all()
    assert len(tables_in(f"{tmp_path}/run/tables/predictions")) == len(predicted)
    assert not any(outcome.made for outcome in order_of(settings))  # nothing is done twice


def test_a_tile_that_fails_takes_no_estimate_from_its_neighbours(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The canyon weaves over y = 0, through two tiles; one of them cannot be looked from."""
    plain = observe_stage.observability

    def failing(store: Any, at: np.ndarray, *others: Any) -> Any:
        if (at[:, 0] < 50.0).all() and (at[:, 1] < 0.0).all():
            raise ModelError("cannot be seen here")
        return plain(store, at, *others)

    monkeypatch.setattr(observe_stage, "observability", failing)
    routes = [str(inputs / f"{kind}.mcap") for kind in ("canyon", "tunnel")]
    how = {"drives": [], "routes": routes, "observe": SEEING, "spacing": 2.0}
    physics = {"recipe": "physics", "offset": 0.0}
    with pytest.raises(PartialError, match="cannot be seen here"):
        ts.run(job(inputs, tmp_path / "run", **how, model=physics))
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(told["failures"]) == ["observe-0_-1"]
    places = places_of(tmp_path / "run")
    lost = places["reason"].str.contains("its task failed")
    assert set(zip(places[lost]["route_id"], places[lost]["y"] < 0.0, strict=True)) == {
        ("canyon", True)
    }
    assert places[~lost]["estimate"].notna().all()
    assert {"canyon", "tunnel"} == set(places[~lost]["route_id"])
    assert len(tables_in(f"{tmp_path}/run/tables/predictions")) == 3


# --- Too few labels


def few(inputs: Path, out: Path, **changes: Any) -> RunSettings:
    """A job that is to learn from 26 places."""
    drives = [{"log": str(inputs / "canyon.mcap")}]
    how: dict[str, Any] = {"drives": drives, "observe": SEEING, "model": {"recipe": "corrected"}}
    return job(inputs, out, **how, **changes)


def test_too_few_labels_are_told_before_and_estimates_made_all_the_same(
    inputs: Path, nothing_ships: Path, tmp_path: Path, capsys: Told
) -> None:
    settings = few(inputs, tmp_path / "run")
    (nothing,) = [n for n in forecast(settings).notes["plan"] if "labels" in n]
    assert nothing.startswith("26 labels, 50 are needed")
    assert "the virtual drive as it is" in nothing
    model = stand_in.write(nothing_ships / "model.skops", settings)
    planned = forecast(settings)
    (note,) = [note for note in planned.notes["plan"] if "labels" in note]
    assert "those of the model that ships" in note
    assert {"samples", "predict"} <= {task.stage for task in planned.tasks}
    assert not {"train", "evaluate"} & {task.stage for task in planned.tasks}

    config = tmp_path / "job.yaml"
    config.write_text(yaml.safe_dump(settings.model_dump(mode="json")))
    assert command(["run", str(config), "--workers", "1"]) == 1
    said = capsys.readouterr()
    assert said.err.count("26 labels, 50 are needed") == 1
    assert "The report is at" in said.out
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert told["failures"] == {"labels": note}
    assert "train" not in told["stages"]

    report = report_of(tmp_path / "run")
    (path,) = report["paths"]
    assert (path["points"], path["judged"]) == (26, 26)  # what was measured stands beside
    worth = report["worth"]
    assert (worth["checked"], worth["places"], worth["drives"]) == (HERE, 26, 1)
    assert worth["mae"] == pytest.approx(path["mae"])
    assert worth["warnings"][0] == note
    use = {"model": {"use": str(model)}, "drives": [], "routes": [str(inputs / "canyon.mcap")]}
    ts.run(
        settings.model_copy(update={"out": str(tmp_path / "used")}).model_copy(
            update={name: getattr(job(inputs, tmp_path / "used", **use), name) for name in use}
        )
    )
    both = places_of(tmp_path / "run"), places_of(tmp_path / "used")
    pd.testing.assert_series_equal(*(b["estimate"] for b in both), check_exact=True)
    assert load_model(model).card["places"] == worth["trained_places"]


def test_labels_that_are_lost_leave_too_few(
    inputs: Path, nothing_ships: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More were measured than are needed, and not enough of them can be learnt from."""
    drives = [{"log": str(inputs / f"{kind}.mcap")} for kind in ("canyon", "tunnel")]
    settings = job(inputs, tmp_path / "run", drives=drives, observe=SEEING, spacing=1.0)
    settings = settings.model_copy(update={"model": ModelSettings(recipe="corrected")})
    plain = samples_stage.join

    def losing(*tables: Any, **named: Any) -> Any:
        return plain(*tables, **named).groups(["canyon"])

    monkeypatch.setattr(samples_stage, "join", losing)
    with pytest.raises(PartialError, match="26 labels, 50 are needed"):
        ts.run(settings)
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(told["failures"]) == ["labels"]
    places = places_of(tmp_path / "run")
    assert (places["estimate"] == places["vd_mean"]).all()


@pytest.mark.parametrize(
    ("sensor", "model", "asked", "seen"),
    [
        ("HDL64", "shipped", None, 100.0),
        ("HDL64", "shipped", 110.0, 110.0),
        ("VLP16", "shipped", None, None),
        ("HDL64", "physics", None, None),
    ],
)
def test_virtual_scans_reach_as_far_as_the_model_knows_unless_told(
    sensor: str, model: str, asked: float | None, seen: float | None, tmp_path: Path
) -> None:
    """The model that ships knows 15 to 100 m, and an HDL-64 has 120."""
    given = estimate_settings(
        ["map.pcd"],
        ["route.csv"],
        tmp_path / "run",
        model,
        PlaceSettings(sensor=sensor),
        VirtualSettings(range_max=asked),
        LabelSettings(),
        MapSettings(),
        ReportSettings(),
    )
    settings = as_far_as_known(given)
    assert as_far_as_known(settings) == settings
    assert settings.observe is not None
    assert settings.observe.range_max == seen


def test_a_run_of_another_map_is_told_of_before_it_is_replaced(
    inputs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one, other = sorted(inputs.glob("map_*.pcd"))[:2]
    for sources, told in (([one], False), ([one, other], False), ([other], False), ([one], True)):
        settings = asked(sources, [inputs / "canyon.mcap"], tmp_path / "run")
        caplog.clear()
        say_other_map(settings)
        assert ("of another map" in caplog.text) is told
        text = yaml.safe_dump(settings.model_dump(mode="json"))
        settings.folder.under("config.yaml").write(text.encode())
    settings.folder.under("config.yaml").write(b"map: [1")
    caplog.clear()
    say_other_map(settings)
    assert caplog.text == ""
