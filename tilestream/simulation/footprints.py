"""Building footprints with heights from GeoJSON: PLATEAU, OSM, or any city in metres."""

import gzip
import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.errors import CorruptSourceError, CrsError, SourceNotFoundError
from tilestream.records import Float64, Int64

HEIGHTS = ("height_m", "height")
"""Properties that may hold a height [m], the first that is there counts."""


@dataclass(frozen=True, eq=False)
class Footprints:
    """Buildings as edges: the building lies left of each edge, so holes run clockwise."""

    start: Float64
    """(e, 2) where each edge begins [m]."""
    end: Float64
    """(e, 2) where each edge ends [m]."""
    building: Int64
    """(e,) row of the building that each edge belongs to, rising."""
    height: Float64
    """(n,) height of each building above its ground [m], above 0."""
    refused: Mapping[str, int]
    """How many buildings of the file were left out, by reason."""
    attribution: str = ""
    """Whose data it is, as the file says."""

    def within(self, low: tuple[float, float], high: tuple[float, float]) -> "Footprints":
        """The buildings with an edge that touches the box from `low` to `high` (by its bounds)."""
        lowest, highest = np.minimum(self.start, self.end), np.maximum(self.start, self.end)
        near = ((highest >= low) & (lowest <= high)).all(axis=1)
        kept = np.zeros(len(self.height), bool)
        kept[self.building[near]] = True
        edges, row = kept[self.building], np.cumsum(kept) - 1
        return Footprints(
            self.start[edges],
            self.end[edges],
            row[self.building[edges]],
            self.height[kept],
            self.refused,
            self.attribution,
        )


def read_footprints(path: str | os.PathLike[str]) -> Footprints:
    """The buildings of a GeoJSON file (`.gz` too), polygons or multipolygons in metres.

    A building that cannot be built (no ring of three corners, an open or self-intersecting ring, a
    height that is missing or not above 0) is left out and counted by its reason.

    Raises:
        SourceNotFoundError: there is no such file.
        CorruptSourceError: it is no GeoJSON, or none of its buildings can be built.
        CrsError: its coordinates are degrees.
    """
    name = os.fspath(path)
    document = _document(name)
    rings: list[Float64] = []
    owner: list[int] = []
    holes: list[bool] = []
    heights: list[float] = []
    refused: Counter[str] = Counter()
    for polygon, properties in _polygons(document, name):
        height = _height(properties)
        reason = "no height" if height is None else "height not above 0" if height <= 0 else ""
        reason = reason or next((why for ring in polygon if (why := _fault(ring))), "")
        if reason:
            refused[reason] += 1
            continue
        for number, ring in enumerate(polygon):
            rings.append(ring[:-1])
            owner.append(len(heights))
            holes.append(number > 0)
        heights.append(height if height is not None else 0.0)
    _refuse_degrees(rings, name)
    crossed = {owner[ring] for ring in _self_intersecting(rings)}
    if crossed:
        refused["self-intersecting ring"] += len(crossed)
    found = _assembled(rings, owner, holes, heights, crossed, refused, document)
    if not len(found.height):
        raise CorruptSourceError(f"{name}: no building can be built; left out: {dict(refused)}")
    return found


def _document(name: str) -> dict[str, Any]:
    if not Path(name).is_file():
        raise SourceNotFoundError(f"{name}: no such file of footprints; check the path")
    try:
        raw = Path(name).read_bytes()
        document = json.loads(gzip.decompress(raw) if name.endswith(".gz") else raw)
    except (OSError, EOFError, ValueError) as error:
        raise CorruptSourceError(f"{name}: no GeoJSON can be read from it: {error}") from None
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise CorruptSourceError(f"{name}: expected a GeoJSON FeatureCollection with features")
    return document


def _polygons(
    document: dict[str, Any], name: str
) -> Iterator[tuple[list[Float64], dict[str, Any]]]:
    for number, feature in enumerate(document["features"]):
        try:
            geometry = feature["geometry"]
            kind, coordinates = geometry["type"], geometry["coordinates"]
            polygons = {"Polygon": [coordinates], "MultiPolygon": coordinates}.get(kind, [])
            for polygon in polygons:
                rings = [np.array(ring, np.float64).reshape(len(ring), -1) for ring in polygon]
                yield [ring[:, :2] for ring in rings], feature.get("properties") or {}
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptSourceError(f"{name}: feature {number} is no GeoJSON: {error}") from None


def _height(properties: dict[str, Any]) -> float | None:
    for key in HEIGHTS:
        value = properties.get(key)
        if isinstance(value, str):
            match = re.fullmatch(r"\s*(-?\d+(?:\.\d+)?)\s*m?\s*", value)
            value = float(match[1]) if match else None
        if isinstance(value, int | float) and np.isfinite(value):
            return float(value)
    return None


def _fault(ring: Float64) -> str:
    if ring.ndim != 2 or ring.shape[1] < 2 or not np.isfinite(ring).all():
        return "coordinates that are no numbers"
    if len(ring) < 4:
        return "fewer than three corners"
    return "" if (ring[0] == ring[-1]).all() else "open ring"


def _refuse_degrees(rings: list[Float64], name: str) -> None:
    if not rings:
        return
    corners = np.concatenate(rings)
    if (np.abs(corners) <= (180.0, 90.0)).all() and (np.ptp(corners, axis=0) < 2.0).all():
        raise CrsError(
            f"{name}: coordinates between {corners.min(axis=0)} and {corners.max(axis=0)} are "
            "degrees, not metres: project them first (for example: ogr2ogr -t_srs EPSG:6677)"
        )


def _self_intersecting(rings: list[Float64]) -> list[int]:
    """Rings of which two sides that are not neighbours cross, in groups of equal length."""
    by_length: dict[int, list[int]] = {}
    for number, ring in enumerate(rings):
        by_length.setdefault(len(ring), []).append(number)
    crossed: list[int] = []
    for length, members in by_length.items():
        a = np.stack([rings[number] for number in members])
        b = np.roll(a, -1, axis=1)
        bad = np.zeros(len(members), bool)
        for step in range(2, length // 2 + 1):
            c, d = np.roll(a, -step, axis=1), np.roll(b, -step, axis=1)
            cuts = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
            bad |= cuts.any(axis=1)
        crossed += [members[row] for row in np.flatnonzero(bad)]
    return sorted(crossed)


def _side(a: Float64, b: Float64, p: Float64) -> Float64:
    """On which side of the line a-b each p lies: +1 left, -1 right, 0 on it."""
    u, v = b - a, p - a
    sides: Float64 = np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
    return sides


def _assembled(
    rings: list[Float64],
    owner: list[int],
    holes: list[bool],
    heights: list[float],
    crossed: set[int],
    refused: Mapping[str, int],
    document: dict[str, Any],
) -> Footprints:
    kept = [building for building in range(len(heights)) if building not in crossed]
    row = {building: number for number, building in enumerate(kept)}
    starts: list[Float64] = [np.empty((0, 2))]
    ends: list[Float64] = [np.empty((0, 2))]
    buildings: list[Int64] = [np.empty(0, np.int64)]
    for ring, building, hole in zip(rings, owner, holes, strict=True):
        if building in crossed:
            continue
        following = np.roll(ring, -1, axis=0)
        local, next_local = ring - ring[0], following - ring[0]
        twice = float((local[:, 0] * next_local[:, 1] - local[:, 1] * next_local[:, 0]).sum())
        turned = (twice < 0) != hole
        starts.append(following if turned else ring)
        ends.append(ring if turned else following)
        buildings.append(np.full(len(ring), row[building]))
    return Footprints(
        np.concatenate(starts),
        np.concatenate(ends),
        np.concatenate(buildings),
        np.array([heights[building] for building in kept]),
        dict(refused),
        str(document.get("attribution", "")),
    )
