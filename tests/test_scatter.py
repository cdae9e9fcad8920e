"""Points to the tiles that own them, against NumPy and Python's whole numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tilestream.grid import MAX_Z_MM, TileGrid, TileKey
from tilestream.kernels.scatter import SPLITMIX, STEP
from tilestream.pipeline.stages import scatter

WORD = 2**64


def mixed(z: int) -> int:
    """splitmix64's mixing function, in Python's whole numbers."""
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 % WORD
    z = (z ^ z >> 27) * 0x94D049BB133111EB % WORD
    return z ^ z >> 31


def print_of(points: list[list[int]]) -> tuple[int, int]:
    """The fingerprint of whole millimetres."""
    golden = int(SPLITMIX)
    keys = [mixed((mixed((x * golden + y) % WORD) * golden + z) % WORD) for x, y, z in points]
    return sum(keys) % WORD, sum(mixed((key + golden) % WORD) for key in keys) % WORD


@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([1e-3, 1.0, 90.0, 1e5, 9e7]),
    tile_mm=st.sampled_from([1000, 33_000, 100_000]),
    count=st.integers(0, 300),
)
@settings(max_examples=60, deadline=None)
def test_every_point_goes_to_the_tile_that_owns_it(
    seed: int, spread: float, tile_mm: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-spread, spread, (count, 3)) * [1.0, 1.0, 0.01]
    halves = rng.random(count) < 0.3
    points[halves] = np.rint(points[halves] * 1000.0) / 1000.0 + 0.0005  # most a tie or nearly one
    mm = np.rint(points * 1000.0).astype(np.int64)
    grouped, tiles = scatter.group(points, TileGrid(tile_mm, 0), "here")
    expected: dict[TileKey, list[list[int]]] = {}
    for x, y, z in mm.tolist():
        key = TileKey(x // tile_mm, y // tile_mm)
        expected.setdefault(key, []).append([x - key.ix * tile_mm, y - key.iy * tile_mm, z])
    assert grouped.dtype == np.int32
    start = 0
    for key, size, fingerprint in tiles:
        assert grouped[start : start + size].tolist() == expected[key]
        assert fingerprint == print_of(expected.pop(key))
        start += size
    assert not expected
    assert start == count


@pytest.mark.parametrize("count", [STEP - 1, STEP, 2 * STEP + 1])
def test_steps_lose_no_point(count: int) -> None:
    points = np.random.default_rng(count).uniform(-20.0, 20.0, (count, 3))
    grouped, tiles = scatter.group(points, TileGrid(10_000, 0), "here")
    corner = np.repeat([[k.ix, k.iy, 0] for k, _, _ in tiles], [n for _, n, _ in tiles], axis=0)
    found = grouped + corner * 10_000
    mm = np.rint(points * 1000.0)
    assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, mm.astype(int).tolist()))


def test_what_fits_no_tile_is_told_apart() -> None:
    limit = MAX_Z_MM / 1000.0
    points = np.array([[0.0, 0.0, limit], [0.0, 0.0, limit + 0.001], [1e30, 0.0, 0.0]])
    inside, outside = scatter.fitting(points)
    assert inside.tolist() == points[:1].tolist()
    assert outside.tolist() == points[1:].tolist()
