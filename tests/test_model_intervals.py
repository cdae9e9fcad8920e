"""Intervals: they hold what they promise for new blocks, and know nothing of units."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from tilestream.model.intervals import (
    SHARES,
    calibrate,
    coverage,
    interval_score,
    stretch,
    wider_for_few,
    with_intervals,
)

Floats = NDArray[np.float64]


def drawn(
    rng: np.random.Generator, blocks: int, bias: float, relative: float
) -> tuple[Floats, Floats]:
    """(blocks, 40) labels and estimates.

    Args:
        rng: of the random numbers.
        blocks: how many.
        bias: standard deviation between blocks, of the logarithm of the error.
        relative: 1: errors grow with the estimate; 0: they are as large everywhere.
    """
    estimate = 0.1 * np.exp(0.5 * rng.normal(size=(blocks, 40)))
    noise = np.exp(bias * rng.normal(size=(blocks, 1)) + 0.4 * rng.normal(size=(blocks, 40))) - 1.0
    scale = relative * estimate + (1.0 - relative) * 0.1
    return np.maximum(estimate + scale * noise, 0.0), estimate


def held_by_new_blocks(bias: float, blocks: int, relative: float, seed: int) -> float:
    """Mean share of the points of new blocks that lie in the interval calibrated on others."""
    rng, held = np.random.default_rng(seed), []
    names = np.repeat([f"b{k:02d}" for k in range(blocks)], 40)
    for _ in range(100 + round(500 * bias)):  # the more, the more blocks differ
        actual, estimate = drawn(rng, blocks + 8, bias, relative)
        interval = calibrate(actual[:blocks].ravel(), estimate[:blocks].ravel(), names)
        low, high = interval.around(estimate[blocks:])
        held.append(((low <= actual[blocks:]) & (actual[blocks:] <= high)).mean())
    assert interval.level == 0.9
    assert interval.blocks == blocks
    return float(np.mean(held))


@pytest.mark.parametrize("relative", [0.0, 1.0])
@pytest.mark.parametrize("bias", [0.0, 0.12, 0.5])
@pytest.mark.parametrize("blocks", [3, 6, 12])
def test_intervals_hold_what_they_promise_for_new_blocks(
    bias: float, blocks: int, relative: float
) -> None:
    """With the unknown block at infinity they would hold 95 % and more."""
    least = 0.84 if (bias, blocks) == (0.5, 3) else 0.86
    assert least < held_by_new_blocks(bias, blocks, relative, seed=blocks) < 0.94


@pytest.mark.parametrize("blocks", [2, 3, 4, 6, 12])
def test_few_blocks_hold_what_they_promise_in_the_mean_over_kinds_of_drives(blocks: int) -> None:
    """Drives whose blocks differ not at all, up to much. Without the widening two blocks hold 83 %
    and three 86 %; without the hardest block twice they would hold less still.
    """
    rng, held = np.random.default_rng(blocks), []
    names = np.repeat([f"b{k:02d}" for k in range(blocks)], 40)
    for bias in (0.0, 0.12, 0.3, 0.5, 0.8):
        for k in range(60):
            actual, estimate = drawn(rng, blocks + 12, bias, k % 2)
            interval = calibrate(actual[:blocks].ravel(), estimate[:blocks].ravel(), names)
            low, high = interval.around(estimate[blocks:])
            held.append(((low <= actual[blocks:]) & (actual[blocks:] <= high)).mean())
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200), st.floats(0.3, 0.99))
def test_the_fewer_blocks_the_wider_and_of_many_not_at_all(blocks: int, level: float) -> None:
    wider = wider_for_few(blocks, level)
    assert wider >= wider_for_few(blocks + 1, level) >= 1.0
    quantile = stats.t.ppf(0.5 + level / 2.0, blocks**2) / stats.norm.ppf(0.5 + level / 2.0)
    assert wider == pytest.approx(quantile)
    assert wider_for_few(1000, level) == pytest.approx(1.0, abs=1e-4)


def test_the_constant_follows_how_errors_grow() -> None:
    rng = np.random.default_rng(0)
    names = np.repeat([f"b{k}" for k in range(8)], 40)
    shares = []
    for relative in (0.0, 1.0):
        actual, estimate = (part.ravel() for part in drawn(rng, 8, 0.0, relative))
        shares.append(calibrate(actual, estimate, names).constant / np.median(actual))
    assert shares[0] == pytest.approx(max(SHARES))
    assert shares[1] <= 1.0


labelled = st.integers(0, 2**32 - 1).map(
    lambda seed: drawn(np.random.default_rng(seed), 5, 0.3, seed % 3 / 2.0)
)
NAMES = np.repeat([f"b{k}" for k in range(5)], 40)


@settings(max_examples=30, deadline=None)
@given(labelled, st.floats(0.01, 100.0))
def test_an_interval_in_other_units_is_the_same(of: tuple[Floats, Floats], unit: float) -> None:
    actual, estimate = (part.ravel() for part in of)
    one = calibrate(actual, estimate, NAMES).around(estimate)
    two = calibrate(unit * actual, unit * estimate, NAMES).around(unit * estimate)
    np.testing.assert_allclose(two, unit * np.array(one), rtol=1e-9, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(labelled, st.floats(0.3, 0.9), st.floats(0.0, 0.09))
def test_a_higher_level_reaches_farther(
    of: tuple[Floats, Floats], level: float, more: float
) -> None:
    actual, estimate = (part.ravel() for part in of)

    lower, higher = (calibrate(actual, estimate, NAMES, of) for of in (level, level + more))
    for interval in (lower, higher):
        low, high = interval.around(estimate)
        assert (low <= estimate).all()
        assert (estimate <= high).all()
        assert (low >= 0.0).all()
    assume(lower.constant == higher.constant)  # another level may ask for another shape
    assert lower.below <= higher.below + 1e-12
    assert lower.above <= higher.above + 1e-12


@settings(max_examples=60, deadline=None)
@example([[0], [0], [-5, 36], [0, 0, 0, 0, 0, -17, 33]], 0.9).via("two equally hard blocks")
@given(
    st.lists(st.lists(st.integers(-20, 40), min_size=1, max_size=7), min_size=2, max_size=6),
    st.sampled_from([0.5, 0.8, 0.9]),
)
def test_the_hardest_block_counts_twice(errors: list[list[int]], level: float) -> None:
    """A literal reference: copies of points stand for weights. All estimates are 1, and so the
    shape is the same whatever the constant.
    """

    def quantile(blocks: list[list[float]], share: float, twice: int | None = None) -> float:
        same = int(np.lcm.reduce([len(block) for block in blocks]))  # points of every block
        pool = sorted(
            error
            for k, block in enumerate(blocks)
            for error in block
            for _ in range(same // len(block) * (1 + (k == twice)))
        )
        return next(x for n, x in enumerate(pool, 1) if n >= share * len(pool) - 1e-6)

    sides = [
        max(quantile([[s * x for x in block] for block in errors], 0.95), 0.0) for s in (-1, 1)
    ]
    down, up = (max(side, 0.5 * max(sides)) for side in sides)
    if up == 0.0:
        return
    scores = [[max(x / up, -x / down) for x in block] for block in errors]
    hard = [round(float(np.quantile(one, level)), 9) for one in scores]
    hardest = hard.index(max(hard))
    size = quantile(scores, level, hardest)
    size *= stats.t.ppf(0.5 + level / 2.0, len(errors) ** 2) / stats.norm.ppf(0.5 + level / 2.0)
    actual = 1.0 + 0.01 * np.concatenate(errors)
    names = np.repeat([f"b{k}" for k in range(len(errors))], [len(block) for block in errors])
    mixed = np.random.default_rng(0).permutation(len(actual))
    interval = calibrate(actual[mixed], np.ones(len(actual)), names[mixed], level)
    low, high = interval.around(np.ones(1))
    reach = 0.01 * size * down, 0.01 * size * up
    assert (1.0 - low[0], high[0] - 1.0) == (pytest.approx(reach[0]), pytest.approx(reach[1]))


def test_intervals_are_widened_and_cut_at_zero_and_one_block_gives_none() -> None:
    actual, estimate = np.array([0.1, 0.2, 0.4, 0.1]), np.full(4, 0.2)
    interval = calibrate(actual, estimate, np.array(["a", "a", "b", "b"]))
    low, high = interval.around(np.array([0.2, 0.2]), np.array([1.0, 3.0]))
    few = wider_for_few(2)
    np.testing.assert_allclose(low, [0.2 - few * 0.1, 0.0])
    np.testing.assert_allclose(high, 0.2 + few * np.array([0.2, 0.6]))  # down 1, up 2 shapes
    alone = calibrate(actual, estimate, np.array(["a"] * 4))
    assert alone.blocks == 0
    assert np.isnan([alone.level, alone.above, *np.ravel(alone.around(estimate))]).all()


def points(error: float) -> pd.DataFrame:
    """Three paths of two blocks, whose third errs by its own."""
    path = np.repeat(["a", "b", "c"], 4)
    return pd.DataFrame(
        {
            "path": path,
            "block": [f"{p}#{k % 2}" for k, p in enumerate(path)],
            "actual": np.where(path == "c", error, 0.12),
            "estimate": 0.1,
        }
    )


def test_coverage_of_a_path_is_calibrated_elsewhere() -> None:
    assert coverage(points(0.11))["covered"].tolist() == [1.0, 1.0, 1.0, 1.0]
    found = coverage(points(0.5)).set_index("path")
    assert found.loc["c", "covered"] == 0.0
    assert found.loc["c", "width"] == pytest.approx(0.03 * wider_for_few(4))
    assert found.loc["a", "covered"] == 1.0
    assert found.loc["", "covered"] == pytest.approx(8 / 12)
    at = with_intervals(points(0.5)).groupby("path")[["low", "high"]].first()
    few = wider_for_few(4)
    np.testing.assert_allclose(at.loc["c"], [0.1 - few * 0.01, 0.1 + few * 0.02])


def test_the_error_of_a_coverage_is_that_of_whole_blocks() -> None:
    """As of a mean of so many independent blocks; of one block it is not known."""
    rng, blocks = np.random.default_rng(0), 60
    whole = rng.permutation(np.repeat([0.1, 5.0], blocks // 2))
    many = pd.DataFrame(
        {
            "path": np.repeat(["a", "b", "c"], 10 * blocks),
            "block": np.repeat([f"b{k}" for k in range(blocks)], 30),
            "actual": np.repeat(whole, 30) * np.tile([1.0, 1.05, 0.95], 10 * blocks),
            "estimate": 0.1,
        }
    )
    found = coverage(many, level=0.3).set_index("path")
    assert 0.2 < found.loc["", "covered"] < 0.8
    inside = with_intervals(many, 0.3).eval("low <= actual <= high").groupby(many["block"]).mean()
    one_block = many[many["block"] == "b0"].assign(path="d", block="alone")
    assert found.loc["", "error"] == pytest.approx(inside.std() / np.sqrt(blocks), 0.1)
    more = coverage(pd.concat([many, one_block]), level=0.3).set_index("path")
    assert np.isnan(more.loc["d", "error"])


@pytest.mark.parametrize("seed", range(4))
def test_large_errors_are_held_as_small_ones_are(seed: int) -> None:
    """Of a good lidar and a few places of a poor one, whose errors grow with the estimate."""
    rng = np.random.default_rng(seed)
    blocks, of_each = 12, 100
    estimate = np.where(rng.random(blocks * of_each) < 0.05, 0.4, 0.05)
    actual = np.abs(estimate * (1.0 + 0.3 * rng.standard_normal(len(estimate))))
    names = np.repeat([f"b{k}" for k in range(blocks)], of_each)
    low, high = calibrate(actual, estimate, names).around(estimate)
    held = (low <= actual) & (actual <= high)
    assert held[estimate == 0.4].mean() == pytest.approx(0.9, abs=0.1)
    assert held[estimate == 0.05].mean() == pytest.approx(0.9, abs=0.05)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.05, 0.95), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_no_ends_score_less_than_the_quantiles(level: float, down: float, up: float) -> None:
    actual = stats.norm.ppf((np.arange(2000) + 0.5) / 2000)
    low, high = stats.norm.ppf([0.5 - level / 2.0, 0.5 + level / 2.0])

    def score(low: float, high: float) -> float:
        return float(interval_score(actual, np.full(2000, low), np.full(2000, high), level).mean())

    other = sorted((low + down, high + up))
    assert score(low, high) <= score(*other) + 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_an_interval_holds_its_own_blocks_as_it_is(seed: int) -> None:
    actual, estimate = (part.ravel() for part in drawn(np.random.default_rng(seed), 6, 0.3, 0.5))
    names = np.repeat([f"b{k}" for k in range(6)], 40)
    interval = calibrate(actual, estimate, names)
    assert stretch(interval, actual, estimate, names) == pytest.approx(1.0)
    wide = replace(interval, below=2.0 * interval.below, above=2.0 * interval.above)
    assert stretch(wide, actual, estimate, names) == pytest.approx(0.5)
    low, high = interval.around(estimate)
    worse = estimate + np.where(actual > estimate, 3.0, 1.0) * (actual - estimate)
    assert stretch(interval, worse, estimate, names) > 1.5
    assert ((worse < low) | (worse > high)).mean() > 0.2
