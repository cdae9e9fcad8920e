"""Coarse first: what is evaluated is right to the bit; how often what is not is off, is told."""

import numpy as np
import pandas as pd
import pytest

from tilestream.factors.along_route import averaged_along
from tilestream.factors.coarse import Coarse, Told
from tilestream.factors.stations import (
    first_stations,
    gaps,
    half_support,
    halved,
    known,
    numbers,
    probes,
    support,
)
from tilestream.records import Float64
from tilestream.settings import CoarseSettings

# --- One route


def table(values: Float64, done: np.ndarray, spacing: float) -> pd.DataFrame:
    n = len(values)
    return pd.DataFrame(
        {
            "route_id": "r",
            "arc_length": spacing * np.arange(n),
            "status": np.where(done, "done", "failed"),
            "vd_mean": values,
        }
    )


@pytest.mark.parametrize("spacing", [0.5, 1.0, 2.0, 7.0])
@pytest.mark.parametrize("seed", range(20))
def test_a_known_place_has_the_average_of_a_full_run(seed: int, spacing: float) -> None:
    """Whatever was taken, and wherever a virtual drive fails: the same bits."""
    rng, width = np.random.default_rng(seed), 1.5
    half = half_support(width, spacing)
    n = int(rng.integers(1, 60))
    values, done = rng.uniform(size=n), rng.uniform(size=n) > rng.choice([0.0, 0.1, 0.5])
    taken = rng.uniform(size=n) < rng.choice([0.3, 0.8, 0.95, 1.0])
    full = averaged_along(table(values, done, spacing), width, ["vd_mean"])
    part = averaged_along(table(values, done, spacing)[taken], width, ["vd_mean"])
    good = known(taken, taken & done, half)
    assert not (good & ~taken).any()
    same = good & done
    assert part["vd_mean"].reindex(full.index)[same].tolist() == full["vd_mean"][same].tolist()
    if taken.all():
        assert good.all()


@pytest.mark.parametrize("places", [1, 2, 7, 40, 500])
@pytest.mark.parametrize("half", [0, 3, 6])
def test_first_stations_are_evenly_spread_and_one_place_in_so_many(places: int, half: int) -> None:
    taken = np.zeros(places, bool)
    stations = first_stations(places, half, 8)
    assert {stations[0], stations[-1]} == {0, places - 1}
    assert np.ptp(np.diff(stations)) <= 1 if len(stations) > 1 else places == 1
    taken |= support(stations, taken, half)
    assert known(taken, taken, half)[stations].all()
    between = probes(stations, 8)
    assert not np.isin(between, stations).any()
    assert np.ptp(np.diff(np.union1d(stations, between))) <= 2 if places > 1 else not between.size
    taken[between] = True
    assert taken.sum() <= places / 8 + (2 * half + 1) / 2 + 2


def test_where_a_place_of_its_kernel_fails_a_station_reaches_all_the_way() -> None:
    taken, done, half = np.zeros(30, bool), np.ones(30, bool), 3
    done[2] = False
    for wanted in ([0, 1, 2], [3, 4]):
        more = support(np.array([1]), taken, half)
        assert np.flatnonzero(more).tolist() == wanted
        taken |= more
        assert known(taken, taken & done, half)[1] == (wanted[0] == 3)
    assert not support(np.array([1]), taken, half).any()


def test_gaps_are_halved_where_ends_are_high_or_differ_or_are_not_known() -> None:
    at = np.array([0, 10, 20, 30, 40, 41, 50])
    ends, estimate = np.isin(np.arange(51), at), np.full(51, np.nan)
    estimate[at] = 0.10, 0.14, 0.08, 0.21, np.nan, 0.1, 0.1
    of = gaps(ends)
    assert of.tolist() == [[0, 10], [10, 20], [20, 30], [30, 40], [41, 50]]
    assert halved(of, estimate, 0.05, 0.2).tolist() == [15, 25, 35]
    assert halved(of, estimate, 0.07, 0.3).tolist() == [25, 35]
    assert halved(of, estimate, 0.05, 0.12).tolist() == [5, 15, 25, 35]
    estimate[[4, 46]] = 0.11, 0.16  # of as much of their kernels as is taken
    assert halved(of, estimate, 0.05, 0.2).tolist() == [15, 25, 35, 45]
    estimate[[4, 46]] = 0.13, 0.14
    assert halved(of, estimate, 0.07, 0.135).tolist() == [5, 15, 25, 35, 45]


def test_numbers_are_of_route_place_and_seed_alone() -> None:
    some = numbers("r", np.arange(1000), 0)
    assert len(np.unique(some)) == 1000
    assert numbers("r", np.array([7]), 0) == some[7]
    assert (some / 2**64).mean() == pytest.approx(0.5, abs=0.05)
    for other in (numbers("s", np.arange(1000), 0), numbers("r", np.arange(1000), 1)):
        assert np.corrcoef(np.argsort(some), np.argsort(other))[0, 1] < 0.2


# --- All routes, in rounds


def estimates_of(lengths: dict[str, int], seed: int) -> Float64:
    """Smooth estimates, some of them high, some of none, and bumps that stations can miss."""
    rng = np.random.default_rng(seed)
    parts = []
    for n in lengths.values():
        step = np.arange(n)
        smooth = 0.1 + 0.03 * np.sin(step / 90.0 + rng.uniform(0, 6))
        for at in rng.integers(0, n, n // 100):
            smooth += 0.12 * np.exp(-(((step - at) / rng.uniform(1, 9)) ** 2))
        parts.append(np.where(rng.uniform(size=n) < 0.002, np.nan, smooth))
    return np.concatenate(parts)


def evaluated(
    estimate: Float64, lengths: dict[str, int], **settings: float
) -> tuple[Coarse, np.ndarray, int]:
    """A coarse run that knows all estimates: what it took, and how often it asked for more."""
    coarse = Coarse(lengths, 6, CoarseSettings(**settings))
    taken, rounds = np.zeros(len(estimate), bool), 0
    while (more := coarse.next()).size:
        assert not taken[more].any()
        taken[more] = True
        coarse.learn(np.where(taken, estimate, np.nan))
        rounds += 1
    return coarse, taken, rounds


@pytest.mark.parametrize("every", [4, 8, 16])
def test_nothing_is_interpolated_that_is_high_or_between_what_differs(every: int) -> None:
    lengths = {"long": 2000, "short": 30, "one": 1, "two": 700}
    estimate = estimates_of(lengths, 0)
    coarse, taken, rounds = evaluated(estimate, lengths, every=every)
    ends = coarse.gaps
    assert (np.abs(np.diff(estimate[ends])) <= 0.05).all()
    assert (estimate[ends] <= 0.2).all()
    told = coarse.told()
    assert told.first < taken.sum() == told.evaluated < len(estimate)
    assert told.rounds == rounds <= np.log2(every) + 8
    inside = coarse.interpolated
    assert told.interpolated == len(inside) > 0
    begins = np.cumsum([0, *lengths.values()])
    route = np.searchsorted(begins, ends, side="right")
    assert (route[:, 0] == route[:, 1]).all()  # nothing between two routes
    outside = np.setdiff1d(np.arange(len(estimate)), inside)
    assert taken[outside].all()
    pairs, whole = coarse.between
    assert taken[pairs].all()
    assert np.isfinite(estimate[pairs]).all()
    own = pairs[~whole, 1]
    assert sorted(pairs[whole, 1]) == sorted(ends[:, 1])
    assert own.tolist() == inside[taken[inside] & np.isfinite(estimate[inside])].tolist()
    assert told.alone == len(own) > 0
    steps = np.concatenate([np.arange(a + 1, b + 1) for a, b in pairs.tolist()])
    assert np.setdiff1d(steps, ends[:, 1]).tolist() == np.setdiff1d(inside, ends[:, 1]).tolist()


def test_the_check_tells_how_often_what_is_interpolated_is_off() -> None:
    """Over many draws it tells the share that a full run finds."""
    lengths, how = {"a": 3000, "b": 2000}, {"every": 32, "tolerance": 0.02}
    estimate = estimates_of(lengths, 1)
    coarse, taken, _ = evaluated(estimate, lengths, checks=0, **how)
    inside, there = coarse.interpolated, np.flatnonzero(taken & np.isfinite(estimate))
    said = np.interp(inside, there, estimate[there])
    truth = float((~(np.abs(said - estimate[inside]) <= 0.02)).mean())
    assert coarse.told().off_share is None
    told: list[Told] = [
        evaluated(estimate, lengths, seed=seed, **how)[0].told() for seed in range(60)
    ]
    checked, off = sum(one.checked for one in told), sum(one.off for one in told)
    assert 0.02 < truth < 0.5
    assert off / checked == pytest.approx(truth, abs=3 * np.sqrt(truth / checked))
    held = [one.off_low <= truth <= one.off_high for one in told]  # type: ignore[operator]
    assert np.mean(held) > 0.85
    bias = float(np.nanmean(said - estimate[inside]))
    biases = [one.off_bias * one.checked for one in told]  # type: ignore[operator]
    assert sum(biases) / checked == pytest.approx(bias, abs=0.001)


def test_places_that_are_lost_are_evaluated_up_to_and_not_beyond() -> None:
    lengths = {"a": 600}
    coarse = Coarse(lengths, 6, CoarseSettings(checks=0))
    lost, taken = np.arange(200, 300), np.zeros(600, bool)
    first = coarse.next()
    coarse.lose(lost)
    while (more := first if first is not None else coarse.next()).size:
        assert first is not None or not np.isin(more, lost).any()
        taken[more], first = True, None
        coarse.learn(np.where(taken, 0.1, np.nan))
    inside = coarse.interpolated
    assert inside.size
    assert not np.isin(inside, lost).any()
    assert (coarse.gaps[:, 1] < 200).sum() + (coarse.gaps[:, 0] >= 300).sum() == len(coarse.gaps)
    assert coarse.told().evaluated == np.setdiff1d(np.flatnonzero(taken), lost).size


def test_a_route_that_is_high_everywhere_is_evaluated_whole() -> None:
    coarse, taken, _ = evaluated(np.full(300, 0.3), {"a": 300})
    assert taken.all()
    assert not coarse.interpolated.size
    assert coarse.told().words.endswith("none is interpolated.")
