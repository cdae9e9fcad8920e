"""A route through points: its arc length and heading, and its points at equal arc length."""

import math
from dataclasses import replace

import numpy as np

from tilestream.errors import CorruptSourceError, PoseError, UsageError
from tilestream.formats.motion import vertices
from tilestream.kernels.fixed_order import norms
from tilestream.records import LEAST_SPACING, Float64, Route

TANGENT_M = 0.5
"""The heading at a point is the direction of the chord from this far before to this far after."""
STEEPEST = 0.5
"""Climb per horizontal length of a whole route that no road has."""
SLOPE_POINTS = 1_000_000
"""At most so many points of a route are looked at for that, a metre apart up to 1,000 km."""


def route_of(
    route_id: str,
    positions: Float64,
    *,
    crs: str | None = None,
    max_jump: float = 1000.0,
    where: str = "route",
) -> Route:
    """The route through the vertices of a path (`motion.vertices`).

    Args:
        route_id: its name.
        positions: (n, 3) points [m, map frame], in order of travel; z may be NaN (in all points).
        crs: coordinate reference system.
        max_jump: longest distance between successive points [m].
        where: how errors name it.

    Raises:
        CorruptSourceError: a number that is not finite, fewer than 2 different points, or a path
            steeper than 1:2 over its length.
        PoseError: a jump longer than `max_jump`.
    """
    flat = bool(np.isnan(positions[:, 2]).all())
    finite = np.isfinite(positions[:, :2] if flat else positions).all(axis=1)
    if not finite.all():
        index = int(np.flatnonzero(~finite)[0])
        if np.isfinite(positions[index, :2]).all():
            raise CorruptSourceError(f"{where}: point {index} has no z, others have: all or none")
        raise CorruptSourceError(f"{where}: point {index} is not finite: {positions[index]}")
    known = positions[:, :2] if flat else positions
    kept = vertices(known)
    if len(kept) < 2:
        raise CorruptSourceError(
            f"{where}: {len(kept)} different points of {len(positions)}; a route needs at least 2"
        )
    steps = norms(np.diff(known[kept], axis=0))
    if steps.max() > max_jump:
        i = int(np.argmax(steps > max_jump))
        raise PoseError(
            f"{where}: jumps {steps[i]:.1f} m from point {kept[i]} to point {kept[i + 1]}, more "
            f"than {max_jump:g} m: split the route there (ts.read_routes takes another max_jump)"
        )
    arc_length: Float64 = np.concatenate([[0.0], np.cumsum(steps)])
    route = positions[kept]
    _check_slope(where, route, arc_length)
    heading = _heading(route, arc_length, arc_length)
    return Route(route_id, route, arc_length, heading, crs, len(positions) - len(kept))


def resample(route: Route, spacing: float = 1.0) -> Route:
    """The route at equal arc length: points at 0, `spacing`, 2 `spacing`, ... on the straight lines
    between its points; what is left at the end (less than `spacing`) is cut off.

    Args:
        route: a route.
        spacing: arc length between points [m].

    Returns:
        A route whose `arc_length` and heading are those of the given one at its points.

    Raises:
        UsageError: `spacing` is below 1 cm, or longer than the route.
    """
    require_length(route, spacing)
    length = route.arc_length[-1]
    # 1e-9: a route of 10 m that sums to 9.999999999 has its last point
    arc_length: Float64 = spacing * np.arange(np.floor(length / spacing + 1e-9) + 1)
    at = np.minimum(arc_length, length)
    positions = _at(route.positions, route.arc_length, at)
    heading = _heading(route.positions, route.arc_length, at)
    return replace(route, positions=positions, arc_length=arc_length, heading=heading)


def require_length(route: Route, spacing: float) -> None:
    """Refuse a route that is shorter than the distance between its points is to be [m].

    Raises:
        UsageError: `spacing` is below 1 cm, or longer than the route.
    """
    length = route.arc_length[-1]
    if not LEAST_SPACING <= spacing <= length:
        raise UsageError(
            f"spacing = {spacing}: must be at least {LEAST_SPACING} m and at most the length of "
            f"route {route.route_id}, {length:.2f} m"
        )


def _check_slope(where: str, positions: Float64, arc_length: Float64) -> None:
    # on points about a metre apart, since the noise of dense poses climbs too
    count = min(math.ceil(arc_length[-1]), SLOPE_POINTS)
    coarse = _at(positions, arc_length, np.linspace(0.0, arc_length[-1], count + 1))
    steps = np.diff(coarse, axis=0)
    climb, run = np.abs(steps[:, 2]).sum(), np.hypot(steps[:, 0], steps[:, 1]).sum()
    if climb > STEEPEST * run:
        raise CorruptSourceError(
            f"{where}: climbs {climb:.1f} m over {run:.1f} m; its z axis does not point up (poses "
            "of a camera?): turn it into a frame with z up"
        )


def _at(positions: Float64, arc_length: Float64, at: Float64) -> Float64:
    return np.column_stack([np.interp(at, arc_length, column) for column in positions.T])


def _heading(positions: Float64, arc_length: Float64, at: Float64) -> Float64:
    """Direction of the chord around each arc length; of the line itself at a point of return."""
    xy = positions[:, :2]
    before = _at(xy, arc_length, np.maximum(at - TANGENT_M, 0.0))
    after = _at(xy, arc_length, np.minimum(at + TANGENT_M, arc_length[-1]))
    chord = after - before
    segment = np.clip(np.searchsorted(arc_length, at, side="right"), 1, len(arc_length) - 1)
    returning = norms(chord) < 1e-6
    chord[returning] = (xy[segment] - xy[segment - 1])[returning]
    return np.arctan2(chord[:, 1], chord[:, 0])
