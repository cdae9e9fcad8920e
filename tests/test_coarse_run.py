"""A coarse run: the same bits where it evaluates, a status of its own where it does not."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import streets
from report_findings import without_labels
from streets import job

import tilestream as ts
from tilestream.apps.scene import scene_of
from tilestream.cli import run as command
from tilestream.cli.viewing import legend
from tilestream.errors import ModelError, PartialError, UsageError
from tilestream.factors.along_route import WIDTH, averaged_along
from tilestream.factors.stations import INTERPOLATED
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run_folder import rows_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages import observe as observe_stage
from tilestream.pipeline.stages.between import ALONE, NAMES, Between
from tilestream.report import cards, gate, pictures, write_report
from tilestream.report.summary import summary

SEEING = {"range_max": 14.0, "starts": 8, "draws": 2, "worlds": 1}
"""A virtual drive that is made fast."""
COARSE = {"every": 4, "tolerance": 0.2, "high": 1.5}
PHYSICS = {"recipe": "physics", "offset": 0.0}
PLACES = 41
"""Of each street, a metre apart."""


@pytest.fixture(scope="module", autouse=True)
def own_caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What these tests learn of costs stays here; their pictures are coarse."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(pictures.png, "__defaults__", (20,))
        yield


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two streets, and a route along each."""
    folder = tmp_path_factory.mktemp("inputs")
    streets.write_inputs(folder)
    for kind in ("canyon", "tunnel"):
        x = streets.STREETS[kind] + np.arange(2.0, 42.1, 1.0)
        y = 0.4 * np.sin(x / 3.0)
        lines = [f"{a:.3f},{b:.3f},2.0" for a, b in zip(x, y, strict=True)]
        (folder / f"{kind}.csv").write_text("\n".join(["x,y,z", *lines]))
    return folder


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are not written: only tables are looked at."""
    monkeypatch.setattr("tilestream.pipeline.jobs.run._report", lambda *_: None)


def asked(inputs: Path, out: Path, coarse: dict[str, Any] | None, **changes: Any) -> RunSettings:
    how: dict[str, Any] = {
        "drives": [],
        "routes": [str(inputs / f"{kind}.csv") for kind in ("canyon", "tunnel")],
        "observe": SEEING,
        "spacing": 1.0,
        "model": PHYSICS,
    }
    return job(inputs, out, **(how | changes), coarse=coarse)


def predictions(run: Path) -> pd.DataFrame:
    rows = rows_of(run, "predictions")
    assert rows is not None
    return rows.sort_values(["route_id", "sample"], ignore_index=True)


@pytest.fixture(scope="module")
def full(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("full") / "run"
    ts.run(asked(inputs, out, None))
    return out


@pytest.fixture(scope="module")
def coarse(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("coarse") / "run"
    ts.run(asked(inputs, out, COARSE))
    return out


def outcomes_of(settings: RunSettings, client: Any = None) -> list[Outcome]:
    found: list[Outcome] = []
    ts.run(settings, client=client, watch=lambda outcome, *_: found.append(outcome))
    return found


def test_what_is_evaluated_has_the_bits_of_a_full_run(full: Path, coarse: Path) -> None:
    whole, found = predictions(full), predictions(coarse)
    between = (found["status"] == INTERPOLATED).to_numpy()
    assert set(found["status"]) == {"done", INTERPOLATED}
    assert 0.2 < between.mean() < 0.9
    evaluated = found[~between].astype({"in_domain": "boolean"})
    pd.testing.assert_frame_equal(
        evaluated, whole[~between].astype({"in_domain": "boolean"}), check_exact=True
    )


def test_the_rest_is_linear_along_the_route_and_has_nothing_else(coarse: Path) -> None:
    found = predictions(coarse)
    for _, route in found.groupby("route_id"):
        own = route[(route["status"] == "done") | (route["reason"] == ALONE)]
        for name in NAMES:
            line = np.interp(route["arc_length"], own["arc_length"], own[name])
            np.testing.assert_allclose(route[name], line, rtol=0, atol=1e-9)
        ends = route.loc[route["status"] == "done", ["sample", "estimate"]].to_numpy()
        apart = np.diff(ends, axis=0)
        assert (np.abs(apart[apart[:, 0] > 1, 1]) <= COARSE["tolerance"]).all()
    between = found[found["status"] == INTERPOLATED]
    blank = ["low", "high", "domain_distance", "in_domain", "cov_along_along", "p_lost", "nvtl"]
    assert between[blank].isna().all().all()
    alone = between["reason"] == ALONE
    told = between.loc[~alone, "reason"]
    assert told.str.match(r"interpolated between sample points \d+ and \d+$").all()
    assert 0 < alone.sum() == json.loads((coarse / "run.json").read_text())["coarse"]["alone"]


def test_a_virtual_drive_in_a_gap_is_of_use_there(coarse: Path) -> None:
    """The estimate is that of as much of its kernel as was taken, and the places beside it lie on
    lines to it."""
    found, drives = predictions(coarse), rows_of(coarse, "observability")
    assert drives is not None
    taken = pd.MultiIndex.from_frame(drives[["route_id", "sample"]])
    places = pd.MultiIndex.from_frame(found[["route_id", "sample"]])
    alone = (found["reason"] == ALONE).to_numpy()
    assert (places.isin(taken) == alone | (found["status"] == "done").to_numpy()).all()
    columns = ["vd_mean"]
    averaged = averaged_along(drives, WIDTH, columns)[columns].set_index(taken)["vd_mean"]
    expected = averaged.reindex(places)[alone].to_numpy()
    assert found["estimate"][alone].tolist() == expected.tolist()


def test_it_is_told_apart_wherever_it_shows(coarse: Path) -> None:
    told = json.loads((coarse / "run.json").read_text())["coarse"]
    found, drives = predictions(coarse), rows_of(coarse, "observability")
    between = found["status"] == INTERPOLATED
    assert drives is not None
    assert not drives.duplicated(["route_id", "sample"]).any()
    assert told["evaluated"] == len(drives) < told["places"] == len(found) == 2 * PLACES
    assert told["interpolated"] == between.sum()
    assert told["first"] < 0.5 * told["evaluated"]
    assert 0 < told["checked"] <= 4
    assert told["off_low"] <= told["off_share"] == told["off"] / told["checked"] <= told["off_high"]
    assert abs(told["off_bias"]) <= told["off_mean"] <= told["off_most"]
    assert told["off_of"] > 0.0
    assert ts.info(coarse).plain()["coverage"]["places_interpolated"] == between.sum()
    shown = scene_of(coarse)
    assert shown.interpolated.sum() == between.sum()
    assert f"{between.sum():,} of them interpolated" in "".join(map(str, legend(shown)))
    report = json.loads((coarse / "report" / "report.json").read_text())
    assert report["facts"]["coarse"] == told
    assert told["told"] in report["worth"]["told"]
    assert report["headline"]["interpolated"] == between.sum()
    figures = {what: figure for figure, what in cards(report)}
    assert figures["places evaluated"] == f"{(~between).sum()} of {len(found)}"
    assert figures["places interpolated between these"] == str(between.sum())
    page = (coarse / "report" / "index.html").read_text()
    assert told["told"].split("; ")[0] in page
    assert "interpolated, not evaluated" in page
    places = pd.read_parquet(coarse / "report" / "places.parquet")
    assert (places["status"] == INTERPOLATED).sum() == between.sum()
    assert places.loc[places["status"] == INTERPOLATED, "vd_mean"].isna().all()
    assert places["feature_count"].notna().all()  # of the map alone, as of any run


def test_covariances_are_of_evaluated_places_alone(coarse: Path, tmp_path: Path) -> None:
    found = predictions(coarse)
    made = ts.export("covariance", coarse, tmp_path / "covariance.csv")
    known = found["cov_along_along"].notna() & (found["status"] == "done")
    assert made["places"] == known.sum()
    assert made["without"] == len(found) - made["places"]
    assert made["interpolated"] == (found["status"] == INTERPOLATED).sum() > 0


@pytest.mark.usefixtures("no_report")
def test_the_same_command_does_nothing_more(inputs: Path, coarse: Path) -> None:
    before = {p: p.read_bytes() for p in (coarse / "tables").rglob("*.parquet")}
    again = outcomes_of(asked(inputs, coarse, COARSE))
    assert not any(outcome.made for outcome in again)
    assert {p: p.read_bytes() for p in (coarse / "tables").rglob("*.parquet")} == before


@pytest.mark.usefixtures("no_report")
def test_neither_tiling_nor_a_stop_nor_workers_show(
    inputs: Path, coarse: Path, tmp_path: Path, workers: Any
) -> None:
    """Stopped in its second round, continued by two workers, on other tiles."""
    tiles = {"sources": [str(inputs / "map_*.pcd")], "tile_size": 20.0}
    settings = asked(inputs, tmp_path / "run", COARSE, map=tiles)

    def stop(outcome: Outcome, *_: Any) -> None:
        if outcome.key.startswith("stations-round2"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ts.run(settings, watch=stop)
    assert not (tmp_path / "run" / "tables" / "predictions").exists()
    later = outcomes_of(settings, workers)
    first = [outcome for outcome in later if outcome.key.startswith("observe-round1")]
    assert first
    assert not any(outcome.made for outcome in first)
    pd.testing.assert_frame_equal(
        predictions(tmp_path / "run"), predictions(coarse), check_exact=True
    )


@pytest.mark.usefixtures("no_report")
def test_the_tables_of_other_runs_do_not_stay(inputs: Path, tmp_path: Path) -> None:
    routes = [str(inputs / "tunnel.csv")]
    for how in (None, COARSE, {**COARSE, "every": 2, "tolerance": 10.0, "checks": 0}, None):
        ts.run(asked(inputs, tmp_path / "run", how, routes=routes))
        drives = rows_of(tmp_path / "run", "observability")
        assert drives is not None
        assert not drives.duplicated("sample").any()
        found = predictions(tmp_path / "run")
        assert (found["status"] == INTERPOLATED).any() == (how is not None)
        assert (len(drives) < PLACES) == (how is not None)
        assert (rows_of(tmp_path / "run", "stations") is not None) == (how is not None)
    assert "coarse" not in json.loads((tmp_path / "run" / "run.json").read_text())


def test_a_tile_that_fails_is_left_out_as_of_any_run(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = observe_stage.observability

    def failing(store: Any, at: np.ndarray, *others: Any) -> Any:
        if (at[:, 0] < 50.0).all() and (at[:, 1] < 0.0).all():
            raise ModelError("cannot be seen here")
        return plain(store, at, *others)

    monkeypatch.setattr(observe_stage, "observability", failing)
    with pytest.raises(PartialError, match="cannot be seen here"):
        ts.run(asked(inputs, tmp_path / "run", COARSE))
    places = pd.read_parquet(tmp_path / "run" / "report" / "places.parquet")
    lost = places["reason"].fillna("").str.contains("its task failed")
    assert set(zip(places[lost]["route_id"], places[lost]["y"] < 0.0, strict=True)) == {
        ("canyon", True)
    }
    assert places[lost]["estimate"].isna().all()
    assert places[~lost]["estimate"].notna().all()
    assert (places[~lost]["status"] == INTERPOLATED).any()
    told = json.loads((tmp_path / "run" / "run.json").read_text())
    (failed,) = told["failures"]  # it was not asked for again
    assert failed.startswith("observe-round")
    assert failed.endswith("-0_-1")


def test_a_place_in_a_gap_that_the_map_knows_nothing_of_has_no_estimate() -> None:
    """And of two routes each has its own gaps."""
    values = np.arange(2 * 2 * len(NAMES), dtype=float).reshape(2, 2, len(NAMES))
    between = Between(("r", "r"), np.array([[2, 6], [8, 10]]), np.array([True, True]), values)
    places = pd.DataFrame(
        {
            "route_id": ["r"] * 12 + ["s"] * 2,
            "sample": [*range(12), 3, 9],
            "status": "done",
            "reason": "",
        }
    )
    places.loc[4, ["status", "reason"]] = "missing", "no ground"
    there = (places["status"] == "done").to_numpy()

    def evaluated(own: pd.DataFrame) -> pd.DataFrame:
        names = [column.name for column in (*PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)]
        found = own[["status", "reason"]].reindex(columns=names)
        return found.assign(in_domain=True, **dict.fromkeys(NAMES, 7.0))

    found = between.filled(places, there, evaluated)
    inside = [3, 5, 9]
    assert np.flatnonzero(found["status"] == INTERPOLATED).tolist() == inside
    first = values[0, 0] + np.outer([0.25, 0.75], values[0, 1] - values[0, 0])
    np.testing.assert_allclose(found.loc[[3, 5], list(NAMES)].to_numpy(float), first)
    assert found.loc[4, ["status", "reason"]].tolist() == ["missing", "no ground"]
    assert found.loc[4, list(NAMES)].isna().all()
    assert (found.drop(index=[*inside, 4])[list(NAMES)] == 7.0).all().all()
    found = replace(between, whole=np.array([False, True])).filled(places, there, evaluated)
    assert np.flatnonzero(found["status"] == INTERPOLATED).tolist() == [3, 5, 6, 9]
    assert found.loc[6, list(NAMES)].tolist() == values[0, 1].tolist()
    assert found.loc[6, "reason"] == ALONE != found.loc[5, "reason"]


# --- Before it runs


def test_a_plan_says_what_the_first_round_takes(inputs: Path, tmp_path: Path) -> None:
    planned = forecast(asked(inputs, tmp_path / "run", COARSE))
    (told,) = [note for note in planned.notes["plan"] if note.startswith("coarse")]
    first = sum(task.work for task in planned.tasks if task.stage == "observe")
    assert f"{first} virtual drives, a run of all places {2 * PLACES};" in told
    assert first < PLACES
    assert {task.stage for task in planned.tasks} >= {"factors", "observe", "predict"}
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"observe": None, "model": {"use": "shipped"}},
        {"model": {"recipe": "forest"}, "drives": [{"log": "drive.mcap"}]},
        {"model": {"recipe": "physics"}, "drives": [{"log": "drive.mcap"}]},
    ],
)
def test_it_is_refused_where_no_estimate_is_there_to_choose_by(
    inputs: Path, tmp_path: Path, changes: dict[str, Any]
) -> None:
    asked(inputs, tmp_path / "run", None, **({"model": PHYSICS} | changes))
    with pytest.raises(UsageError, match=r"coarse.*model\.use"):
        asked(inputs, tmp_path / "run", COARSE, **({"model": PHYSICS} | changes))


def test_the_command_takes_it(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["estimate", str(inputs / "map_canyon.pcd"), "--route", str(inputs / "canyon.csv")]
    line += ["--model", "physics", "--range-max", "14", "--workers", "1"]
    line += ["--out", str(tmp_path / "run"), "--dry-run"]
    assert command([*line, "--coarse", "4", "--tolerance", "0.1"]) == 0
    assert "the first round takes" in capsys.readouterr().out
    assert command([*line, "--tolerance", "0.1"]) == 2
    assert "--coarse" in capsys.readouterr().err
    assert command([*line, "--coarse", "1"]) == 2
    assert "--coarse" in capsys.readouterr().err


# --- Reports of places that are made up


def test_report_and_gate_count_interpolated_places_apart(tmp_path: Path) -> None:
    found = without_labels()
    places = found.places.astype({"in_domain": "boolean"})
    between = places["sample"].between(5, 60) & places["estimate"].notna()
    places.loc[between, "status"] = INTERPOLATED
    places.loc[between, "in_domain"] = pd.NA
    places.loc[between, ["low", "high"]] = np.nan
    told = replace(found, places=places)
    head = summary(told, 0.15)["headline"]
    assert head["interpolated"] == between.sum()
    assert head["estimated"] == summary(found, 0.15)["headline"]["estimated"]
    above = gate(places, 0.15)[0]
    over = (places["estimate"] > 0.15) & between
    assert f"({over.sum()} of them interpolated)" in above
    assert "interpolated" not in gate(found.places, 0.15)[0]
    write_report(told, tmp_path / "report", threshold=0.15)
    page = (tmp_path / "report" / "index.html").read_text()
    assert "interpolated, not evaluated" in page
