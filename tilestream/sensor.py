"""Sensors as data: the numbers that describe a lidar; users write them down for their own."""

import itertools
import math
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from tilestream.bounded_yaml import read_yaml
from tilestream.config import Settings
from tilestream.errors import UsageError
from tilestream.files import local_path
from tilestream.kernels.fixed_order import turned

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

AS_RECORDED = "as recorded"
"""As if by which sensor a log is read that is read as it is."""
EDGE = 1e-9
"""Slack of angles, so that rounding decides nothing [rad]."""


class Mount(Settings):
    """Where a sensor is on its vehicle: T_base_lidar. The frame of the vehicle, base, has x ahead,
    y left, z up, and its origin at the sample point.
    """

    x: float = 0.0
    """Ahead of the vehicle's origin [m]."""
    y: float = 0.0
    """To its left [m]."""
    z: float = 0.0
    """Above it [m]."""
    roll_deg: float = 0.0
    """Turn about the x axis, first [deg]."""
    pitch_deg: float = 0.0
    """Turn about the y axis, then; positive looks down [deg]."""
    yaw_deg: float = 0.0
    """Turn about the z axis, last; positive looks left [deg]."""

    @property
    def T_base_lidar(self) -> Array:
        """(4, 4) the pose of the sensor in the frame of the vehicle."""
        a, b, c = np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])
        roll = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        pitch = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        yaw = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        T_base_lidar = np.eye(4)
        T_base_lidar[:3, :3] = yaw @ pitch @ roll
        T_base_lidar[:3, 3] = self.x, self.y, self.z
        return T_base_lidar

    @property
    def tilt_deg(self) -> float:
        """Angle between the sensor's z axis and the vehicle's [deg]."""
        upright = float(self.T_base_lidar[2, 2])
        return 0.0 if upright == 1.0 else math.degrees(math.acos(min(max(upright, -1.0), 1.0)))


class Sensor(Settings):
    """A lidar: it spins, or turns as far as its horizontal view."""

    name: str
    """Its name in tables and reports."""
    range_max: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """Largest range of a return [m]."""
    elevations_deg: Annotated[tuple[float, ...], Field(min_length=2)]
    """Elevation of each beam above the horizontal of the lidar [deg], rising."""
    fov_deg: tuple[float, float]
    """Lowest and highest elevation of the vertical field of view [deg]."""
    azimuth_step_deg: Annotated[float, Field(gt=0.0, le=90.0)]
    """Angle between two firings of a beam [deg]."""
    rate_hz: Annotated[float, Field(gt=0.0)]
    """Turns per second [1/s]."""
    range_noise: Annotated[float, Field(ge=0.0)] = 0.02
    """Standard deviation of a range [m]."""
    view_deg: Annotated[float, Field(gt=0.0, le=360.0)] = 360.0
    """Horizontal field of view, centred ahead of the lidar [deg]."""
    mount: Mount = Mount()
    """Where it is on its vehicle."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self.fov_deg
        if not -90.0 <= low < high <= 90.0:
            raise ValueError(f"fov_deg {self.fov_deg}: give lowest < highest within [-90, 90]")
        beams = self.elevations_deg
        if any(b <= a for a, b in itertools.pairwise(beams)):
            raise ValueError("elevations_deg must rise from the lowest beam to the highest")
        if not (beams[0] >= -90.0 and beams[-1] <= 90.0):
            raise ValueError("elevations_deg must lie within [-90, 90]")
        return self

    @model_serializer(mode="wrap")
    def _as_before(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the fields that came later where they say nothing: tables and models that know a
        sensor without them stay its own.
        """
        values: dict[str, Any] = dump(self)
        for name in ("view_deg", "mount"):
            if getattr(self, name) == type(self).model_fields[name].default:
                values.pop(name, None)
        return values

    @property
    def sensors(self) -> tuple["Sensor", ...]:
        """Itself: a vehicle with one sensor."""
        return (self,)

    def rays(self, first_azimuth: float = 0.0, clockwise: bool = False) -> Array:
        """(firings, beams, 3) unit vectors of one whole turn in the lidar frame: x ahead, y left, z
        up; firing by firing, each from the lowest beam to the highest.

        Args:
            first_azimuth: where the turn begins [rad, from x to y].
            clockwise: its sense, seen from above.
        """
        firings = round(360.0 / self.azimuth_step_deg)
        turn = np.arange(firings) * (2.0 * np.pi / firings)
        azimuth = first_azimuth - turn if clockwise else first_azimuth + turn
        elevation = np.deg2rad(self.elevations_deg)
        across, up = np.cos(elevation), np.sin(elevation)
        direction = np.empty((firings, len(elevation), 3))
        direction[..., 0] = np.cos(azimuth)[:, None] * across
        direction[..., 1] = np.sin(azimuth)[:, None] * across
        direction[..., 2] = up
        return direction

    def fires(self, rays: Array, blind_deg: float) -> Mask:
        """(…,) which rays the sensor has, and the vehicle does not hide.

        Args:
            rays: (…, 3) in the lidar frame.
            blind_deg: sector to the rear of the vehicle that it hides [deg].
        """
        view = np.deg2rad(self.view_deg)
        azimuth = np.arctan2(rays[..., 1], rays[..., 0])
        seen: Mask = np.mod(azimuth + view / 2.0 + EDGE, 2.0 * np.pi) < view
        return seen & ~in_blind_sector(self.in_base(rays), blind_deg)

    def in_base(self, rays: Array) -> Array:
        """(…, 3) directions in the frame of the vehicle, of directions in the lidar frame."""
        R_base_lidar = self.mount.T_base_lidar[:3, :3]
        return turned(R_base_lidar, rays.reshape(-1, 3)).reshape(rays.shape)

    def with_beams(self, beams: int) -> Self:
        """The sensor with so many of its beams, evenly spread; with all where it has no more."""
        recorded = len(self.elevations_deg)
        if beams >= recorded:
            return self
        kept = tuple(self.elevations_deg[row] for row in kept_beams(recorded, beams))
        return self.model_copy(update={"elevations_deg": kept})


class Vehicle(Settings):
    """A vehicle with several sensors, each with its mount: what they see together is one cloud in
    the frame of the vehicle.
    """

    sensors: Annotated[tuple[Sensor, ...], Field(min_length=1)]
    """Its sensors; the paper's factors look as the first one, upright."""

    @property
    def name(self) -> str:
        """The names of its sensors."""
        return "+".join(sensor.name for sensor in self.sensors)

    @property
    def range_max(self) -> float:
        """Largest range of a return of any of them [m]."""
        return max(sensor.range_max for sensor in self.sensors)

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Lowest and highest elevation of any of them above the horizontal of the vehicle [deg]."""
        return fov_deg_of(self)


Carrier = Sensor | Vehicle
"""What looks: a sensor alone, or a vehicle."""


def fov_deg_of(vehicle: Carrier) -> tuple[float, float]:
    """Lowest and highest elevation of the beams of a vehicle above its horizontal [deg]."""
    lows, highs = zip(
        *(
            (sensor.fov_deg[0] - sensor.mount.tilt_deg, sensor.fov_deg[1] + sensor.mount.tilt_deg)
            for sensor in vehicle.sensors
        ),
        strict=True,
    )
    return max(min(lows), -90.0), min(max(highs), 90.0)


def rim_of(vehicle: Carrier) -> float:
    """How far from the vehicle's origin a sensor of it is at most [m]."""
    mounts = (sensor.mount for sensor in vehicle.sensors)
    return max(math.hypot(mount.x, mount.y, mount.z) for mount in mounts)


def _even(low: float, high: float, beams: int) -> tuple[float, ...]:
    return tuple(low + (high - low) * i / (beams - 1) for i in range(beams))


VLP16 = Sensor(
    name="VLP16",
    range_max=100.0,
    elevations_deg=_even(-15.0, 15.0, 16),
    fov_deg=(-15.0, 15.0),
    azimuth_step_deg=360.0 / 904,
    rate_hz=20.0,
)
"""Velodyne VLP-16, the paper's sensor: 16 beams, +-15 deg, 100 m, 904 firings per turn at 20 Hz."""

HDL64 = Sensor(
    name="HDL64",
    range_max=120.0,
    elevations_deg=tuple(-24.33 + 15.5 / 31 * i for i in range(32))
    + tuple(-8.33 + 10.33 / 31 * i for i in range(32)),
    fov_deg=(-24.9, 2.0),
    azimuth_step_deg=0.1728,
    rate_hz=10.0,
)
"""Velodyne HDL-64E, KITTI's sensor: two blocks of 32 beams, 1/2 deg below -8.33 deg, 1/3 above."""

OS1_128 = Sensor(
    name="OS1_128",
    range_max=120.0,
    elevations_deg=_even(-22.5, 22.5, 128),
    fov_deg=(-22.5, 22.5),
    azimuth_step_deg=360.0 / 1024,
    rate_hz=10.0,
)
"""Ouster OS1-128: 128 beams, +-22.5 deg, 120 m, 1024 firings per turn at 10 Hz."""

SENSORS = {sensor.name: sensor for sensor in (VLP16, HDL64, OS1_128)}
"""The sensors that ship with tilestream, by name."""


def in_blind_sector(points: Array, blind_deg: float, slack: float = EDGE) -> Mask:
    """(…,) whether points or directions lie in the sector that the vehicle hides to its rear.

    Args:
        points: (…, 3) in a frame with x ahead and y left.
        blind_deg: width of the sector, centred on -x [deg].
        slack: beams this near to its edge are outside [rad]; 0: what lies at the edge is inside.
    """
    from_rear = np.abs(np.arctan2(points[..., 1], -points[..., 0]))
    hidden: Mask = from_rear <= np.deg2rad(blind_deg) / 2.0 - slack
    return hidden


def kept_beams(recorded: int, beams: int) -> NDArray[np.int64]:
    """(beams,) which of the recorded beams, from the lowest up, a lidar of fewer beams has: evenly
    spread over them.
    """
    return ((np.arange(beams) + 0.5) * recorded / beams).astype(np.int64)


def sensor_of(given: Any) -> Carrier:
    """What looks, as settings name it.

    Args:
        given: the name of a sensor that ships; a YAML file of what else may be given; the fields of
            a `Sensor`, of which one that ships gives those that are not there; a list of these: a
            `Vehicle`.

    Raises:
        UsageError: no such file or sensor, no mapping of fields, a field that cannot be.
    """
    return _sensor_of(given, ())


def _sensor_of(given: Any, within: tuple[str, ...]) -> Carrier:
    """As `sensor_of`, inside of some files."""
    if isinstance(given, Sensor | Vehicle):
        return given
    if isinstance(given, str) and given in SENSORS:
        return SENSORS[given]
    if given in within:
        raise UsageError(f"{given}: names itself among its sensors")
    if isinstance(given, str):
        content = _read(given)
        try:
            return _sensor_of(content, (*within, given))
        except (UsageError, TypeError) as error:  # TypeError: a key that is no text
            raise UsageError(f"{given}: {error}") from None
    if isinstance(given, Mapping) and given.keys() == {"sensors"}:
        given = given["sensors"]
    if isinstance(given, list | tuple):
        parts = (part for one in given for part in _sensor_of(one, within).sensors)
        return Vehicle(sensors=tuple(parts))
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise UsageError(
            f"sensor is {reprlib.repr(given)}: give a name, a file, fields, or a list of these"
        )
    known = SENSORS.get(str(given.get("name")))
    return Sensor(**(known.model_dump() if known else {}) | dict(given))


def named(given: Any) -> Any:
    """The name of a sensor that ships as it is; anything else as `sensor_of` reads it."""
    return given if isinstance(given, str) and given in SENSORS else sensor_of(given)


def _read(path: str) -> Any:
    """The fields of a sensor, or a list of sensors, in a YAML file."""
    file = Path(local_path(path))
    if not file.is_file():
        raise UsageError(f"{path}: no such sensor or file; known are {', '.join(SENSORS)}")
    fields = read_yaml(file, UsageError)
    if not isinstance(fields, dict | list):
        raise UsageError(f"{path}: give the fields of a sensor, e.g. range_max: 100.0")
    return fields
