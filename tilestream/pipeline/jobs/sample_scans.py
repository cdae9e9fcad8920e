"""Which scans of a drive are its sample points, and which are taken beside them."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from tilestream.errors import UsageError
from tilestream.formats.logs import ScanLog, ScanSelection
from tilestream.formats.motion import along
from tilestream.pipeline.stages.drive_scans import Sample
from tilestream.records import LEAST_SPACING, Float64, Int64

BESIDE = 0.5
"""How far along the drive other scans of a sample point may be from it [m]."""


def choose_samples(
    log: ScanLog, scans: ScanSelection, spacing: float, per_point: int = 1
) -> tuple[Sample, ...]:
    """The scans of the sample points of a drive, the sample points in their order.

    A sample point is the scan nearest to a multiple of `spacing` [m] along the drive
    (`motion.along`). With `per_point` it has up to so many scans: those nearest to it along the
    drive within `BESIDE`, no scan at two sample points; the first is the sample point's own.

    Raises:
        UsageError: `spacing` is below 1 cm, `per_point` not 1 or more, or no scan with a pose is
            selected.
    """
    if per_point < 1:
        raise UsageError(f"scans_per_point is {per_point}: give at least 1")
    if not LEAST_SPACING <= spacing < np.inf:
        raise UsageError(f"spacing is {spacing!r}: give a length of {LEAST_SPACING} m or more")
    chosen = scans.indices(log.stamps_ns)
    chosen = chosen[log.posed[chosen]]
    if not len(chosen):
        raise UsageError(f"{log.path}: no scan with a pose is selected; {len(log)} scans are there")
    arc = along(log.T_map_lidar[chosen, :3, 3])
    places = np.arange(0.0, arc[-1] + 0.5 * spacing, spacing)
    after = np.clip(np.searchsorted(arc, places), 1, max(1, len(arc) - 1))
    nearer = places - arc[after - 1] <= arc[np.minimum(after, len(arc) - 1)] - places
    rows = np.unique(np.where(nearer, after - 1, np.minimum(after, len(arc) - 1)))
    return tuple(
        Sample(number, int(chosen[row]), int(log.stamps_ns[chosen[row]]), float(arc[row]))
        for number, of_point in enumerate(_beside(arc, rows, per_point))
        for row in of_point
    )


def _beside(arc: Float64, rows: Int64, per_point: int) -> Iterator[list[int]]:
    """For each sample point its row, and the rows of the other scans that are taken there.

    Args:
        arc: (k,) of the scans along the drive, not falling [m].
        rows: of the sample points, rising.
        per_point: scans of a sample point, at most.
    """
    scans = np.arange(len(arc))
    after = np.clip(np.searchsorted(rows, scans), 0, len(rows) - 1)
    before = np.maximum(after - 1, 0)

    def far(point: Int64) -> list[Any]:
        return [np.abs(arc - arc[rows[point]]), np.abs(scans - rows[point])]

    # of two sample points as near along the drive (where it stands) the one nearer in time
    (one, one_steps), (other, other_steps) = far(before), far(after)
    nearer = (one < other) | ((one == other) & (one_steps <= other_steps))
    owner = np.where(nearer, before, after)
    distance, steps = far(owner)
    for point, row in enumerate(rows.tolist()):
        own = np.flatnonzero((owner == point) & (distance <= BESIDE))
        nearest = own[np.lexsort((own, steps[own], distance[own]))]
        yield [row, *(scan for scan in nearest.tolist() if scan != row)][:per_point]
