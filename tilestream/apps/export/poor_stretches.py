"""Stretches of road on which a filter should not rely on registrations, as areas."""

from typing import Any

import numpy as np
import pandas as pd
from pyproj import CRS

from tilestream.records import Float64, Int64
from tilestream.report.exports.geometry import as_geojson_has
from tilestream.report.segments import reaches, stretches

BESIDE = 5.0
"""How far an area reaches to each side of its route, and beyond both ends [m]."""
SLACK = 1e-6
"""Rounding of what lies on the rim of an area [m]."""
SHARPEST = 0.5
"""1 + the cosine of the sharpest bend whose corner is not cut off."""


def poor_stretches(places: pd.DataFrame, threshold: float, lost: float) -> list[Int64]:
    """Rows of each stretch whose estimate or share of lost registrations is too large, with what it
    bridges (`report.segments.stretches`).

    Args:
        places: in order along each route: `route_id`, `sample`, `arc_length`, `estimate`, `p_lost`.
        threshold: of the estimate [m].
        lost: of `p_lost`.
    """
    poor = (places["estimate"] > threshold) | (places["p_lost"] > lost)
    return stretches(places, np.flatnonzero(poor))


def areas(places: pd.DataFrame, rows: list[Int64], crs: CRS | None) -> dict[str, Any]:
    """Stretches as a GeoJSON collection of polygons; `ring` of each has its corners in the map
    frame [m].

    Args:
        places: as `poor_stretches`, with `heading`, `x`, `y`.
        rows: of each stretch.
        crs: of the map; None: the polygons are in its metres.

    Raises:
        CrsError: PROJ knows no way from the CRS to degrees.
    """
    reach, features = reaches(places), []
    _, coordinates = as_geojson_has(np.zeros((0, 2)), crs)
    for part in rows:
        here = places.iloc[part]
        ring = area(here[["x", "y"]].to_numpy(np.float64), here["heading"].to_numpy(np.float64))
        shown, _ = as_geojson_has(ring, crs)
        told = {
            "route": str(here["route_id"].iloc[0]),
            "begin_m": float(here["arc_length"].iloc[0]),
            "end_m": float(here["arc_length"].iloc[-1]),
            "length_m": float(reach[part].sum()),
            "estimate_max_m": float(here["estimate"].max()),
            "p_lost_max": float(here["p_lost"].max()),
            "ring": ring.round(3).tolist(),
        }
        polygon = {"type": "Polygon", "coordinates": [shown.round(9).tolist()]}
        features.append({"type": "Feature", "properties": told, "geometry": polygon})
    return {
        "type": "FeatureCollection",
        "name": "poor_stretches",
        "coordinates": coordinates,
        "features": features,
    }


def area(at: Float64, heading: Float64) -> Float64:
    """(k, 2) the ring round a line, `BESIDE` to each side of it and beyond its ends [m]: closed,
    counterclockwise.

    Corners that would lie nearer to the line, on the inside of a bend, are left out.

    Args:
        at: (n, 2) the line [m].
        heading: (n,) its direction at each point, from the x axis [rad]: where it goes on.
    """
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    line = np.vstack([at[0] - BESIDE * ahead[0], at, at[-1] + BESIDE * ahead[-1]])
    way = np.diff(line, axis=0)
    left = way[:, ::-1] * [-1.0, 1.0] / np.hypot(*way.T)[:, None]  # of each piece
    before, behind = np.vstack([left[:1], left]), np.vstack([left, left[-1:]])
    turn = np.maximum(1.0 + (before * behind).sum(axis=1), SHARPEST)
    away = BESIDE * (before + behind) / turn[:, None]  # as far from both pieces
    sides = [line - away, (line + away)[::-1]]
    ring = np.vstack([side[_distances(side, at) >= BESIDE - SLACK] for side in sides])
    return np.vstack([ring, ring[:1]])


def _distances(points: Float64, line: Float64) -> Float64:
    """(k,) from points to a line of straight pieces [m]."""
    begin, way = line[:-1], np.diff(line, axis=0)
    if not len(way):
        begin, way = line, np.zeros((1, 2))
    square = np.maximum((way**2).sum(axis=1), 1e-12)
    from_begin = points[:, None, :] - begin[None]
    along = np.clip((from_begin * way).sum(axis=2) / square, 0.0, 1.0)
    away = np.hypot(*np.moveaxis(from_begin - along[..., None] * way, 2, 0))
    nearest: Float64 = away.min(axis=1)
    return nearest
