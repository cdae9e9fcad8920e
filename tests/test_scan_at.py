"""What a vehicle sees at a place: on the map, the same near it whatever else is read."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

import tilestream as ts
from tilestream.factors.scan_at import scan_at
from tilestream.formats.points.pcd import write_pcd
from tilestream.records import Float64
from tilestream.settings import VirtualSettings
from tilestream.store import TileStore

SENSOR = ts.VLP16.model_copy(update={"range_max": 30.0, "azimuth_step_deg": 2.0})
PLACE = np.array([0.5, -0.3, 2.0])
SEEING = VirtualSettings()


@pytest.fixture(scope="module")
def canyon(tmp_path_factory: pytest.TempPathFactory) -> tuple[TileStore, Float64]:
    """A road of 40 m between two walls, and its points."""
    along, up = np.meshgrid(np.arange(-20.0, 20.0, 0.1), np.arange(0.0, 6.0, 0.1))
    walls = [
        np.column_stack([along.ravel(), np.full(along.size, y), up.ravel()]) for y in (-6.0, 7.0)
    ]
    x, y = np.meshgrid(np.arange(-20.0, 20.0, 0.1), np.arange(-6.0, 7.0, 0.1))
    road = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = np.concatenate([road, *walls])
    folder = tmp_path_factory.mktemp("canyon")
    write_pcd(folder / "canyon.pcd", points)
    return ts.ingest(folder / "canyon.pcd", folder / "map.zarr", tile_size=20.0), points


def test_returns_lie_on_the_map(canyon: tuple[TileStore, Float64]) -> None:
    store, points = canyon
    seen = scan_at(store, PLACE, 0.3, SENSOR, SEEING, 30.0)
    assert len(seen) > 500
    distance, _ = cKDTree(points).query(seen)
    assert np.quantile(distance, 0.99) < 0.35  # noise of the range, and a disc over an edge
    assert (seen[:, 1] > 5.0).any()
    assert (seen[:, 1] < -5.0).any()


def test_less_of_the_map_gives_the_same_near_the_place(canyon: tuple[TileStore, Float64]) -> None:
    store, _ = canyon
    whole, near = (scan_at(store, PLACE, 0.3, SENSOR, SEEING, within) for within in (30.0, 8.0))
    assert 0 < len(near) < len(whole)
    one, other = (
        {tuple(row) for row in seen[np.abs(seen - PLACE)[:, :2].max(axis=1) < 6.8].tolist()}
        for seen in (whole, near)
    )
    assert one == other
    assert len(one) > 100


def test_a_vehicle_that_is_turned_hides_another_side(canyon: tuple[TileStore, Float64]) -> None:
    store, _ = canyon
    blind = VirtualSettings(blind_rear_deg=120.0)
    for heading in (0.0, math.pi / 2.0, -2.0):
        seen = scan_at(store, PLACE, heading, SENSOR, blind, 30.0) - PLACE
        ahead = seen[:, :2] @ np.array([np.cos(heading), np.sin(heading)])
        far = np.hypot(seen[:, 0], seen[:, 1]) > 2.0
        behind = ahead < -0.55 * np.hypot(seen[:, 0], seen[:, 1])
        assert not (behind & far).any()


def test_nothing_is_seen_where_nothing_is(canyon: tuple[TileStore, Float64]) -> None:
    store, _ = canyon
    away = np.array([500.0, 500.0, 2.0])
    assert scan_at(store, away, 0.0, SENSOR, SEEING, 30.0).shape == (0, 3)
