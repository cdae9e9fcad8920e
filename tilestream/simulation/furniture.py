"""Furniture along the streets: posts, bollards, rails, signs, hedges, trees, parked cars.

Where things may stand is decided once for the city, on both sides of every route, just behind the
curb; which of them do, and how they look, comes from a random stream per phenomenon.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tilestream.records import Float64
from tilestream.simulation.ground import Ground
from tilestream.simulation.mesh import EMPTY, Material, Mesh, boxes, joined, leaves, posts
from tilestream.simulation.settings import SimulationSettings, stream
from tilestream.simulation.streets import Street

SPACING = {"lamp": 25.0, "bollard": 2.0, "rail": 3.0, "sign": 18.0, "tree": 8.0, "hedge": 2.0}
"""Distance between two places of a kind along one side of a street [m]."""
PARKING = 6.5
"""Length of a parking place [m]."""
LEAST_ROOM = 1.0
"""Least distance of furniture to a building [m]."""
ROUTE_ROOM = 2.3
"""Least distance of furniture to any route [m]."""


@dataclass(frozen=True, eq=False)
class Kind:
    """All places of one kind of thing."""

    xy: Float64
    """(n, 2) where each stands [m]."""
    yaw: Float64
    """(n,) direction of the street there [rad]."""
    size: Float64
    """(n,) random number in [0, 1) that its size is made from."""

    def within(self, low: Float64, high: Float64) -> NDArray[np.int64]:
        """Rows of those in a box."""
        return np.flatnonzero(((self.xy >= low) & (self.xy <= high)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Furniture:
    """All places by kind: those of `SPACING`, and `parking`."""

    kinds: dict[str, Kind]


def placed(streets: tuple[Street, ...], ground: Ground, settings: SimulationSettings) -> Furniture:
    """Where everything stands."""
    routes = KDTree(np.concatenate([street.xy for street in streets]))
    kinds = {}
    for kind in (*SPACING, "parking"):
        rng = stream(settings.seed, kind)
        found = [_along(street, kind, ground, rng) for street in streets]
        xy = np.concatenate([part[0] for part in found])
        yaw = np.concatenate([part[1] for part in found])
        wanted = np.concatenate([part[2] for part in found])
        chance, size = rng.uniform(size=(2, len(xy)))
        growing = kind in ("tree", "hedge")
        share = settings.city.vegetation if growing else settings.city.furniture
        share = 1.0 if kind == "parking" else share
        kept = (chance < share * wanted) & _free(xy, ground, routes, kind)
        kinds[kind] = Kind(xy[kept], yaw[kept], size[kept])
    return Furniture(kinds)


def _along(
    street: Street, kind: str, ground: Ground, rng: np.random.Generator
) -> tuple[Float64, Float64, Float64]:
    """Candidate places on both sides of a street: where, heading, and how likely each is."""
    spacing = SPACING.get(kind, PARKING)
    places, headings, chances = [], [], []
    for side in (1.0, -1.0):
        arc = np.arange(spacing / 2, len(street.xy) - 1, spacing)
        arc = arc + rng.uniform(-0.15, 0.15, len(arc)) * spacing
        heading = street.heading(arc)
        across = side * np.column_stack([-np.sin(heading), np.cos(heading)])
        curb = _curb(street.at(arc), across, ground)
        one_sided = _share_of(street, arc, "one-sided", "left" if side > 0 else "right")
        offset = {"parking": -1.3, "hedge": 1.3, "tree": 1.2}.get(kind, 0.45)
        reach = np.where(one_sided, np.minimum(curb, 6.0), curb) + offset
        places.append(street.at(arc) + across * reach[:, None])
        headings.append(heading)
        chances.append(_likely(street, kind, arc, curb, one_sided))
    return np.concatenate(places), np.concatenate(headings), np.concatenate(chances)


def _curb(at: Float64, across: Float64, ground: Ground) -> Float64:
    """(k,) distance from the route to the curb, at most 12 m [m]."""
    reach = np.arange(1.0, 12.25, 0.25)
    xy = (at[:, None] + across[:, None] * reach[None, :, None]).reshape(-1, 2)
    cell = np.rint((xy - ground.space.origin) / ground.space.cell).astype(int)
    cell = np.clip(cell, 0, np.array(ground.pavement.shape) - 1)
    paved = ground.space.at(xy) < np.maximum(ground.pavement[tuple(cell.T)], 1.3)
    paved = paved.reshape(len(at), -1)
    first = np.where(paved.any(axis=1), paved.argmax(axis=1), len(reach) - 1)
    return np.asarray(reach[first])


def _share_of(
    street: Street, arc: Float64, kind: str, side: str | None = None
) -> NDArray[np.bool_]:
    inside = np.zeros(len(arc), bool)
    for spot in street.spots_of(kind):
        if side is None or spot.side == side:
            inside |= (arc >= spot.begin) & (arc <= spot.end)
    return inside


def _likely(
    street: Street, kind: str, arc: Float64, curb: Float64, one_sided: NDArray[np.bool_]
) -> Float64:
    """How likely each place is taken: by the width of the street and what its stretch is."""
    wide = curb > 3.6
    base = {
        "lamp": np.where(wide, 0.9, 0.5),
        "bollard": np.where(wide, 0.15, 0.05),
        "rail": np.where(wide, 0.35, 0.0),
        "sign": np.where(wide, 0.4, 0.8),
        "tree": np.where(wide, 0.5, 0.0),
        "hedge": np.where(wide, 0.35, 0.0),
        "parking": np.where(wide, 1.0, 0.25),
    }[kind]
    furnished = _share_of(street, arc, "furnished")
    if kind in ("bollard", "lamp", "tree"):
        base = np.where(furnished, np.maximum(base, 0.8), base)
    if kind in ("tree", "hedge"):
        base = np.where(one_sided, 1.0, base)
    if kind == "parking":
        base = np.where(one_sided, 0.0, base)
    bare = _share_of(street, arc, "tunnel") | _share_of(street, arc, "bridge")
    empty = _share_of(street, arc, "crossing")
    return np.where(bare, 0.0, np.where(empty, 0.03 if kind == "lamp" else 0.0, base))


def _free(xy: Float64, ground: Ground, routes: KDTree, kind: str) -> NDArray[np.bool_]:
    """Whether a place is clear of buildings and of every route."""
    room = 0.4 if kind in ("sign", "bollard") else LEAST_ROOM
    free = ground.space.at(xy) > room
    gap, _ = routes.query(xy, p=np.inf)
    return np.asarray(free & (gap > ROUTE_ROOM * (1.0 if kind != "parking" else 0.9)))


def fixed(found: Furniture, ground: Ground, low: Float64, high: Float64) -> Mesh:
    """Lamp posts, bollards, guard rails and signs of a box."""
    parts = []
    for kind in ("lamp", "bollard", "rail", "sign"):
        places = found.kinds[kind]
        rows = places.within(low, high)
        if not len(rows):
            continue
        size, yaw = places.size[rows], places.yaw[rows]
        foot = np.column_stack([places.xy[rows], ground.at(places.xy[rows]) - 0.1])
        parts.append(_PIECES[kind](foot, yaw, size))
    return joined(parts)


def _lamp(foot: Float64, yaw: Float64, size: Float64) -> Mesh:
    height = 6.0 + 3.0 * size
    arm = foot + np.column_stack([np.zeros((len(foot), 2)), height])
    shape = np.tile([0.15, 1.8, 0.12], (len(foot), 1))
    return joined(
        [
            posts(foot, 0.07 + 0.05 * size, height, Material.METAL),
            boxes(arm, shape, yaw, Material.METAL),
        ]
    )


def _bollard(foot: Float64, yaw: Float64, size: Float64) -> Mesh:
    del yaw
    return posts(foot, np.full(len(foot), 0.06), 0.85 + 0.15 * size, Material.METAL)


def _rail(foot: Float64, yaw: Float64, size: Float64) -> Mesh:
    bar = np.tile([3.0, 0.06, 0.12], (len(foot), 1))
    return joined(
        [
            posts(foot, np.full(len(foot), 0.05), 0.8 + 0.05 * size, Material.METAL),
            boxes(foot + np.array([0.0, 0.0, 0.75]), bar, yaw, Material.METAL),
            boxes(foot + np.array([0.0, 0.0, 0.4]), bar, yaw, Material.METAL),
        ]
    )


def _sign(foot: Float64, yaw: Float64, size: Float64) -> Mesh:
    board = np.column_stack([np.full(len(size), 0.08), 0.4 + 0.5 * size, 0.6 + 1.2 * size])
    lift = np.column_stack([np.zeros((len(foot), 2)), 2.2 + size])
    return joined(
        [
            posts(foot, np.full(len(foot), 0.045), 3.0 + size, Material.METAL),
            boxes(foot + lift, board, yaw, Material.METAL),
        ]
    )


_PIECES = {"lamp": _lamp, "bollard": _bollard, "rail": _rail, "sign": _sign}


def vegetation(
    found: Furniture,
    ground: Ground,
    low: Float64,
    high: Float64,
    settings: SimulationSettings,
    epoch: int,
) -> Mesh:
    """Trunks, leafy crowns and hedges; leaves hang elsewhere in another epoch."""
    growth = epoch if settings.traffic.regrown else 0
    parts = [EMPTY]
    trees, hedges = found.kinds["tree"], found.kinds["hedge"]
    rows = trees.within(low, high)
    foot = np.column_stack([trees.xy[rows], ground.at(trees.xy[rows]) - 0.2])
    size = trees.size[rows]
    parts.append(posts(foot, 0.1 + 0.12 * size, 3.0 + 1.5 * size, Material.FOLIAGE))
    for row, place, scale in zip(rows, foot, size, strict=True):
        rng = stream(settings.seed, "leaves", growth, int(row))
        reach = np.array([1.6, 1.6, 1.5]) * (0.8 + 0.6 * scale)
        middle = place + np.array([0.0, 0.0, 3.8 + 1.8 * scale])
        parts.append(leaves(rng, np.tile(middle, (220, 1)), np.tile(reach, (220, 1)), 0.22))
    rows = hedges.within(low, high)
    foot = np.column_stack([hedges.xy[rows], ground.at(hedges.xy[rows])])
    for row, place, yaw, scale in zip(rows, foot, hedges.yaw[rows], hedges.size[rows], strict=True):
        rng = stream(settings.seed, "hedge leaves", growth, int(row))
        along = np.linspace(-1.0, 1.0, 90)[:, None] * [np.cos(yaw), np.sin(yaw), 0.0]
        middle = place + np.array([0.0, 0.0, 0.5 + 0.15 * scale]) + along
        parts.append(leaves(rng, middle, np.tile([0.35, 0.35, 0.5 + 0.2 * scale], (90, 1)), 0.12))
    return joined(parts)


def parked_cars(
    found: Furniture,
    ground: Ground,
    low: Float64,
    high: Float64,
    settings: SimulationSettings,
    epoch: int,
) -> Mesh:
    """Cars on the parking places that are taken in an epoch."""
    places = found.kinds["parking"]
    n = len(places.xy)
    taken, look = stream(settings.seed, "parked").uniform(size=(2, n))
    if epoch:
        again = stream(settings.seed, "reparked", epoch)
        anew, taken_anew, look_anew = again.uniform(size=(3, n))
        changed = anew < settings.traffic.reparked
        taken, look = np.where(changed, taken_anew, taken), np.where(changed, look_anew, look)
    rows = places.within(low, high)
    rows = rows[taken[rows] < settings.city.parked]
    foot = np.column_stack([places.xy[rows], ground.at(places.xy[rows])])
    return cars(foot, places.yaw[rows], look[rows])


def cars(foot: Float64, yaw: Float64, look: Float64) -> Mesh:
    """Vehicles, from small cars to vans, each a body and a cabin over it."""
    van = look > 0.8
    length, height = 3.6 + 1.4 * look, np.where(van, 1.3, 0.75)
    body = np.column_stack([length, 1.65 + 0.15 * look, height])
    cabin = np.column_stack([0.55 * length, 1.5 + 0.1 * look, np.where(van, 0.7, 0.6)])
    lift = np.column_stack([np.zeros((len(foot), 2)), np.full(len(foot), 0.25)])
    return joined(
        [
            boxes(foot + lift, body, yaw, Material.CAR),
            boxes(foot + lift + [0.0, 0.0, 1.0] * height[:, None], cabin, yaw, Material.CAR),
        ]
    )


def people(foot: Float64, look: Float64) -> Mesh:
    """Pedestrians as upright prisms."""
    return posts(foot, 0.2 + 0.06 * look, 1.5 + 0.35 * look, Material.PERSON)
