"""The 441 scores of a cell's points against plain NumPy over all cells; the factors from them."""

import numpy as np
import pytest
from numpy.typing import NDArray
from test_nearest import UTM_MM, Map, random_map

from tilestream.factors.local_similarity import (
    covariances,
    curvatures,
    entropy,
    secondary_peaks,
)
from tilestream.kernels import shift_sums
from tilestream.kernels.density import magnusson_constants
from tilestream.kernels.nearest import group_by_cell
from tilestream.kernels.neighbours import cells_around
from tilestream.kernels.score_field import SHIFTS, SIDE, reach_of_shifts, score_sums

Floats = NDArray[np.float64]
V = np.array([(i / 5, j / 5, 0.0) for i in range(-10, 11) for j in range(-10, 11)])


def scores(m: Map) -> Floats:
    start, order = group_by_cell(m.cell_of_point, len(m.index))
    edge = m.cell_mm / 1000.0
    cells = m.index, m.cell_mm, m.mean, m.covariance, m.precision
    around = cells_around(m.index, reach_of_shifts(edge))
    return score_sums(m.points_mm, start, order, *cells, *around, *magnusson_constants(edge))


def plain_scores(m: Map, c: int) -> Floats:
    """Brute force over all cells; a tie of 1e-9 m goes to the first."""
    edge = m.cell_mm / 1000.0
    d1, d2 = magnusson_constants(edge)
    x = m.points_mm[m.cell_of_point == c] / 1000.0
    out = np.zeros(SHIFTS)
    for s, v in enumerate(V):
        distance = np.linalg.norm((x + v)[:, None] - m.mean[None], axis=2)
        least = distance.min(axis=1)
        nearest = (distance <= least[:, None] + 1e-9).argmax(axis=1)
        y = x + v - m.mean[nearest]
        form = np.einsum("ni,nij,nj->n", y, m.precision[nearest], y)
        out[s] = (-d1 * np.exp(-d2 / 2 * form))[least <= edge + 1e-9].sum()
    return out


def assert_scores_equal(m: Map, rows: list[int]) -> None:
    fast = scores(m)
    for c in rows:
        plain = plain_scores(m, c)
        assert np.abs(fast[c] - plain).max() <= 2e-6 * max(plain.max(), 1e-3)


# --- The kernel equals its twin


@pytest.mark.parametrize("cell_mm", [500, 1000, 2000, 3300, 10_000])
def test_scores_equal_plain_numpy(cell_mm: int) -> None:
    m = random_map(1, cell_mm)
    assert_scores_equal(m, list(range(0, len(m.index), 5)))


def test_scores_equal_plain_numpy_far_from_the_origin() -> None:
    m = random_map(2, 2000, offset=np.array(UTM_MM))
    assert_scores_equal(m, list(range(0, len(m.index), 5)))


@pytest.mark.interpreted
def test_scores_of_a_single_small_cell_equal_plain_numpy() -> None:
    rng = np.random.default_rng(3)
    m = Map(rng.integers(0, (2000, 2000, 40), (7, 3)), 2000)
    assert len(m.index) == 1
    assert_scores_equal(m, [0])


def test_equally_near_cells_give_way_to_the_first() -> None:
    """A lattice whose points, moved by the shifts, lie exactly between means."""
    x, y = np.meshgrid(np.arange(0, 6000, 200), np.arange(0, 6000, 200))
    m = Map(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size, np.int64)]), 1000)
    m.mean[:, :2] = np.round(m.mean[:, :2] + 0.1, 6)
    rng = np.random.default_rng(4)
    m.precision = m.precision * rng.uniform(0.2, 5.0, (len(m.index), 1, 1))
    m.covariance = np.linalg.inv(m.precision)
    distance = np.sort(np.linalg.norm(m.points_mm[:, None] / 1000.0 - m.mean[None], axis=2), axis=1)
    assert (distance[:, 1] - distance[:, 0] < 1e-9).mean() > 0.2
    assert_scores_equal(m, [0, 14, 21, 35])


def test_many_cells_in_reach_of_a_group_equal_plain_numpy() -> None:
    """More than eight cells in a block: small cells in all directions."""
    rng = np.random.default_rng(5)
    m = Map(rng.integers(0, (4500, 4500, 1500), (20_000, 3)), 500)
    assert len(m.index) > 200
    assert_scores_equal(m, [len(m.index) // 2])


def test_singular_and_identical_cells_give_numbers() -> None:
    point = np.array([[100, 100, 100]] * 6)
    rng = np.random.default_rng(6)
    line = np.column_stack([np.arange(2000, 4000, 20), np.full(100, 500), np.full(100, 700)])
    beside, few = point + np.array([0, 2000, 0]), rng.integers(4000, 6000, (9, 3))
    m = Map(np.concatenate([point, beside, line, few]), 2000)
    assert np.isfinite(scores(m)).all()
    assert_scores_equal(m, list(range(len(m.index))))


# --- Laws


def test_neither_order_nor_far_cells_show() -> None:
    m = random_map(7, 1000, 9000)
    whole = scores(m)
    shuffled = np.random.default_rng(8).permutation(len(m.points_mm))
    m.points_mm, m.cell_of_point = m.points_mm[shuffled], m.cell_of_point[shuffled]
    assert np.array_equal(scores(m), whole)


def test_cells_beyond_the_reach_do_not_matter() -> None:
    rng = np.random.default_rng(9)
    m = Map(rng.integers(0, (9000, 1500, 900), (6000, 3)), 1000)
    whole = scores(m)
    kept = m.index[:, 0] <= 5
    row = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    part = Map(m.points_mm, 1000)
    for name in ("index", "mean", "covariance", "precision"):
        setattr(part, name, getattr(m, name)[kept])
    part.cell_of_point = row[m.cell_of_point]
    inner = part.index[:, 0] <= 2
    assert inner.sum() >= 6
    assert np.array_equal(scores(part)[inner], whole[kept][inner])


def test_the_scores_of_a_symmetric_cell_are_symmetric() -> None:
    rng = np.random.default_rng(10)
    half = rng.integers(50, 950, (40, 3)) * [1, 1, 0] + [0, 0, 1000]
    m = Map(np.concatenate([half, [2000, 2000, 2000] - half]), 2000)
    field = scores(m)[0].reshape(SIDE, SIDE)
    assert field == pytest.approx(field[::-1, ::-1], rel=1e-5)
    assert field.argmax() == SHIFTS // 2


@pytest.mark.interpreted
def test_a_value_is_a_power_of_two() -> None:
    for exponent in np.float32([0.0, 0.25, 0.999999, 1.0, 7.3, 23.9, 31.0]):
        value = shift_sums._value(exponent)
        assert value == pytest.approx(2.0 ** (24.0 - float(exponent)), rel=3e-7, abs=1.0)


# --- The factors of a field


def test_a_uniform_field_has_all_the_entropy() -> None:
    assert entropy(np.full((2, SHIFTS), 3.0)) == pytest.approx(np.log2(441))
    assert np.isnan(entropy(np.zeros((1, SHIFTS)))).all()
    assert entropy(np.eye(1, SHIFTS)) == pytest.approx(0.0)


def test_curvature_of_a_paraboloid_is_its_own() -> None:
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    hessian = turn @ np.diag([0.7, 3.0]) @ turn.T
    field = 2.0 + V[:, 0] - 0.5 * np.einsum("ni,ij,nj->n", V[:, :2], hessian, V[:, :2])
    low, high = curvatures(field[None])
    assert low[0] == pytest.approx(0.7)
    assert high[0] == pytest.approx(3.0)


def test_covariance_of_a_gaussian_is_its_own() -> None:
    form = (V[:, 0] / 0.4) ** 2 + (V[:, 1] / 0.3) ** 2
    soft = np.exp(-0.5 * form)
    xx, xy, yy = covariances((soft / soft.sum())[None])
    assert (xx[0], xy[0], yy[0]) == pytest.approx((0.16, 0.0, 0.09), abs=1e-3)


def test_secondary_peaks_are_counted_once() -> None:
    field = np.full((4, SIDE, SIDE), 1e-6)
    field[0, 10, 10] = 1.0
    field[1, 10, 10], field[1, 0, 0], field[1, 15, 15:17] = 1.0, 0.5, 0.3
    field[2, 10, 10], field[2, 4, 4] = 1.0, 0.009
    field[3] = 1.0
    assert secondary_peaks(field.reshape(4, -1)).tolist() == [0.0, 2.0, 0.0, 0.0]


def test_a_whole_street_equals_plain_numpy(shared_data) -> None:
    """A street of 160 m, thinned to the means of its cells."""
    with np.load(shared_data / "matchers" / "cells_2m.npz") as street:
        m = Map(np.rint(street["mean"] * 1000).astype(np.int64), 4000)
    assert len(m.index) > 50
    assert_scores_equal(m, list(range(0, len(m.index), 40)))
