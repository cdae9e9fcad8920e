"""A spinning lidar: where its beams go, what comes back of them, and how that is measured."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tilestream.records import Float64, Int64, Scan
from tilestream.sensor import Sensor
from tilestream.simulation.mesh import REFLECTIVITY, Material
from tilestream.simulation.settings import LidarSettings, stream

LEAST_RANGE = 0.9
"""Below this range nothing is measured: the vehicle itself [m]."""
FADING = (0.6, 1.0)
"""Shares of the largest range between which returns of dark surfaces fade."""
GRAZING = np.cos(np.deg2rad(75.0))
"""Cosine of incidence below which returns fade."""


class Target(Protocol):
    """What rays are cast at."""

    def first_hits(
        self, start: Float64, direction: Float64
    ) -> tuple[Float64, Float64, NDArray[np.uint8]]:
        """Range [m], cosine of incidence and material of each ray."""


@dataclass(frozen=True, eq=False)
class Turn:
    """The rays of one turn of a sensor, in the order of their firing."""

    direction: Float64
    """(n, 3) unit vectors in the frame of the vehicle: x ahead, y left, z up."""
    ring: NDArray[np.int32]
    """(n,) beam, 0 the lowest."""
    time: Float64
    """(n,) firing time minus the middle of the turn [s]."""
    number: Int64
    """(n,) number of the ray in a turn without a blind sector."""
    whole: int
    """Rays of a turn without a blind sector."""


def turn_of(sensor: Sensor, first_azimuth: float = np.pi, blind_deg: float = 0.0) -> Turn:
    """All rays of one turn, clockwise seen from above, without the blind sector to the rear.

    Args:
        sensor: the sensor.
        first_azimuth: where the turn begins [rad, from x to y]; the cut is at the rear by default.
        blind_deg: sector around the rear that gives nothing [deg].
    """
    direction = sensor.rays(first_azimuth, clockwise=True)
    firings, beams, _ = direction.shape
    time = ((np.arange(firings) + 0.5) / firings - 0.5) / sensor.rate_hz
    seen = sensor.fires(direction, blind_deg)
    firing, ring = np.nonzero(seen)
    return Turn(
        sensor.in_base(direction[seen]),
        ring.astype(np.int32),
        time[firing],
        np.flatnonzero(seen),
        firings * beams,
    )


def measure(
    targets: tuple[Target, ...],
    T_map_lidar: Float64,
    velocity: Float64,
    yaw_rate: float,
    settings: LidarSettings,
    stamp_ns: int,
    seed: tuple[int, ...],
) -> Scan:
    """One scan, as the sensor would record it, from a vehicle that moves during the turn.

    Each ray leaves from where the lidar is at its time; its point is recorded in the frame of that
    time, not of the stamp (the middle of the turn): so a wall ahead is bent by the way of one turn.

    Args:
        targets: scenes of what stands and what moves; the nearest hit counts.
        T_map_lidar: (4, 4) pose of the vehicle's frame in the middle of the turn; without a mount
            it is that of the lidar.
        velocity: (3,) of the lidar in the map [m/s].
        yaw_rate: turning of the vehicle [rad/s].
        settings: of the lidar.
        stamp_ns: time of the middle of the turn [ns].
        seed: what the noise of this scan is drawn from: seed, drive, path, number of the scan.
    """
    sensor = settings.model
    rng = stream(seed[0], "scan noise", *seed[1:])
    turn = turn_of(sensor, rng.uniform(-np.pi, np.pi), settings.blind_deg)
    time = turn.time if settings.distortion else np.zeros(len(turn.time))
    origin = sensor.mount.T_base_lidar[:3, 3]
    start = T_map_lidar[:3, :3] @ origin + T_map_lidar[:3, 3] + time[:, None] * velocity
    angle = time * yaw_rate
    local = turn.direction
    turned = np.column_stack(
        [
            np.cos(angle) * local[:, 0] - np.sin(angle) * local[:, 1],
            np.sin(angle) * local[:, 0] + np.cos(angle) * local[:, 1],
            local[:, 2],
        ]
    )
    direction = turned @ T_map_lidar[:3, :3].T
    true, cosine, material = nearest(targets, start, direction)
    # Drawn for the whole turn, so that a ray's luck and noise do not depend on what others meet.
    luck, noise = rng.uniform(size=turn.whole), rng.normal(0.0, sensor.range_noise, turn.whole)
    came = returned(
        luck[turn.number], true, cosine, material, sensor.range_max, settings.glass_loss
    )
    bias = stream(seed[0], "beam bias").normal(0.0, settings.beam_bias, len(sensor.elevations_deg))
    measured = true[came] + noise[turn.number[came]] + bias[turn.ring[came]]
    if settings.quantum > 0:
        measured = np.rint(measured / settings.quantum) * settings.quantum
    light = REFLECTIVITY[material[came]] * (0.3 + 0.7 * cosine[came])
    return Scan(
        stamp_ns,
        local[came] * measured[:, None] + origin,
        T_map_lidar,
        light.astype(np.float32),
        turn.ring[came],
        turn.time[came],
        int((~came).sum()),
    )


def nearest(
    targets: tuple[Target, ...], start: Float64, direction: Float64
) -> tuple[Float64, Float64, NDArray[np.uint8]]:
    """The nearest of the first hits in several scenes."""
    found, cosine, material = targets[0].first_hits(start, direction)
    for target in targets[1:]:
        other, its_cosine, its_material = target.first_hits(start, direction)
        closer = other < found
        found = np.where(closer, other, found)
        cosine = np.where(closer, its_cosine, cosine)
        material = np.where(closer, its_material, material)
    return found, cosine, material


def returned(
    luck: Float64,
    ranges: Float64,
    cosine: Float64,
    material: NDArray[np.uint8],
    range_max: float,
    glass_loss: float,
) -> NDArray[np.bool_]:
    """Which rays come back: within range, and by chance where far, grazing, or on glass.

    Args:
        luck: (n,) random number in [0, 1) of each ray.
        ranges: (n,) of the first hits [m].
        cosine: (n,) of incidence.
        material: (n,) of what is hit.
        range_max: largest range of a return [m].
        glass_loss: share of the rays on glass that are lost.
    """
    far = np.clip((ranges / range_max - FADING[0]) / (FADING[1] - FADING[0]), 0.0, 1.0)
    far = np.where(np.isfinite(ranges), far, 1.0)
    kept = (1.0 - 0.6 * far) * np.clip(cosine / GRAZING, 0.05, 1.0)
    kept = np.where(material == Material.GLASS, kept * (1.0 - glass_loss), kept)
    came: NDArray[np.bool_] = (luck < kept) & (ranges >= LEAST_RANGE) & (ranges <= range_max)
    return came
