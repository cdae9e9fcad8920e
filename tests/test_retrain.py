"""The plan of a retraining: each lidar, preset, seed and matcher once, each in its own folder."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tilestream.bounded_yaml import read_yaml
from tilestream.errors import UsageError
from tilestream.simulation.settings import load_preset

PIPELINES = Path(__file__).resolve().parents[1] / "pipelines"


@pytest.fixture(scope="module")
def retrain() -> Any:
    spec = importlib.util.spec_from_file_location("retrain", PIPELINES / "retrain.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["retrain"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["retrain"]


def wanted(retrain: Any, out: Path, **changes: Any) -> Any:
    values = read_yaml(PIPELINES / "retrain.yaml", UsageError)
    return retrain.Retraining(**{**values, "out": str(out), **changes})


def test_the_plan_that_ships_sees_each_city_as_its_lidar_does(retrain: Any, tmp_path: Path) -> None:
    runs = dict(retrain.runs_of(wanted(retrain, tmp_path)))
    assert len({run.out for run in runs.values()}) == len(runs)
    for run in runs.values():
        assert run.model.untrained(1000)
        assert run.spacing == run.simulate.every
        preset = load_preset(run.simulate.preset)  # the city is seen as the map is observed
        assert preset.lidar.model.elevations_deg == run.vehicle.elevations_deg
        assert preset.lidar.model.range_max == min(run.observe.range_max, run.vehicle.range_max)
        assert preset.lidar.blind_deg == run.observe.blind_rear_deg
        assert preset.lidar.height == run.sensor_height
    beams = {len(run.vehicle.elevations_deg) for run in runs.values()}
    assert beams == {8, 16, 64, 128}
    assert {run.simulate.city for run in runs.values()} == {"shinjuku", "sendagaya"}
    assert {run.simulate.seed for run in runs.values()} == {0, 1, 2}
    assert {run.label.registration.told for run in runs.values()} == {"autoware", "default"}


def test_runs_of_one_city_share_its_survey_and_its_map(retrain: Any, tmp_path: Path) -> None:
    runs = list(dict(retrain.runs_of(wanted(retrain, tmp_path))).values())
    cities: dict[Any, list[Any]] = {}
    for run in runs:
        city = run.simulate.city, load_preset(run.simulate.preset).preset, run.simulate.seed
        cities.setdefault(city, []).append(run)
    assert len(cities) == 6
    for of_city in cities.values():
        first, *others = of_city
        assert first.simulate.survey_of is None
        assert all(run.simulate.survey_of == first.simulate.folder for run in others)
        assert len({run.map.store for run in of_city}) == 1
        mine, theirs = (set(run.simulate.paths or "*") for run in (first, of_city[-1]))
        assert "*" in mine or mine == theirs  # or the survey lacks a street
    assert len({run.map.store for run in runs}) == 6


def test_a_dry_run_tells_what_it_costs_and_simulates_nothing(
    retrain: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shares = [{"lidars": ["VLP16", "OS1"], "presets": ["physical"]}]
    total = retrain.plan(wanted(retrain, tmp_path, size="small", shares=shares))
    told = capsys.readouterr().out
    assert total > 0.0
    assert f"{total:.3f} core-hours in all" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cities"]
    assert all(p.suffix in (".yaml", ".geojson") for p in (tmp_path / "cities").iterdir())


def test_a_city_that_two_matchers_share_is_forecast_once(retrain: Any, tmp_path: Path) -> None:
    share = {"lidars": ["VLP16"], "presets": ["physical"]}
    one, two = (
        retrain.plan(
            wanted(retrain, tmp_path, size="small", shares=[{**share, "matchers": matchers}])
        )
        for matchers in (["autoware"], ["autoware", "default"])
    )
    assert one > 0.0
    assert two == pytest.approx(one)  # what comes after the simulation is not known before it


def test_a_wrong_key_a_run_twice_or_several_lidars_on_a_vehicle_are_refused(
    retrain: Any, tmp_path: Path
) -> None:
    with pytest.raises((UsageError, TypeError), match="lidarz"):
        wanted(retrain, tmp_path, lidarz=1)
    with pytest.raises((UsageError, TypeError, ValueError), match="VLP17"):
        wanted(retrain, tmp_path, shares=[{"lidars": ["VLP17"]}])
    twice = wanted(retrain, tmp_path, shares=[{"lidars": ["VLP16"]}] * 2)
    with pytest.raises(UsageError, match="in two shares"):
        list(retrain.runs_of(twice))
    two = {"two": {"sensor": ["VLP16", "HDL64"]}}
    several = wanted(retrain, tmp_path, lidars=two, shares=[{"lidars": ["two"]}])
    with pytest.raises(UsageError, match="one lidar"):
        list(retrain.runs_of(several))
    text = yaml.safe_dump({"out": str(tmp_path)})
    (tmp_path / "none.yaml").write_text(text)
    with pytest.raises((UsageError, TypeError), match="lidars"):
        retrain.Retraining(**read_yaml(tmp_path / "none.yaml", UsageError))
