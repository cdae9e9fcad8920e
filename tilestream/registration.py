"""3D-NDT registration of a scan in the map (definitions, section 5).

A scan is preprocessed, the cells around it become a local map, and from every start Newton steps
are taken until one is short.
"""

import numpy as np
from numpy.typing import ArrayLike

from tilestream.errors import RegistrationError
from tilestream.grid import MM_PER_M
from tilestream.kernels.fixed_order import norms
from tilestream.kernels.registration import Aligned, Rule, align
from tilestream.kernels.slots import empty_slots
from tilestream.local_map import LocalCells, reach_of
from tilestream.matcher import RegistrationSettings
from tilestream.preprocessing import LEAST_POINTS, preprocessed
from tilestream.records import Cells, Float64, Int64, Registrations

LARGEST_SCAN = 10_000.0
"""Largest distance of a scan point from the lidar [m]; a farther one is in another frame."""
RIGID = 1e-4
"""How far R^T R of a start may be from the identity: poses are often written with 6 digits."""


def register(
    cells: Cells | LocalCells,
    scan_points: ArrayLike,
    T_map_lidar_starts: ArrayLike,
    settings: RegistrationSettings | None = None,
) -> Registrations:
    """Register a scan in the map by 3D-NDT from every start.

    The result of a start has the same bits on every run, whatever the other starts, their order and
    the order of the scan's points.

    Args:
        cells: cells of the map that cover the scan from every start, and 3 m more (how far the
            steps of a start can lead); others are ignored. `LocalCells`: those, listed once for
            many scans, with the same results.
        scan_points: (n, 3) points in the lidar frame [m], finite. What is done to them before is
            part of `settings` (`preprocessed`).
        T_map_lidar_starts: (k, 4, 4) start poses, or one (4, 4).
        settings: the matcher; default `RegistrationSettings()`.

    Raises:
        RegistrationError: fewer than 10 points, as given or as preprocessed; points or starts that
            are not finite; starts that are not rigid; no cells near the scan, or a start from which
            it hits none.
        UsageError: `LocalCells` of another matcher, or of a box that the scan can leave.
    """
    settings = settings or RegistrationSettings()
    points = preprocessed(_scan(scan_points), settings)
    starts = rigid_poses(T_map_lidar_starts, "start")
    around = _local(cells, points, starts, settings)
    local = around.lists
    corner = np.floor(starts[:, :3, 3] / local.edge).astype(np.int64)
    corner_m = corner * (local.edge * MM_PER_M) / MM_PER_M
    out = _nothing_yet(starts[:, :3, :3], starts[:, :3, 3] - corner_m)
    rule = Rule(
        settings.solver == "definite",
        settings.rotation == "euler",
        settings.step_max,
        settings.epsilon,
        settings.iterations_max,
    )
    seven = None if settings.neighbours == "direct1" else True
    limit = np.float32(local.reach**2) if local.reach else None
    slots = empty_slots(len(points), 7 if seven else 1, around.longest)
    in_lidar, buckets = np.ascontiguousarray(points.T), corner - around.origin
    align(in_lidar, buckets, local, rule, seven, limit, slots, out)
    if not out.hits.all():
        reach = reach_of(points, settings, around.cells.cell_size)
        around.require_near(starts[:, :3, 3], reach)
    _require_hits(out.hits, starts)
    T_map_lidar = starts.copy()
    T_map_lidar[:, :3, :3] = out.R
    T_map_lidar[:, :3, 3] = out.t + corner_m
    return Registrations(
        T_map_lidar=T_map_lidar,
        converged=out.converged,
        iterations=out.iterations,
        score=out.score,
        nvtl=out.best / len(points),
        hits=out.hits,
        hessian=out.hessian,
        points=len(points),
    )


def _scan(scan_points: ArrayLike) -> Float64:
    """(n, 3) the scan's points as float64 [m], checked.

    Raises:
        RegistrationError: another shape, too few, not finite, or too far away.
    """
    points = np.asarray(scan_points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        raise RegistrationError(
            f"the scan has shape {points.shape} and type {points.dtype}: "
            "give (n, 3) points in the lidar frame [m]"
        )
    points = points.astype(np.float64)
    if len(points) < LEAST_POINTS:
        raise RegistrationError(f"the scan has {len(points)} points: give at least {LEAST_POINTS}")
    broken = ~np.isfinite(points).all(axis=1)
    if broken.any():
        raise RegistrationError(
            f"{broken.sum()} of {len(points)} scan points are not finite, "
            f"the first at row {np.argmax(broken)}: leave them out"
        )
    reach = float(norms(points).max())
    if reach > LARGEST_SCAN:
        raise RegistrationError(
            f"a scan point lies {reach:.0f} m from the lidar: give points in the lidar frame"
        )
    return points


def rigid_poses(T: ArrayLike, name: str) -> Float64:
    """(k, 4, 4) poses as float64, from those or one (4, 4).

    Raises:
        RegistrationError: another shape, none, not finite, or not a rotation and a translation.
    """
    poses = np.asarray(T)
    if poses.dtype.kind not in "iuf" or poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise RegistrationError(f"{name}: shape {poses.shape}, give (k, 4, 4) poses or one (4, 4)")
    poses = poses.astype(np.float64).reshape(-1, 4, 4)
    if not len(poses):
        raise RegistrationError(f"{name}: no poses, give at least one")
    R = poses[:, :3, :3]
    finite = np.isfinite(poses).all(axis=(1, 2))
    with np.errstate(invalid="ignore", over="ignore"):
        skew = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
        rigid = (skew <= RIGID) & (np.linalg.det(R) > 0.0)
    rigid &= (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    for good, what in ((finite, "not finite"), (rigid, "not a rotation and a translation")):
        if not good.all():
            row = int(np.argmin(good))
            which = name if len(poses) == 1 else f"{name} {row} of {len(poses)}"
            raise RegistrationError(f"{which} is {what}:\n{poses[row]}")
    return poses


def _local(
    cells: Cells | LocalCells, points: Float64, starts: Float64, settings: RegistrationSettings
) -> LocalCells:
    """The cells that the scan can reach from the starts, listed for the matcher."""
    places = starts[:, :3, 3]
    if isinstance(cells, LocalCells):
        reach = reach_of(points, settings, cells.cells.cell_size)
        cells.require(places, reach, settings)
        return cells
    return LocalCells.around(cells, places, reach_of(points, settings, cells.cell_size), settings)


def _nothing_yet(R: Float64, t: Float64) -> Aligned:
    k = len(R)
    return Aligned(
        R=np.ascontiguousarray(R),
        t=np.ascontiguousarray(t),
        converged=np.zeros(k, np.bool_),
        iterations=np.zeros(k, np.int64),
        score=np.zeros(k),
        best=np.zeros(k),
        hits=np.zeros(k, np.int64),
        hessian=np.zeros((k, 6, 6)),
    )


def _require_hits(hits: Int64, starts: Float64) -> None:
    """RegistrationError where a start ends without a single hit: it has no gradient to follow."""
    lost = np.flatnonzero(hits == 0)
    if lost.size:
        place = ", ".join(f"{c:.1f}" for c in starts[lost[0], :3, 3])
        raise RegistrationError(
            f"the scan hits no cell from {lost.size} of {len(starts)} starts, "
            f"the first is row {lost[0]} at ({place}): the map has nothing there"
        )
