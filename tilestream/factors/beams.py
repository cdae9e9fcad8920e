"""The beams of a vehicle's lidars in one turn, those that the vehicle does not hide."""

from dataclasses import dataclass

import numpy as np

from tilestream.records import Float64, Int64
from tilestream.sensor import Carrier, rim_of
from tilestream.settings import VirtualSettings


@dataclass(frozen=True, eq=False)
class SensorBeams:
    """The beams of one turn of a sensor of a vehicle, outside the vehicle's blind sector."""

    direction: Float64
    """(n, 3) unit vectors in the frame of the vehicle: x ahead, y left, z up; firing by firing,
    counter-clockwise from ahead of the sensor, each from the lowest beam to the highest."""
    origin: Float64
    """(3,) where the sensor is in that frame [m]."""
    range_max: float
    """Usable range [m]."""
    range_noise: float
    """Standard deviation of a range [m]."""
    ring: Int64
    """(n,) number of the beam, 0 the lowest."""
    phase: Float64
    """(n,) when it fires, from -0.5 to 0.5 of a turn; 0 ahead."""
    turn_s: float
    """Duration of a turn [s]."""


@dataclass(frozen=True, eq=False)
class Beams:
    """All beams of one turn of a vehicle's sensors."""

    sensors: tuple[SensorBeams, ...]
    """Those of each sensor."""
    range_max: float
    """Largest usable range [m]."""
    rim: float
    """How far from the vehicle's origin a sensor is at most [m]."""

    @classmethod
    def of(cls, vehicle: Carrier, seeing: VirtualSettings) -> "Beams":
        """The beams of a vehicle, without its blind sector."""
        sensors = []
        for sensor in vehicle.sensors:
            rays = sensor.rays()
            seen = sensor.fires(rays, seeing.blind_rear_deg)
            firing, ring = np.nonzero(seen)
            phase = firing / len(rays)
            reach = sensor.range_max if seeing.range_max is None else seeing.range_max
            sensors.append(
                SensorBeams(
                    sensor.in_base(rays[seen]),
                    sensor.mount.T_base_lidar[:3, 3],
                    min(reach, sensor.range_max),
                    sensor.range_noise,
                    ring,
                    phase - np.rint(phase),
                    1.0 / sensor.rate_hz,
                )
            )
        reach = max(sensor.range_max for sensor in sensors)
        return cls(tuple(sensors), reach, rim_of(vehicle))

    @property
    def direction(self) -> Float64:
        """(n, 3) unit vectors in the frame of the vehicle, sensor by sensor."""
        return np.concatenate([sensor.direction for sensor in self.sensors])

    def __len__(self) -> int:
        return sum(len(sensor.direction) for sensor in self.sensors)
