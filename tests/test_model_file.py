"""Estimates of every place: the same in any company, explained, refused where they cannot be."""

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sklearn
import skops.io
from forest_data import COLUMNS, dataset, drives
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import spearmanr
from sklearn.linear_model import LinearRegression

from tilestream.errors import ModelError, SourceNotFoundError, UsageError
from tilestream.model import model_file, training
from tilestream.model.dataset import TARGETS, Dataset, features_of, join, made_with
from tilestream.model.domain import domain_of
from tilestream.model.model_file import load_model, save_model
from tilestream.model.models import Recipe, grow
from tilestream.model.phrases import PHRASES, REASSURING, phrase_of
from tilestream.model.reasons import (
    SHARES,
    UNITS,
    Typical,
    compared,
    contributions,
    in_words,
    typical_of,
)
from tilestream.model.training import PREDICTION_COLUMNS, Model, predict, train
from tilestream.pipeline.stages.predict import physical
from tilestream.pipeline.stages.samples import COLUMNS as COLUMNS_LEARNT
from tilestream.records import Column
from tilestream.sensor import HDL64, VLP16

MADE_WITH = made_with(COLUMNS, VLP16, 2.0)
NAMES = [column.name for column in COLUMNS]
THREE = {"a": 230, "b": 230, "c": 230}


@pytest.fixture(scope="module")
def learnt() -> Dataset:
    found = dataset(1, related=0.9, lengths=THREE)
    return replace(found, made_with=MADE_WITH, data_sets={"drive": {"solver": "raw", "leaf": 2.0}})


@pytest.fixture(scope="module")
def model(learnt: Dataset) -> Model:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "PAPER", Recipe(trees=15))
        return train(learnt, recipe="paper")


@pytest.fixture(scope="module")
def places() -> pd.DataFrame:
    return drives(2, {"d": 200})[0]


def test_a_place_has_all_estimates(model: Model, places: pd.DataFrame) -> None:
    found = predict(model, places, MADE_WITH)
    assert list(found) == [column.name for column in PREDICTION_COLUMNS]
    assert found.index.equals(places.index)
    assert found.drop(columns=["reason"]).notna().all(axis=None)
    assert (found["status"] == "done").all()
    assert ((found["low"] < found["estimate"]) & (found["estimate"] < found["high"])).all()
    assert found["p_fail"].between(0.0, 1.0).all()
    assert np.allclose(found["floor"], 0.5 * found["estimate"], rtol=0.3)
    assert (found["reason"] != "")[found["estimate"] > model.worst].all()
    assert (found["reason"] == "")[(found["estimate"] <= model.worst) & found["in_domain"]].all()


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_place_has_the_same_bits_in_any_company(
    model: Model, places: pd.DataFrame, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    some = rng.permutation(len(places))[: rng.integers(1, 30)]
    whole = predict(model, places).iloc[some]
    pd.testing.assert_frame_equal(predict(model, places.iloc[some]), whole, check_exact=True)


def test_the_same_model_from_rows_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "PAPER", Recipe(trees=5))
    factors, labels = drives(4, {"a": 150, "b": 220})
    mixed = factors.sample(frac=1.0, random_state=0), labels.sample(frac=1.0, random_state=1)
    one, two = (
        predict(train(join(f, {"drive": x}, COLUMNS), recipe="paper"), factors)
        for f, x in ((factors, labels), mixed)
    )
    pd.testing.assert_frame_equal(one, two, check_exact=True)


def test_a_factor_that_is_nan_gives_no_estimate(model: Model, places: pd.DataFrame) -> None:
    holes = places.copy()
    holes.loc[3, "score_H"] = np.nan
    holes.loc[5, "FDOP"] = np.inf
    holes.loc[5, "reason"] = "nothing in view"
    found = predict(model, holes)
    assert found["status"].value_counts().to_dict() == {"done": 198, "missing": 2}
    estimates = [c.name for c in PREDICTION_COLUMNS if c.dtype == "float64"]
    assert found.loc[[3, 5], estimates].isna().all(axis=None)
    assert not found.loc[[3, 5], "in_domain"].any()
    assert found.loc[3, "reason"] == "no estimate: score_H is not a number"
    assert found.loc[5, "reason"] == "no estimate: FDOP is not a number: nothing in view"
    whole = predict(model, places)
    without = (table.drop(index=[3, 5]) for table in (found, whole))
    pd.testing.assert_frame_equal(*without, check_exact=True)
    nothing = predict(model, holes.loc[[3]])
    assert nothing["status"].tolist() == ["missing"]
    assert predict(model, places.iloc[:0]).empty


def test_other_factors_than_it_was_trained_with_are_refused_by_name(
    model: Model, places: pd.DataFrame
) -> None:
    with pytest.raises(ModelError, match="lacks factors that the model needs: FDOP, score_H"):
        predict(model, places.drop(columns=["score_H", "FDOP"]))
    with pytest.raises(ModelError, match="no numbers: FDOP"):
        predict(model, places.assign(FDOP="near"))
    with pytest.raises(
        ModelError,
        match=r"sensor does not match in .*name.*: the model was trained with name VLP16",
    ):
        predict(model, places, made_with(COLUMNS, HDL64, 2.0))
    with pytest.raises(ModelError, match=r"cell_size does not match: .* 2\.0, .* 1\.0"):
        predict(model, places, made_with(COLUMNS, VLP16, 1.0))
    units = {**MADE_WITH, "units": {**MADE_WITH["units"], "FDOP": "1/m"}}
    with pytest.raises(ModelError, match="FDOP is in '1/m' in the table and was in '1'"):
        predict(model, places, units)
    with pytest.raises(ModelError, match="cell_size does not match"):
        predict(model, places, {k: v for k, v in MADE_WITH.items() if k != "cell_size"})


def test_a_place_unlike_the_training_places_is_flagged(model: Model, learnt: Dataset) -> None:
    inside = predict(model, learnt.rows)
    assert inside["in_domain"].mean() > 0.9
    strange = learnt.rows.copy()
    strange["bhatt_sim"] += 40.0
    found = predict(model, strange)
    assert not found["in_domain"].any()
    assert found["reason"].str.contains("unlike the training places (bhatt_sim", regex=False).all()
    # Each factor within its range, but together as never seen.
    rng = np.random.default_rng(0)
    x = rng.normal(size=(500, 1))
    tied = np.hstack([x, x + 0.01 * rng.normal(size=(500, 1))])
    domain = domain_of(tied, np.repeat([f"b{k}" for k in range(5)], 100))
    assert domain.distance(np.array([[1.5, -1.5]]))[0] > domain.threshold
    assert domain.distance(np.array([[1.5, 1.5]]))[0] < domain.threshold


def test_a_constant_factor_is_part_of_the_domain() -> None:
    X = np.column_stack([np.full(100, 16.0), np.arange(100.0)])
    domain = domain_of(X, np.full(100, "b"))
    assert (domain.distance(X) <= domain.threshold).mean() >= 0.99
    assert domain.distance(np.array([[32.0, 50.0]]))[0] > domain.threshold


def test_contributions_add_up_to_the_estimate(learnt: Dataset) -> None:
    for log in (False, True):
        forest = grow(learnt, "error_mean", Recipe(trees=7, leaf=3, log=log))
        X = learnt.matrix()[:40]
        roots = np.mean([t.tree_.value[0, 0, 0] for t in forest.trees.estimators_])
        added = contributions(forest.trees, X)
        assert np.allclose(added.sum(axis=1) + roots, forest.trees.predict(X), rtol=0, atol=1e-12)
    unused = np.setdiff1d(
        np.arange(X.shape[1]), np.concatenate([t.tree_.feature for t in forest.trees.estimators_])
    )
    assert (added[:, unused] == 0.0).all()


def usual(names: list[str], middle: list[float], rho: list[float], unit: str = "1") -> Typical:
    """What is typical, with quartiles 10 % of the median away."""
    spread = 0.1 * np.array(middle)
    units = tuple("m" if name in ("vd_mean", "vd_along") else unit for name in names)
    return Typical(tuple(names), units, np.array(middle), spread, spread, np.array(rho), 0.15)


def test_reasons_are_words_for_what_raises_the_estimate() -> None:
    names = ["feature_count", "D1_count", "normal_H_8", "new_factor"]
    typical = usual(names, [900.0, 50.0, 3.0, 2.0], [-0.4, -0.3, -0.2, 0.1])
    X = np.array([[100.0, 5.0, 1.0, 9.0]])
    (words,) = in_words(np.array([[0.05, -0.01, 0.03, 0.001]]), names, X, typical)
    assert words == (
        "few features in view (feature_count 100, typically 900); "
        "parallel walls, surfaces face few directions (normal_H_8 1, typically 3); "
        "few poles and edges in view (D1_count 5, typically 50)"
    )
    same = ["D3_count", "D3_ratio", *names[2:]]
    (together,) = in_words(
        np.array([[0.03, 0.02, 0.04, 0.0]]), same, X, replace(typical, names=tuple(same))
    )
    assert together.startswith("bare surfaces without detail (D3_count 100, typically 900); ")
    assert in_words(np.full((1, 4), -1.0), names, typical.middle[None], typical) == [""]
    assert phrase_of("new_factor", True) == "high new_factor"


def test_a_symptom_is_followed_by_causes_in_the_map() -> None:
    names = [
        "vd_mean",
        "vd_along",
        "ob_info_along",
        "ob_returns",
        "wall_H",
        "sight_HDOP",
        "D2_count",
    ]
    middle = [0.05, 0.04, 9000.0, 0.8, 4.6, 2.2, 50.0]
    typical = usual(names, middle, [0.8, 0.7, -0.4, 0.3, -0.2, 0.1, -0.3])
    X = np.array([[0.892, 0.5, 600.0, 0.81, 4.0, 3.0, 60.0]])
    added = np.array([[0.5, 0.2, 0.01, 0.02]])
    (words,) = in_words(added, names[:4], X, typical)
    # ob_returns is as usual, sight_HDOP has no clear side, D2_count lies on its good one.
    assert words == (
        "a virtual drive does not hold its place (89\u00a0cm, typically 5\u00a0cm); "
        "nothing fixes the direction of travel (ob_info_along 600, typically 9000); "
        "parallel walls, surfaces face few directions (wall_H 4, typically 4.6)"
    )
    X[0, 4:] = np.nan
    (words,) = in_words(added, names[:4], X, typical)
    assert words.count("; ") == 1
    assert words.endswith(
        "; nothing fixes the direction of travel (ob_info_along 600, typically 9000)"
    )
    reassuring = usual(["vd_mean", "ob_unmapped"], [0.05, 0.1], [0.8, -0.4])
    (words,) = in_words(
        np.array([[0.5, 0.1]]), reassuring.names, np.array([[0.8, 0.0]]), reassuring
    )
    assert words == "a virtual drive does not hold its place (80\u00a0cm, typically 5\u00a0cm)"
    well = usual(["vd_mean", "ob_info_up"], [0.05, 9000.0], [0.8, -0.4])
    (words,) = in_words(np.array([[0.1, 0.5]]), well.names, np.array([[0.06, 99e3]]), well)
    assert words == "a virtual drive does not hold its place (6\u00a0cm, typically 5\u00a0cm)"
    assert in_words(np.array([[0.1, 0.5]]), well.names, np.array([[0.04, 99e3]]), well) == [""]


@pytest.mark.parametrize(
    ("name", "unit", "value", "middle", "told"),
    [
        ("vd_mean", "m", 0.892, 0.0536, "89\u00a0cm, typically 5.4\u00a0cm"),
        ("vd_mean", "m", 1.234, 0.0, "120\u00a0cm, typically 0\u00a0cm"),
        ("r_average", "m", 43.21, 63.35, "43\u00a0m, typically 63\u00a0m"),
        ("euclidean_dist", "m", 0.7512, 0.7466, "75.1\u00a0cm, typically 74.7\u00a0cm"),
        ("vd_p_fail", "1", 0.123, 0.0221, "12\u00a0%, typically 2.2\u00a0%"),
        ("normal_H_8", "bit", 0.41, 0.83, "normal_H_8 0.41 bit, typically 0.83 bit"),
        ("feature_count", "1", 1234.0, 9871.0, "feature_count 1200, typically 9900"),
        ("ob_info_up", "1/m^2", 574.7, 14756.0, "ob_info_up 570 per m², typically 15000 per m²"),
        ("ob_weak_angle", "rad", 0.1, 0.2, "ob_weak_angle 5.7°, typically 11°"),
        ("FDOP", "lux", 0.5, 0.5, "FDOP 0.5 lux, typically 0.5 lux"),
    ],
)
def test_figures_are_told_as_a_person_reads_them(
    name: str, unit: str, value: float, middle: float, told: str
) -> None:
    assert compared(0, value, usual([name], [middle], [0.5], unit)) == told


def test_what_is_typical_has_quartiles_and_a_bad_side() -> None:
    rng = np.random.default_rng(0)
    error = rng.lognormal(size=400)
    rare = (np.arange(400) % 10 == 0).astype(float)
    X = np.column_stack(
        [np.exp(-error), error + 8.0 * rng.normal(size=400), np.full(400, 16.0), rare]
    )
    columns = [Column(name, "FS", "1", "", "") for name in "abcd"]  # type: ignore[arg-type]
    found = typical_of(X, error, columns, 400)
    weak = spearmanr(X[:, 1], error).statistic
    often = spearmanr(rare, error).statistic
    assert found.rho == pytest.approx([-1.0, weak, 0.0, often])
    assert found.clear == 0.15
    assert typical_of(X, error, columns, 25).clear == pytest.approx(0.4)
    low, middle, high = np.percentile(X[:, 0], [25, 50, 75])
    assert found.middle[0] == pytest.approx(middle)
    values = np.array([[low, 0.0, 99.0, 0.0], [high, np.inf, 16.0, 1.0], [np.nan] * 4])
    out = found.out(values)
    assert out[:, 0] == pytest.approx([-1.0, 1.0, 0.0])
    assert (out[1:, 1] == 0.0).all()
    assert (out[:, 2] == 0.0).all()
    assert out[:, 3] == pytest.approx([0.0, 1.0 / rare.std(), 0.0])


def test_the_worst_places_name_a_cause_in_the_map() -> None:
    """The trees ask the virtual drive alone; the map's own factors say why it drifts."""
    factors, labels = drives(3, {"a": 500, "b": 500})
    rng = np.random.default_rng(3)
    seen = (
        Column("vd_mean", "OB", "m", "", "", "observability"),
        Column("ob_info_along", "OB", "1/m^2", "", "", "observability"),
    )
    error = labels["error_mean"].to_numpy()
    factors["vd_mean"] = error * np.exp(0.05 * rng.normal(size=len(error)))
    factors["ob_info_along"] = 500.0 / error * np.exp(rng.normal(size=len(error)))
    factors["angular_H"] = 5.0 - np.log(error) + 0.4 * rng.normal(size=len(error))
    learnt = join(factors, {"drive": labels}, (*COLUMNS, *seen))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "tuned", lambda *_: Recipe(trees=10, leaf=8, log=True))
        model = train(learnt)
    typical = model.typical
    assert model.factors == ("vd_mean", "ob_info_along")
    found = predict(model, factors)
    worst = factors[found["estimate"] > model.worst]
    reasons = found.loc[worst.index, "reason"].str.split("; unlike").str[0]
    assert reasons.str.startswith("a virtual drive does not hold its place (").all()
    out = np.sign(typical.rho) * typical.out(worst[list(typical.names)].to_numpy())
    own = [name in NAMES for name in typical.names]
    far = (out[:, own] >= 1.2) & (np.abs(typical.rho[own]) >= typical.clear)
    phrases = [phrase_of(n, bool(r > 0.0)) for n, r in zip(NAMES, typical.rho[own], strict=True)]
    causes = far & ~np.isin(phrases, list(REASSURING))
    assert causes.any(axis=1).sum() > 150
    assert reasons[causes.any(axis=1)].str.contains("; ").all()
    assert reasons.str.contains("features on few sides only (angular_H", regex=False).sum() > 150
    lean = predict(model, factors[["vd_mean", "ob_info_along"]])
    pd.testing.assert_frame_equal(lean.drop(columns="reason"), found.drop(columns="reason"))
    assert lean["reason"].str.contains("nothing fixes the direction of travel").sum() > 50
    assert not lean["reason"].str.contains("angular_H").any()


def test_without_training_reasons_rest_on_fixed_bounds() -> None:
    usual = {
        "status": "done", "reason": "", "vd_mean": 0.06, "vd_floor": 0.02, "vd_tail": 0.04,
        "vd_p_fail": 0.1, "vd_along": 0.05, "vd_across": 0.02, "vd_up": 0.01,
        "ob_info_along": 9000.0, "ob_info_across": 12000.0,
        "ob_unmapped": 0.02, "ob_ghosts": 0.1, "ob_returns": 0.8,
    }  # fmt: skip
    tunnel = {"vd_mean": 0.57, "vd_along": 0.55, "ob_info_along": 600.0}
    blind = {"vd_mean": 0.2, "vd_across": 0.18, "ob_info_across": 900.0, "ob_returns": 0.3}
    edge = {"vd_mean": 0.2, "vd_up": 0.19, "ob_unmapped": 0.25, "ob_ghosts": 0.45}
    nothing = {"vd_mean": np.nan, "status": "missing", "reason": "nothing in view"}
    loose = {"vd_mean": 0.3, "ob_info_along": -5.0, "ob_info_across": 0.0}  # H has no maximum
    rows = pd.DataFrame([usual | other for other in ({}, tunnel, blind, edge, nothing, loose)])
    found = physical(rows, 0.01)
    told = found["reason"].str.replace("\u00a0", " ").str.split("; ").tolist()
    assert told == [
        [""],
        [
            "a virtual drive slides along the road (55 cm)",
            "nothing fixes the direction of travel (5 % of what fixes the other)",
        ],
        [
            "a virtual drive slides across the road (18 cm)",
            "nothing fixes the direction across (10 % of what fixes the other)",
            "few beams would come back (30 %)",
        ],
        [
            "a virtual drive rises or sinks (19 cm)",
            "much of the view is not in the map (25 %)",
            "traffic baked into the map stands in view (45 %)",
        ],
        ["nothing in view"],
        ["a virtual drive slides along the road (5 cm)"],
    ]
    assert found["in_domain"].isna().all()
    assert found.loc[:3, "estimate"].tolist() == pytest.approx([0.07, 0.58, 0.21, 0.21])
    empty = ["low", "high", "domain_distance"]
    assert found[empty].isna().all(axis=None)
    pd.testing.assert_frame_equal(physical(rows.iloc[[2]], 0.01), found.iloc[[2]])


def test_every_factor_has_a_phrase_and_its_unit_words() -> None:
    columns = features_of(COLUMNS_LEARNT)
    assert {column.name for column in columns} == set(PHRASES)
    assert set(NAMES) <= set(PHRASES)
    assert {column.unit for column in columns} <= {"m", *UNITS}
    shares = {c.name for c in columns if c.meaning.startswith(("Share", "Mean share"))}
    assert shares == SHARES


def test_a_model_is_one_file(model: Model, places: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "out" / "model.skops"
    save_model(model, path)
    again = load_model(path)
    pd.testing.assert_frame_equal(predict(again, places), predict(model, places), check_exact=True)
    assert again.factors == tuple(NAMES)
    assert again.made_with == MADE_WITH
    assert again.data_set == {"solver": "raw", "leaf": 2.0}
    assert again.facts == model.facts
    assert again.interval == model.interval
    assert set(again.forests) == set(TARGETS)
    assert [p.name for p in path.parent.iterdir()] == ["model.skops"]
    with zipfile.ZipFile(path) as archive:
        types = set(model_file._types(json.loads(archive.read("schema.json"))))
    assert types == model_file.TYPES
    assert set(skops.io.get_untrusted_types(file=path)) <= set(model_file.TRUSTED)


def altered(path: Path, facts: dict[str, Any]) -> None:
    """Write the model of `path` anew with other facts inside."""
    content = skops.io.loads(path.read_bytes(), trusted=list(model_file.TRUSTED))
    content["facts"] = json.dumps(json.loads(content["facts"]) | facts)
    path.write_bytes(skops.io.dumps(content))


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"format_version": 0}, "of format 0, and this tilestream .* reads 2"),
        ({"sklearn": "0.24.2"}, f"scikit-learn 0.24.2, here is {sklearn.__version__}"),
        ({"format": "other"}, "no model of tilestream"),
        ({"factors": ["one"]}, "its forest is not of its factors"),
        ({"interval": None}, "a damaged model file"),
        ({"typical": {"names": ["FDOP"], "units": ["1"]}}, "what is typical is not of its factors"),
    ],
)
def test_an_old_or_foreign_model_is_refused(
    model: Model, tmp_path: Path, facts: dict[str, Any], message: str
) -> None:
    path = tmp_path / "model.skops"
    save_model(model, path)
    altered(path, facts)
    with pytest.raises(ModelError, match=message):
        load_model(path)


class Harmful:
    """Leaves a trace when it is built."""

    built = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        type(self).built = True


def test_other_types_are_refused_by_name_and_nothing_runs(tmp_path: Path) -> None:
    path = tmp_path / "model.skops"
    harmful = Harmful()
    harmful.__dict__["x"] = 1
    skops.io.dump({"facts": "{}", "forests": harmful}, path)
    with pytest.raises(ModelError, match=r"types that no model of tilestream has: .*Harmful"):
        load_model(path)
    assert not Harmful.built
    skops.io.dump({"facts": "{}", "forests": LinearRegression().fit([[1.0]], [1.0])}, path)
    with pytest.raises(ModelError, match="LinearRegression"):
        load_model(path)


def test_files_that_are_no_models_are_refused(model: Model, tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match="no such model file"):
        load_model(tmp_path / "absent.skops")
    path = tmp_path / "model.skops"
    save_model(model, path)
    whole = path.read_bytes()
    other = io.BytesIO()
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme", "hello")
    for content in (b"", b"\x80\x04K\x01.", whole[: len(whole) // 2], other.getvalue()):
        path.write_bytes(content)
        with pytest.raises(ModelError, match="no model file of tilestream"):
            load_model(path)


def test_a_tree_that_leads_out_of_its_arrays_is_refused(model: Model, tmp_path: Path) -> None:
    for field, value in (("left_child", 10**6), ("left_child", 0), ("feature", 99)):
        path = tmp_path / "model.skops"
        save_model(model, path)
        content = skops.io.loads(path.read_bytes(), trusted=list(model_file.TRUSTED))
        tree = content["forests"]["error_mean"].estimators_[3].tree_
        state = tree.__getstate__()
        state["nodes"][field][0] = value
        tree.__setstate__(state)
        path.write_bytes(skops.io.dumps(content))
        with pytest.raises(ModelError, match="a tree leads nowhere"):
            load_model(path)


def test_training_on_a_short_drive_says_that_nothing_was_calibrated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(training, "PAPER", Recipe(trees=5))
    short = train(dataset(0, lengths={"a": 80}), recipe="paper")
    found = predict(short, drives(1, {"b": 50})[0])
    assert short.interval.blocks == 0
    assert found[["low", "high"]].isna().all(axis=None)
    assert found["estimate"].notna().all()


def test_bad_training_is_refused(learnt: Dataset) -> None:
    with pytest.raises(UsageError, match="no recipe 'best': choose from default, paper"):
        train(learnt, recipe="best")
    with pytest.raises(ModelError, match="49 labelled points"):
        train(learnt.take(np.arange(49)))


def test_the_default_model_is_tuned_and_calibrated() -> None:
    factors, labels = drives(9, {"a": 210, "b": 210}, related=0.9)
    found = join(factors, {"drive": labels}, COLUMNS[:4])
    made = train(found, n_jobs=1)
    assert made.facts["recipe"] == "default"
    assert made.facts["log"]
    assert made.interval.blocks == 2
    assert made.interval.level == 0.9
    assert made.interval.factor > 1.0
