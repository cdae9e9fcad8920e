"""Errors of neighbouring places: against a literal reference, and processes that are known."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.model.bootstrap import TIMES
from tilestream.model.correlation import BLOCK, FEWEST, POOLED, REACH, Correlation, correlations
from tilestream.moments import AXES

DRAWS = 5


def drives(
    bias: np.ndarray, noise: float, *, spacing: float = 1.0, draws: int = DRAWS, seed: int = 0
) -> pd.DataFrame:
    """Virtual drives of places with a bias in every axis: of each draw a start."""
    rng = np.random.default_rng(seed)
    count = bias.shape[-1]
    rows = {
        "route_id": "street",
        "sample": np.arange(count),
        "arc_length": spacing * np.arange(count),
        "status": "done",
        "vd_draws": float(draws),
    }
    for axis in AXES:
        error = bias + noise * rng.standard_normal((draws, count))
        rows[f"vd_near_{axis}"] = error.mean(axis=0)
        rows[f"vd_near_{axis}_{axis}"] = (error**2).mean(axis=0)
    return pd.DataFrame(rows)


def known(lags: np.ndarray, bias: np.ndarray, share: float) -> Correlation:
    """A correlation, the same wherever one had driven."""
    return Correlation(lags, bias, share, np.tile(share * bias, (TIMES, 1)))


def two_streets() -> pd.DataFrame:
    """With gaps, places that failed, and some where nothing holds."""
    rng = np.random.default_rng(5)
    first = drives(np.cumsum(rng.normal(0.0, 0.02, 70)), 0.03, seed=1)
    second = drives(rng.normal(0.0, 0.05, 50), 0.03, seed=2).assign(route_id="another")
    table = pd.concat([first, second], ignore_index=True).drop(index=[7, 8, 90])
    table.loc[[20, 21, 100], "status"] = "failed"
    table.loc[[30, 110], [name for name in table if name.startswith("vd_near")]] = np.nan
    table.loc[40, "vd_draws"] = 1.0
    return table


def literal(table: pd.DataFrame, axis: str, lag: int) -> list[float]:
    """The products of two places so many sample points apart; of lag 0 squares without noise."""
    rows = [row for row in table.to_dict("records") if row["status"] == "done"]
    rows = [row for row in rows if row["vd_draws"] > 1.0 and not math.isnan(row[f"vd_near_{axis}"])]
    found = []
    for one in rows:
        for other in rows:
            if one["route_id"] == other["route_id"] and other["sample"] - one["sample"] == lag:
                a, b = (
                    row[f"vd_near_{axis}"] / math.sqrt(row[f"vd_near_{axis}_{axis}"])
                    for row in (one, other)
                )
                noise = 0.0 if lag else (1.0 - a * a) / (one["vd_draws"] - 1.0)
                found.append(a * b - noise)
    return found


def test_it_is_what_a_literal_reading_gives() -> None:
    table = two_streets()
    found = correlations(table)
    assert list(found) == [*AXES, POOLED]
    for axis in AXES:
        means = [np.mean(literal(table, axis, lag)) for lag in range(int(REACH) + 1)]
        assert found[axis].share == pytest.approx(means[0])
        assert found[axis].bias == pytest.approx(np.array(means) / means[0])
        assert found[axis].lags == pytest.approx(np.arange(REACH + 1.0))
    both = [literal(table, "along", lag) + literal(table, "across", lag) for lag in range(4)]
    pooled = [np.mean(products) for products in both]
    assert found[POOLED].bias[:4] == pytest.approx(np.array(pooled) / pooled[0])


def test_the_order_of_the_rows_does_not_matter() -> None:
    table = two_streets()
    for seed in range(3):
        other = correlations(table.sample(frac=1.0, random_state=seed))
        for name, one in correlations(table).items():
            assert one.bias.tobytes() == other[name].bias.tobytes()
            assert one.share == other[name].share


@pytest.mark.parametrize("length", [3.0, 6.0])
def test_a_known_length_is_found(length: float) -> None:
    rng, keeps = np.random.default_rng(3), math.exp(-1.0 / length)
    bias = np.zeros(20_000)
    for k in range(1, len(bias)):
        bias[k] = keeps * bias[k - 1] + math.sqrt(1.0 - keeps**2) * rng.normal(0.0, 0.1)
    found = correlations(drives(bias, 0.1))[POOLED]
    assert found.length == pytest.approx(length, rel=0.15)
    assert found.told == f"{found.length:.1f} m"
    assert 0.3 < found.share < 0.6  # half, in a mean of ratios
    at = np.array([0.5, 1.0, 2.0, 4.0])
    assert found.at(at) == pytest.approx(found.share * np.exp(-at / length), abs=0.04)


def test_noise_alone_is_no_bias() -> None:
    found = correlations(drives(np.zeros(5_000), 0.1))
    assert all(one.share < 0.02 for one in found.values())
    assert all(one.inflation(1.0) < 1.1 for one in found.values())


def test_independent_updates_need_no_inflation_and_equal_ones_their_number() -> None:
    lags = np.arange(0.0, 21.0)
    alone = known(lags, np.eye(21)[0], 1.0)
    assert alone.inflation(1.0) == 1.0
    assert alone.inflation(0.5) == 2.0  # linear between 1 at 0 and 0 at 1 m
    assert (alone.length, alone.told) == (None, "less than 1 m")
    same = known(lags, np.ones(21), 1.0)
    assert same.inflation(1.0) == 41.0
    assert same.inflation(4.0) == 11.0
    assert same.inflation(30.0) == 1.0
    assert (same.length, same.told) == (None, "more than 20 m")
    half = known(lags, np.ones(21), 0.5)
    assert half.inflation(1.0) == 21.0
    turned = known(lags, np.cos(lags), 1.0)
    assert turned.inflation(3.0) == 1.0  # never below
    steep = known(np.arange(3.0), np.array([1.0, 0.6, 0.2]), 0.5)
    assert steep.length == pytest.approx(1.0 + (0.6 - math.exp(-1.0)) / 0.4)


@given(st.floats(0.1, 25.0), st.floats(0.05, 1.0))
def test_fewer_updates_need_no_more(every: float, share: float) -> None:
    falling = known(np.arange(21.0), np.exp(-np.arange(21.0) / 4.0), share)
    assert falling.inflation(every) >= falling.inflation(2.0 * every) >= 1.0


def test_the_span_of_an_inflation_holds_what_other_streets_give() -> None:
    """A moving average over 5 m, along 2 km: what is true of an endless street is known. Almost
    without noise an error over its root mean square is its sign, and the arcsine law holds.
    """
    inside = 0
    true = 1.0 + 2.0 * sum(math.asin(rho) / (0.5 * math.pi) for rho in (0.8, 0.6, 0.4, 0.2))
    for seed in range(20):
        rng = np.random.default_rng(seed)
        bias = np.convolve(rng.normal(0.0, 0.1, 2_004), np.full(5, 5**-0.5), "valid")
        found = correlations(drives(bias, 1e-3, seed=seed))["along"]
        low, high = found.inflation_span(1.0)
        assert low <= found.inflation(1.0) <= high
        inside += low <= true <= high
    assert inside >= 14  # of 18 in the mean
    short = correlations(drives(bias[: int(BLOCK) - 1], 1e-3))["along"]
    assert np.isnan(short.inflation_span(1.0)).all()


def test_what_is_too_little_is_not_known() -> None:
    bias = np.sin(np.arange(200.0) / 3.0)
    assert correlations(drives(bias, 0.1, draws=1)) == {}
    assert correlations(drives(bias[: FEWEST - 1], 0.1)) == {}
    assert correlations(drives(bias, 0.1, spacing=25.0)) == {}
    assert correlations(drives(bias, 0.1).assign(status="failed")) == {}
    (last,) = {len(one.lags) for one in correlations(drives(bias[: FEWEST + 1], 0.1)).values()}
    assert last == 2
