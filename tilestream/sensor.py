"""Sensors as data: the numbers that describe a lidar; users write them down for their own."""

import itertools
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tilestream.config import Settings
from tilestream.errors import UsageError

EDGE = 1e-9
"""Slack of angles, so that rounding decides nothing [rad]."""


class Sensor(Settings):
    """A spinning lidar."""

    name: str
    """Its name in tables and reports."""
    range_max: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """Largest range of a return [m]."""
    elevations_deg: Annotated[tuple[float, ...], Field(min_length=2)]
    """Elevation of each beam above the horizontal [deg], rising."""
    fov_deg: tuple[float, float]
    """Lowest and highest elevation of the vertical field of view [deg]."""
    azimuth_step_deg: Annotated[float, Field(gt=0.0, le=90.0)]
    """Angle between two firings of a beam [deg]."""
    rate_hz: Annotated[float, Field(gt=0.0)]
    """Turns per second [1/s]."""
    range_noise: Annotated[float, Field(ge=0.0)] = 0.02
    """Standard deviation of a range [m]."""

    def rays(self, first_azimuth: float = 0.0, clockwise: bool = False) -> NDArray[np.float64]:
        """(firings, beams, 3) unit vectors of one turn in the lidar frame: x ahead, y left, z up;
        firing by firing, each from the lowest beam to the highest.

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

    def with_beams(self, beams: int) -> Self:
        """The sensor with so many of its beams, evenly spread; with all where it has no more."""
        recorded = len(self.elevations_deg)
        if beams >= recorded:
            return self
        kept = tuple(self.elevations_deg[row] for row in kept_beams(recorded, beams))
        return self.model_copy(update={"elevations_deg": kept})

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


def in_blind_sector(
    points: NDArray[np.float64], blind_deg: float, slack: float = EDGE
) -> NDArray[np.bool_]:
    """(…,) whether points or directions lie in the sector that the vehicle hides to its rear.

    Args:
        points: (…, 3) in a frame with x ahead and y left.
        blind_deg: width of the sector, centred on -x [deg].
        slack: beams this near to its edge are outside [rad]; 0: what lies at the edge is inside.
    """
    from_rear = np.abs(np.arctan2(points[..., 1], -points[..., 0]))
    hidden: NDArray[np.bool_] = from_rear <= np.deg2rad(blind_deg) / 2.0 - slack
    return hidden


def kept_beams(recorded: int, beams: int) -> NDArray[np.int64]:
    """(beams,) which of the recorded beams, from the lowest up, a lidar of fewer beams has: evenly
    spread over them.
    """
    return ((np.arange(beams) + 0.5) * recorded / beams).astype(np.int64)


def sensor_of(name: str) -> Sensor:
    """A sensor by its name, or from a YAML file with the fields of `Sensor`.

    Raises:
        UsageError: no such file or sensor, no mapping of fields, a field that cannot be.
    """
    if name in SENSORS:
        return SENSORS[name]
    if not Path(name).is_file():
        raise UsageError(f"{name}: no such sensor or file; known are {', '.join(SENSORS)}")
    try:
        fields = yaml.safe_load(Path(name).read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{name}: no YAML: {error}") from None
    if not isinstance(fields, dict):
        raise UsageError(f"{name}: give the fields of a sensor, e.g. range_max: 100.0")
    return Sensor(**fields)
