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


def test_the_plan_that_ships_has_every_combination_once(retrain: Any, tmp_path: Path) -> None:
    runs = dict(retrain.runs_of(wanted(retrain, tmp_path)))
    assert len(runs) == 5 * 2 * 2 * 2
    assert len({run.out for run in runs.values()}) == len(runs)
    for run in runs.values():
        assert run.spacing == 5.0
        assert run.model.untrained(1000)
        preset = load_preset(run.simulate.preset)  # the city is seen as the map is observed
        assert preset.lidar.model.elevations_deg == run.vehicle.elevations_deg
        assert preset.lidar.model.range_max == run.observe.range_max
        assert preset.lidar.blind_deg == run.observe.blind_rear_deg
        assert preset.lidar.height == run.sensor_height
    beams = {len(run.vehicle.elevations_deg) for run in runs.values()}
    assert beams == {8, 16, 64, 128}
    cities = {run.simulate.folder: set() for run in runs.values()}
    for run in runs.values():
        cities[run.simulate.folder].add(run.label.registration.told)
    assert len(cities) == 20
    assert set(map(frozenset, cities.values())) == {frozenset({"autoware", "default"})}


def test_a_dry_run_tells_what_it_costs_and_simulates_nothing(
    retrain: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = wanted(retrain, tmp_path, size="small", presets=["physical"], matchers=["autoware"])
    total = retrain.plan(few)
    told = capsys.readouterr().out
    assert total > 0.0
    assert f"{total:.3f} core-hours in all" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cities"]
    assert all(p.suffix == ".yaml" for p in (tmp_path / "cities").iterdir())


def test_a_city_that_two_matchers_share_is_forecast_once(retrain: Any, tmp_path: Path) -> None:
    few = {"size": "small", "presets": ["physical"], "seeds": [0]}
    one, two = (
        retrain.plan(wanted(retrain, tmp_path, **few, matchers=matchers))
        for matchers in (["autoware"], ["autoware", "default"])
    )
    assert one > 0.0
    assert two == pytest.approx(one)  # what comes after the simulation is not known before it


def test_a_wrong_key_or_several_lidars_on_a_vehicle_are_refused(
    retrain: Any, tmp_path: Path
) -> None:
    with pytest.raises((UsageError, TypeError), match="lidarz"):
        wanted(retrain, tmp_path, lidarz=1)
    two = {"two": {"sensor": ["VLP16", "HDL64"]}}
    with pytest.raises(UsageError, match="one lidar"):
        list(retrain.runs_of(wanted(retrain, tmp_path, lidars=two)))
    text = yaml.safe_dump({"out": str(tmp_path)})
    (tmp_path / "none.yaml").write_text(text)
    with pytest.raises((UsageError, TypeError), match="lidars"):
        retrain.Retraining(**read_yaml(tmp_path / "none.yaml", UsageError))
