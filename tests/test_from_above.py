"""The map from above: the highest point of each pixel, whatever the tiles."""

from pathlib import Path

import matplotlib.image as mpimg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import tilestream as ts
from tilestream.formats.points.pcd import write_pcd
from tilestream.from_above import (
    FINEST_MM,
    LEVELS,
    FromAbove,
    above_table,
    seen_from_above,
    tiles_around,
)
from tilestream.grid import MM_PER_M, Box
from tilestream.report.relief import (
    BLOCK,
    FAINT,
    GREY,
    HIGH,
    LEAST,
    LOW,
    STRONG,
    relief,
    relief_png,
)

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def cloud() -> Floats:
    rng = np.random.default_rng(4)
    return rng.uniform((-21.0, -13.0, -2.0), (33.0, 17.0, 9.0), (4000, 3)).round(3)


@pytest.fixture(scope="module")
def store(cloud: Floats, tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    folder = tmp_path_factory.mktemp("above")
    write_pcd(folder / "cloud.pcd", cloud)
    return ts.ingest(folder / "cloud.pcd", folder / "map.zarr", tile_size=8.0, map_leaf=0.0)


def literal(cloud: Floats, edge: int) -> dict[tuple[int, int], float]:
    """Highest point by pixel, one point after the other."""
    found: dict[tuple[int, int], float] = {}
    for x, y, z in np.rint(cloud * MM_PER_M).astype(np.int64).tolist():
        pixel = x // edge, y // edge
        found[pixel] = max(found.get(pixel, z / MM_PER_M), z / MM_PER_M)
    return found


def pixels_of(found: FromAbove) -> dict[tuple[int, int], float]:
    rows, columns = np.nonzero(np.isfinite(found.height))
    left, low = (round(corner / found.pixel) for corner in found.corner)
    return {
        (left + int(c), low + int(r)): float(found.height[r, c])
        for r, c in zip(rows, columns, strict=True)
    }


@pytest.mark.parametrize("level", range(LEVELS))
def test_each_pixel_has_its_highest_point(store: ts.TileStore, cloud: Floats, level: int) -> None:
    edge = FINEST_MM << level
    box = Box.around(cloud, 1.0)
    rows = (box.y_hi - 1) // edge - box.y_lo // edge + 1
    columns = (box.x_hi - 1) // edge - box.x_lo // edge + 1
    found = seen_from_above(store, store.keys(), box, rows * columns)
    assert found is not None
    assert found.pixel == edge / MM_PER_M
    assert found.height.shape == (rows, columns)
    assert pixels_of(found) == literal(cloud, edge)


def test_there_are_no_more_pixels_than_asked_for(store: ts.TileStore, cloud: Floats) -> None:
    box = Box.around(cloud, 0.0)
    for most in (30_000, 5_000, 100, 1):
        found = seen_from_above(store, store.keys(), box, most)
        assert found is not None
        assert found.height.size <= most or found.pixel == FINEST_MM * 2 ** (LEVELS - 1) / MM_PER_M


@pytest.mark.parametrize("size", [100.0, 7.3])
def test_no_tiling_shows(store: ts.TileStore, cloud: Floats, tmp_path: Path, size: float) -> None:
    """Also where tiles cut the pixels, as those of 7.3 m do."""
    write_pcd(tmp_path / "cloud.pcd", cloud)
    other = ts.ingest(
        tmp_path / "cloud.pcd", tmp_path / "map.zarr", tile_size=size, map_leaf=0.0, halo=5.0
    )
    box = Box.around(cloud, 3.0)
    for most in (60_000, 900):
        one, two = (seen_from_above(s, s.keys(), box, most) for s in (store, other))
        assert one is not None
        assert two is not None
        assert one.corner == two.corner
        np.testing.assert_array_equal(one.height, two.height)


def test_a_table_that_is_stored_is_what_is_made_now(store: ts.TileStore) -> None:
    """Every point is in a pixel of every level, and no level has a pixel twice."""
    for key in store.keys()[:3]:
        table = above_table().make(store, key)
        points = store.tile(key).points_mm()
        pixels = np.stack([table[name] for name in ("level", "column", "row")], axis=1)
        assert len(np.unique(pixels, axis=0)) == len(pixels)
        for level in range(LEVELS):
            highest = table["height"][table["level"] == level]
            assert highest.max() == points[:, 2].max()
            assert len(highest) <= len(points)


def test_a_tile_that_is_not_there_is_empty(store: ts.TileStore, cloud: Floats) -> None:
    first, *rest = store.keys()
    box = Box.around(cloud, 0.0)
    whole, part = (seen_from_above(store, keys, box, 10**6) for keys in (store.keys(), rest))
    assert whole is not None
    assert part is not None
    lost = np.isfinite(whole.height) & np.isnan(part.height)
    assert lost.any()
    core = store.grid.core(first)
    rows, columns = np.nonzero(lost)
    x, y = (
        (at + 0.5) * whole.pixel + corner
        for at, corner in zip((columns, rows), whole.corner, strict=True)
    )
    assert core.grown(FINEST_MM).holds((np.stack([x, y], 1) * MM_PER_M).astype(np.int64)).all()
    assert seen_from_above(store, [], box, 100) is None


def test_tiles_around_are_those_that_the_reach_touches(store: ts.TileStore) -> None:
    key = ts.TileKey(2, -1)
    assert tiles_around(store, [key], 0.0) == [key]
    assert len(tiles_around(store, [key], 0.5)) == 9
    assert len(tiles_around(store, [key, ts.TileKey(3, -1)], 8.5)) == 5 * 6


@given(
    st.integers(1, 12),
    st.integers(1, 12),
    st.integers(0, 2**31),
    st.sampled_from([0.25, 2.0, 32.0]),
    st.floats(-100.0, 4000.0),
)
@settings(max_examples=60, deadline=None)
def test_what_is_higher_is_no_fainter_and_heights_above_the_sea_do_not_show(
    rows: int, columns: int, seed: int, pixel: float, sea: float
) -> None:
    rng = np.random.default_rng(seed)
    height = rng.integers(0, 160, (rows, columns)) * 0.25
    height[rng.random((rows, columns)) < 0.3] = np.nan
    found = FromAbove(height, (0.0, 0.0), pixel)
    image = relief(found)[::-1]  # the highest y first
    assert image.shape == (rows, columns, 4)
    assert (image[..., :3] == GREY).all()
    opacity = image[..., 3].astype(float)
    assert (opacity[np.isnan(height)] == 0.0).all()
    there = np.isfinite(height)
    assert (opacity[there] >= np.floor(255.0 * FAINT)).all()
    assert (opacity[there] <= np.ceil(255.0 * STRONG)).all()
    if max(rows, columns) <= max(LEAST, round(BLOCK / pixel)):  # one square, one ground
        known = np.sort(height[there])
        low = known[int(LOW * (len(known) - 1))] if len(known) >= LEAST else np.inf
        order = np.argsort(height[there], kind="stable")
        assert (np.diff(opacity[there][order]) >= 0.0).all()
        assert (opacity[there & (height - low >= HIGH)] == round(255.0 * STRONG)).all()
        assert (opacity[there & (height <= low)] == round(255.0 * FAINT)).all()
    whole = FromAbove(height + np.round(sea), (0.0, 0.0), pixel)
    np.testing.assert_array_equal(relief(whole)[::-1], image)


def test_strays_below_the_road_darken_nothing() -> None:
    rng = np.random.default_rng(0)
    height = np.where(rng.random((200, 300)) < 0.1, 8.0, 0.0)
    image = relief(FromAbove(height, (0.0, 0.0), 0.25))
    strays = rng.random(height.shape) < 0.02
    spoilt = relief(FromAbove(np.where(strays, -16.0, height), (0.0, 0.0), 0.25))
    np.testing.assert_array_equal(spoilt[~strays[::-1]], image[~strays[::-1]])
    assert len(np.unique(image[..., 3])) == 2


def test_a_png_is_read_back(tmp_path: Path) -> None:
    height = np.arange(20.0).reshape(4, 5)
    height[2, 2] = np.nan
    found = FromAbove(height, (0.0, 0.0), 0.5)
    (tmp_path / "map.png").write_bytes(relief_png(found))
    read = np.round(255.0 * mpimg.imread(tmp_path / "map.png")).astype(np.uint8)
    np.testing.assert_array_equal(read, relief(found))
