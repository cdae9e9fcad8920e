"""Facades with relief over footprints: bays with recesses between pilasters, deeper at shops.

There are no roofs: nothing on the streets sees one, and a ray that enters over a low wall meets
the wall behind it.
"""

import numpy as np

from tilestream.records import Float64
from tilestream.simulation.footprints import Footprints
from tilestream.simulation.ground import Ground
from tilestream.simulation.mesh import Material, Mesh, joined, quads, walls
from tilestream.simulation.settings import SimulationSettings, stream

STOREY = 3.6
"""Height of the ground floor [m]."""
LEAST_EDGE = 3.0
"""Shortest side of a building that has bays [m]."""


def facades(footprints: Footprints, ground: Ground, settings: SimulationSettings) -> Mesh:
    """The walls of buildings: a ground floor and the storeys above it, each with its own bays."""
    start, end, building = footprints.start, footprints.end, footprints.building
    foot = ground.slope(start)
    low = np.full(len(footprints.height), np.inf)
    np.minimum.at(low, building, foot)
    top = (low + footprints.height)[building]
    floor = np.minimum(foot.clip(max=low[building]) + STOREY, top)
    depth, bay, share = _style(footprints, settings)
    return joined(
        [
            _bays(
                start,
                end,
                low[building] - 1.0,
                floor,
                1.5 * depth[building],
                bay[building] * 1.3,
                share[building] * 0.6,
                Material.GLASS,
            ),
            _bays(
                start,
                end,
                floor,
                top,
                depth[building],
                bay[building],
                share[building],
                Material.GLASS,
            ),
        ]
    )


def _style(
    footprints: Footprints, settings: SimulationSettings
) -> tuple[Float64, Float64, Float64]:
    """Depth of recesses [m], width of bays [m], share of pilasters: drawn by place, so that a
    building looks the same whatever else is in the box that it is seen in.
    """
    first = np.searchsorted(footprints.building, np.arange(len(footprints.height)))
    corner = np.rint(footprints.start[first] * 100.0).astype(np.int64)
    keys = stream(settings.seed, "relief").integers(1, 2**31, 6)
    words = (corner[:, :1] * keys[:3] + corner[:, 1:] * keys[3:]) % 1_000_003 / 1_000_003.0
    depth = settings.city.relief * np.where(words[:, 0] < 0.15, 0.0, words[:, 0])
    return depth, 2.5 + 4.0 * words[:, 1], 0.15 + 0.35 * words[:, 2]


def _bays(
    start: Float64,
    end: Float64,
    low: Float64,
    high: Float64,
    depth: Float64,
    bay: Float64,
    share: Float64,
    recess: Material,
) -> Mesh:
    """Walls of which every bay is a recess and a pilaster; short and flat sides stay plain."""
    along = end - start
    length = np.hypot(*along.T)
    tall = high > low + 0.01
    plain = tall & ((length < LEAST_EDGE) | (depth < 0.02))
    parts = [walls(start[plain], end[plain], low[plain], high[plain], Material.WALL)]
    rows = np.flatnonzero(tall & ~plain)
    count = np.maximum(np.rint(length[rows] / bay[rows]), 1).astype(np.int64)
    edge = np.repeat(rows, count)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    width = (length[rows] / count).repeat(count)
    unit = along[edge] / length[edge, None]
    inward = np.column_stack([-unit[:, 1], unit[:, 0]]) * depth[edge, None]
    a = start[edge] + unit * (number * width)[:, None]
    b = a + unit * (width * (1.0 - share[edge]))[:, None]
    c = a + unit * width[:, None]
    z, top = low[edge], high[edge]
    parts += [
        walls(a + inward, b + inward, z, top, recess),
        walls(b, c, z, top, Material.WALL),
        walls(a, a + inward, z, top, Material.WALL),
        walls(b + inward, b, z, top, Material.WALL),
    ]
    corners = [np.column_stack([xy, top]) for xy in (a, b, b + inward, a + inward)]
    parts.append(quads(corners[0], corners[1], corners[2], corners[3], Material.WALL))
    return joined(parts)
