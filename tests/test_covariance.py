"""The covariance of a filter's registration: what it is made of, what it is calibrated to."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_data import dataset, with_virtual_drives

from tilestream.errors import ModelError
from tilestream.factors.virtual_drive import MOMENT_COLUMNS, Ends, stratified_starts, virtual_drive
from tilestream.label import start_errors
from tilestream.model.covariance import (
    COVARIANCE_COLUMNS,
    about_bias,
    as_it_is,
    as_json,
    calibrated,
    cores,
    from_json,
    in_map,
    matrices,
    ring_weights,
)
from tilestream.model.covariance_training import calibrate_covariance
from tilestream.model.file import load_model, save_model
from tilestream.model.training import train
from tilestream.moments import AXES, PAIRS, moments_of, scores_of
from tilestream.records import Float64

NAMES = [column.name for column in COVARIANCE_COLUMNS]
SPREAD = np.array([0.05, 0.03, 0.02, 0.002, 0.003, 0.004])


def draw(rng: np.random.Generator, spread: Float64 = SPREAD, lost: float = 0.0) -> Ends:
    """A draw whose errors are Gaussian; a share of its starts ends far away."""
    starts = stratified_starts(32, int(rng.integers(5)))
    axes = rng.normal(0.0, 1.0, (32, 6)) * spread
    axes[rng.random(32) < lost, 0] += 1.5
    error = np.linalg.norm(axes[:, :3], axis=1)
    return Ends(starts, error, axes, rng.normal(2.5, 0.1, 32), rng.normal(4.0, 0.2, 32))


def row(*draws: Ends, route: str = "a", sample: int = 0, arc: float = 0.0) -> dict[str, object]:
    """A place of a table of observability."""
    found = virtual_drive(draws)
    kept = {column.name: found[column.name] for column in MOMENT_COLUMNS}
    return {"route_id": route, "sample": sample, "arc_length": arc, "status": "done", **kept}


def street(seed: int, places: int, spread: Float64 = SPREAD, lost: float = 0.0) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    rows = [
        row(*(draw(rng, spread, lost) for _ in range(5)), sample=k, arc=2.0 * k)
        for k in range(places)
    ]
    return pd.DataFrame(rows)


@given(st.floats(0.01, 2.0))
def test_every_prediction_falls_into_one_ring(error: float) -> None:
    weights = ring_weights(error)
    assert sum(weights.values()) == pytest.approx(1.0)
    assert all(weight >= 0.0 for weight in weights.values())
    off = np.hypot(*np.random.default_rng(0).normal(0.0, error, (2, 20_000)))
    for (name, weight), (low, high) in zip(
        weights.items(), ((0.0, 1.0), (1.0, 1.5), (1.5, math.inf)), strict=True
    ):
        assert ((off >= low) & (off < high)).mean() == pytest.approx(weight, abs=0.02), name


def test_a_core_is_the_moments_of_the_held_starts_by_ring() -> None:
    draws = [draw(np.random.default_rng(k), lost=0.2) for k in range(3)]
    found = cores(pd.DataFrame([row(*draws)]), 0.6, 0.0).iloc[0]
    axes = np.concatenate([one.axes for one in draws])
    error = np.concatenate([one.error for one in draws])
    ring = np.concatenate([one.starts.ring for one in draws])
    held = error <= 0.5
    share, square = 0.0, np.zeros((6, 6))
    for number, weight in enumerate(ring_weights(0.6).values()):
        here = ring == number
        share += weight * (here & held).sum() / here.sum()
        for e in axes[here & held]:
            square += weight * np.outer(e, e) / here.sum()
    assert 0.05 < 1.0 - share < 0.5
    assert found["p_lost"] == pytest.approx(1.0 - share)
    for a, b in PAIRS:
        expected = square[AXES.index(a), AXES.index(b)] / share
        assert found[f"cov_{a}_{b}"] == pytest.approx(expected, abs=1e-15)


def test_those_that_are_lost_leave_the_core_as_it_is() -> None:
    calm, wild = street(1, 40), street(1, 40, lost=0.3)
    a, b = (cores(table, 0.3, 0.0) for table in (calm, wild))
    assert a["p_lost"].max() == 0.0
    assert b["p_lost"].mean() == pytest.approx(0.3, abs=0.05)
    ratio = b["cov_across_across"].mean() / a["cov_across_across"].mean()
    assert ratio == pytest.approx(1.0, abs=0.1)


def test_where_nothing_holds_nothing_is_said() -> None:
    table = street(2, 3, lost=0.0)
    lost = street(2, 3, lost=1.1)
    table = pd.concat([table.iloc[:1], lost.iloc[1:2], table.iloc[2:]], ignore_index=True)
    found = calibrated(cores(table, 0.3, 0.0), as_it_is(0.0))
    assert found["p_lost"].tolist() == [0.0, 1.0, 0.0]
    assert found.drop(columns="p_lost").iloc[1].isna().all()
    assert found.iloc[[0, 2]].notna().all(axis=None)
    near = calibrated(cores(table, 0.3, 2.0), as_it_is(2.0))  # its neighbours know something of it
    assert near.notna().all(axis=None)
    assert 0.3 < near["p_lost"][1] < 0.7


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([0.0, 1.0, 3.0]))
def test_a_covariance_is_one(seed: int, width: float) -> None:
    table = street(seed, 6, lost=0.1)
    rng = np.random.default_rng(seed)
    calibration = replace(as_it_is(width), scale=rng.uniform(0.1, 3.0, 6), added=SPREAD**2)
    calibration = replace(calibration, gain=rng.uniform(0.0, 1.0, 6))
    found = calibrated(cores(table, 0.3, width), calibration)
    assert list(found) == NAMES
    whole = matrices(found)
    inner = about_bias(found) / np.sqrt(np.einsum("i,j->ij", SPREAD, SPREAD))
    assert (np.linalg.eigvalsh(inner) > 0.0).all()
    np.testing.assert_array_equal(whole, whole.transpose(0, 2, 1))
    assert (np.linalg.eigvalsh(whole / np.sqrt(np.einsum("i,j->ij", SPREAD, SPREAD))) > 0.0).all()
    assert (found["nvtl_low"] < found["nvtl"]).all()
    assert (found["nvtl"] < found["nvtl_high"]).all()
    heading = rng.uniform(-4.0, 4.0, len(found))
    turned = in_map(whole, heading)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(turned), np.linalg.eigvalsh(whole), atol=1e-15, rtol=1e-6
    )


def test_in_the_map_it_is_that_of_the_errors_in_the_map() -> None:
    """Turned as the errors themselves are: a literal reference by poses."""
    rng, heading = np.random.default_rng(3), 2.2
    T = np.eye(4)
    c, s = math.cos(heading), math.sin(heading)
    T[:2, :2] = [[c, -s], [s, c]]
    ends = np.repeat(T[None], 400, axis=0)
    ends[:, :3, 3] += rng.normal(0.0, 1.0, (400, 3)) * [0.2, 0.05, 0.01]
    errors = start_errors(T, ends)
    route = np.zeros((1, 6, 6))
    axes = np.column_stack([errors[axis] for axis in AXES])
    route[0] = axes.T @ axes / len(axes)
    off = ends[:, :3, 3] - T[:3, 3]
    np.testing.assert_allclose(
        in_map(route, np.array([heading]))[0, :3, :3], off.T @ off / len(off), atol=1e-12
    )


# --- Calibration


def labelled(places: int, more: Float64, seed: int = 5) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Places whose labels err more than their virtual drives, each axis by its own factor and
    addition, and the labels' moments.
    """
    rng = np.random.default_rng(seed)
    rows, labels = [], []
    for k in range(places):
        spread = SPREAD * rng.uniform(0.5, 2.0)
        rows.append(row(*(draw(rng, spread) for _ in range(5)), sample=k, arc=2.0 * k))
        real = np.sqrt(more[0] * spread**2 + more[1] * SPREAD**2)
        axes = rng.normal(0.0, 1.0, (40, 6)) * real
        held = np.linalg.norm(axes[:, :3], axis=1) <= 0.5
        scores = scores_of("near", rng.normal(2.0, 0.1, 40), rng.normal(5.0, 0.2, 40), held)
        labels.append(moments_of("near", axes, held) | scores)
    return pd.DataFrame(rows), pd.DataFrame(labels)


def test_a_calibration_finds_what_real_scans_add() -> None:
    more = np.array([[1.5, 1.0, 0.5, 1.0, 2.0, 1.0], [0.5, 0.0, 1.0, 1.0, 0.0, 0.3]])
    table, labels = labelled(400, more)
    core = cores(table, 0.3, 0.0)
    found = calibrate_covariance(core, labels, 0.0)
    assert found.places == 400
    assert (found.gain <= 0.3).all(), "errors without a bias"
    variance = found.scale * SPREAD**2 + found.added
    np.testing.assert_allclose(variance, more.sum(axis=0) * SPREAD**2, rtol=0.1)
    np.testing.assert_allclose(found.scale, more[0], rtol=0.25, atol=0.1)
    assert found.scores["nvtl"][0] == pytest.approx(2.0 / 2.5, rel=0.02)
    after = calibrated(core, found)
    for axis in AXES:  # what normalises errors
        square = labels[f"near_{axis}_{axis}"] / after[f"cov_{axis}_{axis}"]
        assert square.mean() == pytest.approx(1.0, abs=0.02)


def test_a_calibration_is_kept_to_the_bit_and_a_damaged_one_refused() -> None:
    table, labels = labelled(60, np.ones((2, 6)))
    found = calibrate_covariance(cores(table, 0.3, 1.0), labels, 1.0)
    again = from_json(as_json(found))
    assert as_json(again) == as_json(found)
    for name, value in (
        ("scale", [1.0] * 5),
        ("gain", [-0.1] * 6),
        ("added", [-1.0] * 6),
        ("width", 0.7),
        ("lost", math.nan),
        ("scores", {}),
    ):
        with pytest.raises(ModelError):
            from_json(as_json(found) | {name: value})


def test_a_model_learns_it_and_its_file_keeps_it(tmp_path: Path) -> None:
    known = with_virtual_drives(dataset(1, lengths={"a": 230, "b": 230, "c": 230}))
    model = train(known, recipe="physics")
    assert model.covariance is not None
    assert model.covariance.places == len(known)
    save_model(model, tmp_path / "model.skops")
    kept = load_model(tmp_path / "model.skops").covariance
    assert kept is not None
    assert as_json(kept) == as_json(model.covariance)
    blind = train(
        replace(known, rows=known.rows.drop(columns="near_along_along")), recipe="physics"
    )
    assert blind.covariance is None


def test_a_bias_that_the_map_shows_is_expected_and_taken_from_the_spread() -> None:
    """Registrations of a place all end off by much the same, virtual and real."""
    rng = np.random.default_rng(8)
    rows, labels = [], []
    for k in range(300):
        bias = rng.normal(0.0, 2.0, 6) * SPREAD
        draws = []
        for _ in range(5):
            one = draw(rng)
            axes = one.axes + bias
            draws.append(replace(one, axes=axes, error=np.linalg.norm(axes[:, :3], axis=1)))
        rows.append(row(*draws, sample=k, arc=2.0 * k))
        axes = rng.normal(0.0, 1.0, (40, 6)) * SPREAD + 0.8 * bias
        held = np.linalg.norm(axes[:, :3], axis=1) <= 0.5
        scores = scores_of("near", np.full(40, 2.0), np.full(40, 5.0), held)
        labels.append(moments_of("near", axes, held) | scores)
    core, measured = cores(pd.DataFrame(rows), 0.3, 0.0), pd.DataFrame(labels)
    found = calibrate_covariance(core, measured, 0.0)
    np.testing.assert_allclose(found.gain, 0.8, atol=0.05)
    after = calibrated(core, found)
    whole, inner = (
        np.sqrt(m[:, range(6), range(6)].mean(axis=0)) for m in (matrices(after), about_bias(after))
    )
    np.testing.assert_allclose(inner, SPREAD, rtol=0.1)
    np.testing.assert_allclose(whole, np.sqrt(1.0 + (0.8 * 2.0) ** 2) * SPREAD, rtol=0.1)
    for axis in AXES:
        square = measured[f"near_{axis}_{axis}"] / after[f"cov_{axis}_{axis}"]
        assert square.mean() == pytest.approx(1.0, abs=0.1)


def test_untrained_it_is_the_moments_of_the_virtual_drive() -> None:
    core = cores(street(3, 5), 0.3, 1.5)
    found = calibrated(core, as_it_is(1.5))
    np.testing.assert_allclose(matrices(found), matrices(core), atol=1e-15)


def test_places_where_one_start_holds_or_none_are_learnt_from_as_far_as_they_say_something() -> (
    None
):
    table, labels = labelled(30, np.ones((2, 6)))
    one = draw(np.random.default_rng(1), lost=1.1)
    axes, error = one.axes.copy(), one.error.copy()
    axes[0, 0], error[0] = 0.01, 0.01
    alone = pd.DataFrame([row(replace(one, axes=axes, error=error), sample=90, arc=500.0)])
    axes, error = one.axes.copy(), one.error.copy()
    axes[-1, 0], error[-1] = 0.01, 0.01
    far = pd.DataFrame([row(replace(one, axes=axes, error=error), sample=91, arc=550.0)])
    none = pd.DataFrame([row(one, sample=92, arc=600.0)])
    core = cores(pd.concat([table, alone, far, none], ignore_index=True), 0.3, 0.0)
    np.testing.assert_array_equal(core["nvtl_sd"].tolist()[-3:], [0.0, np.nan, np.nan])
    assert core["cov_along_along"].notna().tolist()[-3:] == [True, True, False]
    more = pd.concat([labels, labels.iloc[:3]], ignore_index=True)
    found = calibrate_covariance(core, more, 0.0)
    assert found.places == 32
    assert as_json(from_json(as_json(found))) == as_json(found)
    nothing = calibrate_covariance(core.iloc[-1:], more.iloc[-1:], 0.0)
    assert as_json(nothing) == as_json(as_it_is(0.0))
