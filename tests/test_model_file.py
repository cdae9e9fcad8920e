"""Estimates of every place: the same in any company, refused where they cannot be; one file."""

import io
import json
import struct
import zipfile
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sklearn
import skops.io
from fuzz_bombs import one_member_more, with_content
from fuzz_mutations import zipped
from hypothesis import given, settings
from hypothesis import strategies as st
from model_data import COLUMNS, dataset, drives, joined
from sklearn.linear_model import LinearRegression

from tilestream.errors import ModelError, SourceNotFoundError, UsageError
from tilestream.model import file as model_file
from tilestream.model.dataset import TARGETS, Dataset, made_with
from tilestream.model.domain import domain_of
from tilestream.model.file import load_model, save_model
from tilestream.model.forest import Growth, PaperForest
from tilestream.model.prediction import predict
from tilestream.model.training import PREDICTION_COLUMNS, Model, train
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
        patch.setattr(PaperForest, "defaults", asdict(Growth(trees=15)))
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
    monkeypatch.setattr(PaperForest, "defaults", asdict(Growth(trees=5)))
    factors, labels = drives(4, {"a": 150, "b": 220})
    mixed = factors.sample(frac=1.0, random_state=0), labels.sample(frac=1.0, random_state=1)
    one, two = (
        predict(train(joined(f, {"drive": x}, COLUMNS), recipe="paper"), factors)
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
    assert set(again.regressors) == set(TARGETS)
    assert [p.name for p in path.parent.iterdir()] == ["model.skops"]
    with zipfile.ZipFile(path) as archive:
        types = set(model_file._types(json.loads(archive.read("schema.json"))))
    assert types == model_file.CONTAINERS | PaperForest.types
    assert set(skops.io.get_untrusted_types(file=path)) <= PaperForest.types


def altered(path: Path, facts: dict[str, Any]) -> None:
    """Write the model of `path` anew with other facts inside."""
    content = skops.io.loads(path.read_bytes(), trusted=sorted(model_file.TYPES))
    content["facts"] = json.dumps(json.loads(content["facts"]) | facts)
    path.write_bytes(skops.io.dumps(content))


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"format_version": 0}, "of format 0, and this tilestream .* reads 3"),
        ({"sklearn": "0.24.2"}, f"scikit-learn 0.24.2, here is {sklearn.__version__}"),
        ({"format": "other"}, "no model of tilestream"),
        ({"factors": ["one"]}, "its forest is not of its factors"),
        (
            {"facts": {"recipe": "best"}},
            "a model of 'best', and this tilestream has corrected, forest, paper, physics",
        ),
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
        content = skops.io.loads(path.read_bytes(), trusted=sorted(model_file.TYPES))
        tree = content["forests"]["error_mean"].estimators_[3].tree_
        state = tree.__getstate__()
        state["nodes"][field][0] = value
        tree.__setstate__(state)
        path.write_bytes(skops.io.dumps(content))
        with pytest.raises(ModelError, match="a tree leads nowhere"):
            load_model(path)


def test_a_tree_without_nodes_is_refused(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.skops"
    save_model(model, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    schema = with_content(members["schema.json"], b"node_count", 0)
    path.write_bytes(zipped({**members, "schema.json": schema}))
    with pytest.raises(ModelError, match="a tree leads nowhere"):
        load_model(path)


def test_a_file_that_unpacks_to_more_than_a_model_is_refused(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.skops"
    save_model(model, path)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    array = next(name for name in members if name.endswith(".npy"))
    zeros = bytes(10**7)
    packer = zlib.compressobj(1, wbits=-15)
    deflated = packer.compress(zeros) + packer.flush()
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%s,), }\n"
    claims = [header % count for count in (b"400000000", b"4" * 20, b"-1", b"(1, " * 150)]
    forged = {
        "claims to unpack": one_member_more(whole, array, deflated, 2**31, 0),
        "damaged|no model": one_member_more(whole, array, deflated, 100, zlib.crc32(zeros[:100])),
        "parts": zipped({**members, "schema.json": b"[" + b"[]," * 10**6 + b"1]"}),
        "RecursionError": zipped({**members, "schema.json": b"[" * 10**5}),
        "magic string": zipped({**members, array: b"PK" * 99}),
    }
    for told, content in forged.items():
        path.write_bytes(content)
        with pytest.raises(ModelError, match=rf"model\.skops.*({told})"):
            load_model(path)
    for claim in claims:
        npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(claim)) + claim
        path.write_bytes(zipped({**members, array: npy + bytes(64)}))
        with pytest.raises(ModelError, match=r"model\.skops"):
            load_model(path)


def test_training_on_a_short_drive_says_that_nothing_was_calibrated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(PaperForest, "defaults", asdict(Growth(trees=5)))
    short = train(dataset(0, lengths={"a": 80}), recipe="paper")
    found = predict(short, drives(1, {"b": 50})[0])
    assert short.interval.blocks == 0
    assert found[["low", "high"]].isna().all(axis=None)
    assert found["estimate"].notna().all()


def test_bad_training_is_refused(learnt: Dataset) -> None:
    with pytest.raises(
        UsageError, match="no recipe 'best': choose from corrected, forest, paper, physics"
    ):
        train(learnt, recipe="best")
    with pytest.raises(ModelError, match="49 labelled points"):
        train(learnt.take(np.arange(49)))


def test_our_forest_is_tuned_and_calibrated() -> None:
    factors, labels = drives(9, {"a": 210, "b": 210}, related=0.9)
    found = joined(factors, {"drive": labels}, COLUMNS[:4])
    made = train(found, recipe="forest")
    assert made.facts["log"]
    assert made.interval.blocks == 2
    assert made.interval.level == 0.9
    assert made.interval.above > 0.0
