"""The simulated city: laws of its rays and its sensor, its bad input, its sameness."""

import gzip
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tilestream.errors import (
    CorruptSourceError,
    CrsError,
    PlanError,
    SourceNotFoundError,
    UsageError,
)
from tilestream.pipeline.jobs.simulate import require_space
from tilestream.sensor import VLP16
from tilestream.simulation.footprints import Footprints, read_footprints
from tilestream.simulation.free_space import (
    MIN_CLEARANCE,
    clearance,
    free_space,
    resample,
    route_between,
)
from tilestream.simulation.lidar import measure, turn_of
from tilestream.simulation.mesh import Material, boxes, joined, walls
from tilestream.simulation.raycast import Embree, Open3D, Scene
from tilestream.simulation.settings import LidarSettings, load_preset, stream
from tilestream.simulation.streets import Street, check_clear, read_streets

DATA = Path(load_preset.__code__.co_filename).parents[1] / "data"
EXACT = LidarSettings(
    sensor=VLP16.model_copy(update={"range_noise": 0.0}),
    beam_bias=0.0,
    quantum=0.0,
    blind_deg=0.0,
)
UTM = np.array([370_000.0, 3_950_000.0, 40.0])


def square(x: float, y: float, edge: float) -> list[list[float]]:
    return [[x, y], [x + edge, y], [x + edge, y + edge], [x, y + edge], [x, y]]


def write_city(path: Path, *buildings: tuple[list[list[float]], object]) -> Path:
    features = [
        {
            "type": "Feature",
            "properties": {"height": height},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }
        for ring, height in buildings
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def two_blocks(tmp_path: Path) -> Footprints:
    """A street of 10 m along x between two blocks."""
    far = write_city(
        tmp_path / "city.geojson", (square(0, 0, 100), 20), (square(0, 110, 100), "15 m")
    )
    return read_footprints(far)


def wall_ahead(distance: float) -> Scene:
    """A wall across x at a distance from the origin of UTM, 400 m wide and high."""
    start = np.array([[UTM[0] + distance, UTM[1] - 200.0]])
    end = start + np.array([[0.0, 400.0]])
    low, high = np.array([UTM[2] - 200.0]), np.array([UTM[2] + 200.0])
    return Scene(walls(start, end, low, high, Material.WALL), UTM)


# --- Rays


def test_ranges_to_a_plane_are_those_of_the_closed_form() -> None:
    rng = np.random.default_rng(0)
    angle, up = rng.uniform(-1.2, 1.2, 500), rng.uniform(-0.5, 0.5, 500)
    direction = np.column_stack(
        [np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)]
    )
    ranges, cosine, material = wall_ahead(30.0).first_hits(np.tile(UTM, (500, 1)), direction)
    np.testing.assert_allclose(ranges, 30.0 / direction[:, 0], rtol=1e-5)
    np.testing.assert_allclose(cosine, direction[:, 0], atol=1e-5)
    assert (material == Material.WALL).all()


def test_ranges_to_a_turned_box_are_those_of_the_slab_method() -> None:
    rng = np.random.default_rng(1)
    yaw, size = 0.4, np.array([4.0, 2.0, 3.0])
    centre = UTM + np.array([12.0, 3.0, -1.0])
    scene = Scene(boxes(centre[None], size[None], np.array([yaw]), Material.CAR), UTM)
    aim = centre + rng.uniform(-3.0, 3.0, (2000, 3)) - UTM
    direction = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    ranges, _, _ = scene.first_hits(np.tile(UTM, (2000, 1)), direction)
    R = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    origin, local = R @ (UTM - centre), direction @ R.T
    low, high = np.array([-2.0, -1.0, 0.0]), np.array([2.0, 1.0, 3.0])
    slabs = np.stack([(low - origin) / local, (high - origin) / local])
    enter, leave = slabs.min(axis=0).max(axis=1), slabs.max(axis=0).min(axis=1)
    expected = np.where(enter < leave, enter, np.inf)
    clear = np.abs(enter - leave) > 1e-3
    assert np.isfinite(expected[clear]).sum() > 300
    np.testing.assert_allclose(ranges[clear], expected[clear], rtol=1e-4)


def test_nothing_to_hit_is_infinitely_far() -> None:
    ranges, _, _ = wall_ahead(30.0).first_hits(UTM[None], np.array([[-1.0, 0.0, 0.0]]))
    assert ranges[0] == np.inf
    empty = Scene(joined([]), UTM)
    assert empty.first_hits(UTM[None], np.array([[1.0, 0.0, 0.0]]))[0][0] == np.inf


def test_both_casters_meet_the_same_triangles() -> None:
    for name in ("embreex", "open3d"):
        reason = f"{name} cannot be loaded, so that there is no second caster"
        pytest.importorskip(name, reason=reason, exc_type=ImportError)
    rng = np.random.default_rng(2)
    corners = rng.uniform(-60.0, 60.0, (5000, 1, 3)) + rng.normal(0.0, 1.5, (5000, 3, 3))
    start, direction = rng.uniform(-5.0, 5.0, (20_000, 3)), rng.normal(size=(20_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = start.astype(np.float32), direction.astype(np.float32)
    (reach, number, normal), (others_reach, others_number, others_normal) = (
        caster(corners.astype(np.float32)).cast(*rays) for caster in (Embree, Open3D)
    )
    met = number >= 0
    assert 2_000 < met.sum() < 18_000
    # Two of 5000 triangles so near each other that rounding decides are met by one ray in 10^5.
    assert (number != others_number).sum() <= 2
    met &= number == others_number
    # Ten units in the last place of a coordinate of 100 m.
    np.testing.assert_allclose(reach[met], others_reach[met], atol=1e-4, rtol=0.0)
    ours, others = (
        found[met] / np.linalg.norm(found[met], axis=1, keepdims=True)
        for found in (normal, others_normal)
    )
    np.testing.assert_allclose(np.abs((ours * others).sum(axis=1)), 1.0, atol=1e-5)


def test_what_is_missing_is_said_where_nothing_casts_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("embreex", "embreex.mesh_construction", "open3d"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UsageError, match=r"embreex.*open3d.*pip install embreex"):
        wall_ahead(30.0)


# --- The sensor


def test_a_turn_of_the_vlp16_is_its_data_sheet() -> None:
    turn = turn_of(VLP16)
    assert turn.direction.shape == (904 * 16, 3)
    np.testing.assert_allclose(np.linalg.norm(turn.direction, axis=1), 1.0)
    elevation = np.rad2deg(np.arcsin(turn.direction[:, 2]))
    np.testing.assert_allclose(elevation, -15.0 + 2.0 * turn.ring, atol=1e-9)
    azimuth = np.unwrap(np.arctan2(turn.direction[::16, 1], turn.direction[::16, 0]))
    np.testing.assert_allclose(np.diff(azimuth), -2 * np.pi / 904)
    assert turn.time.min() == pytest.approx(-0.025, abs=3e-5)
    assert turn.time.mean() == pytest.approx(0.0, abs=1e-12)


def test_the_rear_is_blind() -> None:
    turn = turn_of(VLP16, first_azimuth=0.7, blind_deg=120.0)
    azimuth = np.rad2deg(np.arctan2(turn.direction[:, 1], turn.direction[:, 0]))
    assert np.abs(azimuth).max() <= 120.0 + 1e-9
    assert len(azimuth) / 16 == pytest.approx(904 * 2 / 3, abs=2)


@pytest.mark.parametrize("speed", [0.0, 2.0])
def test_a_wall_ahead_is_bent_by_the_way_of_a_turn(speed: float) -> None:
    pose = np.eye(4)
    pose[:3, 3] = UTM
    velocity = np.array([speed, 0.0, 0.0])
    scan = measure((wall_ahead(20.0),), pose, velocity, 0.0, EXACT, 10**18, (0, 0, 0, 0))
    assert scan.time_offset is not None
    # Seen later is seen from nearer by: x = 20 m - v t.
    np.testing.assert_allclose(scan.points[:, 0], 20.0 - speed * scan.time_offset, atol=1e-4)
    assert scan.stamp_ns == 10**18
    assert np.abs(scan.time_offset).max() <= 0.025
    assert len(scan.points) > 3000


def test_noise_and_bias_have_the_size_that_is_set() -> None:
    settings = LidarSettings(beam_bias=0.05, quantum=0.0, blind_deg=0.0)
    pose = np.eye(4)
    pose[:3, 3] = UTM
    scan = measure((wall_ahead(20.0),), pose, np.zeros(3), 0.0, settings, 0, (3, 0, 0, 0))
    assert scan.ring is not None
    reach = np.linalg.norm(scan.points, axis=1)
    residual = reach - 20.0 / (scan.points[:, 0] / reach)
    per_beam = np.array([residual[scan.ring == ring].mean() for ring in range(16)])
    spread = residual - per_beam[scan.ring]
    assert spread.std() == pytest.approx(VLP16.range_noise, rel=0.05)
    assert 0.02 < per_beam.std() < 0.1


def test_a_scan_is_drawn_from_its_seed_alone() -> None:
    pose = np.eye(4)
    pose[:3, 3] = UTM
    scene = wall_ahead(20.0)
    draws = [
        measure((scene,), pose, np.zeros(3), 0.0, LidarSettings(), 0, (0, 0, 0, number)).points
        for number in (1, 1, 2)
    ]
    assert draws[0].tobytes() == draws[1].tobytes()
    assert draws[0].tobytes() != draws[2].tobytes()


def test_streams_of_two_phenomena_differ() -> None:
    a, b = stream(1, "parked").uniform(size=4), stream(1, "lamp").uniform(size=4)
    assert not np.isclose(a, b).any()
    np.testing.assert_array_equal(a, stream(1, "parked").uniform(size=4))


# --- Footprints


def test_the_buildings_of_the_package_carry_their_attribution() -> None:
    found = read_footprints(DATA / "shinjuku_buildings.geojson.gz")
    assert "PLATEAU" in found.attribution
    assert "CC BY 4.0" in found.attribution
    assert len(found.height) > 20_000
    assert (found.height > 0).all()
    assert (DATA / "shinjuku_buildings.geojson.gz").stat().st_size <= 1_000_000


def test_all_real_buildings_but_the_flat_ones_are_read(shared_data: Path) -> None:
    found = read_footprints(shared_data / "shinjuku" / "buildings_local_m.geojson.gz")
    assert found.refused == {"height not above 0": 7}
    assert len(found.height) == 56_011 - 7


def test_buildings_lie_left_of_their_edges_however_their_rings_turn(tmp_path: Path) -> None:
    ring = square(10, 10, 20)
    city = write_city(tmp_path / "c.json", (ring, 5), (square(50, 10, 20)[::-1], 5))
    found = read_footprints(city)
    for building in (0, 1):
        a, b = (part[found.building == building] for part in (found.start, found.end))
        area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
        assert area == pytest.approx(400.0)


def test_a_bad_building_among_good_ones_is_counted(tmp_path: Path) -> None:
    bow = [[0, 30], [10, 40], [10, 30], [0, 40], [0, 30]]
    city = write_city(
        tmp_path / "c.json",
        (square(0, 0, 10), 9.0),
        (square(20, 0, 10), 0),
        (square(40, 0, 10), -3),
        (square(60, 0, 10), None),
        (square(80, 0, 10)[:-1], 9.0),
        (bow, 9.0),
    )
    found = read_footprints(city)
    assert len(found.height) == 1
    assert found.refused == {
        "height not above 0": 2,
        "no height": 1,
        "open ring": 1,
        "self-intersecting ring": 1,
    }


def test_what_is_no_city_says_so(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="degrees"):
        read_footprints(write_city(tmp_path / "d.json", (square(139.69, 35.69, 0.001), 9)))
    with pytest.raises(CorruptSourceError, match="no building"):
        read_footprints(write_city(tmp_path / "z.json", (square(0, 0, 10), 0)))
    with pytest.raises(SourceNotFoundError):
        read_footprints(tmp_path / "none.json")
    broken = tmp_path / "cut.geojson.gz"
    broken.write_bytes(gzip.compress(b'{"type": "FeatureCollection"')[:-5])
    with pytest.raises(CorruptSourceError):
        read_footprints(broken)


# --- Streets


def test_distance_to_buildings_is_that_of_the_raster(tmp_path: Path) -> None:
    found = two_blocks(tmp_path)
    space = free_space(found)
    places = np.array([[50.0, 105.0], [20.0, 103.0], [60.0, 108.5]])
    np.testing.assert_allclose(space.at(places), [5.0, 3.0, 1.5], atol=0.51)
    np.testing.assert_allclose(clearance(places, found), [5.0, 3.0, 1.5])
    np.testing.assert_array_equal(clearance(np.array([[50.0, 50.0], [1.0, 1.0]]), found), 0.0)
    assert space.at(np.array([[50.0, 50.0]]))[0] == 0.0


def test_a_route_keeps_to_the_middle_of_a_narrow_street(tmp_path: Path) -> None:
    found = two_blocks(tmp_path)
    route = route_between(free_space(found), np.array([[5.0, 104.0], [95.0, 106.0]]), 60)
    assert len(route) == 60
    np.testing.assert_allclose(np.hypot(*np.diff(route, axis=0).T), 1.0, atol=0.02)
    check_clear(Street("a", "", route, True), found)
    with pytest.raises(UsageError, match="asked for are 500"):
        route_between(free_space(found), np.array([[5.0, 104.0], [95.0, 106.0]]), 500)


def test_a_route_through_a_building_is_refused(tmp_path: Path) -> None:
    line = resample(np.array([[-20.0, 50.0], [20.0, 50.0], [60.0, 50.0]]))
    with pytest.raises(UsageError, match="route x comes within"):
        check_clear(Street("x", "", line, True), two_blocks(tmp_path))


def test_the_paths_are_those_of_the_paper() -> None:
    streets = read_streets(DATA / "shinjuku_routes.geojson")
    driven = {street.name: len(street.xy) for street in streets if street.driven}
    assert driven == {"I": 1163, "II": 734, "III": 269, "IV": 652, "V": 794}
    assert any(not street.driven for street in streets)
    for kind, least in (("tunnel", 3), ("crossing", 2), ("bridge", 3), ("one-sided", 3)):
        on = {street.name for street in streets if street.driven and street.spots_of(kind)}
        assert len(on) >= least, kind
    long = {
        street.name
        for street in streets
        for tunnel in street.spots_of("tunnel")
        if tunnel.end - tunnel.begin >= 150.0
    }
    assert len(long) >= 2


@pytest.mark.slow
def test_every_path_keeps_clear_of_every_building() -> None:
    found = read_footprints(DATA / "shinjuku_buildings.geojson.gz")
    for street in read_streets(DATA / "shinjuku_routes.geojson"):
        assert clearance(street.xy, found).min() >= MIN_CLEARANCE, street.name


# --- Settings


def test_presets_refuse_what_they_do_not_know(tmp_path: Path) -> None:
    assert load_preset("paper").preset == "paper"
    assert "proves nothing" in load_preset("paper").note
    bad = tmp_path / "mine.yaml"
    bad.write_text("lidar:\n  ranje_max: 40\n")
    with pytest.raises(UsageError, match=r"mine\.yaml.*ranje_max.*range_max"):
        load_preset(str(bad))
    bad.write_text("lidar:\n  sensor: {name: mine, rings: 4}\n")
    with pytest.raises(UsageError, match=r"rings"):
        load_preset(str(bad))
    with pytest.raises(SourceNotFoundError):
        load_preset("paqer")


def test_no_space_on_the_disk_is_said_before(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="GB are free"):
        require_space(tmp_path, 10**18)
