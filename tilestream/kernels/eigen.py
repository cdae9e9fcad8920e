"""Eigenvalues and eigenvectors of symmetric 3x3 matrices."""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]

LANES = 32
"""Matrices that are turned together; what becomes of one does not depend on the others."""
SWEEPS = 20
"""Most sweeps over the three off-diagonal entries; about six do."""
XX, YY, ZZ, XY, XZ, YZ = range(6)
"""Rows of what is turned: the matrix; then the rows of the eigenvectors, three each."""


@njit(nogil=True, error_model="numpy", inline="always")
def _turned(go, app, aqq, apq, arp, arq, v0p, v0q, v1p, v1q, v2p, v2q):  # type: ignore[no-untyped-def]
    """One Jacobi rotation in the plane (p, q) that makes a_pq zero; r is the third axis. Where not
    `go`, or a_pq is zero, all is as it was: chosen without a branch.
    """
    go = go & (apq != 0.0)
    theta = (aqq - app) / (2.0 * apq)
    t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
    t = -t if theta < 0.0 else t
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    return (
        app - t * apq if go else app,
        aqq + t * apq if go else aqq,
        c * arp - s * arq if go else arp,
        s * arp + c * arq if go else arq,
        c * v0p - s * v0q if go else v0p,
        s * v0p + c * v0q if go else v0q,
        c * v1p - s * v1q if go else v1p,
        s * v1p + c * v1q if go else v1q,
        c * v2p - s * v2q if go else v2p,
        s * v2p + c * v2q if go else v2q,
    )


@njit(nogil=True, error_model="numpy", inline="always")
def _is_diagonal(a, b, c, ab, ac, bc):  # type: ignore[no-untyped-def]
    return abs(ab) + abs(ac) + abs(bc) <= 1e-20 * (abs(a) + abs(b) + abs(c))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def eigen(covariance: Float64) -> tuple[Float64, Float64]:
    """Eigenvalues and eigenvectors of symmetric 3x3 matrices by cyclic Jacobi rotations.

    Each rotation makes one off-diagonal entry zero; a few sweeps over the three leave less than
    1e-20 of the diagonal (the closed form by trigonometry loses 2e-9 of lam1 on poles, this 5e-16).

    Args:
        covariance: (n, 3, 3) symmetric matrices, any unit.

    Returns:
        (n, 3) eigenvalues, descending, those below 0 set to 0, and (n, 3, 3) unit eigenvectors in
        the columns: eigenvectors[i, :, 0] belongs to the largest.
    """
    k = covariance.shape[0]
    values, vectors = np.empty((k, 3)), np.empty((k, 3, 3))
    w = np.empty((15, LANES))
    for begin in range(0, k, LANES):
        count = min(LANES, k - begin)
        w[:] = 0.0
        w[6], w[10], w[14] = 1.0, 1.0, 1.0
        for m in range(count):
            of = covariance[begin + m]
            w[XX, m], w[YY, m], w[ZZ, m] = of[0, 0], of[1, 1], of[2, 2]
            w[XY, m], w[XZ, m], w[YZ, m] = of[0, 1], of[0, 2], of[1, 2]
        for _ in range(SWEEPS):
            moving = 0
            for m in range(LANES):
                moving += not _is_diagonal(w[0, m], w[1, m], w[2, m], w[3, m], w[4, m], w[5, m])
            if not moving:
                break
            for m in range(np.uint64(LANES)):
                a, b, c, ab, ac, bc = w[XX, m], w[YY, m], w[ZZ, m], w[XY, m], w[XZ, m], w[YZ, m]
                v0a, v0b, v0c = w[6, m], w[7, m], w[8, m]
                v1a, v1b, v1c = w[9, m], w[10, m], w[11, m]
                v2a, v2b, v2c = w[12, m], w[13, m], w[14, m]
                go = not _is_diagonal(a, b, c, ab, ac, bc)
                a, b, ac, bc, v0a, v0b, v1a, v1b, v2a, v2b = _turned(
                    go, a, b, ab, ac, bc, v0a, v0b, v1a, v1b, v2a, v2b
                )
                ab = 0.0 if go else ab
                a, c, ab, bc, v0a, v0c, v1a, v1c, v2a, v2c = _turned(
                    go, a, c, ac, ab, bc, v0a, v0c, v1a, v1c, v2a, v2c
                )
                ac = 0.0 if go else ac
                b, c, ab, ac, v0b, v0c, v1b, v1c, v2b, v2c = _turned(
                    go, b, c, bc, ab, ac, v0b, v0c, v1b, v1c, v2b, v2c
                )
                bc = 0.0 if go else bc
                w[XX, m], w[YY, m], w[ZZ, m], w[XY, m], w[XZ, m], w[YZ, m] = a, b, c, ab, ac, bc
                w[6, m], w[7, m], w[8, m] = v0a, v0b, v0c
                w[9, m], w[10, m], w[11, m] = v1a, v1b, v1c
                w[12, m], w[13, m], w[14, m] = v2a, v2b, v2c
        for m in range(count):
            _in_order(w[:, m], values[begin + m], vectors[begin + m])
    return values, vectors


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _in_order(turned, values, vectors):  # type: ignore[no-untyped-def]
    """Write what was found of one matrix, the largest eigenvalue first."""
    first, second, third = 0, 1, 2
    if turned[first] < turned[second]:
        first, second = second, first
    if turned[second] < turned[third]:
        second, third = third, second
    if turned[first] < turned[second]:
        first, second = second, first
    for place, axis in ((0, first), (1, second), (2, third)):
        values[place] = max(turned[axis], 0.0)
        for row in range(3):
            vectors[row, place] = turned[6 + 3 * row + axis]
