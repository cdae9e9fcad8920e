"""Ghosts: traffic that was baked into the map is told from what stands there."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tilestream.factors.ghosts import (
    AROUND,
    BLOCK,
    HIGH_MM,
    LEVEL,
    LOW_MM,
    OPEN,
    REACH_EDGES,
    SLIM,
    UPRIGHT,
    ghosts_among,
)

EDGE = 200
Mask = np.ndarray
STEPS = range(-AROUND, AROUND + 1)


def box(low: tuple[int, int, int], high: tuple[int, int, int]) -> np.ndarray:
    """A point in the middle of every voxel of a box, given in voxels."""
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * EDGE + EDGE // 2


def street() -> tuple[np.ndarray, dict[str, Mask]]:
    """Ground of 40 m x 12 m, and on it a car that passed, one that stayed, a tree, a facade."""
    ground = box((0, 0, 0), (200, 60, 1))
    under = (np.abs(ground[:, :2] - (20_000, 6_000)) < (2_300, 900)).all(axis=1)
    parts = {
        "ground": ground[~under],  # none is seen beneath the parked car
        "passed": box((30, 25, 2), (52, 33, 8)),
        "parked": box((89, 26, 2), (111, 34, 8)),
        "crown": box((140, 20, 18), (160, 40, 25)),
        "trunk": box((149, 29, 1), (151, 31, 18)),
        "facade": box((0, 59, 1), (200, 60, 50)),
        "post": box((70, 10, 1), (71, 11, 12)),
        "stub": box((80, 10, 1), (81, 11, 5)),
    }
    of = np.repeat(list(parts), [len(part) for part in parts.values()])
    return np.concatenate(list(parts.values())), {name: of == name for name in parts}


def test_what_passed_is_a_ghost_and_what_stands_is_not() -> None:
    centres, of = street()
    ghost = ghosts_among(centres, EDGE)
    height = centres[:, 2] - EDGE // 2
    assert ghost[of["passed"] & (height > LOW_MM)].all()
    assert (of["passed"] & ghost).sum() > 500
    assert ghost[of["stub"] & (height > LOW_MM)].all()
    for name in ("ground", "parked", "crown", "trunk", "facade", "post"):
        assert not ghost[of[name]].any(), name


def test_stray_returns_below_the_road_are_no_ground() -> None:
    centres, of = street()
    rng = np.random.default_rng(0)
    stray = rng.integers((0, 0, -6_000), (40_000, 12_000, -1_000), (150, 3))
    mirrored = box((32, 20, -12), (34, 24, -6))
    found = ghosts_among(np.concatenate([centres, stray, mirrored]), EDGE)[: len(centres)]
    np.testing.assert_array_equal(found, ghosts_among(centres, EDGE))
    assert found[of["passed"]].sum() > 500


@pytest.mark.parametrize("shift", [(0, 0, 137), (-33_000, 12_000, -5_001), (3 * 10**8, 10**9, 0)])
def test_whole_metres_of_translation_do_not_show(shift: tuple[int, int, int]) -> None:
    centres, _ = street()
    moved = centres + np.array(shift)
    np.testing.assert_array_equal(ghosts_among(moved, EDGE), ghosts_among(centres, EDGE))


def literal(centre_mm: np.ndarray) -> Mask:
    """The definition, one surfel after the other."""
    column = centre_mm[:, :2] // EDGE
    found = np.zeros(len(centre_mm), np.bool_)
    lowest: dict[tuple[int, int], int] = {}
    for x, y, z in (centre_mm // (EDGE, EDGE, 1)).tolist():
        lowest[x, y] = min(z, lowest.get((x, y), z))
    level = {
        (i, j): z
        for (i, j), z in lowest.items()
        if sum(abs(lowest.get((i + a, j + b), 10**9) - z) <= LOW_MM for a in STEPS for b in STEPS)
        >= LEVEL
    }

    def ground(at: np.ndarray) -> float:
        i, j = at // BLOCK
        near = [z for (x, y), z in level.items() if abs(x // BLOCK - i) < 2 > abs(y // BLOCK - j)]
        return min(near, default=np.nan)

    for row, z in enumerate(centre_mm[:, 2]):

        def shows(at: np.ndarray) -> bool:
            here = centre_mm[(column == at).all(axis=1), 2]
            if not len(here):
                return False
            low = ground(at)
            return bool(here.min() <= low + LOW_MM and here.max() <= low + HIGH_MM)

        def stands(at: np.ndarray) -> int:
            """How much of a column is above the ground and open."""
            here = centre_mm[(column == at).all(axis=1), 2]
            around = [shows(at + np.array((i, j))) for i in STEPS for j in STEPS]
            if not shows(at) or sum(around) < OPEN * len(around):
                return 0
            height = here - ground(at)
            return int(((height > LOW_MM) & (height <= HIGH_MM)).sum())

        height = z - ground(column[row])
        if LOW_MM < height <= HIGH_MM and stands(column[row]):
            around = [stands(column[row] + np.array((i, j))) > 0 for i in STEPS for j in STEPS]
            found[row] = stands(column[row]) < UPRIGHT or sum(around) > SLIM
    return found


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_ghosts_are_those_of_the_literal_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = box((-9, -6, 0), (8, 7, 1))
    kept = ground[rng.uniform(size=len(ground)) < 0.9]
    above = rng.integers((-1800, -1200, 0), (1600, 1400, 4500), (25, 3))
    post = np.array([[300, 300, 300 + 200 * k] for k in range(rng.integers(3, 14))])
    below = rng.integers((-1800, -1200, -3000), (1600, 1400, 0), (6, 3))
    centres = np.concatenate([kept, above, post, below])
    np.testing.assert_array_equal(ghosts_among(centres, EDGE), literal(centres))


def test_nothing_beyond_the_reach_shows() -> None:
    centres, _ = street()
    x = centres[:, 0]
    middle = (x > 8_000) & (x < 14_000)
    margin = REACH_EDGES * EDGE
    crop = (x > 8_000 - margin) & (x < 14_000 + margin)
    everywhere = ghosts_among(centres, EDGE)
    cut = np.zeros(len(centres), np.bool_)
    cut[crop] = ghosts_among(centres[crop], EDGE)
    assert everywhere[middle].any()
    np.testing.assert_array_equal(cut[middle], everywhere[middle])
    assert len(ghosts_among(centres[:0], EDGE)) == 0
