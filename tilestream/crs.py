"""Coordinate reference systems: the gate where one enters, and the one where two meet.

Inside, everything is in metres. What comes in is in metres, is brought to metres, or is refused.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from tilestream.errors import CrsError

_PLANE = [
    {"name": "Easting", "abbreviation": "E", "direction": "east", "unit": "metre"},
    {"name": "Northing", "abbreviation": "N", "direction": "north", "unit": "metre"},
]
"""The axes that two CRS are compared with: x and y of a file are east and north in this order,
whatever the order of a CRS says."""


class Unit(NamedTuple):
    """A unit of length."""

    name: str
    metres: float
    """Its length [m]."""


METRE = Unit("metre", 1.0)


@dataclass(frozen=True)
class Entered:
    """A CRS of a map, in metres, and what brings the coordinates of its file there."""

    crs: str | None
    """As it was named, where that is one in metres without heights; else an EPSG code or WKT. None:
    a local frame."""
    xy: Unit = METRE
    """Of x and y in the file."""
    z: Unit = METRE
    """Of z in the file."""
    notes: tuple[str, ...] = ()
    """What was converted, and what of the CRS a map does not keep: a line each."""

    @property
    def metric(self) -> bool:
        """Whether the coordinates of the file are metres already."""
        return self.xy.metres == self.z.metres == 1.0


def parsed(crs: str, who: str) -> CRS:
    """A CRS from any string that pyproj reads.

    Args:
        crs: the string.
        who: names it, for messages.

    Raises:
        CrsError: pyproj cannot read it.
    """
    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise CrsError(f"{who}: {_short(crs)} is no CRS that pyproj reads: {error}") from None


def enter(
    crs: CRS | str | None, who: str, *, xy: Unit | None = None, z: Unit | None = None
) -> Entered:
    """The gate where a CRS enters.

    Args:
        crs: the CRS, or any string that pyproj reads; None: not known, only its units are.
        who: whose it is, for messages.
        xy: unit of x and y, where the file says it besides; it overrides that of the CRS.
        z: likewise of z. Heights whose unit no one tells have that of x and y.

    Raises:
        CrsError: one that pyproj cannot read, in degrees, geocentric, or whose axes are in units
            that do not fit together.
    """
    system = parsed(crs, who) if isinstance(crs, str) else crs
    if system is None:
        xy = xy or METRE
        return Entered(None, xy, z or xy, _converted(xy, z))
    plane, height = _parts(system)
    _refuse_degrees(plane, who)
    own = _unit(plane, slice(0, 2), who) or METRE
    own_z = _unit(height, slice(0, 1), who) if height else _unit(plane, slice(2, 3), who)
    xy, z = xy or own, z or own_z
    notes = _converted(xy, z)
    if height is not None:
        notes += (f"its heights are {height.name}: the map's CRS is {plane.name}, without them",)
    if plane.is_engineering:
        return Entered(None, xy, z or xy, (f"its CRS {plane.name} is a local frame", *notes))
    if isinstance(crs, str) and plane is system and own == METRE:
        return Entered(crs, xy, z or xy, notes)
    return Entered(_name(plane if own == METRE else _in_metres(plane)), xy, z or xy, notes)


def same(a: str, b: str) -> bool:
    """Whether two CRS mean the same by x and y: however they are written, in whatever unit, with or
    without heights.

    Raises:
        CrsError: pyproj cannot read one.
    """
    first, second = (_compared(_parts(parsed(crs, "CRS"))[0]) for crs in (a, b))
    return a == b or bool(first.equals(second, ignore_axis_order=True))


def one_crs(asked: str | None, sources: Iterable[tuple[str, str | None]]) -> str | None:
    """The gate where the CRS of several sources meet: the one that all are in; None: no one names
    one.

    Args:
        asked: the CRS that was asked for, any string that pyproj reads; None: none was.
        sources: path and CRS of each source; None: its file names none.

    Raises:
        CrsError: there are two, named with their sources; one was asked for that is not in metres,
            as which the points of a source that names none would be read; or the one is that of web
            maps, whose metres are none on the ground.
    """
    every = [(path, crs) for path, crs in sources]
    if asked is not None:
        entered = enter(asked, ASKED)
        bare = [path for path, crs in every if crs is None]
        if not entered.metric and bare:
            raise CrsError(
                f"{ASKED}, {_short(asked)}, is in {entered.xy.name} and {bare[0]} names none, so "
                f"its points would be read as metres: write the CRS into the file (of LAS and LAZ "
                f"`pdal translate IN OUT --writers.las.a_srs={_short(asked)}`), or multiply its "
                f"coordinates by {entered.xy.metres:.12g}"
            )
        every.insert(0, (ASKED, entered.crs))
    known = [(who, crs) for who, crs in every if crs is not None]
    for who, crs in known[1:]:
        require_same(*known[0], who, crs)
    for who, crs in known[:1]:
        if _method(parsed(crs, who)) == WEB_MERCATOR:
            raise CrsError(
                f"{who}: its CRS {named(crs)} is that of web maps, where a metre on the ground is "
                "1 / cos(latitude) m, so no length would be right: project it to one that keeps "
                "lengths first, e.g. UTM (for example with PDAL's filters.reprojection)"
            )
    return known[0][1] if known else None


def _method(crs: CRS) -> str:
    """How a CRS projects; empty: it does not."""
    how = _parts(crs)[0].coordinate_operation
    return how.method_name if how else ""


WEB_MERCATOR = "Popular Visualisation Pseudo Mercator"
"""The name of its method."""
ASKED = "the crs that was asked for"


def require_same(one: str, crs: str | None, other: str, crs_of_other: str | None) -> None:
    """The gate where two CRS meet that must be the same; a local frame fits any.

    Args:
        one: names whose the first is.
        crs: the first.
        other: names whose the second is.
        crs_of_other: the second.

    Raises:
        CrsError: they are two.
    """
    if crs is not None and crs_of_other is not None and not same(crs, crs_of_other):
        raise CrsError(
            f"{one} is {_short(crs)} and {other} is {_short(crs_of_other)}: bring all into one CRS "
            "first (for example with PDAL's filters.reprojection)"
        )


def projection(source: CRS | str, target: CRS | str, who: str) -> Transformer:
    """From one CRS to another, x (or longitude) first.

    Raises:
        CrsError: PROJ knows no way; names both.
    """
    try:
        return Transformer.from_crs(source, target, always_xy=True)
    except ProjError as error:
        raise CrsError(
            f"{who}: cannot be brought from {named(source)} to {named(target)}: {error}"
        ) from None


def named(crs: CRS | str) -> str:
    """A CRS in few words."""
    return _short(crs if isinstance(crs, str) else _name(crs))


def _parts(crs: CRS) -> tuple[CRS, CRS | None]:
    """The horizontal and the vertical part; what a CRS says of its way to WGS 84 is left out."""
    if crs.is_bound and crs.source_crs is not None:
        return _parts(crs.source_crs)
    if not crs.is_compound:
        return crs, None
    plane, height = crs.sub_crs_list[:2]
    return _parts(plane)[0], _parts(height)[0]


def _refuse_degrees(plane: CRS, who: str) -> None:
    if plane.is_projected or plane.is_engineering:
        return
    what = "in degrees" if plane.is_geographic else f"a {plane.type_name}, no plane"
    raise CrsError(
        f"{who}: its CRS {named(plane)} ({plane.name}) is {what}: project it to one in metres "
        "first, e.g. UTM (for example with PDAL's filters.reprojection)"
    )


def _unit(crs: CRS, axes: slice, who: str) -> Unit | None:
    """The one unit of some axes; None where the CRS has none of them."""
    found = {Unit(a.unit_name, a.unit_conversion_factor) for a in crs.axis_info[axes]}
    lengths = {unit.metres for unit in found}
    if len(lengths) > 1 or not all(0.0 < metres < math.inf for metres in lengths):
        told = " and ".join(sorted(unit.name for unit in found))
        raise CrsError(f"{who}: its CRS {named(crs)} has axes in {told}: bring it to metres first")
    return METRE if lengths == {1.0} else next(iter(found), None)


def _converted(xy: Unit, z: Unit | None) -> tuple[str, ...]:
    """What is to be told of units other than metres."""
    if xy == METRE and z in (None, METRE):
        return ()
    heights = f"z, whose unit it does not say, in {xy.name} too" if z is None else f"z in {z.name}"
    factors = f"{xy.metres:.12g} m" + (f" and {z.metres:.12g} m" if z and z != xy else "")
    return (f"x and y are in {xy.name}, {heights}: brought to metres, {factors} each",)


def _name(crs: CRS) -> str:
    """An EPSG code where the CRS has one, else its WKT."""
    code = crs.to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code else str(crs.to_wkt())


def _in_metres(plane: CRS) -> CRS:
    """The same projection in metres: its parameters keep their own units."""
    described = plane.to_json_dict()
    described.pop("id", None)
    for axis in described["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    return CRS.from_json_dict(described | {"name": f"{plane.name} in metres"})


def _compared(plane: CRS) -> CRS:
    """A horizontal CRS as it is compared: axes to the east and north in metres."""
    directions = {axis.direction for axis in plane.axis_info[:2]}
    if not plane.is_projected or directions != {"east", "north"}:
        return plane
    described = plane.to_json_dict()
    described.pop("id", None)
    described["coordinate_system"] = {"subtype": "Cartesian", "axis": _PLANE}
    return CRS.from_json_dict(described)


def _short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}…"
