"""Figures, protocols and intervals; that the random split proves nothing."""

from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest
from model_data import COLUMNS, caused, dataset, unrelated

from tilestream.errors import ModelError
from tilestream.model.evaluation import (
    PAPER_TABLE,
    criterion_importances,
    cross_validate,
    factor_sets,
    figures_by_protocol,
    held_out,
    importances_of,
)
from tilestream.model.figures import Figures, figures, figures_of
from tilestream.model.forest import Growth, PaperForest
from tilestream.model.splits import block_splits, leave_path_out, random_split

QUICK = Growth(trees=20)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of the paper's forest, which has a fifth of its trees."""
    monkeypatch.setattr(PaperForest, "defaults", asdict(QUICK))
    return PaperForest.name


def test_irrelevant_smooth_factors_shine_on_the_random_split_and_fail_on_blocks(
    quick: str,
) -> None:
    """In the mean of five worlds: one has so few independent points that chance decides.

    The skill is 0.87 at random and -0.25 apart, with standard errors of 0.01 and 0.1; the errors
    apart are 10.3 times as large, with one of 0.7. So all limits are four and more away.
    """
    at_random, by_path, by_block = [], [], []
    for seed in range(5, 10):
        world = unrelated(seed)
        at_random.append(figures_of(held_out(world, random_split(world), quick)))
        by_path.append(figures_of(held_out(world, leave_path_out(world), quick)))
        by_block.append(figures_of(held_out(world, block_splits(world, folds=3), quick)))
    assert mean_of("mae", at_random) < 0.0283
    assert mean_of("within_25mm", at_random) > 0.641
    assert mean_of("skill", at_random) > 0.5
    for apart in (by_path, by_block):
        assert mean_of("skill", apart) < 0.15
        assert mean_of("mae", apart) > 5.0 * mean_of("mae", at_random)


def mean_of(name: str, found: list[Figures]) -> float:
    return float(np.mean([getattr(one, name) for one in found]))


def test_figures_by_hand() -> None:
    actual = np.array([0.10, 0.20, 0.30, 0.40])
    estimate = np.array([0.12, 0.20, 0.26, 0.50])
    found = figures(actual, estimate, np.full(4, 0.25))
    assert found.points == 4
    assert found.mae == pytest.approx(0.04)
    assert found.rmse == pytest.approx(np.sqrt((0.02**2 + 0.04**2 + 0.1**2) / 4))
    assert (found.within_25mm, found.within_50mm) == (0.5, 0.75)
    assert found.r2 == pytest.approx(1 - 0.012 / 0.05)
    assert found.skill == pytest.approx(1 - 0.04 / 0.1)
    assert found.spearman == pytest.approx(1.0)
    same = figures(np.full(3, 0.1), np.full(3, 0.1), np.full(3, 0.1))
    assert np.isnan([same.r2, same.skill, same.spearman]).all()
    with pytest.raises(ModelError, match="no points to evaluate"):
        figures(actual[:0], estimate[:0], estimate[:0])


def test_table_iv_has_every_protocol_and_factor_set(quick: str) -> None:
    found = dataset(2, related=0.9, lengths={"a": 410, "b": 300})
    tables = []
    for name, columns in factor_sets(found.columns).items():
        held = cross_validate(found.with_columns(columns), quick)
        tables.append(figures_by_protocol(held, quick).assign(factors=name))
    table = pd.concat(tables, ignore_index=True)
    assert len(table) == 3 * 4
    assert list(table["factors"].unique()) == list(PAPER_TABLE["factors"])
    assert (table["reason"] == "").all()
    assert np.isfinite(table["mae"]).all()
    points = table.groupby("protocol")["points"].first().to_dict()
    assert points == {"paper": 178, "path": 710, "blocks": 710}


def test_a_protocol_that_cannot_be_followed_says_why() -> None:
    found = cross_validate(dataset(2, lengths={"a": 120}), "training median")
    table = figures_by_protocol(found, "training median")
    reasons = dict(zip(table["protocol"], table["reason"], strict=True))
    assert reasons["paper"] == ""
    assert "one path only" in reasons["path"]
    assert "one block only" in reasons["blocks"]
    assert table.loc[table["protocol"] != "paper", "mae"].isna().all()


def test_importances_find_the_causes() -> None:
    world, few = caused(), asdict(QUICK)
    fitted = PaperForest.fit(world, "error_mean", settings=few)
    own = importances_of(fitted, world.columns).set_index("factor")
    assert own["importance"].sum() == pytest.approx(1.0)
    causes = {COLUMNS[0].name, COLUMNS[9].name, COLUMNS[-1].name}
    assert set(own["importance"].nlargest(3).index) == causes
    by_criterion = criterion_importances(world, PaperForest, few).set_index("criterion")
    assert list(by_criterion.index) == ["FS", "RQ", "LY", "LS"]
    assert by_criterion["factors"].sum() == len(COLUMNS)
    assert (by_criterion.loc[["FS", "RQ", "LS"], "increase"] > 0.005).all()
    assert abs(by_criterion.loc["LY", "increase"]) < 0.003
