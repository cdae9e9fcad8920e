"""Neighbours, PFH and Bhattacharyya against plain NumPy, and their laws."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tilestream.kernels.neighbours import cells_around, neighbours_within
from tilestream.kernels.pairs import (
    bhattacharyya_sums,
    entropy_of_counts,
    histogram_distances,
    pfh_counts,
)

Floats = NDArray[np.float64]


# --- Cells at random: sorted voxels, a mean in each, covariances of every shape


def random_cells(
    seed: int, count: int, span: tuple[int, int, int], edge: float, offset: int = 0
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Index, mean, covariance (regularised) and normal of up to `count` cells."""
    rng = np.random.default_rng(seed)
    index = np.unique(rng.integers(0, span, (count, 3)), axis=0) + offset
    mean = (index + rng.uniform(0.0, 1.0, index.shape)) * edge
    turn = np.linalg.qr(rng.normal(size=(len(index), 3, 3)))[0]
    lam = np.sort(rng.uniform(0.01, 0.6, (len(index), 3)) ** 2, axis=1)
    lam[::3, 0] = lam[::3, 1] = 1e-4
    covariance = turn @ (lam[:, :, None] * turn.transpose(0, 2, 1))
    normal = np.ascontiguousarray(turn[:, :, 0])
    normal[::4] = [0.0, 0.0, 1.0]
    return index, mean, 0.5 * (covariance + covariance.transpose(0, 2, 1)), normal


def lists(start: NDArray[np.int64], near: NDArray[np.int32]) -> list[list[int]]:
    return [near[a:b].tolist() for a, b in pairwise(start)]


# --- The same in plain NumPy


def plain_neighbours(mean: Floats, radius: float) -> list[list[int]]:
    within = np.linalg.norm(mean[:, None] - mean[None], axis=2) <= radius
    np.fill_diagonal(within, False)
    return [np.flatnonzero(row).tolist() for row in within]


def plain_fifth(x: float, low: float, high: float) -> int:
    return int(np.clip(np.floor((x - low) / ((high - low) / 5) + 1e-9), 0, 4))


def plain_bin(mean: Floats, normal: Floats, i: int, j: int) -> int | None:
    d = mean[j] - mean[i]
    length = np.linalg.norm(d)
    if length == 0:
        return None
    s, t = i, j
    if abs(normal[j] @ d) / length > abs(normal[i] @ d) / length + 1e-9:
        s, t, d = j, i, -d
    u, target = normal[s], normal[t]
    v = np.cross(d, u)
    if np.linalg.norm(v) <= 1e-6 * length:
        return None
    v /= np.linalg.norm(v)
    w = np.cross(u, v)
    alpha = plain_fifth(v @ target, -1, 1)
    phi = plain_fifth(u @ d / length, -1, 1)
    sine, cosine = (x if abs(x) >= 1e-9 else 0.0 for x in (w @ target, u @ target))
    theta = plain_fifth(np.arctan2(sine, cosine), -np.pi, np.pi)
    return 25 * alpha + 5 * phi + theta


def plain_counts(mean: Floats, normal: Floats, near: list[list[int]]) -> NDArray[np.int64]:
    counts = np.zeros((len(mean), 125), np.int64)
    for c, around in enumerate(near):
        if len(around) < 3:
            continue
        for i, j in combinations(sorted([c, *around]), 2):
            pair = plain_bin(mean, normal, i, j)
            if pair is not None:
                counts[c, pair] += 1
    return counts


def plain_bhattacharyya(mean: Floats, covariance: Floats, i: int, j: int) -> float:
    middle, d = (covariance[i] + covariance[j]) / 2, mean[j] - mean[i]
    spread = np.linalg.det(middle) / np.sqrt(
        np.linalg.det(covariance[i]) * np.linalg.det(covariance[j])
    )
    return float(d @ np.linalg.solve(middle, d) / 8 + np.log(spread) / 2)


# --- Kernels equal their twins


@pytest.mark.parametrize(
    ("edge", "radius", "span"),
    [(2.0, 5.0, (9, 8, 4)), (0.5, 2.0, (12, 12, 6)), (10.0, 5.0, (4, 4, 3)), (1.0, 5.0, (9, 9, 3))],
)
def test_neighbours_are_the_cells_within_the_radius(
    edge: float, radius: float, span: tuple[int, int, int]
) -> None:
    for seed, offset in ((1, 0), (2, -5), (3, 1_900_000)):
        index, mean, _, _ = random_cells(seed, 150, span, edge, offset)
        assert lists(*neighbours_within(index, mean, edge, radius)) == plain_neighbours(
            mean, radius
        )


@pytest.mark.interpreted
def test_a_neighbour_at_the_radius_counts() -> None:
    index = np.array([[0, 0, 0], [1, 2, 0], [2, 0, 0]])
    mean = np.array([[0.5, 0.5, 0.5], [3.5, 4.5, 0.5], [5.500001, 0.5, 0.5]])
    assert lists(*neighbours_within(index, mean, 2.0, 5.0)) == [[1], [0, 2], [1]]


def test_cells_around_are_the_cells_in_the_voxels_around() -> None:
    index, *_ = random_cells(4, 200, (10, 9, 6), 1.0, -3)
    reach = (2, 1, 3)
    within = (np.abs(index[:, None] - index[None]) <= reach).all(axis=2)
    assert lists(*cells_around(index, reach)) == [np.flatnonzero(r).tolist() for r in within]


def test_maps_far_apart_have_neighbours_too() -> None:
    near, _, _, _ = random_cells(5, 60, (5, 5, 3), 2.0)
    index = np.concatenate([near - 10**9, near, near + np.array([10**9, 0, 0])])
    index = index[np.lexsort(index.T[::-1])]
    start, cells = neighbours_within(index, index * 2.0 + 1.0, 2.0, 5.0)
    assert lists(start, cells) == plain_neighbours(index * 2.0 + 1.0, 5.0)
    assert len(cells) > 0


def test_no_cells_have_no_neighbours() -> None:
    start, near = neighbours_within(np.zeros((0, 3), np.int64), np.zeros((0, 3)), 2.0, 5.0)
    assert start.tolist() == [0]
    assert len(near) == 0


@pytest.mark.interpreted
@pytest.mark.parametrize("edge", [1.0, 2.0, 5.0])
def test_histograms_count_what_plain_numpy_counts(edge: float) -> None:
    index, mean, _, normal = random_cells(6, 70, (6, 5, 3), edge)
    start, near = neighbours_within(index, mean, edge, 5.0)
    counts = pfh_counts(mean, normal, start, near)
    assert counts.sum() > 0
    assert np.array_equal(counts, plain_counts(mean, normal, lists(start, near)))


@pytest.mark.interpreted
def test_sums_of_distances_equal_plain_numpy() -> None:
    index, mean, covariance, normal = random_cells(7, 90, (7, 6, 3), 2.0)
    start, near = neighbours_within(index, mean, 2.0, 5.0)
    counts = pfh_counts(mean, normal, start, near)
    l1, pairs = histogram_distances(counts, start, near)
    bhatt = bhattacharyya_sums(mean, covariance, start, near)
    entropy = entropy_of_counts(counts)
    for c, around in enumerate(lists(start, near)):
        shares = [counts[k] / counts[k].sum() if counts[k].any() else None for k in [c, *around]]
        own, others = shares[0], [s for s in shares[1:] if s is not None]
        expected = [] if own is None else [np.abs(own - s).sum() for s in others]
        assert pairs[c] == len(expected)
        assert l1[c] == pytest.approx(sum(expected), rel=1e-12)
        assert bhatt[c] == pytest.approx(
            sum(plain_bhattacharyya(mean, covariance, c, k) for k in around), rel=1e-9
        )
        if own is not None:
            filled = own[own > 0]
            assert entropy[c] == pytest.approx(-(filled * np.log2(filled)).sum(), abs=1e-12)
        else:
            assert np.isnan(entropy[c])


# --- Laws


def test_nothing_depends_on_where_the_map_lies_or_ends() -> None:
    index, mean, covariance, normal = random_cells(8, 500, (16, 8, 4), 2.0)
    parts = []
    for inside in (np.ones(len(index), bool), (index[:, 0] >= 1) & (index[:, 0] <= 14)):
        start, near = neighbours_within(index[inside], mean[inside], 2.0, 5.0)
        counts = pfh_counts(mean[inside], normal[inside], start, near)
        terms = np.column_stack(
            [
                entropy_of_counts(counts),
                histogram_distances(counts, start, near)[0],
                bhattacharyya_sums(mean[inside], covariance[inside], start, near),
            ]
        )
        parts.append(terms[(index[inside, 0] >= 7) & (index[inside, 0] <= 8)])
    assert len(parts[0]) > 20
    assert np.array_equal(parts[0], parts[1], equal_nan=True)


@pytest.mark.interpreted
def test_identical_and_singular_neighbours_give_numbers() -> None:
    index = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0], [40, 0, 0]])
    mean = np.array([[1.0, 1.0, 1.0]] * 4 + [[81.0, 1.0, 1.0]])
    covariance = np.repeat(1e-4 * np.eye(3)[None], 5, axis=0)
    normal = np.repeat([[0.0, 0.0, 1.0]], 5, axis=0)
    start, near = neighbours_within(index, mean, 2.0, 5.0)
    assert np.diff(start).tolist() == [3, 3, 3, 3, 0]
    counts = pfh_counts(mean, normal, start, near)
    assert not counts.any(), "pairs with the same mean do not count"
    assert np.isnan(entropy_of_counts(counts)).all()
    assert histogram_distances(counts, start, near)[1].tolist() == [0] * 5
    assert bhattacharyya_sums(mean, covariance, start, near) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.interpreted
def test_fewer_than_three_neighbours_give_no_histogram() -> None:
    index = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 0, 0]])
    mean = np.array([[1.0, 1.0, 1.0], [3.0, 1.5, 1.0], [5.0, 3.0, 1.2], [7.0, 1.0, 1.4]])
    normal = np.repeat([[0.0, 0.6, 0.8]], 4, axis=0)
    start, near = neighbours_within(index, mean, 2.0, 5.0)
    assert np.diff(start).tolist() == [2, 3, 3, 2]
    assert pfh_counts(mean, normal, start, near).any(axis=1).tolist() == [False, True, True, False]


@given(st.lists(st.integers(0, 50), min_size=1, max_size=125).filter(any))
def test_entropy_lies_between_zero_and_log2_of_the_bins(row: list[int]) -> None:
    entropy = entropy_of_counts(np.array([row], np.int32))[0]
    assert 0.0 <= entropy <= np.log2(len(row)) + 1e-12


def test_a_street_has_the_same_terms_as_plain_numpy(shared_data) -> None:
    with np.load(shared_data / "matchers" / "cells_2m.npz") as street:
        index, mean, covariance = street["index"], street["mean"], street["covariance"]
    normal = np.ascontiguousarray(np.linalg.eigh(covariance)[1][:, :, 0])
    order = np.lexsort(index.T[::-1])
    index, mean, normal = index[order], mean[order], normal[order]
    start, near = neighbours_within(index, mean, 2.0, 5.0)
    counts = pfh_counts(mean, normal, start, near)
    around = lists(start, near)
    for c in range(0, len(index), 400):
        only = [around[c] if k == c else [] for k in range(len(index))]
        assert np.array_equal(counts[c], plain_counts(mean, normal, only)[c])
