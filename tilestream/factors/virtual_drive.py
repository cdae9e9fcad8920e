"""The virtual drive: where registrations of the virtual scan end (definitions, section 4.5).

The paper's label, with virtual scans in place of a real one: some of its 317 starts around the
sample point, spread and weighted so that they represent the whole disc. Where a registration ends
is random to a degree, so several scans are registered, each from other starts: the draws.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from tilestream.label import FAILED, disc_starts, start_errors
from tilestream.local_map import LocalCells
from tilestream.matcher import RegistrationSettings
from tilestream.moments import (
    AXES,
    autoware_scores,
    moment_columns,
    moments_of,
    score_columns,
    scores_of,
)
from tilestream.records import Cells, Column, Criterion, Float64, Int64
from tilestream.registration import register

RINGS = {"near": (0.0, 0.5, 1 / 4), "middle": (0.5, 0.75, 1 / 4), "far": (0.75, 1.0, 1 / 2)}
"""Rings of the disc of starts: inner and outer radius as shares of the disc's, and share of the
starts of a draw. The near one, within 1.0 m, makes the floor; far starts decide the tail."""
SOURCE = "definitions, section 4.5"
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Turn from one start to the next, so that any number of them is spread evenly [rad]; half of it
from the starts of one draw to those of the next."""


def _column(
    name: str,
    unit: str,
    meaning: str,
    source: str = SOURCE,
    kind: Criterion = "OB",
) -> Column:
    return Column(name, kind, unit, meaning, source, "observability")


PART_COLUMNS = (
    _column("vd_mean", "m", "Mean 3D error of the virtual drive, weighted by area."),
    _column("vd_floor", "m", "The same of the starts within 1.0 m: what no start helps."),
    _column("vd_tail", "m", "What the far starts add.", "vd_mean - vd_floor"),
    _column("vd_p_fail", "1", "Share of the disc whose starts end more than 0.5 m away."),
    _column("vd_along", "m", "Mean of abs(along), the error along the route."),
    _column("vd_across", "m", "Mean of abs(across), the error across the route."),
    _column("vd_up", "m", "Mean of abs(up), the error in map z."),
)
"""What a draw says; the table has the means over the draws."""
SPREAD_COLUMNS = tuple(
    _column(
        f"{part.name}_sd",
        part.unit,
        f"Standard deviation of {part.name} over the draws; NaN of one draw.",
        kind="place",
    )
    for part in PART_COLUMNS
)
MOMENT_COLUMNS = (
    *(
        column
        for ring in RINGS
        for column in moment_columns(
            f"vd_{ring}", f"starts of the {ring} ring, all draws,", "place", SOURCE, "observability"
        )
    ),
    *score_columns(
        "vd_near", "starts of the near ring, all draws,", "place", SOURCE, "observability"
    ),
)
"""Moments of the errors ring by ring, and scores: what a covariance is made of."""
COLUMNS = (
    *PART_COLUMNS,
    _column("vd_median", "m", "Median 3D error of those that do not fail. NaN: there are none."),
    _column("vd_draws", "1", "Draws: scans that could be registered.", kind="place"),
    *SPREAD_COLUMNS,
    *MOMENT_COLUMNS,
)


@dataclass(frozen=True, eq=False)
class Starts:
    """Some of the paper's 317 starts."""

    offset: Float64
    """(k, 2) in map x and y [m]."""
    weight: Float64
    """(k,) share of the disc that each represents; their sum is 1."""
    ring: Int64
    """(k,) number of its ring in `RINGS`."""


def stratified_starts(count: int | None = 32, draw: int = 0) -> Starts:
    """Starts that are spread evenly over each of three rings of their disc.

    Args:
        count: how many, 8 or more; None, or as many as there are: all of them.
        draw: another number gives others.
    """
    disc = disc_starts()
    radius = np.hypot(disc[:, 0], disc[:, 1])
    whole = float(radius.max())
    edges = [outer * whole + 1e-9 for _, outer, _ in RINGS.values()]
    ring = np.searchsorted(edges, radius)
    if count is None or count >= len(disc):
        return Starts(disc, np.full(len(disc), 1.0 / len(disc)), ring)
    chosen, weights = [], []
    for number, (inner, outer, share) in enumerate(RINGS.values()):
        rows = np.flatnonzero(ring == number)
        wanted = min(max(round(share * count), 1), len(rows))
        weights.append(np.full(wanted, len(rows) / len(disc) / wanted))
        pairs = (wanted + 1) // 2
        step = np.arange(pairs)
        area = inner**2 + (outer**2 - inner**2) * (step + 0.5) / pairs
        spiral = whole * np.sqrt(area) * np.exp(1j * GOLDEN_ANGLE * (step + 0.5 * draw))
        for goal in np.column_stack([spiral, -spiral]).ravel()[:wanted]:
            nearest = int(np.argmin(np.abs(disc[rows] @ (1.0, 1.0j) - goal)))
            chosen.append(rows[nearest])
            rows = np.delete(rows, nearest)
    return Starts(disc[chosen], np.concatenate(weights), ring[chosen])


@dataclass(frozen=True, eq=False)
class Ends:
    """Where the registrations of one scan end: a draw of the virtual drive."""

    starts: Starts
    """Where they started."""
    error: Float64
    """(k,) 3D errors [m]."""
    axes: Float64
    """(k, 6) signed errors, `AXES` [m, rad]."""
    nvtl: Float64
    """(k,) NVTL at the end, as Autoware says it."""
    tp: Float64
    """(k,) transform probability at the end."""


def ends_of(
    cells: Cells | LocalCells,
    points: Float64,
    T_map_lidar: Float64,
    settings: RegistrationSettings,
    starts: Starts,
) -> Ends:
    """Where a scan's registrations end.

    Args:
        cells: the map around the place.
        points: (n, 3) the virtual scan, in the lidar frame [m].
        T_map_lidar: (4, 4) the place from which it was taken.
        settings: the matcher.
        starts: where they start.

    Raises:
        RegistrationError: as `register`.
    """
    poses = np.repeat(T_map_lidar[None], len(starts.offset), axis=0)
    poses[:, :2, 3] += starts.offset
    found = register(cells, points, poses, settings)
    errors = start_errors(T_map_lidar, found.T_map_lidar)
    axes = np.column_stack([errors[axis] for axis in AXES])
    scores = autoware_scores(found.nvtl, found.score, found.hits, found.points)
    return Ends(starts, errors["error"], axes, *scores)


def virtual_drive(drives: Sequence[Ends]) -> dict[str, float]:
    """What draws say together, in the columns of `COLUMNS`; at least one."""
    said = pd.DataFrame([_parts(one) for one in drives])
    spread = said[[column.name for column in PART_COLUMNS]].std(ddof=1)
    return {
        **{str(name): float(value) for name, value in said.mean().items()},
        "vd_draws": float(len(drives)),
        **{f"{name}_sd": float(value) for name, value in spread.items()},
        **_moments(drives),
    }


def _parts(ends: Ends) -> dict[str, float]:
    """What a draw says."""
    weight, error = ends.starts.weight, ends.error
    near = ends.starts.ring == 0
    mean = float(weight @ error)
    floor = float(weight[near] @ error[near] / weight[near].sum())
    held = error <= FAILED
    along, across, up = weight @ np.abs(ends.axes[:, :3])
    return {
        "vd_mean": mean,
        "vd_floor": floor,
        "vd_tail": mean - floor,
        "vd_p_fail": float(weight @ ~held),
        "vd_median": weighted_median(error[held], weight[held]),
        "vd_along": float(along),
        "vd_across": float(across),
        "vd_up": float(up),
    }


def _moments(drives: Sequence[Ends]) -> dict[str, float]:
    """`MOMENT_COLUMNS`, all starts of a ring alike."""
    axes = np.vstack([one.axes for one in drives])
    ring, error, nvtl, tp = (
        np.concatenate(parts)
        for parts in zip(*((d.starts.ring, d.error, d.nvtl, d.tp) for d in drives), strict=True)
    )
    held = error <= FAILED
    found: dict[str, float] = {}
    for number, name in enumerate(RINGS):
        here = ring == number
        found |= moments_of(f"vd_{name}", axes[here], held[here])
    near = ring == 0
    return found | scores_of("vd_near", nvtl[near], tp[near], held[near])


def weighted_median(values: Float64, weight: Float64) -> float:
    """The smallest value up to which half of the weight lies; NaN of nothing."""
    if not len(values):
        return math.nan
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(up_to, 0.5 * up_to[-1])])
