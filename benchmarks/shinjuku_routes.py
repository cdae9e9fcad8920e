"""Lay the routes of the simulated Shinjuku through its streets.

    python benchmarks/shinjuku_routes.py FOLDER

The package's own files are in tilestream/data: shinjuku_routes.geojson, and demo_routes.geojson,
600 m of path I with a crossing, a bridge and a tunnel. The waypoints are ours; the ways between
them keep clear of the real buildings.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder to write to")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from typing import Any

import numpy as np

import tilestream
from tilestream.simulation.footprints import read_footprints
from tilestream.simulation.free_space import clearance, free_space, route_between
from tilestream.simulation.streets import Street, check_clear

DATA = Path(tilestream.__file__).parent / "data"
ROUTES = (
    (
        "I",
        "narrow shopping streets, wide roads with hedges and trees, skyscrapers",
        1163,
        (
            (-40, -85),
            (-40, -12),
            (2, -10),
            (2, 62),
            (-45, 62),
            (-88, 100),
            (-96, 148),
            (-225, 135),
            (-350, 112),
            (-540, 84),
            (-590, 110),
            (-630, 280),
            (-668, 380),
            (-675, 500),
            (-680, 640),
        ),
    ),
    (
        "II",
        "narrow road, wide pavements with bollards, lamp posts and trees, skyscrapers",
        734,
        (
            (-90, -170),
            (-92, -30),
            (-195, -22),
            (-212, 40),
            (-240, 150),
            (-262, 290),
            (-340, 335),
            (-480, 312),
            (-560, 290),
        ),
    ),
    (
        "III",
        "residential street, a short tunnel at its beginning, trees all along the other side",
        269,
        ((-742, -290), (-766, -150), (-790, -50), (-830, 20)),
    ),
    (
        "IV",
        "narrow and dense shopping streets",
        652,
        (
            (600, 700),
            (585, 618),
            (512, 630),
            (482, 560),
            (450, 490),
            (390, 510),
            (393, 590),
            (430, 598),
            (440, 650),
            (455, 672),
            (545, 624),
        ),
    ),
    (
        "V",
        "narrow shopping street, multi-lane roads, skyscrapers, under several bridges",
        794,
        ((85, 680), (110, 600), (148, 475), (200, 462), (300, 465), (470, 412), (770, 320)),
    ),
    ("E1", "mapped only: shopping street", None, ((660, 160), (560, 225), (450, 285))),
    ("E2", "mapped only: wide road", None, ((-220, 475), (-420, 560), (-620, 640))),
)
SPOTS = {
    "I": [
        ("narrow", 0, 200, "right"),
        ("furnished", 290, 420, "right"),
        ("crossing", 470, 530, "right"),
        ("bridge", 560, 586, "right"),
        ("tunnel", 640, 797, "right"),
        ("crossing", 850, 905, "right"),
        ("one-sided", 930, 1060, "left"),
        ("bridge", 1085, 1110, "right"),
    ],
    "II": [
        ("furnished", 0, 330, "right"),
        ("bridge", 250, 272, "right"),
        ("crossing", 385, 440, "right"),
        ("one-sided", 470, 620, "left"),
        ("bridge", 680, 700, "right"),
    ],
    "III": [("tunnel", 2, 72, "right"), ("one-sided", 90, 268, "right")],
    "IV": [("narrow", 0, 651, "right")],
    "V": [
        ("narrow", 0, 200, "right"),
        ("bridge", 262, 284, "right"),
        ("bridge", 292, 318, "right"),
        ("crossing", 322, 372, "right"),
        ("bridge", 440, 462, "right"),
        ("bridge", 742, 770, "right"),
        ("tunnel", 566, 726, "right"),
        ("wide", 372, 560, "right"),
    ],
    "E1": [("narrow", 0, 100, "right")],
    "E2": [("one-sided", 100, 240, "left"), ("bridge", 300, 330, "right")],
}
NAMES = ("kind", "begin", "end", "side")
DEMO = (230, 831)
"""Sample points of path I that the demo drives along."""


def main(given: argparse.Namespace) -> None:
    """Lay all routes, check their clearance exactly, and write them."""
    buildings = read_footprints(DATA / "shinjuku_buildings.geojson.gz")
    space = free_space(buildings)
    features = []
    for name, kind, points, waypoints in ROUTES:
        xy = np.round(route_between(space, np.array(waypoints, np.float64), points), 3)
        check_clear(Street(name, kind, xy, points is not None), buildings)
        clear = clearance(xy, buildings)
        print(f"{name}: {len(xy)} points, clearance {clear.min():.2f} to {clear.max():.1f} m")
        spots = [dict(zip(NAMES, spot, strict=True)) for spot in SPOTS[name]]
        properties = {"name": name, "kind": kind, "driven": points is not None, "spots": spots}
        geometry = {"type": "LineString", "coordinates": xy.tolist()}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    write(given.folder / "shinjuku_routes.geojson", "shinjuku routes", features)
    write(given.folder / "demo_routes.geojson", "demo route", [cut(features[0], *DEMO)])


def write(path: Path, name: str, features: list[dict[str, Any]]) -> None:
    """Write a file of routes."""
    document = {"type": "FeatureCollection", "name": name, "features": features}
    path.write_text(json.dumps(document) + "\n")


def cut(route: dict[str, Any], begin: int, end: int) -> dict[str, Any]:
    """A stretch of a route, with those of its spots that lie within."""
    spots = [
        {**spot, "begin": spot["begin"] - begin, "end": spot["end"] - begin}
        for spot in route["properties"]["spots"]
        if begin <= spot["begin"] and spot["end"] < end
    ]
    line = {"type": "LineString", "coordinates": route["geometry"]["coordinates"][begin:end]}
    return {**route, "properties": {**route["properties"], "spots": spots}, "geometry": line}


if __name__ == "__main__":
    main(GIVEN)
