"""Lanelet2 maps: centre lines of the lanelets that vehicles drive on.

Format: Lanelet2's OSM XML (a lanelet is a relation with the ways `left` and `right`, maybe
`centerline`); Autoware's maps carry metric `local_x`, `local_y` and `ele` tags on every node.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.routes.base import DEGREES, Lost, Path3
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64

NOT_FOR_VEHICLES = frozenset(
    {"crosswalk", "walkway", "shared_walkway", "pedestrian_lane", "stairs", "bicycle_lane", "rail"}
)
"""Subtypes of lanelets that are left out."""
MIN_SAMPLES = 10
"""Least number of points on a centre line made from its bounds."""


@dataclass(frozen=True, eq=False)
class _Lanelet:
    number: str
    starts_at: tuple[str, str]
    """First nodes of its left and right bound, in the direction of travel."""
    ends_at: tuple[str, str]
    """Last nodes of its left and right bound."""
    centre: Float64
    """(n, 3) centre line."""


def read_lanelet2(path: str) -> Sequence[Path3 | Lost]:
    """Centre lines of the lanelets for vehicles, in the file's order.

    The centre line is the lanelet's own where it has one, else the middle of its bounds, each at
    the same share of its length. Lanelets are joined to one path (`101-102-105`) as long as exactly
    one follows and it follows that one only. A lanelet that lacks a bound or a node is lost. What
    an editor has marked as deleted is not there.

    Coordinates are `local_x`, `local_y` and `ele` (z) where every node of the bounds has them, else
    longitude and latitude in degrees (`Path3.crs` says so), z from `ele` where every node has it.

    Raises:
        CorruptSourceError: no Lanelet2 map, or no lanelets for vehicles in it.
    """
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise CorruptSourceError(f"{path}: no OSM XML ({error})") from error
    ways = {_id(w): [str(nd.get("ref")) for nd in w.iter("nd")] for w in _there(root, "way")}
    relations = [r for r in _there(root, "relation") if _for_vehicles(_tags(r))]
    if not relations:
        raise CorruptSourceError(f"{path}: holds no lanelets for vehicles")
    used = {n for r in relations for m in r.iter("member") for n in ways.get(_ref(m), [])}
    nodes = _Nodes.of(path, {_id(n): n for n in _there(root, "node") if _id(n) in used})
    lanelets: list[_Lanelet] = []
    lost: list[Lost] = []
    for relation in relations:
        try:
            lanelets.append(_lanelet(path, relation, ways, nodes))
        except CorruptSourceError as error:
            lost.append(Lost(_id(relation), error))
    crs = None if nodes.metric else DEGREES
    paths = [
        Path3("-".join(part.number for part in chain), _joined(chain), crs, lanelets=_begins(chain))
        for chain in _chains(lanelets)
    ]
    return [*paths, *lost]


def _there(root: ET.Element, kind: str) -> list[ET.Element]:
    """The elements of a kind but for those that an editor has marked as deleted."""
    return [
        element
        for element in root.iter(kind)
        if element.get("action") != "delete" and element.get("visible") != "false"
    ]


def _for_vehicles(tags: dict[str, str]) -> bool:
    return tags.get("type") == "lanelet" and tags.get("subtype") not in NOT_FOR_VEHICLES


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Where the nodes are that lanelets for vehicles use."""

    path: str
    elements: dict[str, ET.Element]
    tags: dict[str, dict[str, str]]
    metric: bool
    """Whether all have `local_x` and `local_y`."""
    has_z: bool
    """Whether all have `ele`."""

    @classmethod
    def of(cls, path: str, elements: dict[str, ET.Element]) -> "_Nodes":
        tags = {number: _tags(element) for number, element in elements.items()}
        metric = all("local_x" in t and "local_y" in t for t in tags.values())
        return cls(path, elements, tags, metric, all("ele" in t for t in tags.values()))

    def line(self, numbers: list[str]) -> Float64:
        """(n, 3) points of a way.

        Raises:
            CorruptSourceError: a node is not there, or has no position; names it.
        """
        return np.array([self._point(number) for number in numbers])

    def _point(self, number: str) -> list[float]:
        node, tags = self.elements.get(number), self.tags.get(number, {})
        if node is None:
            raise CorruptSourceError(f"{self.path}: node {number} is used and not there")
        x, y = ("local_x", "local_y") if self.metric else ("lon", "lat")
        given = tags if self.metric else node
        try:
            z = float(tags["ele"]) if self.has_z else np.nan
            return [float(given.get(x) or ""), float(given.get(y) or ""), z]
        except ValueError as error:
            message = f"{self.path}: node {number} has no position ({error})"
            raise CorruptSourceError(message) from error


def _lanelet(
    path: str, relation: ET.Element, ways: dict[str, list[str]], nodes: _Nodes
) -> _Lanelet:
    number = _id(relation)
    roles = {str(m.get("role")): _ref(m) for m in relation.iter("member") if m.get("type") == "way"}
    bounds = []
    for role in ("left", "right"):
        bound = ways.get(roles.get(role, ""), [])
        if len(bound) < 2:
            raise CorruptSourceError(f"{path}: lanelet {number} has no {role} bound of 2 nodes")
        bounds.append(bound)
    left, right = bounds
    left_xyz, right_xyz = (nodes.line(bound) for bound in bounds)
    if _against(left_xyz, right_xyz):
        right, right_xyz = right[::-1], right_xyz[::-1]
    if not _on_the_left(left_xyz, right_xyz):
        left, left_xyz, right, right_xyz = left[::-1], left_xyz[::-1], right[::-1], right_xyz[::-1]
    centre = _middle(left_xyz, right_xyz)
    own = ways.get(roles.get("centerline", ""), [])
    if len(own) >= 2:
        drawn = nodes.line(own)
        centre = drawn[::-1] if _against(centre, drawn) else drawn
    return _Lanelet(number, (left[0], right[0]), (left[-1], right[-1]), centre)


def _against(a: Float64, b: Float64) -> bool:
    """Whether two lines side by side run in opposite directions."""

    def apart(p: Float64, q: Float64) -> float:
        return math.dist(p[:2], q[:2])

    return apart(a[0], b[-1]) + apart(a[-1], b[0]) < apart(a[0], b[0]) + apart(a[-1], b[-1])


def _on_the_left(left: Float64, right: Float64) -> bool:
    """Whether the area between the bounds is to the right of `left` (traffic runs along it)."""
    ring = np.concatenate([left, right[::-1]])[:, :2]
    ring = ring - ring[0]
    following = np.roll(ring, -1, axis=0)
    return bool((ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum() <= 0)


def _middle(left: Float64, right: Float64) -> Float64:
    """Middle of two lines, at the same share of their lengths, as often as the finer has points."""
    count = max(len(left), len(right), MIN_SAMPLES)
    shares = np.linspace(0.0, 1.0, count)
    return (_at_share(left, shares) + _at_share(right, shares)) / 2


def _at_share(line: Float64, shares: Float64) -> Float64:
    steps = norms(np.diff(line[:, :2], axis=0))
    along = np.concatenate([[0.0], np.cumsum(steps)])
    return np.column_stack([np.interp(shares * along[-1], along, column) for column in line.T])


def _chains(lanelets: list[_Lanelet]) -> list[list[_Lanelet]]:
    starting: dict[tuple[str, str], list[_Lanelet]] = {}
    ending: dict[tuple[str, str], list[_Lanelet]] = {}
    for lanelet in lanelets:
        starting.setdefault(lanelet.starts_at, []).append(lanelet)
        ending.setdefault(lanelet.ends_at, []).append(lanelet)

    def successor(lanelet: _Lanelet) -> _Lanelet | None:
        following = starting.get(lanelet.ends_at, [])
        alone = len(following) == 1 and len(ending[lanelet.ends_at]) == 1
        return following[0] if alone else None

    followers = {id(s) for lanelet in lanelets if (s := successor(lanelet)) is not None}
    chains: list[list[_Lanelet]] = []
    done: set[int] = set()
    # a ring of lanelets has no first one: it begins at the one the file names first
    for lanelet in [x for x in lanelets if id(x) not in followers] + lanelets:
        chain: list[_Lanelet] = []
        part: _Lanelet | None = lanelet
        while part is not None and id(part) not in done:
            done.add(id(part))
            chain.append(part)
            part = successor(part)
        if chain:
            chains.append(chain)
    order = {id(lanelet): index for index, lanelet in enumerate(lanelets)}
    return sorted(chains, key=lambda chain: order[id(chain[0])])


def _joined(chain: list[_Lanelet]) -> Float64:
    """The centre lines one after the other, the shared points once."""
    first, *rest = chain
    return np.concatenate([first.centre, *(part.centre[1:] for part in rest)])


def _begins(chain: list[_Lanelet]) -> tuple[tuple[str, int], ...]:
    """The lanelets, and where in what is joined each begins: at the last point before it."""
    ends = accumulate((len(part.centre) - 1 for part in chain), initial=0)
    return tuple((part.number, end) for part, end in zip(chain, ends, strict=False))


def _tags(element: ET.Element) -> dict[str, str]:
    return {str(tag.get("k")): str(tag.get("v")) for tag in element.iter("tag")}


def _id(element: ET.Element) -> str:
    return str(element.get("id"))


def _ref(member: ET.Element) -> str:
    return str(member.get("ref"))
