"""One vehicle: mounts turn beams, several sensors are one cloud, an upright lidar is as it was."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scenes import PLACES
from scipy.spatial.transform import Rotation
from test_virtual_scan import CLEAN, FEW, scene_of, sheet

import tilestream as ts
from tilestream.errors import UsageError
from tilestream.factors.beams import Beams
from tilestream.factors.observability import observability
from tilestream.factors.virtual_scan import VirtualScan, look, virtual_scan
from tilestream.formats.points.pcd import write_pcd
from tilestream.marks import hash_of
from tilestream.sensor import Carrier, Mount, Sensor, Vehicle, in_blind_sector, sensor_of
from tilestream.settings import PlaceSettings, VirtualSettings
from tilestream.simulation.lidar import measure, turn_of
from tilestream.simulation.settings import LidarSettings

Floats = np.ndarray
EXACT = FEW.model_copy(update={"range_noise": 0.0})
CERTAIN = VirtualSettings(fading=0.0, grazing_deg=89.9999, range_min=0.0)
PLACE_MM = np.array([8101, 303, 2001])


def mounted(sensor: Sensor = EXACT, **mount: float) -> Sensor:
    return sensor.model_copy(update={"mount": Mount(**mount)})


def scan_of(points: Floats, vehicle: Carrier, place_mm: Floats, heading: float) -> VirtualScan:
    beams = Beams.of(vehicle, CERTAIN)
    scene = scene_of(points, place_mm, beams.rim)
    found = look(scene, place_mm, heading, CERTAIN, beams)
    return virtual_scan(scene, found, place_mm, CERTAIN, beams)


@pytest.fixture(scope="module")
def street() -> Floats:
    """A short street whose coordinates are odd millimetres: on no face of the lattice."""
    points = PLACES["crossing"](np.random.default_rng(4), 16.0, 0.3)
    return (2 * np.rint(points * 500).astype(np.int64) + 1) / 1000.0


# --- Mounts


def test_a_tilted_mount_turns_the_beams() -> None:
    angles = {"roll_deg": 5.0, "pitch_deg": 20.0, "yaw_deg": -70.0}
    R = Rotation.from_euler("xyz", list(angles.values()), degrees=True).as_matrix()
    beams, upright = Beams.of(mounted(**angles), CLEAN), Beams.of(EXACT, CLEAN)
    np.testing.assert_allclose(beams.direction, upright.direction @ R.T, atol=1e-12)
    np.testing.assert_allclose(mounted(**angles).mount.T_base_lidar[:3, :3], R, atol=1e-12)
    nose_down = mounted(pitch_deg=10.0).in_base(np.array([[1.0, 0.0, 0.0]]))[0]
    assert nose_down[2] == pytest.approx(-np.sin(np.radians(10.0)))
    assert Mount(pitch_deg=10.0).tilt_deg == pytest.approx(10.0)
    assert Mount(yaw_deg=77.0, x=1.0).tilt_deg == 0.0


@pytest.mark.parametrize("mount", [{"pitch_deg": 25.0}, {"roll_deg": -8.0, "x": 1.2, "z": 0.4}])
def test_the_ground_is_flat_in_the_frame_of_the_vehicle(mount: dict[str, float]) -> None:
    ground = sheet(np.random.default_rng(0), 40.0, 40.0)
    points = np.column_stack([ground, np.full(len(ground), -2.0)])
    found = scan_of(points, mounted(**mount), np.zeros(3, np.int64), 0.4)
    assert len(found.points) > 20
    np.testing.assert_allclose(found.points[:, 2], -2.0, atol=0.01)


def test_a_moved_sensor_sees_what_one_at_its_place_sees(street: Floats) -> None:
    offset_mm = np.array([1200, -300, 450])
    heading = np.pi / 2
    turned_mm = np.array([300, 1200, 450])
    x, y, z = offset_mm / 1000.0
    moved = scan_of(street, mounted(x=x, y=y, z=z), PLACE_MM, heading)
    there = scan_of(street, EXACT, PLACE_MM + turned_mm, heading)
    np.testing.assert_array_equal(moved.ranges, there.ranges)
    np.testing.assert_allclose(moved.points, there.points + offset_mm / 1000.0, atol=1e-9)
    assert moved.unmapped_share == there.unmapped_share


# --- Several sensors


def halves() -> Vehicle:
    ahead, behind = ({"view_deg": 180.0, "mount": Mount(yaw_deg=yaw)} for yaw in (0.0, 180.0))
    return Vehicle(sensors=tuple(EXACT.model_copy(update=half) for half in (ahead, behind)))


def in_order(beams: Beams, values: Floats) -> Floats:
    """Values of beams, by their directions."""
    return values[np.lexsort(np.round(beams.direction, 6).T + 0.0)]


def test_two_half_views_are_one_whole_view(street: Floats) -> None:
    whole, both = (Beams.of(vehicle, CERTAIN) for vehicle in (EXACT, halves()))
    np.testing.assert_allclose(
        in_order(both, both.direction), in_order(whole, whole.direction), atol=1e-12
    )
    one, two = (scan_of(street, vehicle, PLACE_MM, 0.3) for vehicle in (EXACT, halves()))
    np.testing.assert_allclose(in_order(both, two.ranges), in_order(whole, one.ranges), atol=1e-6)
    assert (two.return_share, two.unmapped_share) == (one.return_share, one.unmapped_share)
    assert len(two.points) == len(one.points)


def test_a_vehicle_of_two_half_views_is_observed_as_one_whole_view(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", PLACES["canyon"](np.random.default_rng(3), 30.0, 0.3))
    store = ts.ingest(tmp_path / "a.pcd", tmp_path / "map.zarr", tile_size=20.0)
    one, two = (
        observability(
            store, [[12.0, 0.5, 2.0]], [0.1], vehicle, VirtualSettings(starts=8, draws=2, worlds=1)
        )
        for vehicle in (EXACT, halves())
    )
    assert one["status"].tolist() == two["status"].tolist() == ["done"]
    assert two["ob_returns"][0] == pytest.approx(one["ob_returns"][0], abs=0.1)
    assert two["ob_cells"][0] == pytest.approx(one["ob_cells"][0], rel=0.1)
    assert two["vd_mean"][0] < 0.5


def test_a_view_ahead_has_the_beams_of_its_sector() -> None:
    narrow = EXACT.model_copy(update={"view_deg": 120.0})
    beams = Beams.of(narrow, CLEAN)
    assert len(beams) * 3 == len(Beams.of(EXACT, CLEAN))
    azimuth = np.degrees(np.arctan2(beams.direction[:, 1], beams.direction[:, 0]))
    assert (azimuth.min(), azimuth.max()) == pytest.approx((-60.0, 54.0))
    simulated = turn_of(narrow)
    assert len(simulated.direction) == len(beams)
    assert simulated.whole == 3 * len(beams)


def test_the_blind_sector_is_the_vehicles() -> None:
    """A lidar that looks back loses what is behind the vehicle, whatever its own rear is."""
    seeing = CLEAN.model_copy(update={"blind_rear_deg": 90.0})
    for yaw in (0.0, 180.0, 60.0):
        beams = Beams.of(mounted(yaw_deg=yaw), seeing)
        azimuth = np.abs(np.degrees(np.arctan2(beams.direction[:, 1], beams.direction[:, 0])))
        assert azimuth.max() <= 135.0 + 1e-6
    points = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.5, 3.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(in_blind_sector(points, 90.0), [False, True, False])
    assert in_blind_sector(points, 90.0, slack=0.0)[0]
    assert not in_blind_sector(points, 0.0).any()


# --- Simulated


class Ground:
    """A plane at z = 0."""

    def first_hits(self, start: Floats, direction: Floats) -> tuple[Floats, Floats, Floats]:
        down = np.maximum(-direction[:, 2], 1e-12)
        return start[:, 2] / down, np.ones(len(down)), np.zeros(len(down), np.uint8)


def test_a_simulated_scan_is_in_the_frame_of_the_vehicle_too() -> None:
    tilted = mounted(ts.VLP16.model_copy(update={"range_noise": 0.0}), pitch_deg=20.0, z=0.5)
    lidar = LidarSettings(sensor=tilted, beam_bias=0.0, quantum=0.0, distortion=False)
    T = np.eye(4)
    T[:3, 3] = 5.0, 6.0, 2.0
    scan = measure((Ground(),), T, np.zeros(3), 0.0, lidar, 0, (1, 2, 3))
    assert len(scan.points) > 1000
    np.testing.assert_allclose(scan.points[:, 2], -2.0, atol=1e-9)
    assert scan.points[:, 0].mean() > 1.0


def test_a_simulated_vehicle_has_one_lidar() -> None:
    with pytest.raises(UsageError, match="one lidar: give one sensor"):
        LidarSettings(sensor=["VLP16", "HDL64"])
    assert LidarSettings(sensor={"name": "VLP16", "view_deg": 120.0}).model.view_deg == 120.0


# --- As data


def test_a_sensor_without_mount_and_view_has_the_identity_that_it_had() -> None:
    assert hash_of(ts.VLP16) == "bf60928463cd372453c579bd16df722b"
    assert not {"mount", "view_deg"} & ts.VLP16.model_dump().keys()
    assert hash_of(mounted(ts.VLP16, z=0.1)) != hash_of(ts.VLP16)


def test_a_list_of_sensors_is_a_vehicle(tmp_path: Path) -> None:
    listed: list[Any] = ["VLP16", {"name": "HDL64", "mount": {"z": 0.5, "pitch_deg": 10.0}}]
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(listed))
    places = PlaceSettings(sensor=listed)
    assert places == PlaceSettings(sensor=str(tmp_path / "car.yaml"))
    assert places == PlaceSettings(**places.model_dump(mode="json"))
    vehicle = places.vehicle
    assert isinstance(vehicle, Vehicle)
    assert vehicle.sensors == (ts.VLP16, mounted(ts.HDL64, z=0.5, pitch_deg=10.0))
    assert (vehicle.name, vehicle.range_max) == ("VLP16+HDL64", 120.0)
    assert vehicle.fov_deg == pytest.approx((-34.9, 15.0))
    assert places.looking_sensor == ts.VLP16
    for wrong, said in (
        ([], "sensors"),
        (3, "give a name, a file, fields"),
        ([{"name": "VLP16", "mount": {"hight": 1.0}}], "hight is no setting"),
        ([{"name": "mine"}], "range_max"),
    ):
        with pytest.raises(UsageError, match=said):
            sensor_of(wrong)
