"""One Newton step of the registration: gradient, Hessian, two solvers (definitions, section 5.1).

A step is (tau, w) [m, rad]: t <- t + tau, R <- Exp(w) R, about the scan's origin. A scan point
r = R p moves by J = [I, -[r]_x]. With f = B q (q from the cell's mean to the point, B the inverse
covariance) and the weight w = -d1 d2 exp(-d2/2 q.f) of a pair, the score s = sum -d1 exp(..) has

    gradient  -sum w J^T f
    Hessian   -sum w J^T (B - d2 f f^T) J - sum w f . (second derivative of the point).

Everything here is float64 and 6x6.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]

F, C, M, K, N = 0, 3, 12, 18, 27
"""Where the sums of a pose begin: F = sum w f (3), C = sum w f r^T (9), M = sum w (B - d2 f f^T)
(6: xx xy xz yy yz zz), K = sum M [r]_x (9), N = -sum [r]_x M [r]_x (6)."""
SUMS = 33
"""Number of these sums."""

ROTATION_SCALE = 0.1
"""D of the definite solver: a radian counts as 10 m."""
LEAST_CURVATURE = 1e-6
"""Smallest |eigenvalue| that the definite solver divides by, as a share of the largest."""
SINGULAR = 1e-12
"""The raw solver calls a matrix singular below this ratio of its pivots."""


@njit(nogil=True, error_model="numpy")
def assemble(sums: Float64, g: Float64, H: Float64) -> None:
    """Gradient (6,) and Hessian (6, 6) of the score from the sums of a pose.

    The second derivative of a point is the symmetric part of e_i x (e_j x r).
    """
    for i in range(3):
        g[i] = -sums[F + i]
        for j in range(3):
            H[i, 3 + j] = H[3 + j, i] = sums[K + 3 * i + j]
    g[3] = sums[C + 5] - sums[C + 7]  # -(sum w r x f)_x = C_yz - C_zy
    g[4] = sums[C + 6] - sums[C + 2]
    g[5] = sums[C + 1] - sums[C + 3]
    trace = sums[C] + sums[C + 4] + sums[C + 8]
    k = 0
    for i in range(3):
        for j in range(i, 3):
            twice = sums[C + 3 * i + j] + sums[C + 3 * j + i]
            H[i, j] = H[j, i] = -sums[M + k]
            H[3 + i, 3 + j] = H[3 + j, 3 + i] = -sums[N + k] - 0.5 * twice
            k += 1
        H[3 + i, 3 + i] += trace


@njit(nogil=True, error_model="numpy")
def to_euler(axes: Float64, g: Float64, H: Float64) -> None:
    """Convert a gradient and Hessian for R <- Exp(w) R to the angles of R = Rx Ry Rz, in place.

    The columns a_i of `axes` are ex, Rx ey, Rx Ry ez: w = A (rates of the angles). The second
    derivative a_i x (a_j x r), i the outer angle, differs from its symmetric part by (a_i x a_j) x
    r / 2: H_ij = a_i . H_w a_j + g_w . (a_i x a_j) / 2 for i < j.
    """
    old_g, old_H = g.copy(), H.copy()
    for i in range(3):
        g[3 + i] = 0.0
        for a in range(3):
            g[3 + i] += axes[a, i] * old_g[3 + a]
        for j in range(3):
            H[i, 3 + j] = 0.0
            for a in range(3):
                H[i, 3 + j] += old_H[i, 3 + a] * axes[a, j]
            H[3 + j, i] = H[i, 3 + j]
    for i in range(3):
        for j in range(i, 3):
            value = 0.0
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                cross = axes[b, i] * axes[c, j] - axes[c, i] * axes[b, j]
                value += 0.5 * old_g[3 + a] * cross
                for d in range(3):
                    value += axes[a, i] * old_H[3 + a, 3 + d] * axes[d, j]
            H[3 + i, 3 + j] = H[3 + j, 3 + i] = value


@njit(nogil=True, error_model="numpy")
def _cholesky(A: Float64, shift: float, L: Float64) -> bool:
    """L L^T = A - shift I; False where that is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            value = A[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                value -= shift
                if not value > 0.0:
                    return False
                L[i, i] = math.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    return True


@njit(nogil=True, error_model="numpy")
def _cholesky_solve(L: Float64, b: Float64, x: Float64) -> None:
    for i in range(6):
        value = b[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value / L[i, i]
    for i in range(5, -1, -1):
        value = x[i]
        for k in range(i + 1, 6):
            value -= L[k, i] * x[k]
        x[i] = value / L[i, i]


@njit(nogil=True, error_model="numpy")
def _rotate(A: Float64, V: Float64, p: int, q: int) -> None:
    """The Jacobi rotation that makes A[p, q] zero."""
    theta = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    if theta < 0.0:
        t = -t
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    A[p, p] -= t * A[p, q]
    A[q, q] += t * A[p, q]
    A[p, q] = A[q, p] = 0.0
    for k in range(6):
        if k not in (p, q):
            x, y = A[k, p], A[k, q]
            A[k, p] = A[p, k] = c * x - s * y
            A[k, q] = A[q, k] = s * x + c * y
        x, y = V[k, p], V[k, q]
        V[k, p] = c * x - s * y
        V[k, q] = s * x + c * y


@njit(nogil=True, error_model="numpy")
def eigen6(A: Float64, V: Float64) -> None:
    """Diagonalise a symmetric (6, 6) matrix in place by cyclic Jacobi; eigenvectors in columns."""
    for i in range(6):
        for j in range(6):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(6):
            diagonal += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if off <= 1e-28 * diagonal:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if A[p, q] != 0.0:
                    _rotate(A, V, p, q)


@njit(nogil=True, error_model="numpy")
def definite_step(g: Float64, H: Float64, step_max: float, d: Float64) -> float:
    """Newton step (6,) that always increases the score, into `d`; returns its norm.

    H_s = D H D, D = diag(1, 1, 1, 1/10, 1/10, 1/10); each eigenvalue e of H_s becomes
    -max(|e|, 1e-6 max|e|); the step is scaled down to a norm of at most `step_max`.
    """
    A, L, b = np.empty((6, 6)), np.zeros((6, 6)), np.empty(6)
    trace = 0.0
    for i in range(6):
        di = 1.0 if i < 3 else ROTATION_SCALE
        b[i] = di * g[i]
        for j in range(6):
            A[i, j] = -H[i, j] * di * (1.0 if j < 3 else ROTATION_SCALE)
        trace += A[i, i]
    # where all of A lies above the floor, no eigenvalue changes and no decomposition is needed
    if trace > 0.0 and _cholesky(A, LEAST_CURVATURE * trace, L):
        _cholesky(A, 0.0, L)
        _cholesky_solve(L, b, d)
    else:
        _curved_solve(A, b, LEAST_CURVATURE, True, L, d)
    for i in range(3, 6):
        d[i] *= ROTATION_SCALE
    return _capped(d, step_max, 0.0)


@njit(nogil=True, error_model="numpy")
def raw_step(g: Float64, H: Float64, step_max: float, step_min: float, d: Float64) -> float:
    """Newton step (6,) as PCL takes it, into `d`; returns its norm.

    H d = -g, the least-squares solution where H is singular; negated if it would lower the score;
    norm = max(min(|d|, step_max), step_min).
    """
    if not _eliminate(H, g, d):
        A, V = H.copy(), np.empty((6, 6))
        _curved_solve(A, g, 6.0 * 2.220446049250313e-16, False, V, d)
    slope = 0.0
    for i in range(6):
        d[i] = -d[i]
        slope += g[i] * d[i]
    if slope <= 0.0:
        for i in range(6):
            d[i] = -d[i]
    return _capped(d, step_max, step_min)


@njit(nogil=True, error_model="numpy")
def _curved_solve(A, b, floor, lift, V, x):  # type: ignore[no-untyped-def]
    """Solve A x = b by x = V E^-1 V^T b where A = V E V^T, overwriting A, V.

    With `lift` every eigenvalue e counts as max(|e|, `floor` times the largest magnitude); without,
    directions with |e| below that are left out (pseudo-inverse).
    """
    eigen6(A, V)
    largest = 0.0
    for k in range(6):
        largest = max(largest, abs(A[k, k]))
        x[k] = 0.0
    if largest == 0.0:
        return
    for k in range(6):
        e = A[k, k]
        if lift:
            e = max(abs(e), floor * largest)
        elif abs(e) <= floor * largest:
            continue
        dot = 0.0
        for i in range(6):
            dot += V[i, k] * b[i]
        for i in range(6):
            x[i] += V[i, k] * (dot / e)


@njit(nogil=True, error_model="numpy")
def _eliminate(H: Float64, b: Float64, x: Float64) -> bool:
    """Solve H x = b by elimination with row pivoting; False where H is singular."""
    A = H.copy()
    for i in range(6):
        x[i] = b[i]
    smallest, largest = math.inf, 0.0
    for k in range(6):
        pivot = k + int(np.argmax(np.abs(A[k:, k])))
        size = abs(A[pivot, k])
        smallest, largest = min(smallest, size), max(largest, size)
        if not smallest > SINGULAR * largest:
            return False
        for j in range(6):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        x[k], x[pivot] = x[pivot], x[k]
        for i in range(k + 1, 6):
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, 6):
                A[i, j] -= factor * A[k, j]
            x[i] -= factor * x[k]
    for i in range(5, -1, -1):
        for j in range(i + 1, 6):
            x[i] -= A[i, j] * x[j]
        x[i] /= A[i, i]
    return True


@njit(nogil=True, error_model="numpy")
def _capped(d: Float64, step_max: float, step_min: float) -> float:
    """Scale `d` to max(min(|d|, step_max), step_min); that norm, or 0 where d is 0."""
    norm = 0.0
    for i in range(6):
        norm += d[i] * d[i]
    norm = math.sqrt(norm)
    if norm == 0.0:
        return 0.0
    wanted = max(min(norm, step_max), step_min)
    if wanted != norm:
        for i in range(6):
            d[i] *= wanted / norm
    return wanted
