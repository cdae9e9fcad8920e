"""Regressors: each keeps the protocol, and is what it is called."""

import json
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import skops.io
from model_data import COLUMNS, caused, dataset, drives, joined, unrelated, with_virtual_drives
from sklearn.ensemble import RandomForestRegressor

from tilestream.errors import ModelError
from tilestream.factors import layout
from tilestream.model.baselines import FOOTPRINT
from tilestream.model.dataset import Dataset
from tilestream.model.evaluation import held_out
from tilestream.model.features import with_derived
from tilestream.model.figures import figures_of
from tilestream.model.forest import CANDIDATES, CAUTIOUS, Growth, PaperForest, TunedForest
from tilestream.model.registry import COMPETITORS, REGRESSORS
from tilestream.model.splits import Split, leave_path_out
from tilestream.records import Column

QUICK = Growth(trees=20)


@pytest.fixture(scope="module", name="caused")
def _caused() -> Dataset:
    return caused()


@pytest.fixture(scope="module", name="observed")
def _observed(caused: Dataset) -> Dataset:
    return with_virtual_drives(caused, hidden=0.5)


@pytest.mark.parametrize("name", sorted(COMPETITORS))
def test_every_competitor_estimates_what_it_has_not_seen(name: str, observed: Dataset) -> None:
    rng = np.random.default_rng(0)
    asked = {n: rng.normal(size=len(observed)) for n in FOOTPRINT if n not in observed.names}
    robust = (Column(n, "LY", "1", "", "", "robust") for n in asked)
    whole = replace(
        observed, rows=observed.rows.assign(**asked), columns=(*observed.columns, *robust)
    )
    rows = np.arange(len(whole))
    split = Split("half", rows[::3], rows[1::3])
    blind = replace(whole, rows=whole.rows.copy())
    blind.rows.loc[split.test, "error_mean"] = -1.0
    points = held_out(whole, [split], name)
    assert np.isfinite(points["estimate"]).all()
    assert np.array_equal(points["estimate"], held_out(blind, [split], name)["estimate"])
    assert np.array_equal(points["actual"], whole.label()[split.test])


@pytest.mark.parametrize("name", sorted(REGRESSORS))
def test_every_regressor_keeps_the_protocol(name: str, observed: Dataset) -> None:
    kind, target, few = REGRESSORS[name], "error_mean", observed.take(np.arange(0, 630, 2))
    fitted = kind.fit(few, target, seed=2)
    assert set(fitted.factors) == {column.name for column in kind.features(few.columns)}
    whole = fitted.predict(observed.rows)
    same = kind.fit(few, target, 2, fitted.settings, n_jobs=2)
    np.testing.assert_array_equal(same.predict(observed.rows), whole)
    some = np.random.default_rng(0).permutation(len(observed))[:50]
    np.testing.assert_array_equal(fitted.predict(observed.rows.iloc[some]), whole[some])
    added, weights = fitted.contributions(few.rows[:7]), fitted.importances()
    assert added.shape == (7, len(fitted.factors))
    assert np.isfinite(added).all()
    assert (weights >= 0.0).all()
    assert weights.sum() == pytest.approx(0.0 if name == "physics" else 1.0)
    file = skops.io.dumps(fitted.save())
    saved = skops.io.loads(file, trusted=sorted(kind.types))
    told = json.loads(json.dumps({**fitted.settings, "seed": 2}))
    again = kind.load(saved, target, fitted.factors, told)
    assert again.settings == fitted.settings
    assert again.learnt() == fitted.learnt()
    np.testing.assert_array_equal(again.predict(observed.rows), whole)
    for other, factors in ((saved, fitted.factors[1:]), ("words", fitted.factors)):
        with pytest.raises(ModelError, match="a damaged model file"):
            kind.load(other, target, factors, told)


def test_related_factors_are_learnt_across_paths(caused: Dataset) -> None:
    caused = caused.with_columns([caused.columns[k] for k in (0, 3, 9, 19)])
    splits = leave_path_out(caused)[:2]
    paper = figures_of(held_out(caused, splits, "paper"))
    ours = figures_of(held_out(caused, splits, "forest"))
    assert ours.skill > 0.3
    assert ours.spearman > 0.8
    assert ours.mae < 1.1 * paper.mae
    for name in ("training median", "path median", "nearest training point"):
        assert figures_of(held_out(caused, splits, name)).mae > ours.mae, name


def test_the_papers_forest_is_scikit_learns_own(caused: Dataset) -> None:
    plain = RandomForestRegressor(random_state=3).fit(caused.matrix(), caused.label())
    ours = PaperForest.fit(caused, "error_mean", seed=3)
    assert np.array_equal(ours.predict(caused.rows), plain.predict(caused.matrix()))
    assert PaperForest.defaults["trees"] == 100


def test_the_forest_is_chosen_on_held_out_blocks(caused: Dataset) -> None:
    def chosen(world: Dataset) -> Growth:
        return Growth(**TunedForest.tuned(world, "error_mean"))

    assert chosen(caused) == CANDIDATES[0]
    assert chosen(unrelated(5)) in CANDIDATES[1:]
    assert chosen(caused.take(np.arange(80))) == CAUTIOUS


def test_a_forest_of_logarithms_is_near_the_median() -> None:
    factors, labels = drives(1, {"a": 300, "b": 300})
    rng = np.random.default_rng(1)
    labels["error_mean"] = 0.1 * np.exp(rng.normal(size=len(labels)))
    found = joined(factors, {"drive": labels}, COLUMNS)
    estimate = {}
    for log in (False, True):
        growth = asdict(replace(QUICK, leaf=150, log=log))
        fitted = PaperForest.fit(found, "error_mean", settings=growth)
        estimate[log] = fitted.predict(found.rows).mean()
    assert abs(estimate[True] - np.median(found.label())) < 0.015
    assert estimate[False] > 1.4 * estimate[True]


def test_contributions_add_up_to_the_estimate(caused: Dataset) -> None:
    for log in (False, True):
        growth = asdict(Growth(trees=7, leaf=3, log=log))
        forest = PaperForest.fit(caused, "error_mean", settings=growth)
        X = caused.matrix()[:40]
        roots = np.mean([t.tree_.value[0, 0, 0] for t in forest.trees.estimators_])
        added = forest.contributions(caused.rows[:40])
        assert np.allclose(added.sum(axis=1) + roots, forest.trees.predict(X), rtol=0, atol=1e-12)
    unused = np.setdiff1d(
        np.arange(X.shape[1]), np.concatenate([t.tree_.feature for t in forest.trees.estimators_])
    )
    assert (added[:, unused] == 0.0).all()


def test_the_default_forest_learns_from_observability_alone_where_it_is_there() -> None:
    plain = dataset(1, lengths={"a": 120})
    assert TunedForest.features(plain.columns) == plain.columns
    seen = replace(plain.columns[0], factor_set="observability")
    assert TunedForest.features((seen, *plain.columns[1:])) == [seen]


def test_the_opponents_are_what_they_are_called() -> None:
    found = dataset(8, lengths={"a": 100, "b": 100})
    label, path = found.label(), found.rows["path"].to_numpy()
    train, test = np.flatnonzero(path == "a")[::10], np.flatnonzero(path == "a")
    split = [Split("", train, test)]
    nearest = held_out(found, split, "nearest training point")["estimate"].to_numpy()
    arc = found.rows["arc_length"].to_numpy()
    for k, row in enumerate(test):
        gap = np.abs(arc[train] - arc[row])
        assert nearest[k] in label[train][gap == gap.min()]
    other = [Split("", train, np.flatnonzero(path == "b"))]
    assert set(held_out(found, other, "nearest training point")["estimate"]) <= set(label[train])
    median = held_out(found, other, "path median")["estimate"]
    assert (median == np.median(label[train])).all()
    both = [Split("", np.arange(len(found)), np.arange(len(found)))]
    of_path = held_out(found, both, "path median").groupby("path")["estimate"].unique()
    assert of_path["b"] == [np.median(label[path == "b"])]
    with pytest.raises(ModelError, match="needs the robust factors empty_sector, wall_H"):
        held_out(found, split, "footprint forest")


def test_the_footprint_forest_asks_for_azimuths_and_horizontal_normals_alone() -> None:
    assert len(set(FOOTPRINT)) == 7
    rng = np.random.default_rng(1)
    plan = {"cells": np.array([400.0]), "azimuth": rng.integers(0, 9, (1, 90))}
    plan |= {name: rng.integers(0, 9, (1, 90)) for name in ("wall", "azimuth_standing")}
    plan |= {f"normal_{k}": rng.uniform(50.0, 90.0, 1) for k in ("xx", "xy", "yy")}

    def seven() -> dict[str, float]:
        """With any heights, distances and tilts."""
        rest = [f"{kind}_{a}z" for kind in ("normal", "sight") for a in "xyz"]
        rest += ["range", "range_squared", "sight_xx", "sight_xy", "sight_yy"]
        sums = plan | {name: rng.uniform(1.0, 400.0, 1) for name in rest}
        sums |= {f"normal_{m}": rng.integers(0, 9, (1, m * m)) for m in (8, 16, 90)}
        found = pd.DataFrame(layout.factors(sums)).assign(heading=0.3)
        return dict(with_derived(found)[list(FOOTPRINT)].iloc[0])

    assert seven() == seven()
