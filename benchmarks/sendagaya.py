"""Clip a second district out of the real buildings of Shinjuku and lay three routes through it.

    python benchmarks/sendagaya.py BUILDINGS.geojson.gz OUT

Writes OUT/sendagaya_buildings.geojson.gz and OUT/sendagaya_routes.geojson, the package's own files
in tilestream/data: a district of low houses south-east of the paper's, that a model which was
trained there has never seen. The waypoints are ours; the ways between them keep clear of the real
buildings.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("buildings", type=Path, help="../shared/data/shinjuku/buildings_local_m…")
    parser.add_argument("out", type=Path, help="the folder to write to")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import gzip
import json
from typing import Any

import numpy as np

from tilestream.simulation.city import MARGIN
from tilestream.simulation.footprints import read_footprints
from tilestream.simulation.free_space import clearance, free_space, route_between
from tilestream.simulation.streets import Street, check_clear

ROUTES = (
    ("avenue", "a street of two lanes", 420,
     ((640, -1050), (700, -1150), (770, -1290), (808, -1400), (825, -1480)), ()),
    ("cross", "a narrow street", 290,
     ((700, -1055), (850, -1085), (1000, -1150)), (("narrow", 60, 280, "right"),)),
    ("rail", "a wide road beside a railway", 380,
     ((720, -905), (900, -915), (1040, -915), (1120, -920)),
     (("furnished", 60, 200, "right"), ("one-sided", 220, 370, "left"))),
)  # fmt: skip
"""Name, what sort of street it is, sample points, waypoints [m], spots."""
SPOT = ("kind", "begin", "end", "side")
ATTRIBUTION = (
    "Buildings: 3D city model, Project PLATEAU (Ministry of Land, "
    "Infrastructure, Transport and Tourism, Japan), via indigo-lab/plateau-lod2-mvt, CC BY 4.0, "
    "https://creativecommons.org/licenses/by/4.0/; clipped and projected to local metres."
)


def main(given: argparse.Namespace) -> None:
    """Lay the routes, check their clearance exactly, keep the buildings around them."""
    buildings = read_footprints(given.buildings)
    space = free_space(buildings)
    features, around = [], []
    for name, kind, points, waypoints, spots in ROUTES:
        xy = np.round(route_between(space, np.array(waypoints, np.float64), points), 3)
        check_clear(Street(name, kind, xy, True), buildings)
        clear = clearance(xy, buildings)
        print(f"{name}: {len(xy)} points, clearance {clear.min():.2f} to {clear.max():.1f} m")
        told = [dict(zip(SPOT, spot, strict=True)) for spot in spots]
        properties = {"name": name, "kind": kind, "driven": True, "spots": told}
        geometry = {"type": "LineString", "coordinates": xy.tolist()}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
        around.append(xy)
    routes = {"type": "FeatureCollection", "name": "sendagaya routes", "features": features}
    (given.out / "sendagaya_routes.geojson").write_text(json.dumps(routes) + "\n")
    _clip(given, np.concatenate(around))


def _clip(given: argparse.Namespace, near: Any) -> None:
    whole = json.loads(gzip.decompress(given.buildings.read_bytes()))
    kept = []
    for feature in whole["features"]:
        corners = np.asarray(feature["geometry"]["coordinates"][0], np.float64)[:, :2]
        away = np.hypot(*(corners[:, None] - near).transpose(2, 0, 1))
        if away.min() <= MARGIN:
            kept.append(feature)
    document = {
        "type": "FeatureCollection",
        "name": "sendagaya",
        "attribution": ATTRIBUTION,
        "note": whole["note"],
        "features": kept,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    path = given.out / "sendagaya_buildings.geojson.gz"
    path.write_bytes(gzip.compress(text, 9, mtime=0))
    print(f"{len(kept)} of {len(whole['features'])} buildings: {path}")


if __name__ == "__main__":
    main(GIVEN)
