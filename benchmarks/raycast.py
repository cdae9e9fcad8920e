"""Rays cast by Embree's own binding and by Open3D: do they meet the same, and what do they cost?

python benchmarks/raycast.py [--preset paper] [--path I] [--point 100] [--metres 50] [--rounds 7]

Both cast the same turns of the lidar at the same stretch of street, one after the other in every
round. Times are CPU times of the process with all its threads, medians over the rounds.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--path", default="I")
    parser.add_argument("--point", type=int, default=100, help="where the stretch begins [m]")
    parser.add_argument("--metres", type=int, default=50, help="length of the stretch")
    parser.add_argument("--rounds", type=int, default=7)
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import time

import numpy as np

from tilestream.simulation.city import build_city
from tilestream.simulation.lidar import turn_of
from tilestream.simulation.raycast import Embree, Open3D
from tilestream.simulation.settings import load_preset

CASTERS: dict[str, type[Embree | Open3D]] = {"embreex": Embree, "Open3D": Open3D}


def main(given: argparse.Namespace) -> None:
    """Build, cast, compare, print."""
    settings = load_preset(given.preset)
    city = build_city(settings)
    street = city.street(given.path)
    xy = street.xy[given.point : given.point + given.metres]
    origin = np.array([*xy[0], 0.0])
    corners = (city.scene(xy, 1).corners - origin).astype(np.float32)
    lidar = np.column_stack([xy, city.ground.at(xy) + settings.lidar.height]) - origin
    turn = turn_of(settings.lidar.model).direction.astype(np.float32)
    starts = [np.tile(place, (len(turn), 1)).astype(np.float32) for place in lidar]
    print(f"{len(corners):,} triangles, {len(starts)} turns of {len(turn):,} rays")

    seconds: dict[tuple[str, str], list[float]] = {}
    hits = {}
    for _ in range(given.rounds):
        for name, kind in CASTERS.items():
            began = time.process_time()
            caster = kind(corners)
            caster.cast(starts[0][:1], turn[:1])  # the tree is built at the first ray
            built = time.process_time()
            hits[name] = [caster.cast(start, turn) for start in starts]
            cast = (time.process_time() - built) / len(starts)
            for step, took in (("build", built - began), ("turn", cast)):
                seconds.setdefault((name, step), []).append(took)
    print("| CPU ms, median (least, largest) | embreex | Open3D | ratio of medians |")
    print("|---|---|---|---|")
    for step in ("build", "turn"):
        ours, others = (1000 * np.array(seconds[name, step]) for name in CASTERS)
        told = " | ".join(
            f"{np.median(t):.1f} ({t.min():.1f}, {t.max():.1f})" for t in (ours, others)
        )
        print(f"| {step} | {told} | {np.median(ours) / np.median(others):.2f} |")

    (reach, number, normal), (others_reach, others_number, others_normal) = (
        [np.concatenate(part) for part in zip(*hits[name], strict=True)] for name in CASTERS
    )
    both = (number >= 0) & (others_number >= 0)
    same = both & (number == others_number)
    apart = np.abs(reach[both].astype(float) - others_reach[both])
    ours, others = (
        part[same] / np.linalg.norm(part[same].astype(float), axis=1, keepdims=True)
        for part in (normal, others_normal)
    )
    turned = np.linalg.norm(np.cross(ours, others), axis=1).max()
    print(
        f"\nmet by embreex {np.mean(number >= 0):.4f}, by Open3D {np.mean(others_number >= 0):.4f}"
    )
    print(f"rays that meet another triangle, or nothing: {np.sum(number != others_number)}")
    print(f"ranges apart: at most {1e6 * apart.max():.1f} um, same bits {np.mean(apart == 0):.6f}")
    print(f"normals apart: at most {turned:.1e} rad")


if __name__ == "__main__":
    main(GIVEN)
