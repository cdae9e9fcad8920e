"""Laws of the tile lattice."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.errors import UsageError
from tilestream.grid import Box, TileGrid, TileKey, whole_mm

keys = st.builds(TileKey, st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6))
grids = st.builds(TileGrid, st.integers(1, 10**6), st.integers(0, 10**5))


@given(keys)
def test_a_key_is_read_back_from_what_it_prints(key: TileKey) -> None:
    assert TileKey.parse(str(key)) == key


def test_a_key_prints_as_column_and_row() -> None:
    assert str(TileKey(12, -3)) == "12_-3"


@pytest.mark.parametrize("text", ["12", "12_3_4", "a_b", "012_3", "1_ 2", "", "+1_2", "points"])
def test_what_is_no_key_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="no tile key"):
        TileKey.parse(text)


@given(grids, st.integers(-(10**8), 10**8), st.integers(-(10**8), 10**8))
def test_every_place_lies_in_the_core_of_its_tile_and_of_no_other(
    grid: TileGrid, x: int, y: int
) -> None:
    key = grid.key_at(x / 1000, y / 1000)
    core = grid.core(key)
    assert core.x_lo <= x < core.x_hi
    assert core.y_lo <= y < core.y_hi
    assert list(grid.keys_over(Box(x, y, x + 1, y + 1))) == [key]


@given(st.integers(1, 50), st.integers(0, 60), keys)
def test_the_halo_box_touches_exactly_the_tiles_within_the_halo(
    tile: int, halo: int, key: TileKey
) -> None:
    grid = TileGrid(tile, halo)
    reach = -(-halo // tile)
    expected = [
        TileKey(ix, iy)
        for ix in range(key.ix - reach, key.ix + reach + 1)
        for iy in range(key.iy - reach, key.iy + reach + 1)
    ]
    assert list(grid.keys_over(grid.halo_box(key))) == expected


def test_an_empty_box_touches_no_tile() -> None:
    assert list(TileGrid(10, 0).keys_over(Box(5, 5, 5, 9))) == []


@given(st.integers(1, 10**9))
def test_whole_millimetres_survive_metres(mm: int) -> None:
    assert whole_mm(mm / 1000, "length") == mm


@pytest.mark.parametrize("length", [0.0005, 1.23456, float("nan"), float("inf")])
def test_fractions_of_a_millimetre_are_refused(length: float) -> None:
    with pytest.raises(UsageError, match="map_leaf is"):
        whole_mm(length, "map_leaf")


@pytest.mark.parametrize(("tile", "halo"), [(0.0, 1.0), (-1.0, 1.0), (10.0, -1.0), (2e6, 0.0)])
def test_impossible_grids_are_refused(tile: float, halo: float) -> None:
    with pytest.raises(UsageError, match=r"tile_size|halo"):
        TileGrid.of(tile, halo)


def test_a_cell_size_that_does_not_divide_the_tile_names_the_nearest_that_do() -> None:
    grid = TileGrid.of(100.0, 10.0)
    grid.require_cell_size(2000)
    with pytest.raises(UsageError) as caught:
        grid.require_cell_size(3000)
    message = str(caught.value)
    assert "cell size of 2.5 m or 3.125 m" in message
    assert "tiles of 99 m or 102 m" in message
    with pytest.raises(UsageError, match="more than 0"):
        grid.require_cell_size(0)
