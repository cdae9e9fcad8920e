"""3D-NDT registration of a scan from many starts: Newton steps until one is short (definitions,
section 5.1).

The result of a start does not depend on the starts before it: the content of a slot is decided by
its bucket alone, or is cleared before each start.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit
from tilestream.kernels.newton import SUMS, M, assemble, definite_step, raw_step, to_euler
from tilestream.kernels.slots import FAR, LN4, best_of_cells, forget_rows, sums_at

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

NO_SCORE = 1.0e-3
"""Only below this sum of densities a step checks whether the scan still hits any cell."""
SMALL_ANGLE = 1.0e-4
"""Euler angles below this [rad] count as 0 in the derivatives, as in PCL and Autoware."""


class LocalMap(NamedTuple):
    """The cells around a scan, as the kernel reads them (buckets: kernels/neighbour_lists.py)."""

    shape: Int64
    """(3,) number of buckets of the dense grid."""
    edge: float
    """Edge of a bucket [m]."""
    first: Int32
    """(buckets + 1,) where the list of a bucket begins in `cell` and `shift`."""
    cell: Int32
    """(entries,) rows of `table`."""
    shift: Int32
    """(entries,) packed shifts from the bucket to the cell's corner [bucket edges]."""
    table: Float32
    """(cells, 9) mean from the cell's corner [m], inverse covariance xx xy xz yy yz zz times
    d2 / 2 log2(e) [1/m^2]."""
    reach: float
    """Radius within which a cell counts [m]; 0: every cell that the bucket lists counts."""
    d1: float
    """Magnusson's d1 < 0, no unit."""


class Rule(NamedTuple):
    """How to step: fields of `RegistrationSettings`, lengths [m], angles [rad]."""

    definite: bool
    euler: bool
    step_max: float
    epsilon: float
    iterations_max: int


class Aligned(NamedTuple):
    """Input and output of `align`, a row per start."""

    R: Float64
    """(k, 3, 3) rotations: in, of the starts; out, final."""
    t: Float64
    """(k, 3) translations from the corner of the start's bucket [m]: in, of the starts; out,
    final."""
    converged: NDArray[np.bool_]
    """(k,) whether the last step was shorter than epsilon."""
    iterations: Int64
    """(k,) steps taken."""
    score: Float64
    """(k,) sum over points and their cells of -d1 p at the final pose."""
    best: Float64
    """(k,) sum over points of their best cell's -d1 p."""
    hits: Int64
    """(k,) points with at least one cell."""
    hessian: Float64
    """(k, 6, 6) of the score at the final pose, for steps (tau, w) [m, rad]."""


@njit(nogil=True, error_model="numpy")
def _exponential(w: Float64, R: Float64) -> None:
    """R <- Exp(w) R, by Rodrigues' formula."""
    angle = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if angle < 1e-8:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        cx, cy, cz = w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x
        R[0, j] = x + a * cx + b * (w[1] * cz - w[2] * cy)
        R[1, j] = y + a * cy + b * (w[2] * cx - w[0] * cz)
        R[2, j] = z + a * cz + b * (w[0] * cy - w[1] * cx)


@njit(nogil=True, error_model="numpy")
def _euler_angles(R: Float64, angles: Float64) -> None:
    """The angles (rx, ry, rz) of R = Rx Ry Rz [rad]."""
    angles[0] = math.atan2(-R[1, 2], R[2, 2])
    angles[1] = math.asin(min(max(R[0, 2], -1.0), 1.0))
    angles[2] = math.atan2(-R[0, 1], R[0, 0])


@njit(nogil=True, error_model="numpy")
def _from_euler(angles: Float64, ignored: float, R: Float64, axes: Float64) -> None:
    """R = Rx Ry Rz and the axes ex, Rx ey, Rx Ry ez of its angles; angles below `ignored` are 0."""
    rx, ry, rz = angles[0], angles[1], angles[2]
    sx, cx = (0.0, 1.0) if abs(rx) < ignored else (math.sin(rx), math.cos(rx))
    sy, cy = (0.0, 1.0) if abs(ry) < ignored else (math.sin(ry), math.cos(ry))
    sz, cz = (0.0, 1.0) if abs(rz) < ignored else (math.sin(rz), math.cos(rz))
    R[0, 0], R[0, 1], R[0, 2] = cy * cz, -cy * sz, sy
    R[1, 0], R[1, 1], R[1, 2] = cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy
    R[2, 0], R[2, 1], R[2, 2] = sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy
    axes[0, 0], axes[1, 0], axes[2, 0] = 1.0, 0.0, 0.0
    axes[0, 1], axes[1, 1], axes[2, 1] = 0.0, cx, sx
    axes[0, 2], axes[1, 2], axes[2, 2] = sy, -sx * cy, cx * cy


@njit(nogil=True, error_model="numpy")
def _newton_step(rule, axes, g, H, d):  # type: ignore[no-untyped-def]
    """The step `d` of a solver, from the gradient and Hessian for R <- Exp(w) R; its norm."""
    if rule.euler:
        to_euler(axes, g, H)
    if rule.definite:
        return definite_step(g, H, rule.step_max, d)
    return raw_step(g, H, rule.step_max, 0.5 * rule.epsilon, d)


@njit(nogil=True, error_model="numpy")
def _move(rule, d, angles, R, t, axes):  # type: ignore[no-untyped-def]
    """Apply the step `d` to a pose: R, t (and the Euler angles and axes), in place."""
    for i in range(3):
        t[i] += d[i]
    if rule.euler:
        for i in range(3):
            angles[i] += d[3 + i]
        _from_euler(angles, 0.0, R, axes)
    else:
        _exponential(d[3:], R)


@njit(nogil=True, error_model="numpy")
def _scale(sums: Float64, d1: float) -> None:
    """Multiply the sums of kernels/slots.py with their constants, in place (kernels/newton.py)."""
    for k in range(SUMS + 1):
        sums[k] *= -d1 * LN4 if M <= k < SUMS else -d1


@njit(nogil=True, error_model="numpy")
def align(points, corner, local, rule, seven, limit, state, out):  # type: ignore[no-untyped-def]
    """Register a scan from every start; fills `out` (an `Aligned`).

    Args:
        points: (3, n) scan in the lidar frame [m], float64.
        corner: (k, 3) the bucket, on the local grid, that `out.t` of each start counts from.
        local: the cells around the scan (a `LocalMap`).
        rule: how to step (a `Rule`).
        seven: None for one slot per point, True for seven.
        limit: None, or the squared reach [m^2], float32.
        state: slots for n points, one or seven per row as `seven` says; scratch memory.
        out: starts in, results out.
    """
    slots = np.uint64(1) if seven is None else np.uint64(7)
    far = np.float32(FAR * local.edge)
    nearby = np.float32((0.1 * FAR * local.edge) ** 2) if limit is None else limit
    sums, g, H, d = np.empty(SUMS + 1), np.empty(6), np.empty((6, 6)), np.empty(6)
    axes, lever, angles = np.eye(3), np.eye(3), np.empty(3)
    for s in range(out.R.shape[0]):
        R, t = out.R[s], out.t[s]
        forget_rows(state, slots, far)
        _euler_angles(R, angles)
        norm, steps, hits = math.inf, 0, 1
        while steps < rule.iterations_max and not norm < rule.epsilon and hits > 0:
            if rule.euler:
                _from_euler(angles, SMALL_ANGLE, lever, axes)
                sums_at(state, points, R, lever, t, corner[s], local, seven, limit, sums)
            else:
                sums_at(state, points, R, None, t, corner[s], local, seven, limit, sums)
            if sums[SUMS] < NO_SCORE:
                _, hits = best_of_cells(state, slots, nearby)
            _scale(sums, local.d1)
            assemble(sums, g, H)
            norm = _newton_step(rule, axes, g, H, d)
            _move(rule, d, angles, R, t, axes)
            steps += 1
        sums_at(state, points, R, None, t, corner[s], local, seven, limit, sums)
        best, hits = best_of_cells(state, slots, nearby)
        _scale(sums, local.d1)
        assemble(sums, g, out.hessian[s])
        out.score[s] = sums[SUMS]
        out.best[s] = -local.d1 * best
        out.hits[s] = hits
        out.iterations[s] = steps
        out.converged[s] = norm < rule.epsilon and hits > 0
