"""The ground of a map: its levels, which one a vehicle stands on, and what is told of heights."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tilestream as ts
from tilestream.cli import run
from tilestream.factors.ground import ground_under, levels
from tilestream.factors.heights import note_of_drive, notes_of_routes
from tilestream.factors.sample_points import raised
from tilestream.formats.points.pcd import write_pcd
from tilestream.records import RouteZ

ROAD, DECK, CROWN = 0.0, 6.0, 11.0
"""Heights of a street, of a bridge above it, and of leaves above both [m]."""


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    """A street along x, from x = 20 on below a bridge, from x = 40 on below leaves as well."""
    x, y = np.meshgrid(np.arange(0.0, 60.0, 0.1), np.arange(-4.0, 4.0, 0.1))
    flat = np.column_stack([x.ravel(), y.ravel()])
    layers = [
        np.column_stack([flat[flat[:, 0] >= begins], np.full((flat[:, 0] >= begins).sum(), z)])
        for begins, z in ((0.0, ROAD), (20.0, DECK), (40.0, CROWN))
    ]
    folder = tmp_path_factory.mktemp("crossing")
    write_pcd(folder / "crossing.pcd", np.concatenate(layers))
    return ts.ingest(folder / "crossing.pcd", folder / "map.zarr", tile_size=20.0)


@given(st.lists(st.integers(-9_000, 9_000), max_size=60))
def test_levels_are_those_of_the_definition(heights: list[int]) -> None:
    """Against its literal reading."""
    pieces: list[list[int]] = []
    for height in sorted(heights):
        if pieces and height - pieces[-1][-1] <= 500:
            pieces[-1].append(height)
        else:
            pieces.append([height])
    wanted = [np.percentile(p, 5.0) / 1000.0 for p in pieces if len(p) >= 0.05 * len(heights)]
    assert levels(np.array(heights, np.int64)).tolist() == wanted


@given(st.permutations(range(0, 40, 2)), st.integers(-(10**9), 10**9))
def test_no_order_and_no_offset_shows_in_levels(heights: list[int], offset: int) -> None:
    moved = np.array(heights, np.int64) * 100
    np.testing.assert_allclose(
        levels(moved + offset) - offset / 1000.0, levels(np.sort(moved)), atol=1e-6
    )


def test_a_few_points_below_the_road_are_no_ground() -> None:
    specks, road = np.full(4, -2000), np.full(96, 0)
    assert levels(np.concatenate([specks, road])).tolist() == [0.0]
    assert levels(np.concatenate([np.full(5, -2000), np.full(95, 0)])).tolist() == [-2.0, 0.0]


@pytest.mark.parametrize(
    ("x", "z", "z_is", "ground"),
    [
        (10.0, np.nan, "ground", ROAD),
        (30.0, np.nan, "ground", ROAD),
        (30.0, 0.4, "ground", ROAD),
        (30.0, 2.0, "ground", ROAD),  # the lidar of a car below the bridge
        (30.0, 3.1, "ground", ROAD),  # nearer to the deck, but for the height of the lidar
        (30.0, 5.2, "ground", DECK),
        (30.0, 6.3, "ground", DECK),
        (30.0, 8.0, "ground", DECK),  # the lidar of a car on it
        (50.0, 8.0, "ground", DECK),
        (30.0, 1.7, "lidar", ROAD),
        (30.0, 5.9, "lidar", ROAD),  # of a tall vehicle: it does not stand above itself
        (50.0, 8.0, "lidar", DECK),
        (30.0, -3.0, "lidar", ROAD),
        (50.0, 6.0, "road", DECK),
    ],
)
def test_bridges_stay_bridges(
    crossing: ts.TileStore, x: float, z: float, z_is: RouteZ, ground: float
) -> None:
    found, _ = ground_under(np.array([[x, 0.0, z]]), crossing, z_is)
    assert found == pytest.approx(ground)


def test_there_is_no_ground_beside_the_map(crossing: ts.TileStore) -> None:
    found, why = ground_under(np.array([[10.0, 60.0, 0.0], [500.0, 0.0, 0.0]]), crossing)
    assert np.isnan(found).all()
    assert why.tolist() == ["", ""]


def test_a_road_far_from_the_ground_is_not_taken(crossing: ts.TileStore) -> None:
    at = np.array([[10.0, 0.0, z] for z in (-5.01, -4.99, 0.0, 4.99, 5.01, 6.99, 7.01)])
    found = raised(at, crossing, 2.0, "ground")
    assert found.above_ground.tolist() == at[:, 2].tolist()
    far = [True, False, False, False, True, True, True]
    assert np.isnan(found.lidar[:, 2]).tolist() == (found.why != "").tolist() == far
    assert found.lidar[2, 2] == 2.0
    found = raised(at, crossing, 2.0, "lidar")
    far = [True, True, False, False, False, False, True]
    assert np.isnan(found.lidar[:, 2]).tolist() == (found.why != "").tolist() == far


# --- What is told


def test_a_route_with_other_heights_is_told() -> None:
    good, high, far = [0.1, -0.2, np.nan], [1.6, 1.7, 1.8], [8.0, 8.1, 8.2]
    places = pd.DataFrame(
        {"route_id": ["a"] * 3 + ["b"] * 3 + ["c"] * 3, "above_ground": [*good, *high, *far]}
    )
    b, c = notes_of_routes(places, 2.0, "ground")
    assert "route b: its z is 1.7 m above the ground" in b
    assert "left out" not in b
    assert "route c: its z is 8.1 m above the ground" in c
    assert "3 places" in c
    a, c = notes_of_routes(places, 2.0, "lidar")  # the road of a is 2 m below the ground
    assert "route a" in a
    assert "route c" in c


def test_a_lidar_that_is_not_where_the_settings_say_is_told() -> None:
    heights = pd.Series([2.3, np.nan, 2.2, 2.4])
    assert note_of_drive(heights, 2.1) == []
    assert note_of_drive(pd.Series([np.nan]), 2.1) == []
    (note,) = note_of_drive(heights, 1.5)
    assert "2.3 m" in note
    assert "3 scans" in note
    assert "1.5 m" in note


def test_a_route_8_m_above_the_map_is_refused(
    cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = f"{tmp_path}/map.zarr"
    ts.ingest(cases / "street.pcd", store)
    route = str(cases / "route" / "8_m_above_the_ground.csv")
    asked = ["factors", store, "--route", route, "--out", f"{tmp_path}/out", "--json"]
    assert run(asked) == 1
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert found["failed"] == found["sample_points"] == 21
    assert any("8.0 m above the ground of the map" in note for note in found["notes"]["routes"])
    assert "more than 5 m above or below the ground" in told.err
    table = ts.factors_along(
        ts.open_store(store), ts.read_routes(route), tmp_path / "road", route_z="road"
    )
    assert set(table["status"]) == {"failed"}
    np.testing.assert_allclose(table["above_ground"], 8.0, atol=0.1)
