"""Distances of points to the nearest mean, against plain NumPy over all cells."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tilestream.kernels.cells import cell_of_points, cell_sums, moments, regularise
from tilestream.kernels.eigen import eigen
from tilestream.kernels.nearest import REACH, group_by_cell, nearest_mean_sums
from tilestream.kernels.neighbours import cells_around

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
UTM_MM = (368_000_000, 3_955_000_000, 40_000)


class Map:
    """Points and their cells, as the kernels take them."""

    def __init__(self, points_mm: Ints, cell_mm: int) -> None:
        self.points_mm, self.cell_mm = points_mm, cell_mm
        self.index, sums = cell_sums(points_mm, cell_mm, 6)
        self.mean, covariance = moments(self.index, sums, cell_mm)
        self.covariance, self.precision = regularise(*eigen(covariance))
        self.cell_of_point = cell_of_points(points_mm, cell_mm, self.index)

    def sums(self) -> tuple[Floats, Floats]:
        start, order = group_by_cell(self.cell_of_point, len(self.index))
        around = cells_around(self.index, (REACH, REACH, REACH))
        cells = self.index, self.cell_mm, self.mean, self.precision
        return nearest_mean_sums(self.points_mm, start, order, *cells, *around)


def random_map(seed: int, cell_mm: int, count: int = 3000, offset: Ints | None = None) -> Map:
    """Ground, a wall and a cloud in 4 x 4 x 3 voxels."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, (4 * cell_mm, 4 * cell_mm, 3 * cell_mm), (count, 3))
    points[: count // 3, 2] = rng.integers(0, 30, count // 3)
    points[count // 3 : count // 2, 0] = cell_mm + rng.integers(0, 30, count // 2 - count // 3)
    return Map(points if offset is None else points + offset, cell_mm)


def plain_sums(m: Map) -> tuple[Floats, Floats]:
    """Brute force over all cells; a tie of 1e-9 m goes to the first."""
    x = m.points_mm / 1000.0
    distance = np.linalg.norm(x[:, None] - m.mean[None], axis=2)
    nearest = (distance <= distance.min(axis=1, keepdims=True) + 1e-9).argmax(axis=1)
    y = x - m.mean[nearest]
    sigmas = np.sqrt(np.einsum("ni,nij,nj->n", y, m.precision[nearest], y))
    inside = m.cell_of_point >= 0
    rows, cells = m.cell_of_point[inside], len(m.index)
    metres = distance[np.arange(len(x)), nearest]
    return np.bincount(rows, metres[inside], cells), np.bincount(rows, sigmas[inside], cells)


@pytest.mark.parametrize("cell_mm", [500, 2000, 10_000])
@pytest.mark.parametrize("offset", [(0, 0, 0), UTM_MM])
def test_sums_equal_plain_numpy(cell_mm: int, offset: tuple[int, int, int]) -> None:
    m = random_map(1, cell_mm, 1000, np.array(offset))
    assert len(m.index) > 20
    check_sums(m)


@pytest.mark.interpreted
def test_sums_of_few_points_equal_plain_numpy() -> None:
    check_sums(random_map(1, 2000, 300, np.array(UTM_MM)))


def check_sums(m: Map) -> None:
    euclidean, mahalanobis = m.sums()
    plain_euclidean, plain_mahalanobis = plain_sums(m)
    assert euclidean == pytest.approx(plain_euclidean, rel=1e-7)
    assert mahalanobis == pytest.approx(plain_mahalanobis, rel=1e-6)


def test_means_at_a_regular_distance_go_to_the_first_cell() -> None:
    x, y = np.meshgrid(np.arange(0, 4000, 200), np.arange(0, 4000, 200))
    lattice = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size, np.int64)])
    m = Map(lattice, 1000)
    m.precision *= np.arange(1.0, len(m.index) + 1)[:, None, None]  # so that a wrong cell shows
    distance = np.linalg.norm(lattice[:, None] / 1000.0 - m.mean[None], axis=2)
    nearest_two = np.sort(distance, axis=1)[:, :2]
    assert np.isclose(nearest_two[:, 0], nearest_two[:, 1], atol=1e-9, rtol=0.0).sum() == 0
    m.mean[:, :2] += 0.1  # means at 0.5 m: points at whole metres are between two or four
    m.mean = np.round(m.mean, 6)
    distance = np.sort(np.linalg.norm(lattice[:, None] / 1000.0 - m.mean[None], axis=2), axis=1)
    assert np.isclose(distance[:, 0], distance[:, 1], atol=1e-9, rtol=0.0).sum() > 50
    for fast, plain in zip(m.sums(), plain_sums(m), strict=True):
        assert fast == pytest.approx(plain, rel=1e-7)


def test_no_order_of_points_shows() -> None:
    m = random_map(2, 2000)
    first = m.sums()
    shuffled = np.random.default_rng(3).permutation(len(m.points_mm))
    m.points_mm, m.cell_of_point = m.points_mm[shuffled], m.cell_of_point[shuffled]
    for a, b in zip(first, m.sums(), strict=True):
        assert np.array_equal(a, b)


def test_cells_far_away_do_not_matter() -> None:
    m = random_map(4, 1000, 6000)
    whole = m.sums()
    kept = m.index[:, 0] <= 2
    row = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    part = random_map(4, 1000, 6000)
    part.index, part.mean, part.precision = m.index[kept], m.mean[kept], m.precision[kept]
    part.cell_of_point = row[m.cell_of_point]
    inner = part.index[:, 0] == 0
    assert inner.sum() > 8
    for a, b in zip(whole, part.sums(), strict=True):
        assert np.array_equal(a[kept][inner], b[inner])


def test_a_point_is_no_farther_from_the_nearest_mean_than_from_its_own() -> None:
    m = random_map(5, 2000)
    inside = m.cell_of_point >= 0
    own = m.points_mm[inside] / 1000.0 - m.mean[m.cell_of_point[inside]]
    rows = np.bincount(m.cell_of_point[inside], np.linalg.norm(own, axis=1), len(m.index))
    assert (m.sums()[0] <= rows + 1e-6).all()
    assert (m.sums()[0] < rows - 1e-3).any()


@pytest.mark.interpreted
def test_cells_without_points_sum_to_zero() -> None:
    m = random_map(6, 2000)
    m.cell_of_point = np.full(len(m.points_mm), -1)
    for sums in m.sums():
        assert sums.tolist() == [0.0] * len(m.index)


@pytest.mark.interpreted
def test_groups_hold_each_point_once() -> None:
    rows = np.array([2, -1, 0, 2, 2, -1, 0])
    start, order = group_by_cell(rows, 4)
    assert start.tolist() == [0, 2, 2, 5, 5]
    assert [sorted(order[a:b]) for a, b in ((0, 2), (2, 5))] == [[2, 6], [0, 3, 4]]
