"""The virtual drive: where registrations of the virtual scan end (definitions, section 4.5).

The paper's label, with the virtual scan in place of a real one: some of its 317 starts around the
sample point, spread and weighted so that they represent the whole disc.
"""

import math

import numpy as np

from tilestream.label import FAILED, NEAR, disc_starts, start_errors
from tilestream.matcher import RegistrationSettings
from tilestream.records import Cells, Column, Float64
from tilestream.registration import register

STRATA = ((0.0, 0.5, 1.0 / 8.0), (0.5, 0.75, 1.0 / 4.0), (0.75, 1.0, 5.0 / 8.0))
"""Rings of the disc of starts: inner and outer radius as shares of the disc's, and share of the
starts. Far starts decide the tail."""
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Turn from one start to the next, so that any number of them is spread evenly [rad]."""


def _column(name: str, unit: str, meaning: str, source: str = "definitions, section 4.5") -> Column:
    return Column(name, "OB", unit, meaning, source, "observability")


COLUMNS = (
    _column("vd_mean", "m", "Mean 3D error of the virtual drive, weighted by area."),
    _column("vd_floor", "m", "The same of the starts within 1.0 m: what no start helps."),
    _column("vd_tail", "m", "What the far starts add.", "vd_mean - vd_floor"),
    _column("vd_p_fail", "1", "Share of the disc whose starts end more than 0.5 m away."),
    _column("vd_median", "m", "Median 3D error of the others. NaN: there are none."),
    _column("vd_along", "m", "Mean of abs(along), the error along the route."),
    _column("vd_across", "m", "Mean of abs(across), the error across the route."),
    _column("vd_up", "m", "Mean of abs(up), the error in map z."),
)


def stratified_starts(count: int | None = 64) -> tuple[Float64, Float64]:
    """Some of the paper's 317 starts, spread evenly over each of three rings of their disc.

    Args:
        count: how many, 8 or more; None, or as many as there are: all of them.

    Returns:
        (k, 2) offsets in map x and y [m], and (k,) weights that sum to 1: the share of the disc's
        starts that each represents.
    """
    disc = disc_starts()
    if count is None or count >= len(disc):
        return disc, np.full(len(disc), 1.0 / len(disc))
    radius = np.hypot(disc[:, 0], disc[:, 1])
    whole = float(radius.max())
    chosen, weights = [], []
    for inner, outer, share in STRATA:
        ring = (radius > inner * whole + 1e-9) | (inner == 0.0)
        rows = np.flatnonzero(ring & (radius <= outer * whole + 1e-9))
        wanted = min(max(round(share * count), 1), len(rows))
        pairs = (wanted + 1) // 2
        step = np.arange(pairs)
        area = inner**2 + (outer**2 - inner**2) * (step + 0.5) / pairs
        spiral = whole * np.sqrt(area) * np.exp(1j * GOLDEN_ANGLE * step)
        for goal in np.column_stack([spiral, -spiral]).ravel()[:wanted]:
            away = np.abs(disc[rows] @ (1.0, 1.0j) - goal)
            nearest = int(np.argmin(away))
            chosen.append(rows[nearest])
            rows = np.delete(rows, nearest)
        weights.append(np.full(wanted, (len(rows) + wanted) / len(disc) / wanted))
    return disc[chosen], np.concatenate(weights)


def virtual_drive(
    cells: Cells,
    points: Float64,
    T_map_lidar: Float64,
    settings: RegistrationSettings,
    starts: tuple[Float64, Float64],
) -> dict[str, float]:
    """Where a scan's registrations end, in the columns of `COLUMNS`.

    Args:
        cells: the map around the place.
        points: (n, 3) the virtual scan, in the lidar frame [m].
        T_map_lidar: (4, 4) the place from which it was taken.
        settings: the matcher.
        starts: offsets and weights, see `stratified_starts`.

    Raises:
        RegistrationError: as `register`.
    """
    offsets, weight = starts
    poses = np.repeat(T_map_lidar[None], len(offsets), axis=0)
    poses[:, :2, 3] += offsets
    errors = start_errors(T_map_lidar, register(cells, points, poses, settings).T_map_lidar)
    error = errors["error"]
    near = np.hypot(offsets[:, 0], offsets[:, 1]) <= NEAR + 1e-9
    floor = float(weight[near] @ error[near] / weight[near].sum())
    held = error <= FAILED
    return {
        "vd_mean": float(weight @ error),
        "vd_floor": floor,
        "vd_tail": float(weight @ error) - floor,
        "vd_p_fail": float(weight @ ~held),
        "vd_median": weighted_median(error[held], weight[held]),
        "vd_along": float(weight @ np.abs(errors["along"])),
        "vd_across": float(weight @ np.abs(errors["across"])),
        "vd_up": float(weight @ np.abs(errors["up"])),
    }


def weighted_median(values: Float64, weight: Float64) -> float:
    """The smallest value up to which half of the weight lies; NaN of nothing."""
    if not len(values):
        return math.nan
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(up_to, 0.5 * up_to[-1])])
