"""A recorded path cut where nobody drove: between two poses that are too far apart."""

from dataclasses import replace

import numpy as np

from tilestream.formats.motion import FASTEST, MOVED_M, along, jumped, vertices
from tilestream.formats.routes.base import Path3
from tilestream.kernels.fixed_order import norms

MANY = 20.0
"""A step so many times as long as the usual one is a gap in what was recorded, ..."""
PAUSE = 5.0
"""... if it also took so many times as long: without a pause it is the vehicle that is faster."""


def pieces(path: Path3, max_speed_mps: float = FASTEST) -> tuple[list[Path3], list[str]]:
    """The parts of a recorded path between its gaps, and notes on where it was cut.

    A gap is a step that no vehicle drives between its stamps (`motion.jumped`), or that is more
    than 20 times as long as the usual step (the median of those between vertices) after more than 5
    times the usual time; where there are no stamps, the length decides. A part in which the vehicle
    stands is left out, if there are others. A path that was drawn has no gaps.

    Args:
        path: a path in metres.
        max_speed_mps: fastest that a vehicle drives [m/s].
    """
    xyz = path.positions
    known = xyz[:, :2] if np.isnan(xyz[:, 2]).all() else xyz
    if not path.recorded or len(xyz) < 2 or not np.isfinite(known).all():
        return [path], []
    steps = norms(np.diff(known, axis=0))
    usual = norms(np.diff(known[vertices(known)], axis=0))
    gaps = steps > MANY * np.median(usual) if len(usual) else np.zeros(len(steps), dtype=bool)
    if path.stamps_s is not None:
        seconds = np.diff(path.stamps_s)
        gaps &= seconds > PAUSE * np.median(seconds)
        gaps |= jumped(steps, seconds, max_speed_mps)
    cuts = np.flatnonzero(gaps) + 1
    if not len(cuts):
        return [path], []
    parts = np.split(np.arange(len(xyz)), cuts)
    driven = [part for part in parts if along(known[part])[-1] >= MOVED_M] or parts
    (x, y), length = xyz[cuts[0] - 1, :2], steps[cuts[0] - 1]
    told = (
        f"route {path.route_id} is cut where nobody drove: at a gap of {length:.1f} m after "
        f"({x:.1f}, {y:.1f})" + (f", and at {len(cuts) - 1} more" if len(cuts) > 1 else "")
    )
    if standing := len(parts) - len(driven):
        told += f"; {standing} of {len(parts)} parts are left out, the vehicle stands in them"
    return [replace(path, positions=xyz[part], stamps_s=None) for part in driven], [told]
