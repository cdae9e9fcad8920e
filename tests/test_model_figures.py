"""How sure figures are, and how much repeated drives say can be known."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_data import COLUMNS, drives, joined
from scipy.stats import spearmanr

from tilestream.errors import ModelError
from tilestream.model.bootstrap import TIMES, resampled, resampled_spearman
from tilestream.model.dataset import Dataset
from tilestream.model.figures import FIGURES, difference, figures_of, segments_of, with_spans
from tilestream.model.repeats import repeated


def points(blocks: int, seed: int = 0, places: int = 60, spread: float = 0.5) -> pd.DataFrame:
    """Held-out points of paths of one block each, whose errors differ by block."""
    rng = np.random.default_rng(seed)
    block = np.repeat(np.arange(blocks), places)
    actual = 0.1 * np.exp(0.5 * rng.normal(size=len(block)))
    off = 0.03 * np.exp(spread * rng.normal(size=blocks))[block] * rng.normal(size=len(block))
    return pd.DataFrame(
        {
            "row": np.arange(len(block)),
            "group": "drive",
            "path": [f"p{k:02d}" for k in block],
            "block": [f"p{k:02d}#00" for k in block],
            "fold": [f"path p{k:02d}" for k in block],
            "arc_length": np.tile(np.arange(float(places)), blocks),
            "actual": actual,
            "estimate": actual + off,
            "median": 0.1,
        }
    )


def test_blocks_are_drawn_with_replacement() -> None:
    counts = resampled(12)
    assert counts.shape == (TIMES, 12)
    assert (counts.sum(axis=1) == 12.0).all()
    assert counts.mean() == 1.0
    assert counts.var() == pytest.approx(11.0 / 12.0, rel=0.05)
    np.testing.assert_array_equal(counts, resampled(12))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_rank_correlation_of_resampled_blocks_is_that_of_the_copied_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, two = (rng.integers(0, 9, 40).astype(float) for _ in range(2))
    block = rng.integers(0, 5, 40)
    counts = rng.integers(0, 3, (3, 5)).astype(float) + np.eye(3, 5)
    found = resampled_spearman(one, two, block, counts)
    for row, count in enumerate(counts):
        copied = np.repeat(np.arange(40), count[block].astype(int))
        if np.ptp(one[copied]) and np.ptp(two[copied]):
            expected = spearmanr(one[copied], two[copied]).statistic
            assert found[row] == pytest.approx(expected, abs=1e-9)
        else:
            assert np.isnan(found[row])


def test_intervals_hold_the_figures_of_other_worlds() -> None:
    """As often as they promise, in the mean over worlds: few blocks hold a little less."""
    held = []
    far = figures_of(points(4000, seed=1, places=20))
    for seed in range(60):
        row = with_spans(points(20, seed=100 + seed, places=20))
        held += [
            row[f"{name}_low"] <= getattr(far, name) <= row[f"{name}_high"]
            for name in ("skill", "spearman")
        ]
    assert 0.78 < np.mean(held) < 0.97


def test_figures_have_intervals_round_them_and_one_block_has_none() -> None:
    found = with_spans(points(10))
    assert tuple(found) == FIGURES
    for name in ("skill", "spearman", "segment_skill", "segment_spearman"):
        assert found[f"{name}_low"] < found[name] < found[f"{name}_high"]
    wider = with_spans(points(10, spread=1.2))
    assert wider["skill_high"] - wider["skill_low"] > 1.5 * (
        found["skill_high"] - found["skill_low"]
    )
    alone = with_spans(points(1))
    assert np.isnan([alone["skill_low"], alone["spearman_high"]]).all()


def test_segments_are_means_over_whole_windows() -> None:
    found = points(3, places=30)
    found = found.drop(index=[*range(12, 19), 61])  # a window with 5 of 12 places, one with 11
    segments = segments_of(found)
    assert segments.groupby("path").size().to_dict() == {"p00": 2, "p01": 3, "p02": 3}
    first = found[found["path"] == "p02"].iloc[:11]
    here = segments[segments["path"] == "p02"].iloc[0]
    assert here["actual"] == pytest.approx(first["actual"].mean())
    assert here["estimate"] == pytest.approx(first["estimate"].mean())
    others = segments.loc[segments["path"] != "p02", "actual"]
    assert here["median"] == others.median()
    twice = pd.concat([found, found.assign(group="again", actual=1.0)])
    assert len(segments_of(twice)) == 2 * len(segments)
    one_fold = segments_of(found.assign(fold="one"))
    assert (one_fold["median"] == one_fold["actual"].median()).all()
    with_few = with_spans(found[found["arc_length"] < 1.0].assign(arc_length=[0.0, 5.0, 11.0]))
    assert with_few["points"] == 3


def test_a_paired_difference_is_of_the_same_points() -> None:
    found = points(12)
    better = found.sample(frac=1.0, random_state=0)
    better = better.assign(estimate=0.5 * (better["actual"] + better["estimate"]))
    told = difference(better, found)
    one, two = figures_of(better), figures_of(found)
    assert told["points"] == len(found)
    assert told["mae"] == pytest.approx(two.mae - one.mae)
    assert told["skill"] == pytest.approx(one.skill - two.skill)
    assert 0.0 < told["skill_low"] < told["skill"] < told["skill_high"]
    back = difference(found, better)
    assert back["skill_high"] == pytest.approx(-told["skill_low"])
    same = difference(found, found)
    assert (same["skill_low"], same["skill_high"]) == (0.0, 0.0)
    # paired, it is far surer than the figures themselves
    row = with_spans(found)
    close = difference(found.assign(estimate=found["estimate"] + 1e-4), found)
    assert close["skill_high"] - close["skill_low"] < 0.1 * (row["skill_high"] - row["skill_low"])


# --- Repeated drives


def repeats(
    count: int, noise: float, seed: int = 0, lengths: dict[str, int] | None = None
) -> tuple[Dataset, float]:
    """So many drives, a truth and normal noise each; and the skill of the truth itself."""
    factors, labels = drives(seed, lengths or {"a": 1200, "b": 1200})
    rng = np.random.default_rng(seed)
    truth = labels["error_mean"].to_numpy()
    each = {
        f"d{k}": labels.assign(error_mean=truth + noise * truth * rng.normal(size=len(truth)))
        for k in range(count)
    }
    found = joined(factors, each, COLUMNS[:2])
    off = np.mean([np.abs(table["error_mean"] - truth).mean() for table in each.values()])
    label = found.label()
    return found, 1.0 - off / np.abs(label - np.median(label)).mean()


@pytest.mark.parametrize("count", [2, 3, 5])
def test_the_limit_is_the_skill_of_the_truth(count: int) -> None:
    found, of_truth = repeats(count, 0.3)
    told = repeated(found)
    assert told["drives"] == count
    assert told["limit"] == pytest.approx(of_truth, abs=0.03)
    assert told["limit_low"] < told["limit"] < told["limit_high"]
    assert told["skill"] < told["limit"] - 0.05  # a repeated drive is no ceiling


def test_a_repeated_drive_by_hand() -> None:
    factors, labels = drives(1, {"a": 200})
    again = labels.assign(error_mean=labels["error_mean"] + 0.01)
    lesser = again.assign(as_sensor="16beams")
    both = joined(factors, {"one": labels, "two": again}, COLUMNS)
    found = repeated(both)
    assert found["points"] == 400
    assert found["mae"] == pytest.approx(0.01)
    assert found["skill"] > 0.5
    median = np.median(both.label())
    ratio = 0.01 / np.abs(both.label() - median).mean()
    assert found["limit"] == pytest.approx(1.0 - ratio / np.sqrt(2.0))
    assert np.isnan([found["limit_low"], found["skill_low"]]).all()  # one block
    for lone in (both.groups(["one"]), joined(factors, {"one": labels, "two": lesser}, COLUMNS)):
        with pytest.raises(ModelError, match="no place was driven twice"):
            repeated(lone)


def test_places_that_fewer_drives_know_count_as_they_are() -> None:
    found, _ = repeats(3, 0.3, lengths={"a": 600, "b": 600})
    some = found.rows[(found.rows["group"] != "d2") | (found.rows["path"] == "a")]
    told = repeated(found.take(some.index.to_numpy()))
    assert told["drives"] == 3
    assert told["points"] == 600 * 3 * 2 + 600 * 2
    assert told["limit"] == pytest.approx(repeated(found)["limit"], abs=0.04)
