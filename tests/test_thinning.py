"""The order of a tile's points and their centroids, against sorts by NumPy and exact fractions."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tilestream.kernels import thinning

SPREADS = st.sampled_from([1, 300, 100_000, 2**30])


def scattered(seed: int, spread: tuple[int, int, int], count: int = 400) -> np.ndarray:
    """(n, 3) int32 points in a box, some of them twice; z on both sides of 0."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, spread, (count, 3)) - [0, 0, spread[2] // 2]
    return points[rng.integers(0, count, count)].astype(np.int32)


@given(seed=st.integers(0, 2**32 - 1), spread=st.tuples(SPREADS, SPREADS, SPREADS))
@settings(max_examples=30, deadline=None)
def test_points_are_sorted_by_voxel_then_by_themselves(
    seed: int, spread: tuple[int, int, int]
) -> None:
    points = scattered(seed, spread)
    keys = np.concatenate([points // 1000, points], axis=1)
    np.testing.assert_array_equal(thinning.sort(points, 1000).T, points[np.lexsort(keys.T[::-1])])


@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.tuples(SPREADS, SPREADS, SPREADS),
    leaf=st.sampled_from([1, 7, 200, 1000, 10**6]),
    origin=st.tuples(*[st.integers(-(10**11), 10**11)] * 3),
)
@settings(max_examples=60, deadline=None)
def test_a_voxel_has_the_mean_of_its_points_rounded_half_to_even_in_the_map(
    seed: int, spread: tuple[int, int, int], leaf: int, origin: tuple[int, int, int]
) -> None:
    points = scattered(seed, spread)
    voxels: dict[tuple[int, ...], list[list[int]]] = {}
    for point in points.tolist():
        voxels.setdefault(tuple(c // leaf for c in point), []).append(point)
    expected = [
        [
            round(o + Fraction(sum(c), len(c))) - o
            for o, c in zip(origin, np.array(of).T.tolist(), strict=True)
        ]
        for _, of in sorted(voxels.items())
    ]
    found = thinning.thin(points, leaf, np.array(origin))
    assert found.dtype == np.int32
    assert found.T.tolist() == expected


@pytest.mark.parametrize("count", [1, thinning.STEP, thinning.STEP + 1, 3 * thinning.STEP - 1])
@pytest.mark.parametrize("size", [1, 2, 5, 2 * thinning.STEP])
def test_voxels_are_whole_wherever_the_steps_end(count: int, size: int) -> None:
    voxel = np.arange(count) // size
    points = np.stack([voxel * 10, 0 * voxel, np.arange(count) % 10], axis=1).astype(np.int32)
    found = thinning.thin(points, 10, np.zeros(3, np.int64)).T
    starts = range(0, count, size)
    of = [points[s : s + size, 2].tolist() for s in starts]
    expected = [[10 * k, 0, round(Fraction(sum(z), len(z)))] for k, z in enumerate(of)]
    assert found.tolist() == expected


def test_no_points_are_in_order() -> None:
    none = np.zeros((0, 3), np.int32)
    assert (
        thinning.sort(none, 1000).shape
        == thinning.thin(none, 200, np.zeros(3, np.int64)).shape
        == (3, 0)
    )
