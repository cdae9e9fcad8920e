"""One model over several runs: what may differ between them, what must not, what its card says."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import model_data
import numpy as np
import pytest

import tilestream as ts
from tilestream.errors import ModelError, UsageError
from tilestream.matcher import MATCHERS
from tilestream.model.applicability import check_making
from tilestream.model.card import card_told
from tilestream.model.checked import checked_of
from tilestream.model.dataset import Dataset, made_with
from tilestream.model.domain import WIDEST
from tilestream.model.evaluation import cross_validate
from tilestream.model.figures import figures_of
from tilestream.model.file import load_model, save_model
from tilestream.model.making import inputs_of
from tilestream.model.over_runs import Run, over_runs
from tilestream.model.prediction import predict
from tilestream.model.splits import BUFFER, OVER_RUNS, PROTOCOLS, leave_path_out, protocols_of
from tilestream.model.training import train
from tilestream.pipeline.jobs.train_over import as_read
from tilestream.sensor import Sensor

LENGTHS = {"a": 240, "b": 240, "c": 240}
LESSER = ts.VLP16.with_beams(8)


def making(sensor: Sensor = ts.VLP16, matcher: str = "autoware", **seeing: Any) -> dict[str, Any]:
    columns = (*model_data.COLUMNS, *model_data.OBSERVED)
    return made_with(columns, sensor, 2.0) | {
        "sensor_height": 2.0,
        "map_leaf": 0.2,
        "seeing": ts.VirtualSettings(**seeing).model_dump(mode="json"),
        "matcher": MATCHERS[matcher].model_dump(mode="json"),
    }


def measured(seed: int, of: dict[str, Any]) -> Dataset:
    found = model_data.with_virtual_drives(model_data.dataset(seed, 0.7, LENGTHS), seed=seed)
    identity = {
        "drive": {"as_sensor": "as recorded", "true_pose": "log", "registration": of["matcher"]}
    }
    return replace(found, made_with=of, data_sets=identity)


@pytest.fixture(scope="module")
def runs() -> dict[str, Dataset]:
    return {
        "vlp": measured(1, making()),
        "hdl": measured(2, making(ts.HDL64, range_max=80.0)),
        "lesser": measured(3, making(LESSER, "default", range_max=30.0, blind_rear_deg=120.0)),
    }


@pytest.fixture(scope="module")
def together(runs: dict[str, Dataset]) -> Dataset:
    return over_runs({name: Run(one) for name, one in runs.items()})


@pytest.fixture(scope="module")
def model(runs: dict[str, Dataset]) -> Any:
    return ts.train_over(runs, recipe="physics")


def test_rows_are_named_by_their_run_and_none_is_lost(
    runs: dict[str, Dataset], together: Dataset
) -> None:
    assert len(together) == sum(map(len, runs.values()))
    for name, one in runs.items():
        own = together.rows[together.rows["group"] == f"{name}/drive"]
        assert list(own["path"]) == [f"{name}/{path}" for path in one.rows["path"]]
        assert list(own["block"]) == [f"{name}/{block}" for block in one.rows["block"]]
        np.testing.assert_array_equal(own["error_mean"], one.rows["error_mean"])
        averaged = together.averaged(2.0).rows.loc[own.index, "vd_mean"]
        np.testing.assert_array_equal(averaged, one.averaged(2.0).rows["vd_mean"])
    assert together.rows["lidar"].nunique() == 3
    assert set(together.streets) == {f"one district/{path}" for path in LENGTHS}


def test_a_street_held_out_is_held_out_in_all_runs(together: Dataset) -> None:
    splits = leave_path_out(together)
    assert len(splits) == len(LENGTHS)
    for split in splits:
        held, train_ = (set(together.streets[rows]) for rows in (split.test, split.train))
        assert len(held) == 1
        assert held.isdisjoint(train_)
        assert together.rows.iloc[split.test]["lidar"].nunique() == 3


def test_a_lidar_held_out_is_estimated_on_streets_that_no_other_lidar_trained_on(
    together: Dataset,
) -> None:
    splits = OVER_RUNS[0].splits(together, 0)
    at = together.rows[["x", "y"]].to_numpy()
    for split in splits:
        test, train_ = (together.rows.iloc[rows] for rows in (split.test, split.train))
        assert test["lidar"].nunique() == 1
        assert set(test["lidar"]).isdisjoint(train_["lidar"])
        apart = np.hypot(*(at[split.train[:, None]] - at[split.test[None]]).transpose(2, 0, 1))
        assert apart.min() > BUFFER
    assert sorted(np.concatenate([split.test for split in splits])) == list(range(len(together)))


def test_a_district_is_held_out_whatever_its_coordinates(runs: dict[str, Dataset]) -> None:
    """Two cities in frames of their own, where the numbers of the coordinates are the same."""
    cities = {"vlp": "Chiyoda", "hdl": "Chiyoda", "lesser": "Nerima"}
    found = over_runs({name: Run(one, cities[name]) for name, one in runs.items()})
    splits = OVER_RUNS[1].splits(found, 0)
    assert [len(split.test) + len(split.train) for split in splits] == [len(found)] * 2
    for split in splits:
        held = set(found.rows.iloc[split.test]["district"])
        assert held.isdisjoint(found.rows.iloc[split.train]["district"])


def test_protocols_that_cannot_be_followed_say_so(runs: dict[str, Dataset]) -> None:
    assert protocols_of(runs["vlp"]) == PROTOCOLS
    alone = over_runs({"vlp": Run(runs["vlp"])})
    found = cross_validate(alone, "physics")
    assert "one lidar only" in str(found["lidar"])
    assert "one district only" in str(found["district"])
    assert len(found["path"]) == len(alone)


def test_what_must_be_equal_is_refused_by_name(runs: dict[str, Dataset]) -> None:
    one = runs["vlp"]
    for changes, named in (
        ({"cell_size": 1.0}, "cell_size"),
        ({"map_leaf": 0.1}, "map_leaf"),
        ({"seeing": {**one.made_with["seeing"], "draws": 3}}, "seeing.draws"),
        ({"seeing": {**one.made_with["seeing"], "without_ghosts": False}}, "without_ghosts"),
        ({"units": {**one.made_with["units"], "vd_mean": "cm"}}, "units.vd_mean"),
    ):
        other = replace(one, made_with={**one.made_with, **changes})
        with pytest.raises(ModelError, match=named):
            ts.train_over({"one": one, "other": other}, recipe="physics")
    with pytest.raises(ModelError, match="factors"):
        ts.train_over({"one": one, "other": one.with_columns(one.columns[:-1])})
    with pytest.raises(UsageError, match="twice: its labels would count twice"):
        ts.train_over({"one": one, "other": one}, recipe="physics")
    newer = replace(one, stages={"observe": 9})
    with pytest.raises(ModelError, match="versions of stages"):
        ts.train_over({"one": one, "other": newer})
    as_other = {"drive": {**one.data_sets["drive"], "as_sensor": "16beams-30m"}}
    with pytest.raises(ModelError, match="16beams-30m"):
        ts.train_over({"one": one, "other": replace(one, data_sets=as_other)})
    starts = {"drive": {**one.data_sets["drive"], "starts": {"radius": 1.0}}}
    with pytest.raises(ModelError, match="starts"):
        ts.train_over({"one": one, "other": replace(one, data_sets=starts)}, recipe="physics")


def test_only_recipes_that_know_the_lidar_learn_from_several(runs: dict[str, Dataset]) -> None:
    with pytest.raises(UsageError, match="does not know the lidar"):
        ts.train_over(runs, recipe="forest")
    with pytest.raises(UsageError, match="no run is named so"):
        ts.train_over(runs, recipe="physics", districts={"vlp16": "Chiyoda"})
    with pytest.raises(UsageError, match="no run"):
        ts.train_over({})


def test_the_card_has_the_ranges_of_all_runs_and_is_kept(model: Any, tmp_path: Path) -> None:
    card = model.card
    inputs = card["inputs"]
    assert inputs["beams"] == [8.0, 64.0]
    assert inputs["range_m"] == [30.0, 100.0]
    assert inputs["blind_rear_deg"] == [0.0, 120.0]
    assert inputs["matcher.solver"] == ["definite", "raw"]
    assert inputs["height_m"] == [2.0, 2.0]
    assert len(card["lidars"]) == 3
    assert card["matchers"] == ["autoware", "default"]
    assert card["places"] == 720 * 3
    assert model.data_set == {"as_sensor": "as recorded", "true_pose": "log"}
    path = tmp_path / "model.skops"
    ts.train_over({"a": measured(1, making())}, recipe="physics", out=path)
    assert load_model(path).card["lidars"] == ["VLP16, 16 beams, 100 m"]


def test_inside_of_the_card_nothing_happens_outside_it_is_flagged_with_its_range(
    model: Any, runs: dict[str, Dataset]
) -> None:
    places = runs["vlp"].averaged(model.width).rows
    plain = predict(model, places)
    within = making(ts.VLP16.with_beams(12), range_max=50.0, seed=7)
    assert check_making(model, within) == []
    assert predict(model, places, within).equals(plain)
    found = predict(model, places, making(range_max=20.0))
    assert found["estimate"].equals(plain["estimate"])
    assert not found["in_domain"].any()
    assert found["reason"].str.contains("range_m 20, trained over 30 to 100", regex=False).all()
    outside = [one.name for one in check_making(model, making(ts.OS1_128))]
    assert "beams" in outside


def test_outside_of_the_card_intervals_are_as_wide_as_held_out_lidars_need(
    model: Any, runs: dict[str, Dataset], tmp_path: Path
) -> None:
    assert 1.0 <= model.card["wider_outside"] <= WIDEST
    harder = replace(model, card={**model.card, "wider_outside": 2.0})
    save_model(harder, tmp_path / "m.skops")
    places = runs["vlp"].averaged(model.width).rows
    plain = predict(model, places)
    found = predict(load_model(tmp_path / "m.skops"), places, making(range_max=20.0))
    grown = (found["high"] - found["estimate"]) / (plain["high"] - plain["estimate"])
    assert grown.to_numpy() == pytest.approx(2.0)
    assert (found["low"] <= plain["low"]).all()
    assert found["reason"].str.contains("its interval 2 times wider", regex=False).all()


def test_a_lidar_unlike_all_others_asks_for_wider_intervals(runs: dict[str, Dataset]) -> None:
    """The same labels, but of one lidar twice what its virtual drive says."""
    rows = runs["hdl"].rows
    twice = replace(runs["hdl"], rows=rows.assign(error_mean=2.0 * rows["error_mean"]))
    alike = ts.train_over(runs, recipe="physics").wider_outside
    unlike = ts.train_over({**runs, "hdl": twice}, recipe="physics").wider_outside
    assert unlike > alike


def test_held_out_figures_are_those_of_cross_validation(together: Dataset) -> None:
    found = checked_of(together, "physics")
    points = cross_validate(together, "physics")
    for name, protocol in (("held-out paths", "path"), ("held-out lidar", "lidar")):
        told, of = found[name], figures_of(points[protocol])
        assert told["places"] == len(points[protocol])
        assert (told["mae_m"], told["skill"][0]) == (of.mae, of.skill)
        assert told["skill"][1] <= of.skill <= told["skill"][2]
        assert told["over_physics"] == [0.0, 0.0, 0.0]  # it is physics
        assert 0.5 < told["coverage"][0] <= 1.0
    assert "held-out district" not in found  # there is one
    assert found["held-out lidar"]["of_paths"] == pytest.approx(1.0, abs=0.2)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_a_card_says_what_the_model_is_worth_where_it_is_asked_for(
    runs: dict[str, Dataset], model: Any
) -> None:
    judged = ts.train_over(runs, recipe="physics", judge=True)
    assert "checked" not in model.card
    assert judged.card["checked"]["held-out paths"]["places"] == judged.card["places"]
    assert any("held-out paths" in line for line in card_told(judged.card))


def test_what_may_not_differ_is_refused_by_a_model_of_several_lidars_too(model: Any) -> None:
    with pytest.raises(ModelError, match="cell_size"):
        check_making(model, making() | {"cell_size": 1.0})
    with pytest.raises(ModelError, match="draws"):
        check_making(model, making(draws=3))


def test_a_model_of_one_run_refuses_another_lidar_as_before(runs: dict[str, Dataset]) -> None:
    alone = train(runs["vlp"], recipe="physics")
    assert alone.card["judged"] == []
    assert alone.card["inputs"]["beams"] == [16.0, 16.0]
    for other in (making(ts.HDL64), making(matcher="default"), making(range_max=50.0)):
        with pytest.raises(ModelError, match="does not match"):
            check_making(alone, other)


def test_one_lidar_with_two_matchers_judges_the_matcher_only(runs: dict[str, Dataset]) -> None:
    other = measured(5, making(matcher="default"))
    found = ts.train_over({"one": runs["vlp"], "other": other}, recipe="physics")
    assert found.card["judged"] == ["matcher"]
    assert check_making(found, making(matcher="default")) == []
    with pytest.raises(ModelError, match="sensor does not match"):
        check_making(found, making(ts.HDL64))


def test_a_vehicle_of_two_tilted_lidars_is_described_in_its_own_frame() -> None:
    mounts = [{"z": 1.0, "pitch_deg": 10.0}, {"z": 0.0, "x": 3.0, "y": 4.0}]
    sensors = [{**ts.VLP16.model_dump(mode="json"), "mount": mount} for mount in mounts]
    found = inputs_of(making() | {"sensor": {"sensors": sensors}})
    assert found["lidars"] == 2.0
    assert found["beams"] == 32.0
    assert found["elevation_low_deg"] == pytest.approx(-25.0)
    assert found["elevation_high_deg"] == pytest.approx(25.0)
    assert found["height_m"] == pytest.approx(2.5)
    assert found["offset_m"] == pytest.approx(5.0)


def test_a_place_of_another_world_has_a_wider_interval_and_says_so(
    model: Any, runs: dict[str, Dataset]
) -> None:
    places = runs["vlp"].averaged(model.width).rows.iloc[[0] * 4].reset_index(drop=True)
    k = model.factors.index("ob_hint")
    unit = model.domain.distance(
        model.domain.middle + np.eye(len(model.factors))[[k]] * model.domain.scale[k]
    )[0]
    wanted = np.array([0.5, 1.5, 2.0, 50.0])  # in thresholds, from the middle
    places[list(model.factors)] = model.domain.middle
    places["ob_hint"] += wanted * model.domain.threshold / unit * model.domain.scale[k]
    found = predict(model, places)
    np.testing.assert_allclose(found["domain_distance"], wanted * model.domain.threshold)
    assert list(found["in_domain"]) == [True, False, False, False]
    assert found["estimate"].nunique() == 1
    above = found["high"] - found["estimate"]
    np.testing.assert_allclose(above / above[0], [1.0, 1.5, 2.0, 3.0])
    low, _ = model.interval.around(found["estimate"].to_numpy(), np.array([1.0, 1.5, 2.0, 3.0]))
    np.testing.assert_allclose(found["low"], low, rtol=1e-9)
    assert "wider" not in found["reason"][0]
    for row, times in ((1, "1.5"), (2, "2"), (3, "3")):
        assert "unlike the training places (ob_hint" in found["reason"][row]
        assert f"its interval {times} times wider" in found["reason"][row]


def test_the_fewer_places_teach_a_model_the_less_its_interval_promises(
    runs: dict[str, Dataset], model: Any
) -> None:
    rows = runs["vlp"].rows
    few = runs["vlp"].take(np.flatnonzero(rows["path"].isin(["a", "b"])))
    alone = train(few, recipe="physics")
    assert alone.interval.blocks == 2
    assert alone.facts["wider_for_few_blocks"] == pytest.approx(1.296, abs=1e-3)
    assert model.interval.blocks == 3  # pieces: the same streets with three lidars


def test_drives_of_one_job_are_each_the_lidar_that_they_are_read_as() -> None:
    settings = ts.RunSettings(
        out="run",
        map={"sources": ["map.las"]},
        sensor="HDL64",
        drives=[
            {"log": "a.mcap"},
            {"log": "b.mcap", "beams": 16, "range_max": 30.0, "blind_rear_deg": 120.0},
            {"log": "c.mcap", "deskew": True},
        ],
    )
    found = {group: inputs_of(made) for group, made in as_read(settings).items()}
    lidars = {name: (one["beams"], one["range_m"]) for name, one in found.items()}
    assert lidars == {"a": (64.0, 120.0), "b": (16.0, 30.0), "c": (64.0, 120.0)}
    assert [one["blind_rear_deg"] for one in found.values()] == [0.0, 120.0, 0.0]
