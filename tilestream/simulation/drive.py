"""Drives along a street: where the vehicle is at a time, what moves around it, what it scans."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tilestream.records import Float64, Int64, Scan, Trajectory
from tilestream.simulation import furniture
from tilestream.simulation.city import City
from tilestream.simulation.ground import Ground
from tilestream.simulation.lidar import measure
from tilestream.simulation.mesh import Mesh, joined
from tilestream.simulation.raycast import Scene
from tilestream.simulation.settings import SimulationSettings, stream
from tilestream.simulation.streets import Street

EPOCH_NS = 1_600_000_000_000_000_000
"""When drive 0 of the first street begins [ns]."""
DAY_NS = 86_400_000_000_000
"""Between two drives of the same street [ns]."""
LANE = 3.2
"""Distance of the lane of moving cars from the route [m]."""
AHEAD = 110.0
"""How far from the vehicle things move [m]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A vehicle that drives along a street."""

    street: Street
    height: float
    """Height of the sensor above the ground [m]."""
    speed: Float64
    """(n,) speed at each sample point [m/s]."""
    time: Float64
    """(n,) when it passes each sample point [s after the drive begins]."""
    side: float = 0.0
    """How far right of the street's route it keeps [m]."""

    def arc_at(self, time: Float64) -> Float64:
        """(k,) arc length at times [m]; before and after the drive the end speed goes on."""
        time = np.asarray(time, np.float64)
        arc = np.interp(time, self.time, self.street.arc)
        before = np.minimum(time - self.time[0], 0.0) * self.speed[0]
        after = np.maximum(time - self.time[-1], 0.0) * self.speed[-1]
        return np.asarray(arc + before + after)

    def pose(self, ground: Ground, arc: Float64) -> Float64:
        """(k, 4, 4) poses of the sensor in the map, level across, pitched with the road."""
        xy, heading = self.street.at(arc), self.street.heading(arc)
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        rise = (ground.slope(xy + ahead) - ground.slope(xy - ahead)) / 2.0
        x = np.column_stack([ahead, rise])
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        y = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(xy))])
        T = np.tile(np.eye(4), (len(xy), 1, 1))
        T[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=2)
        xy = xy + self.side * np.column_stack([ahead[:, 1], -ahead[:, 0]])
        T[:, :2, 3] = xy
        T[:, 2, 3] = road(ground, xy) + self.height
        return T


def road(ground: Ground, xy: Float64) -> Float64:
    """(k,) height of the road under the vehicle [m], smoothed over its length of 3 m."""
    around = xy[:, None] + np.array([(0.0, 0.0), (1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)])
    return np.asarray(ground.at(around.reshape(-1, 2)).reshape(len(xy), -1).mean(axis=1))


def driven_way(street: Street, settings: SimulationSettings) -> Street:
    """A street from where the drive begins."""
    return street.back() if settings.reverse else street


def motion_of(street: Street, settings: SimulationSettings, height: float) -> Motion:
    """A drive whose speed varies smoothly between 65 % and 100 % of the largest."""
    rng = stream(settings.seed, "speed", settings.drive, street.number)
    phase, length = rng.uniform(0.0, 2 * np.pi, 3), rng.uniform(40.0, 150.0, 3)
    wave = np.sin(street.arc[:, None] * 2 * np.pi / length + phase).mean(axis=1)
    speed = settings.lidar.speed * (0.825 + 0.175 * wave)
    between = 2.0 / (speed[:-1] + speed[1:])
    time = np.concatenate([[0.0], np.cumsum(between)])
    return Motion(street, height, speed, time, settings.side)


def stamps_of(motion: Motion, settings: SimulationSettings, scans_per_point: int) -> Int64:
    """(n, s) stamps of the scans of each sample point [ns]: s turns around its passing."""
    period = 1.0 / settings.lidar.model.rate_hz
    begin = EPOCH_NS + settings.drive * DAY_NS + motion.street.number % 20 * (DAY_NS // 24)
    turns = (np.arange(scans_per_point) - (scans_per_point - 1) / 2) * period
    return begin + np.rint((motion.time[:, None] + turns) * 1e9).astype(np.int64)


def scans(city: City, street: Street, points: range, scans_per_point: int = 1) -> Iterator[Scan]:
    """The scans at some sample points of a street, each with its true pose.

    Args:
        city: the city, with the settings of the drive.
        street: the street as it is driven (`driven_way`).
        points: of its sample points.
        scans_per_point: turns kept per sample point.
    """
    settings = city.settings
    motion = motion_of(street, settings, settings.lidar.height)
    still = Scene(
        city.scene(street.xy[points.start : points.stop], settings.drive + 1),
        np.array([*street.xy[points.start], 0.0]),
    )
    stamps = stamps_of(motion, settings, scans_per_point)
    traffic = traffic_of(street, settings, settings.drive + 1)
    for point in points:
        for turn in range(scans_per_point):
            stamp = int(stamps[point, turn])
            since = (stamp - stamps[0].mean()) / 1e9
            arc = motion.arc_at(np.array([since]))
            step = motion.pose(city.ground, np.concatenate([arc - 0.05, arc, arc + 0.05]))
            speed = float(np.interp(arc[0], street.arc, motion.speed))
            velocity = (step[2, :3, 3] - step[0, :3, 3]) / 0.1 * speed
            heading = street.heading(arc[0] + np.array([-0.05, 0.05]))
            turned = float(np.angle(np.exp(1j * (heading[1] - heading[0]))))
            moving = Scene(traffic.mesh(city.ground, arc[0], since), still.origin)
            seed = (settings.seed, settings.drive, street.number, point * 64 + turn)
            yaw_rate = turned / 0.1 * speed
            targets = (still, moving)
            yield measure(targets, step[1], velocity, yaw_rate, settings.lidar, stamp, seed)


@dataclass(frozen=True, eq=False)
class Traffic:
    """Cars and pedestrians that move along a street."""

    street: Street
    cars: Float64
    """(n, 4) arc length at time 0 [m], speed along the route [m/s], offset left of it [m], look."""
    people: Float64
    """(n, 4) likewise."""

    def mesh(self, ground: Ground, arc: float, time: float) -> Mesh:
        """What moves within `AHEAD` of an arc length at a time [s]; nothing hits the vehicle."""
        length = len(self.street.xy) + 2 * AHEAD
        parts = []
        for table, shape in ((self.cars, "cars"), (self.people, "people")):
            place = np.mod(table[:, 0] + table[:, 1] * time + AHEAD, length) - AHEAD
            lateral = table[:, 2]
            near = np.abs(place - arc) < AHEAD
            place, lateral, look = place[near], lateral[near], table[near, 3]
            heading = self.street.heading(place)
            across = np.column_stack([-np.sin(heading), np.cos(heading)])
            xy = self.street.at(place) + across * lateral[:, None]
            clear = ground.space.at(xy) > (1.3 if shape == "cars" else 0.5)
            foot = np.column_stack([xy, ground.at(xy)])[clear]
            if shape == "cars":
                parts.append(furniture.cars(foot, heading[clear], look[clear]))
            else:
                parts.append(furniture.people(foot, look[clear]))
        return joined(parts)


def traffic_of(
    street: Street, settings: SimulationSettings, epoch: int, share: float = 1.0
) -> Traffic:
    """The traffic of a street on one day: cars in both directions, people on both pavements."""
    hundreds = (len(street.xy) + 2 * AHEAD) / 100.0
    n_cars = round(settings.traffic.cars_per_100m * hundreds * share)
    n_people = round(settings.traffic.people_per_100m * hundreds * share)
    table = []
    kinds = (("cars", n_cars, LANE, 4.0, 11.0), ("people", n_people, 2.8, 0.6, 1.6))
    for kind, count, least, slow, fast in kinds:
        draws = stream(settings.seed, kind, epoch, street.number).uniform(size=(count, 5))
        side = np.where(draws[:, 1] < 0.5, 1.0, -1.0)
        arc = draws[:, 0] * hundreds * 100.0 - AHEAD
        speed = -side * (slow + (fast - slow) * draws[:, 2])
        table.append(np.column_stack([arc, speed, side * (least + 3.0 * draws[:, 3]), draws[:, 4]]))
    return Traffic(street, *table)


def odometry(city: City, truth: Trajectory, street: Street) -> Trajectory:
    """The poses that the vehicle believes: the true ones with a smooth error in x and y."""
    settings = city.settings
    rng = stream(settings.seed, "odometry", settings.drive, street.number)
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    T = truth.T_map_lidar.copy()
    T[:, :2, 3] += smooth(rng, seconds * settings.lidar.speed, settings.odometry_error)
    return Trajectory(truth.stamps_ns, T, truth.frame)


def smooth(rng: np.random.Generator, arc: Float64, size: float, axes: int = 2) -> Float64:
    """(k, axes) smooth curves over arc length, waves of 50 to 200 m, root mean square `size` in
    all axes together [m].
    """
    length = rng.uniform(50.0, 200.0, (4, axes))
    phase = rng.uniform(0.0, 2 * np.pi, (4, axes))
    waves = np.sin(arc[:, None, None] * 2 * np.pi / length + phase).sum(axis=1)
    return np.asarray(waves * size / np.sqrt(2.0 * axes))
