"""The score of a cell's points when all of them are shifted: the sums behind `score_H` (eq. 12).

Each point x is moved by 441 shifts v, and each x + v is scored against the cell whose mean is
nearest. What makes this fast, without changing which cell is found:

* The points of a cell are taken in groups that lie together, the shifts in blocks. Which of two
  means is nearer is linear in x + v: a mean that is farther than another one at all corners of the
  box that a group covers in a block cannot be the nearest there. Mostly one to four remain.
* |x + v - mu|^2 - |v|^2 - 2 v.x is A(x) + T(v): both are rounded to whole numbers, so a comparison
  is an addition of integers. Each cell's distance is increased by its place in the list times more
  than the rounding error, so that of equally near cells the lexicographically first is found.
* As a function of v the Mahalanobis form is (U1 + G1.v)^2 + (U2 + G2.v)^2 + U3, along the steep
  and the flat horizontal axis of the cell; scaled, it is an exponent of 2. A block where it is
  above 25 for all cells and points gives 0 and is skipped.
* Values are whole multiples of 2^-24 and sums exact, so order and tiling have no effect.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit
from tilestream.kernels.nearest import from_corner
from tilestream.kernels.shift_sums import (
    BLOCK,
    CAP,
    GROUP,
    ONE,
    sum_of_eight,
    sum_of_four,
    sum_of_many,
    sum_of_two,
)

SIDE = 21
"""Shifts along each axis: v = (i / 5, j / 5) m, i and j from -10 to 10, i slowest."""
SHIFTS = SIDE * SIDE
STEP = 0.2
"""Distance of two shifts [m]."""
FARTHEST = 2.0
"""The largest shift along an axis [m]."""
DARK = 25.1
"""From this exponent on the value is 0, however float32 rounds."""
SET_BACK = 4.0
"""Steps added to a cell's distance per place in its list; the rounding error is below 2 steps."""
ANY = np.int32(2**31 - 1)
"""A distance larger than that of any cell."""


class Near(NamedTuple):
    """The cells that can be nearest to a cell's shifted points, with tables for one group of
    points.
    """

    at: NDArray[np.float64]
    """(3, k) their means, from the cell's corner [m]."""
    whitening: NDArray[np.float64]
    """(k, 7) their rows of `_horizontal_axes`."""
    slope: NDArray[np.float64]
    """(k, 6) what a step of v in x, in y adds to T, to U1 and to U2."""
    A: NDArray[np.int32]
    """(k, GROUP) |x - mu|^2 in whole steps, with the steps of `SET_BACK`."""
    U: NDArray[np.float32]
    """(k, 3 GROUP) U1, U2, U3 of the points, scaled to exponents of 2."""
    span: NDArray[np.float64]
    """(k, 5) least and largest U1 and U2, least U3 over the group."""
    over: NDArray[np.float64]
    """(k,) smallest excess of a mean's squared distance over the nearest one's in a block [m^2]."""
    alive: NDArray[np.int64]
    """(k,) which of them can be nearest in a block."""


class Lanes(NamedTuple):
    """A group of points, one per SIMD lane, and the state of its search in a block of shifts."""

    x: NDArray[np.float64]
    """(3, GROUP) points from the cell's corner [m]."""
    pull: NDArray[np.int32]
    """(2, 2 GROUP) what a step of v in x, in y subtracts from the distance limit, in whole steps;
    row 0, for blocks where the limit cannot matter: 0."""
    base: NDArray[np.int32]
    """(2, SIDE, SIDE) the distance limit of each shift before `pull` is subtracted; row 0: no
    limit."""
    least: NDArray[np.int32]
    """(GROUP,) distance of the nearest cell so far, in whole steps."""
    exponent: NDArray[np.float32]
    """(GROUP,) exponent of that cell's value."""


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _by_place(offset, cell_size):  # type: ignore[no-untyped-def]
    """An order of a cell's points in which successive points are near one another.

    By the Morton code of the 4 x 4 x 4 parts of the cell.
    """
    n = len(offset)
    code, start = np.empty(n, np.int64), np.zeros(65, np.int64)
    for i in range(n):
        morton = 0
        for a in range(3):
            quarter = min(max(int(offset[i, a] * 4.0 / cell_size), 0), 3)
            morton += ((quarter & 1) << a) + ((quarter >> 1) << (3 + a))
        code[i] = morton
        start[morton + 1] += 1
    for b in range(64):
        start[b + 1] += start[b]
    order = np.empty(n, np.int64)
    for i in range(n):
        order[start[code[i]]] = i
        start[code[i]] += 1
    return order


@njit(nogil=True, error_model="numpy")
def _horizontal_axes(precision, covariance, bits):  # type: ignore[no-untyped-def]
    """The Mahalanobis form of each cell as a sum of squares, of which shifts change only two.

    With G = Sigma'^-1 and w the horizontal part of y, y^T G y = |R (w + s z)|^2 + z^2 / Sigma'_zz,
    where R^T R = G_xx and s = G_xx^-1 G_xz. The rows of R are the eigenvectors of G_xx times the
    roots of its eigenvalues, the steep one first.

    Args:
        precision: (m, 3, 3) inverses of the regularised covariances [1/m^2].
        covariance: (m, 3, 3) regularised covariances [m^2].
        bits: factor that makes the form an exponent of 2: d2 / (2 ln 2).

    Returns:
        (m, 7) R row by row, R s, and 1 / Sigma'_zz; the latter times bits, the others times its
        root.
    """
    out = np.empty((len(precision), 7))
    for i in range(len(precision)):
        g = precision[i]
        middle, half = 0.5 * (g[0, 0] + g[1, 1]), 0.5 * (g[0, 0] - g[1, 1])
        steep = middle + np.sqrt(half * half + g[0, 1] * g[0, 1])
        flat = (g[0, 0] * g[1, 1] - g[0, 1] * g[0, 1]) / steep
        angle = 0.5 * np.arctan2(g[0, 1], half)
        c, s = np.cos(angle), np.sin(angle)
        r1, r2 = np.sqrt(bits * steep), np.sqrt(bits * flat)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = r1 * c, r1 * s, -r2 * s, r2 * c
        out[i, 4] = (c * g[0, 2] + s * g[1, 2]) * bits / r1
        out[i, 5] = (c * g[1, 2] - s * g[0, 2]) * bits / r2
        out[i, 6] = bits / covariance[i, 2, 2]
    return out


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _within_reach(mean, axes, candidates, corner, middle, half, limit, scale, near):  # type: ignore[no-untyped-def]
    """Keep the candidates that some shift brings within the limit of the box; their number."""
    at, whitening, slope = near.at, near.whitening, near.slope
    found = 0
    for k in candidates:
        x, y, z = mean[k, 0] - corner[0], mean[k, 1] - corner[1], mean[k, 2] - corner[2]
        gap_x = max(abs(x - middle[0]) - half[0] - FARTHEST, 0.0)
        gap_y = max(abs(y - middle[1]) - half[1] - FARTHEST, 0.0)
        gap_z = max(abs(z - middle[2]) - half[2], 0.0)
        if gap_x * gap_x + gap_y * gap_y + gap_z * gap_z > limit * limit + 1e-6:
            continue
        at[0, found], at[1, found], at[2, found] = x, y, z
        for a in range(7):
            whitening[found, a] = axes[k, a]
        slope[found, 0] = -2.0 * STEP * scale * x
        slope[found, 1] = -2.0 * STEP * scale * y
        for a in range(4):
            slope[found, 2 + a] = STEP * axes[k, a]
        found += 1
    return found


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _take_group(offset, members, scale, lanes, middle, half):  # type: ignore[no-untyped-def]
    """Load the points of a group (unused lanes repeat the last one) and compute their box."""
    x, pull = lanes.x, lanes.pull
    for a in range(3):
        low, high = np.inf, -np.inf
        for p in range(GROUP):
            value = offset[members[min(p, len(members) - 1)], a]
            x[a, p] = value
            low, high = min(low, value), max(high, value)
        middle[a], half[a] = 0.5 * (low + high), 0.5 * (high - low)
    for p in range(GROUP):
        pull[1, p] = np.int32(np.rint(2.0 * STEP * scale * x[0, p]))
        pull[1, p + GROUP] = np.int32(np.rint(2.0 * STEP * scale * x[1, p]))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _tabulate(near, lanes, k, n, scale):  # type: ignore[no-untyped-def]
    """Fill the tables of the k-th cell for the n points of a group."""
    x, y, z = lanes.x[0], lanes.x[1], lanes.x[2]
    A, U, w = near.A[k], near.U[k], near.whitening[k]
    w0, w1, w2, w3, w4, w5, w6 = w[0], w[1], w[2], w[3], w[4], w[5], w[6]
    mx, my, mz = near.at[0, k], near.at[1, k], near.at[2, k]
    back = SET_BACK * k
    for p in range(GROUP):
        dx, dy, dz = x[p] - mx, y[p] - my, z[p] - mz
        A[p] = np.int32(np.rint((dx * dx + dy * dy + dz * dz) * scale + back))
    for p in range(GROUP):
        dx, dy, dz = x[p] - mx, y[p] - my, z[p] - mz
        U[p] = np.float32(w0 * dx + w1 * dy + w4 * dz)
        U[p + GROUP] = np.float32(w2 * dx + w3 * dy + w5 * dz)
        U[p + 2 * GROUP] = np.float32(w6 * dz * dz)
    low1 = high1 = U[0]
    low2 = high2 = U[GROUP]
    low3 = U[2 * GROUP]
    for p in range(n):
        low1, high1 = min(low1, U[p]), max(high1, U[p])
        low2, high2 = min(low2, U[p + GROUP]), max(high2, U[p + GROUP])
        low3 = min(low3, U[p + 2 * GROUP])
    span = near.span
    span[k, 0], span[k, 1], span[k, 2], span[k, 3], span[k, 4] = low1, high1, low2, high2, low3
    for p in range(n, GROUP):
        U[p + 2 * GROUP] = CAP  # a lane without a point adds 0


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _choose(near, cells, cx, cy, cz, hx, hy, hz, limit, slack):  # type: ignore[no-untyped-def]
    """The cells that can be nearest, and within the limit, in a box of centre c and half size h.

    Returns:
        Their number (0 if none can be nearest in the box) and whether the limit may matter.
    """
    x, y, z, over, alive = near.at[0], near.at[1], near.at[2], near.over, near.alive
    for k in range(cells):
        dx, dy, dz = x[k] - cx, y[k] - cy, z[k] - cz
        over[k] = dx * dx + dy * dy + dz * dz
    first = 0
    for k in range(1, cells):
        first = k if over[k] < over[first] else first
    nearest, ox, oy, oz = over[first], x[first], y[first], z[first]
    for k in range(cells):
        swing = abs(x[k] - ox) * hx + abs(y[k] - oy) * hy + abs(z[k] - oz) * hz
        over[k] = over[k] - nearest - 2.0 * swing
    count = 0
    for k in range(cells):
        if over[k] <= slack:
            gx = max(abs(x[k] - cx) - hx, 0.0)
            gy = max(abs(y[k] - cy) - hy, 0.0)
            gz = max(abs(z[k] - cz) - hz, 0.0)
            if gx * gx + gy * gy + gz * gz <= limit * limit + 1e-6:
                alive[count] = k
                count += 1
    far_x, far_y, far_z = abs(cx - ox) + hx, abs(cy - oy) + hy, abs(cz - oz) + hz
    limited = far_x * far_x + far_y * far_y + far_z * far_z > limit * limit - slack
    return count, np.int64(limited)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _is_dark(near, count, i, j):  # type: ignore[no-untyped-def]
    """Whether all values in the block around the shift (i, j) are 0."""
    r = 0.5 * (BLOCK - 1)
    for n in range(count):
        k = near.alive[n]
        span, slope = near.span[k], near.slope[k]
        g1, r1 = i * slope[2] + j * slope[3], r * (abs(slope[2]) + abs(slope[3]))
        g2, r2 = i * slope[4] + j * slope[5], r * (abs(slope[4]) + abs(slope[5]))
        e1 = max(span[0] + g1 - r1, -(span[1] + g1 + r1), 0.0)
        e2 = max(span[2] + g2 - r2, -(span[3] + g2 + r2), 0.0)
        if e1 * e1 + e2 * e2 + span[4] < DARK:
            return False
    return True


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _add_group(near, cells, lanes, middle, half, limit, scale, total):  # type: ignore[no-untyped-def]
    """Add the values of a group over all the shifts."""
    slack = (SET_BACK * cells + 8.0) / scale
    A, U, slope, alive = near.A, near.U, near.slope, near.alive
    pull, base, least, exponent = lanes.pull, lanes.base, lanes.least, lanes.exponent
    r = 0.5 * (BLOCK - 1)
    hx, hy, hz = half[0] + r * STEP, half[1] + r * STEP, half[2]
    for i0 in range(-10, 11, BLOCK):
        for j0 in range(-10, 11, BLOCK):
            cx, cy = middle[0] + STEP * (i0 + r), middle[1] + STEP * (j0 + r)
            count, limited = _choose(near, cells, cx, cy, middle[2], hx, hy, hz, limit, slack)
            if _is_dark(near, count, i0 + r, j0 + r):
                continue
            if count <= 8:
                for n in range(count, 8):
                    alive[n] = alive[count - 1]
            if count <= 2:
                sum_of_two(A, U, slope, alive, pull, base, limited, i0, j0, total)
            elif count <= 4:
                sum_of_four(A, U, slope, alive, pull, base, limited, i0, j0, total)
            elif count <= 8:
                sum_of_eight(A, U, slope, alive, pull, base, limited, i0, j0, total)
            else:
                sum_of_many(
                    A, U, slope, alive, count, pull, base, limited, i0, j0, total, least, exponent
                )


@njit(nogil=True, error_model="numpy", boundscheck=False)
def score_sums(
    points_mm: NDArray[np.int64],
    start: NDArray[np.int64],
    order: NDArray[np.int64],
    index: NDArray[np.int64],
    cell_mm: int,
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    precision: NDArray[np.float64],
    around_start: NDArray[np.int64],
    around: NDArray[np.int32],
    d1: float,
    d2: float,
) -> NDArray[np.float64]:
    """Sum over a cell's points x of -d1 p(x + v; c*) for the 441 shifts v (definitions,
    section 3, `score_H`).

    p(y; c) = exp(-d2/2 (y - mu)^T Sigma'^-1 (y - mu)); c* is the cell whose mean is nearest to
    x + v, of means within 1e-9 m the lexicographically first; none within l gives 0.

    Args:
        points_mm: (n, 3) points [mm, map frame], any order.
        start: (m + 1,) starts of `group_by_cell`.
        order: (k,) points of `group_by_cell`.
        index: (m, 3) voxel indices, lexicographically sorted.
        cell_mm: edge l of a voxel [mm].
        mean: (m, 3) means [m, map frame].
        covariance: (m, 3, 3) regularised covariances [m^2].
        precision: (m, 3, 3) their inverses [1/m^2].
        around_start: (m + 1,) starts of `cells_around` with `reach_of_shifts`.
        around: cells of `cells_around`.
        d1: constant of the score, < 0.
        d2: constant of the density.

    Returns:
        (m, 441) sums, no unit, relative error below 1e-5 of a row's largest; i slowest.
    """
    m = len(index)
    limit = cell_mm / 1000.0
    sums = np.zeros((m, SHIFTS))
    axes = _horizontal_axes(precision, covariance, 0.5 * d2 / np.log(2.0))
    # No |x - mu|^2 is above reach^2, no 2 v.mu above the second part [m^2]: 30 bits hold the sum.
    reach = FARTHEST * np.sqrt(2.0) + (1.0 + np.sqrt(3.0)) * limit
    scale = 2.0**30 / (reach * reach + 4.0 * FARTHEST * (2.0 * limit + FARTHEST))
    most = max(np.max(np.diff(around_start)), 8) if m else 8
    near = Near(
        np.empty((3, most)),
        np.empty((most, 7)),
        np.empty((most, 6)),
        np.empty((most, GROUP), np.int32),
        np.empty((most, 3 * GROUP), np.float32),
        np.empty((most, 5)),
        np.empty(most),
        np.empty(most, np.int64),
    )
    lanes = Lanes(
        np.empty((3, GROUP)),
        np.zeros((2, 2 * GROUP), np.int32),
        np.full((2, SIDE, SIDE), ANY),
        np.empty(GROUP, np.int32),
        np.empty(GROUP, np.float32),
    )
    total = np.empty((SIDE, SIDE), np.int64)
    for c in range(m):
        if start[c] == start[c + 1]:
            continue
        corner_mm = index[c] * cell_mm
        offset, middle, half = from_corner(points_mm, order[start[c] : start[c + 1]], corner_mm)
        candidates = around[around_start[c] : around_start[c + 1]]
        cells = _within_reach(
            mean, axes, candidates, corner_mm / 1000.0, middle, half, limit, scale, near
        )
        for i in range(-10, 11):
            for j in range(-10, 11):
                square = limit * limit - STEP * STEP * (i * i + j * j)
                base = np.rint(scale * square) + SET_BACK * cells + 16.0
                lanes.base[1, i + 10, j + 10] = np.int32(base)
        total[:] = 0
        place = _by_place(offset, limit)
        for first in range(0, len(place), GROUP):
            members = place[first : first + GROUP]
            _take_group(offset, members, scale, lanes, middle, half)
            for k in range(cells):
                _tabulate(near, lanes, k, len(members), scale)
            _add_group(near, cells, lanes, middle, half, limit, scale, total)
        for i in range(SIDE):
            for j in range(SIDE):
                sums[c, i * SIDE + j] = -d1 * (total[i, j] / ONE)
    return sums


def reach_of_shifts(cell_size: float) -> tuple[int, int, int]:
    """Voxels to each side, in x, y and z, that can hold the nearest cell of a shifted point.

    A shift of 2 m ends at most ceil(2 / l) voxels away, and a mean within l of there lies in that
    voxel or in one of the 26 around it.
    """
    sideways = int(np.ceil(FARTHEST / cell_size - 1e-9)) + 1
    return sideways, sideways, 1
