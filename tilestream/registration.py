"""3D-NDT registration of a scan in the map (definitions, section 5).

A scan is preprocessed, the cells around it become a local map, and from every start Newton steps
are taken until one is short.
"""

import logging
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.errors import RegistrationError
from tilestream.grid import MM_PER_M
from tilestream.kernels.density import magnusson_constants
from tilestream.kernels.fixed_order import norms
from tilestream.kernels.neighbour_lists import neighbour_lists
from tilestream.kernels.registration import Aligned, LocalMap, Rule, align
from tilestream.kernels.slots import empty_slots
from tilestream.matcher import RegistrationSettings
from tilestream.preprocessing import LEAST_POINTS, preprocessed
from tilestream.records import Cells, Float64, Int64, Registrations

LARGEST_SCAN = 10_000.0
"""Largest distance of a scan point from the lidar [m]; a farther one is in another frame."""
RIGID = 1e-4
"""How far R^T R of a start may be from the identity: poses are often written with 6 digits."""
MAX_BUCKETS = 2**27
"""Most buckets of the dense grid around a scan: 4 bytes each, half a gigabyte."""

_log = logging.getLogger(__name__)


def register(
    cells: Cells,
    scan_points: ArrayLike,
    T_map_lidar_starts: ArrayLike,
    settings: RegistrationSettings | None = None,
) -> Registrations:
    """Register a scan in the map by 3D-NDT from every start.

    The result of a start has the same bits on every run, whatever the other starts, their order and
    the order of the scan's points.

    Args:
        cells: cells of the map that cover the scan from every start, and 3 m more (how far the
            steps of a start can lead); others are ignored.
        scan_points: (n, 3) points in the lidar frame [m], finite. What is done to them before is
            part of `settings` (`preprocessed`).
        T_map_lidar_starts: (k, 4, 4) start poses, or one (4, 4).
        settings: the matcher; default `RegistrationSettings()`.

    Raises:
        RegistrationError: fewer than 10 points, as given or as preprocessed; points or starts that
            are not finite; starts that are not rigid; no cells near the scan, or a start from which
            it hits none.
    """
    settings = settings or RegistrationSettings()
    points = preprocessed(_scan(scan_points), settings)
    starts = rigid_poses(T_map_lidar_starts, "start")
    local, origin = _local_map(cells, points, starts, settings)
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
    slots = empty_slots(len(points), 7 if seven else 1, int(np.diff(local.first).max()))
    if not getattr(align, "signatures", True):  # there are none under NUMBA_DISABLE_JIT
        _log.info("loading the registration kernels; the first time, compiling them for a minute")
    align(np.ascontiguousarray(points.T), corner - origin, local, rule, seven, limit, slots, out)
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


def _local_map(
    cells: Cells, points: Float64, starts: Float64, settings: RegistrationSettings
) -> tuple[LocalMap, Int64]:
    """The cells that the scan can reach from the starts, on a dense grid, and the grid's origin
    [buckets of the map's lattice].
    """
    size = cells.cell_size
    halves, span = (2, 3) if settings.neighbours == "radius" else (1, 1)
    span = 0 if settings.neighbours == "direct1" else span
    near = _near(cells, points, starts, settings)
    index, mean = cells.index[near], cells.mean[near]
    low = index.min(axis=0) * halves - span - 1
    shape = index.max(axis=0) * halves - low + span + 2
    if math.prod(shape.tolist()) > MAX_BUCKETS:
        raise RegistrationError(
            f"the scan and its starts span {shape} voxels of {size / halves:g} m: "
            "register fewer starts at once, or use larger cells"
        )
    offset = mean - index * cells.cell_mm / MM_PER_M
    reach = size if settings.neighbours == "radius" else 0.0
    edge = size / halves
    d1, d2 = magnusson_constants(size, settings.outlier_ratio)
    inverse = _inverse_covariance(cells, near, settings) * (0.5 * d2 * math.log2(math.e))
    upper = np.triu_indices(3)
    table = np.column_stack([offset, inverse[:, upper[0], upper[1]]]).astype(np.float32)
    first, cell, shift = neighbour_lists(
        index * halves - low, offset / edge, shape, span, reach / edge
    )
    return LocalMap(shape, edge, first, cell, shift, table, reach, d1), low


def _near(
    cells: Cells, points: Float64, starts: Float64, settings: RegistrationSettings
) -> NDArray[np.intp]:
    """Rows of the cells in the box that the scan can reach: its radius and the longest path of a
    start.
    """
    steps = settings.iterations_max * max(settings.step_max, settings.epsilon)
    way = float(norms(points).max()) + steps + 2.0 * cells.cell_size
    where = starts[:, :3, 3]
    low = np.floor((where.min(axis=0) - way) / cells.cell_size)
    high = np.floor((where.max(axis=0) + way) / cells.cell_size)
    near = np.flatnonzero(((cells.index >= low) & (cells.index <= high)).all(axis=1))
    if not near.size:
        place = ", ".join(f"{c:.1f}" for c in where.mean(axis=0))
        raise RegistrationError(
            f"no cells within {way:.0f} m of the starts around ({place}): "
            "the scan lies outside the map, or its pose is in another frame"
        )
    return near


def _inverse_covariance(
    cells: Cells, rows: NDArray[np.intp], settings: RegistrationSettings
) -> Float64:
    """(m, 3, 3) inverse covariances of the density [1/m^2]."""
    if settings.covariance == "regularised":
        return cells.precision[rows]
    seed = 1.0 / np.maximum(cells.count[rows] - 1, 1)
    values = cells.eigenvalues[rows] + seed[:, None]
    values = np.maximum(values, 0.01 * values[:, :1])
    vectors = cells.eigenvectors[rows]
    inverse: Float64 = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return inverse


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
