"""The map and the estimates as a scene for Foxglove and rviz."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import TilestreamError
from tilestream.files import Files
from tilestream.formats.logs import Cloud, Marker, write_scene
from tilestream.records import Float64, Int64
from tilestream.report.colours import greys, height_range
from tilestream.report.data import Findings, estimates, interpolated
from tilestream.report.exports.labels import worst_labels
from tilestream.report.formatting import distance
from tilestream.report.measured import measure_of
from tilestream.report.segments import joined

MOST_POINTS = 500_000
"""Map points in the scene: 8 MB before compression."""
PREFIX = "/tilestream/"
"""Of the topics, so that the scene can be played beside a vehicle's own."""
PARENT = "world"
"""The frame of the coordinates of the map, in which the scene's frame `map` is."""
ROUND = 10.0
"""The origin is a multiple of this [m]."""
ROUTE, BETWEEN, WORST, CUBE, LETTERS = 0.6, 0.2, 1.6, 0.9, 1.4
"""Width of the route, and of it where estimates are interpolated, diameter of one of the worst
places, edge of a measured one, height of the letters [m]."""
RAISED = 3.0
"""How far above its place a text stands [m]."""
WHITE = np.full((1, 3), 255, np.uint8)
ABOUT_TOPICS = (
    "map: the map, thinned, grey by height; places: every place with estimate, low, high, measured "
    "[m], p_fail [1] and interpolated: 1 where it was not evaluated, else 0; route: the estimates "
    "as lines, thin where interpolated; worst: the worst places by number; measured: cubes by the "
    "error that was measured there"
)


def write_foxglove(file: Files, found: Findings) -> dict[str, Any]:
    """Write an MCAP of the topics `map` (where the map is there), `places`, `route`, `worst`
    and `measured` (where there are any) below `/tilestream`, in the colours of the report.

    Float32 would lose centimetres far from 0, and a viewer looks at 0 first: positions are relative
    to a round origin near the worst place. The static transform from `world`, the map's own
    coordinates, to `map` has it, and so has the file's metadata.

    Returns:
        What was written: `origin` [m]; `map_points`, and `without_map`: why there are none;
        `not_placed`: how many places have no position and are not in it.
    """
    at = found.places[["x", "y", "z"]].to_numpy(np.float64)
    placed = np.isfinite(at).all(axis=1)
    worst = {row: label for row, label in worst_labels(found).items() if placed[row]}
    origin = _origin(at[placed], at[list(worst)])
    points, why = _map(found)
    topics: dict[str, Cloud | list[Marker]] = {}
    if len(points):
        shades = np.round(255.0 * greys(points[:, 2], height_range(points[:, 2])))
        topics[PREFIX + "map"] = Cloud(points - origin, shades.astype(np.uint8))
    if placed.any():
        topics[PREFIX + "places"] = _places(found, placed, origin)
        topics[PREFIX + "route"] = list(_route(found, at - origin, placed))
    if worst:
        topics[PREFIX + "worst"] = list(_worst(found, at - origin, worst))
    measured = np.flatnonzero(np.isfinite(measure_of(found.places).measured) & placed)
    if len(measured):
        topics[PREFIX + "measured"] = [_cubes(found, at - origin, measured)]
    write_scene(
        file, topics, parent=PARENT, origin=tuple(origin.tolist()), about=_about(found, origin)
    )
    return {
        "origin": origin.tolist(),
        "map_points": len(points),
        "without_map": why,
        "not_placed": int((~placed).sum()),
    }


def _about(found: Findings, origin: Float64) -> dict[str, str]:
    """The metadata of the file."""
    x, y, z = origin.tolist()
    return {
        "title": found.title,
        "origin": f"positions are relative to x {x:.0f}, y {y:.0f}, z {z:.0f} m of the map",
        "crs": found.crs or "the map names no CRS",
        "worth": found.worth_told or "nobody has said what the estimates are worth",
        "topics": ABOUT_TOPICS,
        "edges_of_colours_cm": ", ".join(f"{100 * edge:.3g}" for edge in found.scale.edges),
    }


def _origin(at: Float64, worst: Float64) -> Float64:
    """(3,) a round place near the worst one, else near the middle of all [m]."""
    if not len(at):
        return np.zeros(3)
    near = worst[0] if len(worst) else np.median(at, axis=0)
    origin: Float64 = np.round(near / ROUND) * ROUND + 0.0  # no -0
    return origin


def _map(found: Findings) -> tuple[Float64, str]:
    """(n, 3) points of the map [m], and why there are none."""
    if found.map_points is None:
        return np.zeros((0, 3)), "the report was made without the map"
    try:
        points = found.map_points(MOST_POINTS)
    except TilestreamError as error:
        return np.zeros((0, 3)), str(error)
    return points, "" if len(points) else "the map has no points there"


def _places(found: Findings, placed: NDArray[np.bool_], origin: Float64) -> Cloud:
    part = found.places[placed]
    values = {
        name: part[name].to_numpy(np.float64) for name in ("estimate", "low", "high", "p_fail")
    }
    return Cloud(
        part[["x", "y", "z"]].to_numpy(np.float64) - origin,
        found.scale.rgb(estimates(part)),
        values
        | {"measured": measure_of(part).measured, "interpolated": interpolated(part).astype(float)},
    )


def _route(found: Findings, at: Float64, placed: NDArray[np.bool_]) -> Iterator[Marker]:
    """A line through each run of neighbours, thin and of a group of its own where they, or one of
    two, are interpolated.
    """
    rgb = found.scale.rgb(estimates(found.places))
    ids = found.places["route_id"].astype(str).to_numpy()
    there = joined(found.places) & placed[1:] & placed[:-1]
    between = interpolated(found.places)
    thin = between[1:] | between[:-1]  # the piece from each place to the next
    for pieces in np.split(np.arange(len(there)), np.flatnonzero(np.diff(thin + 2 * there)) + 1):
        if len(pieces) and there[pieces[0]]:
            rows = np.append(pieces, pieces[-1] + 1)
            name = f"{ids[rows[0]]}{', interpolated' if thin[pieces[0]] else ''}"
            width = BETWEEN if thin[pieces[0]] else ROUTE
            yield Marker("line", name, at[rows], rgb[rows], width)


def _worst(found: Findings, at: Float64, labels: Mapping[int, str]) -> Iterator[Marker]:
    """A ball at each of the worst places, and what is to be said of it above."""
    rows = list(labels)
    error = measure_of(found.places).known[rows]
    yield Marker("spheres", "places", at[rows], found.scale.rgb(error), WORST)
    up = np.array([[0.0, 0.0, RAISED]])
    for row, label in labels.items():
        place = found.places.iloc[row]
        told = [label]
        told += [f"{place['route_id']}, {distance(place['arc_length'])}"]
        told += [line for line in str(place["reason"] or "").split("; ") if line]
        text = "\n".join(told).replace("\u00a0", " ")
        yield Marker("text", "labels", at[[row]] + up, WHITE, LETTERS, text)


def _cubes(found: Findings, at: Float64, rows: Int64) -> Marker:
    rgb = found.scale.rgb(measure_of(found.places).measured[rows])
    return Marker("cubes", "measured", at[rows], rgb, CUBE)
