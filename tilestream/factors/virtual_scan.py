"""The scan that a lidar would take at a place, cast at the map's surfels (definitions, section
4.3).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.beams import Beams, SensorBeams
from tilestream.factors.scene import COLUMN_MM, Scene
from tilestream.factors.worlds import Dice, kept, stopped, world_at
from tilestream.grid import MM_PER_M
from tilestream.kernels.fixed_order import turned
from tilestream.kernels.virtual_scan import (
    FREE,
    Int32,
    cast,
    leave_map,
)
from tilestream.records import Float64, Int64
from tilestream.settings import VirtualSettings

NEAR_GROUND, LOW_SHARE, USUAL_HEIGHT = 20.0, 0.2, 2.0
"""The road is taken to be where this share of the returns below the lidar within 20 m lie lower; as
far below the lidar as usual where there are none [m]."""


@dataclass(frozen=True, eq=False)
class Returns:
    """The first surfels that the beams of a sensor at a place meet."""

    place_mm: Int64
    """(3,) of the sensor [mm, map frame]."""
    origin: Float64
    """(3,) the same in the frame of the vehicle [m]."""
    direction: Float64
    """(n, 3) of the beams in the map frame."""
    ranges: Float64
    """(n,) of the first surfel [m]; inf: none is met."""
    cosine: Float64
    """(n,) of incidence; 0: none is met."""
    surfel: Int32
    """(n,) row of what is met; -1: nothing is."""


def near_share(scene: Scene, place_mm: Int64, beams: Beams, within: float) -> float:
    """Share of the beams of a vehicle at a place that meet the map within a short distance.

    Args:
        scene: the map around the place.
        place_mm: (3,) of the lidar [mm, map frame].
        beams: its beams, as if it headed along the map's x axis.
        within: the distance [m].
    """
    met = [
        np.isfinite(_cast(scene, place_mm, 0.0, sensor, 0.0, within).ranges)
        for sensor in beams.sensors
    ]
    return float(np.concatenate(met).mean())


@dataclass(frozen=True, eq=False)
class VirtualScan:
    """The result of casting the beams of one turn at a place."""

    ranges: Float64
    """(n,) true range of each beam's first return [m]; inf: none."""
    cosine: Float64
    """(n,) cosine of its incidence; 0: none."""
    came: NDArray[np.bool_]
    """(n,) which returns come back to the sensor."""
    points: Float64
    """(m, 3) those returns with the noise of the sensor, in the frame of the vehicle [m]."""
    return_share: float
    """Share of the beams that come back, 1 for all."""
    unmapped_share: float
    """Share of the beams that meet nothing and leave the mapped area."""


def look(
    scene: Scene, place_mm: Int64, heading: float, seeing: VirtualSettings, beams: Beams
) -> tuple[Returns, ...]:
    """The first surfels that the beams of a vehicle at a place meet, sensor by sensor.

    Args:
        scene: the map around the place, as far as the beams reach.
        place_mm: (3,) of the vehicle's origin [mm, map frame].
        heading: direction of travel [rad, from the map's x axis].
        seeing: from which range on something is met.
        beams: its beams, `Beams.of(vehicle, seeing)`.
    """
    return tuple(
        _cast(scene, place_mm, heading, sensor, seeing.range_min, sensor.range_max)
        for sensor in beams.sensors
    )


def look_past(
    scene: Scene, found: tuple[Returns, ...], seeing: VirtualSettings, beams: Beams
) -> tuple[Returns, ...]:
    """The first surfels that beams meet where some are left out, from what they met with these.

    The same as `look` in the scene: what met a surfel that is still there meets it again, so only
    the others are cast.

    Args:
        scene: `Scene.without` of the one that was looked at.
        found: what `look` met there.
        seeing: as of `look`.
        beams: as of `look`.
    """
    return tuple(
        _past(scene, met, seeing.range_min, sensor.range_max)
        for sensor, met in zip(beams.sensors, found, strict=True)
    )


def _past(scene: Scene, met: Returns, range_min: float, range_max: float) -> Returns:
    again = np.flatnonzero((met.surfel != FREE) & scene.bricks.gone[met.surfel])
    ranges, cosine, surfel = met.ranges.copy(), met.cosine.copy(), met.surfel.copy()
    ranges[again], cosine[again], surfel[again] = _met(
        scene, met.place_mm, met.direction[again], range_min, range_max
    )
    return Returns(met.place_mm, met.origin, met.direction, ranges, cosine, surfel)


def virtual_scan(
    scene: Scene,
    found: tuple[Returns, ...],
    place_mm: Int64,
    seeing: VirtualSettings,
    beams: Beams,
    draw: int = 0,
) -> VirtualScan:
    """The scan of a vehicle at a place: first returns, drop-outs, noise.

    A return at range r with cosine of incidence c comes back with the probability
    (1 - fading f) min(1, c / cos(grazing)), f rising linearly from 0 to 1 between `fading_from` and
    1 of the usable range. Its range gets normal noise. Both are drawn from the place in whole
    millimetres, the seed, the number of the draw and the number of the beam alone.

    Args:
        scene: the map around the place.
        found: what the beams meet, from `look`.
        place_mm: as of `look`.
        seeing: as of `look`; its drop-outs.
        beams: as of `look`.
        draw: which of several scans.
    """
    dice = Dice(place_mm, seeing.seed, draw)
    parts = []
    for sensor, met in zip(beams.sensors, found, strict=True):
        came = dice.uniform(len(met.ranges)) < probability(
            met.ranges, met.cosine, sensor.range_max, seeing
        )
        noise = dice.normal(sensor.range_noise, len(met.ranges))
        points = sensor.direction[came] * (met.ranges + noise)[came, None] + met.origin
        parts.append((met.ranges, met.cosine, came, _leaves(scene, met, sensor), points))
    ranges, cosine, came, left, points = (np.concatenate(part) for part in zip(*parts, strict=True))
    return VirtualScan(ranges, cosine, came, points, float(came.mean()), float(left.mean()))


def _leaves(scene: Scene, met: Returns, sensor: SensorBeams) -> NDArray[np.bool_]:
    """(n,) which beams meet nothing and leave the mapped area."""
    left: NDArray[np.bool_] = leave_map(
        scene.mapped,
        scene.mapped_corner,
        COLUMN_MM,
        met.place_mm,
        met.direction,
        met.ranges,
        sensor.range_max * MM_PER_M,
    )
    return left


def scan_in_world(
    found: tuple[Returns, ...], place_mm: Int64, seeing: VirtualSettings, beams: Beams, draw: int
) -> Float64:
    """(m, 3) the points of a scan in a street that is not as it was mapped (`worlds.py`), in the
    frame of the vehicle [m]; arguments as of `virtual_scan`.
    """
    dice = Dice(place_mm, seeing.seed, draw)
    rings = max(int(sensor.ring.max()) + 1 for sensor in beams.sensors)
    world = world_at(dice, _ground_below(found, beams), rings, beams.sensors[0].turn_s)
    parts = []
    for sensor, met in zip(beams.sensors, found, strict=True):
        reach = seeing.range_min, sensor.range_max
        ranges, cosine = stopped(world, sensor.direction, met.ranges, met.cosine, reach)
        came = kept(world, dice, ranges, cosine, sensor.range_max)
        noise = dice.normal(sensor.range_noise, len(ranges)) + world.bias[sensor.ring]
        points = sensor.direction[came] * (ranges + noise)[came, None] + met.origin
        points[:, 0] += world.slip * sensor.phase[came]
        parts.append(points)
    return np.concatenate(parts)


def _ground_below(found: tuple[Returns, ...], beams: Beams) -> float:
    """Height of the road above the vehicle's origin [m], from what its beams meet around it."""
    heights = []
    for sensor, met in zip(beams.sensors, found, strict=True):
        at = sensor.direction * np.where(np.isfinite(met.ranges), met.ranges, 0.0)[:, None]
        near = (np.hypot(at[:, 0], at[:, 1]) < NEAR_GROUND) & (at[:, 2] < 0.0)
        heights.append((at[near] + met.origin)[:, 2])
    below = np.concatenate(heights)
    return float(np.quantile(below, LOW_SHARE)) if len(below) else -USUAL_HEIGHT


def rotation_of(heading: float) -> Float64:
    """(3, 3) from the frame of a vehicle to that of the map, by its heading [rad]: R_map_base."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def whole_places(places: Float64) -> Int64:
    """Places [m] in whole millimetres, half to even."""
    whole: Int64 = np.rint(places * MM_PER_M).astype(np.int64)
    return whole


def _cast(
    scene: Scene,
    place_mm: Int64,
    heading: float,
    sensor: SensorBeams,
    range_min: float,
    range_max: float,
) -> Returns:
    """What the beams of a sensor meet between two ranges [m] from where it is, whole millimetres
    of the map, on a vehicle whose origin is at a place.
    """
    R_map_base = rotation_of(heading)
    direction = turned(R_map_base, sensor.direction)
    offset_mm = np.rint(turned(R_map_base, sensor.origin[None])[0] * MM_PER_M).astype(np.int64)
    at_mm = place_mm + offset_mm
    origin = turned(R_map_base.T, offset_mm[None] / MM_PER_M)[0]
    return Returns(at_mm, origin, direction, *_met(scene, at_mm, direction, range_min, range_max))


def _met(
    scene: Scene, at_mm: Int64, direction: Float64, range_min: float, range_max: float
) -> tuple[Float64, Float64, Int32]:
    """Ranges, cosines and rows of what beams from a point meet, as in `Returns`."""
    n = len(direction)
    out = np.empty(n), np.empty(n), np.empty(n, np.int32)
    cast(scene.bricks, at_mm, direction, range_min * MM_PER_M, range_max * MM_PER_M, *out)
    return out


def probability(
    ranges: Float64, cosine: Float64, range_max: float, seeing: VirtualSettings
) -> Float64:
    """(n,) probability that returns come back (see `virtual_scan`); 0 where there is none."""
    there = np.isfinite(ranges)
    span = max((1.0 - seeing.fading_from) * range_max, 1e-9)
    far = np.clip((np.where(there, ranges, 0.0) - seeing.fading_from * range_max) / span, 0.0, 1.0)
    grazing = np.minimum(cosine / np.cos(np.deg2rad(seeing.grazing_deg)), 1.0)
    return np.where(there, (1.0 - seeing.fading * far) * grazing, 0.0)
