"""What the simulation costs: seconds per scan and per 100 m of survey, one core.

python benchmarks/simulate.py [--preset physical] [--path I] [--point 100] [--metres 50]
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="physical")
    parser.add_argument("--path", default="I")
    parser.add_argument("--point", type=int, default=100, help="where the stretch begins [m]")
    parser.add_argument("--metres", type=int, default=50, help="length of the stretch")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import resource
import time

import numpy as np

from tilestream.simulation.city import build_city
from tilestream.simulation.drive import scans
from tilestream.simulation.settings import load_preset
from tilestream.simulation.survey import survey


def main(given: argparse.Namespace) -> None:
    """Time the parts of one stretch of street; the least of three runs each."""
    began = time.perf_counter()
    city = build_city(load_preset(given.preset))
    print(f"city: {time.perf_counter() - began:.1f} s, {len(city.footprints.height)} buildings")
    street, span = city.street(given.path), (given.point, given.point + given.metres)
    seconds: dict[str, list[float]] = {"scene": [], "scans": [], "survey": []}
    for _ in range(3):
        began = time.perf_counter()
        triangles = len(city.scene(street.xy[slice(*span)], 0))
        seconds["scene"].append(time.perf_counter() - began)
        began = time.perf_counter()
        returns = [len(scan.points) for scan in scans(city, street, range(*span))]
        seconds["scans"].append(time.perf_counter() - began)
        began = time.perf_counter()
        points = len(survey(city, street, span, 0))
        seconds["survey"].append(time.perf_counter() - began)
    scene, scanned, surveyed = (min(seconds[name]) for name in ("scene", "scans", "survey"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    print(f"scene of {given.metres} m: {scene:.2f} s, {triangles:,} triangles, peak {peak:.0f} MB")
    print(
        f"scan: {1000 * (scanned - scene) / given.metres:.1f} ms and the scene's share, "
        f"{np.mean(returns):.0f} returns"
    )
    per_100 = 100 / given.metres
    print(f"survey: {per_100 * surveyed:.1f} s per 100 m and pass, {per_100 * points:,.0f} points")


if __name__ == "__main__":
    main(GIVEN)
