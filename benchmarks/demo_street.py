"""Makes the small street that ships with tilestream: `python benchmarks/demo_street.py`.

A canyon that opens into a crossing, composed from the same surfaces as the scenes of the tests.
"""

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from scenes import PLACES, in_map  # noqa: E402 - the scenes live beside the tests

from tilestream.formats.las import write_las  # noqa: E402

SPACING = 0.2
"""Distance between points [m]."""
LENGTH = 60.0
"""Length of each place [m]."""


def demo_street() -> np.ndarray:
    """(n, 3) points of the street [m]."""
    rng = np.random.default_rng(20)
    parts = [
        in_map(PLACES[name](rng, LENGTH, SPACING), (LENGTH * number, 0.0, 0.0))
        for number, name in enumerate(("canyon", "crossing"))
    ]
    return np.vstack(parts)


if __name__ == "__main__":
    target = ROOT / "tilestream" / "data" / "street.laz"
    points = demo_street()
    write_las(target, points)
    print(f"{target}: {len(points):,} points, {target.stat().st_size:,} bytes")
