"""The map of the dashboard as it is sent and kept: bounded, the worst places first, no harm."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_run import estimates_task, places_of, small_map
from hypothesis import given
from hypothesis import strategies as st
from naps import Nap
from numpy.typing import NDArray

from tilestream.from_above import FromAbove
from tilestream.grid import Box, TileKey
from tilestream.pipeline.engine import map_sender
from tilestream.pipeline.engine.attempt import attempt
from tilestream.pipeline.engine.map_sender import MARKS_OF_TILE, MapSender, patch_of
from tilestream.pipeline.engine.map_view import BLOCK, MOST_MARKS, MapView, Patch, thinned
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.report.relief import FAINT
from tilestream.store import TileStore


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> TileStore:
    """A map of four tiles."""
    return small_map(tmp_path_factory.mktemp("street"))


PLACES = st.lists(
    st.tuples(
        st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(0.0, 9.0) | st.just(float("nan"))
    ),
    max_size=60,
)


@given(PLACES, st.integers(4, 20))
def test_of_many_places_the_worst_are_left(
    given_places: list[tuple[float, float, float]], most: int
) -> None:
    places = np.array(given_places).reshape(-1, 3)
    kept, square = thinned(places, most, 1.0)
    assert len(kept) <= most
    assert {tuple(row) for row in kept.tolist() if row[2] == row[2]} <= {
        tuple(row) for row in places.tolist()
    }
    if len(kept) < len(places):  # each that is gone is no worse than one of its square
        squares: dict[tuple[int, ...], float] = {}
        for x, y, error in np.nan_to_num(kept, nan=-1.0).tolist():
            key = int(x // square), int(y // square)
            assert key not in squares
            squares[key] = error
        for x, y, error in np.nan_to_num(places, nan=-1.0).tolist():
            assert error <= squares[int(x // square), int(y // square)]
    else:
        assert np.array_equal(kept, places, equal_nan=True)


def test_the_marks_of_a_city_are_bounded_and_hold_its_worst_place() -> None:
    view, rng = MapView(), np.random.default_rng(0)
    for tile in range(300):
        x = 100.0 * tile + np.arange(100)
        places = np.column_stack([x, np.zeros(100), rng.gamma(2.0, 0.1, 100)])
        if tile == 123:
            places[50, 2] = 77.0
        view.draw({"marks": places.tobytes(), "places": 100})
    assert view.places == 30_000
    assert MOST_MARKS / 4 < len(view.marks) <= MOST_MARKS
    assert [12_350.0, 0.0, 77.0] in view.marks.tolist()
    assert view.facts()["worst_of_squares_m"] == view.square > 1.0


@given(st.integers(-300, 300), st.integers(-300, 300), st.integers(1, 300), st.integers(1, 300))
def test_a_patch_is_seen_where_it_was_sent_to(
    column: int, row: int, rows: int, columns: int
) -> None:
    shades = (1 + np.arange(rows * columns) % 250).astype(np.uint8).reshape(rows, columns)
    view = MapView()
    view.draw({"patch": Patch(0.5 * column, 0.5 * row, 0.5, shades).message()})
    assert set(view.changes) == set(range(len(view.blocks)))
    found = np.zeros_like(shades)
    for block in view.blocks:
        assert block.shades.shape == (BLOCK, BLOCK)
        left, low = round(block.x / 0.5) - column, round(block.y / 0.5) - row
        down, across = np.nonzero(block.shades)
        found[low + down, left + across] = block.shades[down, across]
    assert np.array_equal(found, shades)


class Sent(list[dict[str, Any]]):
    """Takes what is sent, and shows it as the scheduler does."""

    def view(self) -> MapView:
        view = MapView()
        for message in self:
            view.draw(message)
        return view


def raster(view: MapView) -> tuple[NDArray[np.uint8], float, float, float]:
    """All blocks in one, its corner and its pixel [m]."""
    left, low = (min(getattr(b, axis) for b in view.blocks) for axis in "xy")
    pixel = view.blocks[0].pixel
    places = [(round((b.y - low) / pixel), round((b.x - left) / pixel)) for b in view.blocks]
    rows, columns = (max(p[k] for p in places) + BLOCK for k in (0, 1))
    whole = np.zeros((rows, columns), np.uint8)
    for (row, column), block in zip(places, view.blocks, strict=True):
        whole[row : row + BLOCK, column : column + BLOCK] = block.shades
    return whole, left, low, pixel


def test_tiles_from_above_and_estimates_are_sent(street: TileStore, tmp_path: Path) -> None:
    """Where a pixel is drawn, the map has points, and the other way round."""
    sent = Sent()
    tiles = sorted(street.keys())
    (tmp_path / "predictions").mkdir()
    plan, sender = MapPlan.of_store(street), MapSender(sent.append)
    tasks = [plan.above(tile) for tile in tiles]
    tasks += [
        estimates_task(tmp_path, tile, places_of(street, tile, [0.1, np.nan, 0.3]))
        for tile in tiles
    ]
    tasks.append(Nap(tiles[0], "terms"))
    for task in tasks:
        sender.plan(task)
    for task in tasks:
        assert attempt(task).ok
        sender.learn(task)
    sender.close()
    view = sent.view()
    assert (view.relief_tiles, view.places) == (len(tiles), 3 * len(tiles))
    wanted = {place[:2] for tile in tiles for place in places_of(street, tile, [0.1, 0.2, 0.3])}
    assert {(x, y) for x, y, _ in view.marks.tolist()} == wanted
    assert np.nanmin(view.marks[:, 2]) == 0.1
    assert np.isnan(view.marks[:, 2]).sum() == len(tiles)
    shades, left, low, pixel = raster(view)
    points = np.concatenate([street.tile(tile).points_mm() for tile in tiles])
    columns, rows = (points[:, :2] // round(1000 * pixel)).T
    drawn = np.zeros(shades.shape, bool)
    drawn[rows - round(low / pixel), columns - round(left / pixel)] = True
    assert np.array_equal(shades > 0, drawn)
    assert shades[drawn].min() == round(255 * FAINT)


def test_patches_of_coarse_pixels_do_not_overlap(
    street: TileStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pixels of 4 m lie across the edges of tiles of 10 m: each is drawn once."""
    sent = Sent()
    monkeypatch.setattr(map_sender, "PIXELS", 9 * 4)
    plan, sender = MapPlan.of_store(street), MapSender(sent.append)
    tasks = [plan.above(tile) for tile in sorted(street.keys())]
    for task in tasks:
        sender.plan(task)
    for task in tasks:
        assert attempt(task).ok
        sender.learn(task)
    sender.close()
    seen: set[tuple[float, float]] = set()
    for message in sent:
        patch = Patch.of(message["patch"])
        assert patch.pixel == 4.0
        for row, column in np.ndindex(patch.shades.shape):
            pixel = patch.x + 4.0 * column, patch.y + 4.0 * row
            assert pixel not in seen
            seen.add(pixel)
    assert len(seen) == 25


def test_a_tile_of_less_than_a_pixel_is_drawn_with_its_neighbours_or_not_at_all() -> None:
    found = FromAbove(np.ones((1, 1)), (0.0, 0.0), 32.0)
    assert patch_of(found, Box(0, 0, 10_000, 10_000)) is None
    patch = patch_of(found, Box(10_000, 10_000, 20_000, 20_000))
    assert patch is not None
    assert (patch.x, patch.y, patch.shades.shape) == (0.0, 0.0, (1, 1))


def test_a_tile_of_many_places_sends_a_bounded_message(street: TileStore, tmp_path: Path) -> None:
    sent = Sent()
    tile = street.keys()[0]
    (tmp_path / "predictions").mkdir()
    places = [(0.01 * i, 3.0 * i, 0.1) for i in range(4_000)]
    task = estimates_task(tmp_path, tile, places)
    assert attempt(task).ok
    sender = MapSender(sent.append)
    sender.learn(task)
    sender.close()
    (message,) = sent
    assert message["places"] == 4_000
    assert len(message["marks"]) <= 24 * MARKS_OF_TILE


def test_what_cannot_be_drawn_is_told_once_and_harms_nothing(
    street: TileStore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sent = Sent()
    sender = MapSender(sent.append)
    (tmp_path / "predictions").mkdir()
    tasks = [estimates_task(tmp_path, tile, [(0.0, 0.0, 0.1)]) for tile in sorted(street.keys())]
    assert attempt(tasks[-1]).ok  # the others have no table
    with caplog.at_level(logging.INFO):
        for task in tasks:
            sender.learn(task)
        sender.close()
    assert [message["places"] for message in sent] == [1]
    assert len([line for line in caplog.messages if "dashboard" in line]) == 1


def test_a_run_sends_a_bounded_number_of_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sent = Sent()
    (tmp_path / "predictions").mkdir()
    monkeypatch.setattr(map_sender, "BYTES_OF_RUN", 100)
    sender = MapSender(sent.append)
    with caplog.at_level(logging.INFO):
        for number in range(10):
            task = estimates_task(tmp_path, TileKey(number, 0), [(0.0, 0.0, 0.1)])
            assert attempt(task).ok
            sender.learn(task)
        sender.close()
    assert sum(len(message["marks"]) for message in sent) == 96
    assert len([line for line in caplog.messages if "full" in line]) == 1
