"""The survey: a mapping vehicle with a dense scanner drives every street, there and back."""

import numpy as np

from tilestream.records import Float64
from tilestream.simulation.city import City
from tilestream.simulation.drive import road, smooth, traffic_of
from tilestream.simulation.lidar import nearest, returned
from tilestream.simulation.raycast import Scene
from tilestream.simulation.settings import stream
from tilestream.simulation.streets import Street

ELEVATION = (-50.0, 55.0)
"""Lowest and highest ray of the scanner [deg]."""
GLASS_LOSS = 0.035
"""Share of the rays on glass that do not come back."""
SPEED = 8.0
"""Of the mapping vehicle [m/s]: what moves is elsewhere one metre on."""
SIDE = 0.8
"""How far right of the route each pass drives [m]."""


def survey(city: City, street: Street, points: tuple[int, int], passes: int) -> Float64:
    """Map points that one pass measures from some sample points of a street.

    Each metre the scanner sends its rays from random places of that metre; what comes back carries
    noise and the pass's drift, so that two passes see a wall in two places.

    Args:
        city: the city, with the settings of the survey.
        street: the street.
        points: the first sample point and the one after the last.
        passes: number of the pass; odd ones drive back.

    Returns:
        (n, 3) points [m, map frame], rounded to 1 mm.
    """
    settings = city.settings
    begin, end = points
    still = Scene(city.scene(street.xy[begin:end], 0), np.array([*street.xy[begin], 0.0]))
    traffic = traffic_of(street, settings, 1_000_000 + passes, settings.survey.traffic)
    drift_of = stream(settings.seed, "drift", street.number, passes)
    drift = smooth(drift_of, street.arc, settings.survey.drift, axes=3)
    drift[:, 2] *= 0.5
    direction_of_travel = 1.0 if passes % 2 == 0 else -1.0
    found = []
    for point in range(begin, end):
        rng = stream(settings.seed, "survey noise", street.number, passes, point)
        start, direction = _rays(city, street, point, direction_of_travel, rng)
        moving = Scene(
            traffic.mesh(city.ground, float(point), direction_of_travel * point / SPEED),
            still.origin,
        )
        ranges, cosine, material = nearest((still, moving), start, direction)
        luck = rng.uniform(size=len(ranges))
        noise = rng.normal(0.0, settings.survey.noise, len(ranges))
        came = returned(luck, ranges, cosine, material, settings.survey.range_max, GLASS_LOSS)
        measured = ranges[came] + noise[came]
        found.append(start[came] + direction[came] * measured[:, None] + drift[point])
    return np.rint(np.concatenate(found) * 1000.0) / 1000.0


def _rays(
    city: City, street: Street, point: int, direction_of_travel: float, rng: np.random.Generator
) -> tuple[Float64, Float64]:
    """Rays over the metre after a sample point, denser towards the horizon than to the zenith."""
    count = city.settings.survey.rays_per_m
    along, azimuth, elevation = rng.uniform(size=(3, count))
    arc = point + along
    heading = street.heading(np.array([float(point)]))
    side = -SIDE * direction_of_travel * np.array([-np.sin(heading[0]), np.cos(heading[0])])
    xy = street.at(arc) + side
    z = road(city.ground, street.at(np.array([point, point + 1.0]))) + city.settings.survey.height
    start = np.column_stack([xy, z[0] + along * (z[1] - z[0])])
    low, high = np.deg2rad(ELEVATION)
    up = low + (high - low) * elevation
    turn = 2 * np.pi * azimuth
    direction = np.column_stack([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), np.sin(up)])
    return start, direction
