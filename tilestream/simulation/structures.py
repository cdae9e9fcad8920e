"""Tunnels and bridges over the routes: bare walls and ceilings, decks on abutments."""

import numpy as np

from tilestream.records import Float64
from tilestream.simulation.ground import Ground
from tilestream.simulation.mesh import Material, Mesh, joined, quads
from tilestream.simulation.streets import Spot, Street

TUNNEL_HALF_WIDTH, TUNNEL_HEIGHT = 4.5, 5.0
"""Of the clear section of a tunnel [m]."""
BRIDGE_HEIGHT, DECK = 4.7, 1.3
"""Clearance under a bridge and depth of its deck [m]."""
BRIDGE_HALF_WIDTH = (4.0, 9.0)
"""Least and largest distance of abutments from the route [m]."""
FLARE = 3.0
"""Length of the portals' wing walls [m]."""


def tunnels_and_bridges(
    streets: tuple[Street, ...], ground: Ground, low: Float64, high: Float64
) -> Mesh:
    """All tunnels and bridges that reach into a box."""
    parts = []
    for street in streets:
        for spot in street.spots_of("tunnel", "bridge"):
            xy = street.at(np.array([spot.begin, (spot.begin + spot.end) / 2, spot.end]))
            reach = (spot.end - spot.begin) / 2
            if ((xy[1] > low - reach) & (xy[1] < high + reach)).all():
                parts.append(_tube(street, spot, ground))
    return joined(parts)


def half_width(street: Street, spot: Spot, ground: Ground) -> float:
    """Distance of the walls of a tunnel or bridge from the route [m]."""
    arc = np.arange(spot.begin, spot.end + 0.5, 1.0)
    free = float(ground.space.at(street.at(arc)).min())
    if spot.kind == "tunnel":
        return min(TUNNEL_HALF_WIDTH, free - 0.3)
    return float(np.clip(free - 0.5, *BRIDGE_HALF_WIDTH))


def _tube(street: Street, spot: Spot, ground: Ground) -> Mesh:
    """Two walls and a ceiling along the route; a bridge also shows its deck's faces and top."""
    arc = np.linspace(spot.begin, spot.end, max(2, round((spot.end - spot.begin) / 2) + 1))
    centre, heading = street.at(arc), street.heading(arc)
    across = np.column_stack([-np.sin(heading), np.cos(heading)])
    half = half_width(street, spot, ground)
    left, right = centre + across * half, centre - across * half
    foot = ground.slope(centre) - 1.0
    roof = ground.slope(centre) + (TUNNEL_HEIGHT if spot.kind == "tunnel" else BRIDGE_HEIGHT)
    parts = [
        _strip(np.column_stack([left, foot]), np.column_stack([left, roof])),
        _strip(np.column_stack([right, foot]), np.column_stack([right, roof])),
        _strip(np.column_stack([left, roof]), np.column_stack([right, roof])),
    ]
    parts += [_portal(left[end], right[end], across[end], foot[end], roof[end]) for end in (0, -1)]
    return joined(parts)


def _strip(a: Float64, b: Float64) -> Mesh:
    return quads(a[:-1], a[1:], b[1:], b[:-1], Material.CONCRETE)


def _portal(left: Float64, right: Float64, across: Float64, foot: float, roof: float) -> Mesh:
    """The face that is seen from outside: the deck's edge and a wing wall on each side."""
    outer_left, outer_right = left + across * FLARE, right - across * FLARE

    def face(a: Float64, b: Float64, low: float, high: float) -> Mesh:
        ring = [(*a, low), (*b, low), (*b, high), (*a, high)]
        a3, b3, c3, d3 = (np.array([corner]) for corner in ring)
        return quads(a3, b3, c3, d3, Material.CONCRETE)

    return joined(
        [
            face(outer_left, outer_right, roof, roof + DECK),
            face(outer_left, left, foot, roof),
            face(right, outer_right, foot, roof),
        ]
    )
