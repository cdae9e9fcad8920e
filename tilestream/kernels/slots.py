"""The score of a scan and its derivatives as one reduction without branches, over cached cells.

Gathering the cells of a point costs more than the arithmetic, and from one Newton step to the next
few points change their bucket (kernels/neighbour_lists.py). So every scan point owns a row of slots
that holds copies of its cells, and only points that moved to another bucket are packed again. A
point with more cells than slots also owns overflow rows, behind the rows of the points.

Layout, so that the reduction reads contiguous float32 only: rows lie in blocks of `BLOCK`. A block
is an array of lines; a line holds one value of every row of the block. Lines are `STRIDE` apart, an
odd number of cache lines: with an even number they would evict each other from the cache. Nine
lines per slot: the cell's mean, and its inverse covariance xx xy xz yy yz zz in units where the
density is 2^-(q.f). Six lines per row: u, the point from its bucket's corner, and r = R p, its
lever arm. An empty slot holds a cell so far away that its density is nothing.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import config, types
from numba.core.extending import intrinsic
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

BLOCK = 256
"""Rows of a block."""
STRIDE = BLOCK + 16
"""From one line of a block to the next [float32 values]: 17 cache lines."""
CELL = 9
"""Values of a cell in a slot: mean and inverse covariance."""
POINT = 6
"""Values of a row: u and r."""
FAR = 1000.0
"""Mean of the cell in an empty slot along x [bucket edges]."""
LN4 = 2.0 * math.log(2.0)
"""d2 over the factor of the inverse covariances, d2 / 2 log2(e)."""

_BLOCK, _1 = np.uint64(BLOCK), np.uint64(STRIDE)
_2, _3, _4, _5, _6, _7, _8, _CELL = (np.uint64(k * STRIDE) for k in (2, 3, 4, 5, 6, 7, 8, CELL))
_T0, _T1, _T2, _T3, _T4, _T5, _T6, _T7, _T8 = (np.uint64(k) for k in range(CELL))
_ZERO, _LN4 = np.float32(0.0), np.float32(LN4)

EXACT_ENOUGH = {"contract", "nnan", "ninf", "nsz"}
"""Fast math without reassociation."""


class Slots(NamedTuple):
    """The slots of a scan of n points; made by `empty_slots`, changed in place."""

    cells: Float32
    """(blocks * slots * CELL * STRIDE,) the cells of every row."""
    points: Float32
    """(blocks * POINT * STRIDE,) u and r of every row."""
    bucket: Int32
    """(n,) the bucket that a point is in."""
    packed: Int32
    """(n,) the bucket that its slots hold; -1 none."""
    more: Int32
    """(n,) its first overflow row; -1 none."""
    owner: Int32
    """(rows,) the point of a row."""
    following: Int32
    """(rows,) the next overflow row of the same point, or the next free row; -1 none."""
    best: Float32
    """(rows,) the largest density of a row."""
    used: Int64
    """(3,) rows in use, first free row among them (-1 none), number of initialised blocks."""


def empty_slots(points: int, slots: int, most: int) -> Slots:
    """Slots for a scan of that many points whose buckets list at most `most` cells."""
    rows = points * max(1, -(-most // slots))
    blocks = -(-rows // BLOCK)
    return Slots(
        cells=np.empty(blocks * slots * CELL * STRIDE, np.float32),
        points=np.zeros(blocks * POINT * STRIDE, np.float32),
        bucket=np.empty(points, np.int32),
        packed=np.full(points, -1, np.int32),
        more=np.full(points, -1, np.int32),
        owner=np.zeros(rows, np.int32),
        following=np.full(rows, -1, np.int32),
        best=np.empty(blocks * BLOCK, np.float32),
        used=np.array([points, -1, 0]),
    )


if config.DISABLE_JIT:  # type: ignore[attr-defined]

    def _wide_vectors() -> None:
        """Without the compiler there is nothing to ask for."""

else:

    @intrinsic
    def _wide_vectors(_context: Any) -> Any:
        """Ask LLVM for 512-bit vectors in this function where the CPU has them.

        It avoids them by default, since they once lowered the clock; a reduction that does
        nothing else gains a third.
        """

        def mark(context: Any, builder: Any, *_: Any) -> Any:
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
            return context.get_dummy_value()

        return types.none(), mark


# 2^x on [-1/2, 1/2], relative error 1.6e-7: Chebyshev interpolation of degree 5
_P0, _P1, _P2, _P3, _P4, _P5 = (
    np.float32(c)
    for c in np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)
_ROUND = np.float32(1.5 * 2**23)  # adding it leaves the nearest integer in the lowest bits
_LEAST = np.float32(-100.0)
_MANTISSA = np.int32(23)


@njit(nogil=True, error_model="numpy", fastmath=EXACT_ENOUGH)
def _exp2(x):  # type: ignore[no-untyped-def]
    """2^x in float32 for x <= 0, 2^-100 below -100. Not reassociated: that undoes the rounding."""
    x = max(x, _LEAST)
    shifted = np.float32(x + _ROUND)
    f = x - (shifted - _ROUND)
    p = np.float32(_P0 + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5)))))
    exponent = np.int32(shifted.view(np.int32) << _MANTISSA)
    return np.int32(p.view(np.int32) + exponent).view(np.float32)


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=True)
def _add_cell(a, cells, k, ux, uy, uz, limit):  # type: ignore[no-untyped-def]
    """Add the cell at `k` to the sums of a row: p, 2 ln 2 p f and p (B - 2 ln 2 f f^T).

    With a `limit`, a cell whose mean is farther than its root has no density.
    """
    s, fx, fy, fz, mxx, mxy, mxz, myy, myz, mzz = a
    qx, qy, qz = ux - cells[k], uy - cells[k + _1], uz - cells[k + _2]
    bxx, bxy, bxz = cells[k + _3], cells[k + _4], cells[k + _5]
    byy, byz, bzz = cells[k + _6], cells[k + _7], cells[k + _8]
    gx = bxx * qx + bxy * qy + bxz * qz
    gy = bxy * qx + byy * qy + byz * qz
    gz = bxz * qx + byz * qy + bzz * qz
    p = _exp2(-(qx * gx + qy * gy + qz * gz))
    if limit is not None:
        p = p if qx * qx + qy * qy + qz * qz <= limit else _ZERO
    w = _LN4 * p
    hx, hy, hz = w * gx, w * gy, w * gz
    mxx += p * bxx
    mxy += p * bxy
    mxz += p * bxz
    myy += p * byy
    myz += p * byz
    mzz += p * bzz
    return (
        s + p,
        fx + hx,
        fy + hy,
        fz + hz,
        mxx - hx * gx,
        mxy - hx * gy,
        mxz - hx * gz,
        myy - hy * gy,
        myz - hy * gz,
        mzz - hz * gz,
    )


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=True)
def _reduce(cells, points, blocks, limit, seven, sums):  # type: ignore[no-untyped-def]
    """Add the sums of all rows to `sums`: those of kernels/newton.py, then p; without constants.

    A block is summed in float32, blocks in float64. `limit` and `seven` are None or given: each
    makes a kernel of its own, with or without radius, of seven slots or of one.
    """
    _wide_vectors()
    for block in range(blocks):
        s = gx = gy = gz = _ZERO
        cxx = cxy = cxz = cyx = cyy = cyz = czx = czy = czz = _ZERO
        axx = axy = axz = ayy = ayz = azz = _ZERO
        kxx = kxy = kxz = kyx = kyy = kyz = kzx = kzy = kzz = _ZERO
        nxx = nxy = nxz = nyy = nyz = nzz = _ZERO
        first = np.uint64(block) * (_CELL if seven is None else np.uint64(7) * _CELL)
        own = np.uint64(block) * _6
        for i in range(_BLOCK):
            k, j = first + i, own + i
            ux, uy, uz = points[j], points[j + _1], points[j + _2]
            x, y, z = points[j + _3], points[j + _4], points[j + _5]
            a = (_ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO)
            a = _add_cell(a, cells, k, ux, uy, uz, limit)
            if seven is not None:
                a = _add_cell(a, cells, k + _CELL, ux, uy, uz, limit)
                a = _add_cell(a, cells, k + np.uint64(2) * _CELL, ux, uy, uz, limit)
                a = _add_cell(a, cells, k + np.uint64(3) * _CELL, ux, uy, uz, limit)
                a = _add_cell(a, cells, k + np.uint64(4) * _CELL, ux, uy, uz, limit)
                a = _add_cell(a, cells, k + np.uint64(5) * _CELL, ux, uy, uz, limit)
                a = _add_cell(a, cells, k + np.uint64(6) * _CELL, ux, uy, uz, limit)
            p, fx, fy, fz, mxx, mxy, mxz, myy, myz, mzz = a
            s, gx, gy, gz = s + p, gx + fx, gy + fy, gz + fz
            cxx, cxy, cxz = cxx + fx * x, cxy + fx * y, cxz + fx * z
            cyx, cyy, cyz = cyx + fy * x, cyy + fy * y, cyz + fy * z
            czx, czy, czz = czx + fz * x, czy + fz * y, czz + fz * z
            axx, axy, axz = axx + mxx, axy + mxy, axz + mxz
            ayy, ayz, azz = ayy + myy, ayz + myz, azz + mzz
            # K = M [r]_x, [r]_x = ((0, -z, y), (z, 0, -x), (-y, x, 0))
            pxx, pxy, pxz = mxy * z - mxz * y, mxz * x - mxx * z, mxx * y - mxy * x
            pyx, pyy, pyz = myy * z - myz * y, myz * x - mxy * z, mxy * y - myy * x
            pzx, pzy, pzz = myz * z - mzz * y, mzz * x - mxz * z, mxz * y - myz * x
            kxx, kxy, kxz = kxx + pxx, kxy + pxy, kxz + pxz
            kyx, kyy, kyz = kyx + pyx, kyy + pyy, kyz + pyz
            kzx, kzy, kzz = kzx + pzx, kzy + pzy, kzz + pzz
            # N = -[r]_x K, symmetric
            nxx, nxy = nxx + z * pyx - y * pzx, nxy + z * pyy - y * pzy
            nxz, nyy = nxz + z * pyz - y * pzz, nyy + x * pzy - z * pxy
            nyz, nzz = nyz + x * pzz - z * pxz, nzz + y * pxz - x * pyz
        # fmt: off
        for n, value in enumerate((
            gx, gy, gz, cxx, cxy, cxz, cyx, cyy, cyz, czx, czy, czz, axx, axy, axz, ayy, ayz, azz,
            kxx, kxy, kxz, kyx, kyy, kyz, kzx, kzy, kzz, nxx, nxy, nxz, nyy, nyz, nzz, s,
        )):
            sums[n] += value
        # fmt: on


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=EXACT_ENOUGH)
def _locate(points, R, lever, t, corner, shape, edge, rows, bucket):  # type: ignore[no-untyped-def]
    """Compute u, r and the bucket of every point, into `rows` and `bucket`.

    x = R p + t [m, from the bucket corner `corner`] is float64, so u does not lose digits with the
    distance from the scan's origin. Points outside the grid fall into its empty border.
    `lever` is None, or another rotation than R to take r from.
    """
    _wide_vectors()
    inverse = 1.0 / edge
    cx, cy, cz = float(corner[0]), float(corner[1]), float(corner[2])
    top_x, top_y, top_z = shape[0] - 1.0, shape[1] - 1.0, shape[2] - 1.0
    ny, nz = float(shape[1]), float(shape[2])
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    tx, ty, tz = t[0], t[1], t[2]
    n = np.uint64(points.shape[1])
    for block in range((n + _BLOCK - np.uint64(1)) // _BLOCK):
        own, begin = block * _6, block * _BLOCK
        for i in range(min(_BLOCK, n - begin)):
            k, j = begin + i, own + i
            px, py, pz = points[0, k], points[1, k], points[2, k]
            x = r00 * px + r01 * py + r02 * pz + tx
            y = r10 * px + r11 * py + r12 * pz + ty
            z = r20 * px + r21 * py + r22 * pz + tz
            fx, fy, fz = np.floor(x * inverse), np.floor(y * inverse), np.floor(z * inverse)
            rows[j] = x - fx * edge
            rows[j + _1] = y - fy * edge
            rows[j + _2] = z - fz * edge
            if lever is None:
                rows[j + _3], rows[j + _4], rows[j + _5] = x - tx, y - ty, z - tz
            else:
                rows[j + _3] = lever[0, 0] * px + lever[0, 1] * py + lever[0, 2] * pz
                rows[j + _4] = lever[1, 0] * px + lever[1, 1] * py + lever[1, 2] * pz
                rows[j + _5] = lever[2, 0] * px + lever[2, 1] * py + lever[2, 2] * pz
            ax = min(max(fx + cx, 0.0), top_x)
            ay = min(max(fy + cy, 0.0), top_y)
            az = min(max(fz + cz, 0.0), top_z)
            bucket[k] = np.int32((ax * ny + ay) * nz + az)


@njit(nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _slot(row, slots):  # type: ignore[no-untyped-def]
    """Where the first slot of a row begins in `Slots.cells`; a slot takes `_CELL` more."""
    return (row // _BLOCK) * (slots * _CELL) + row % _BLOCK


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _clear(cells, row, slots, far):  # type: ignore[no-untyped-def]
    """Empty all slots of a row; the inverse covariances that they hold stay."""
    k = _slot(row, slots)
    for _ in range(slots):
        cells[k] = far
        k += _CELL


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _initialise(cells, used, slots, far):  # type: ignore[no-untyped-def]
    """Fill the blocks in use that are not initialised yet with empty slots."""
    while used[2] * BLOCK < used[0]:
        for row in range(np.uint64(used[2]) * _BLOCK, np.uint64(used[2] + 1) * _BLOCK):
            k = _slot(row, slots)
            for _ in range(slots):
                cells[k], cells[k + _1], cells[k + _2] = far, _ZERO, _ZERO
                cells[k + _3] = cells[k + _6] = cells[k + _8] = 1.0
                cells[k + _4] = cells[k + _5] = cells[k + _7] = 0.0
                k += _CELL
        used[2] += 1


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _further_row(cells, used, owner, following, more, i, slots, far):  # type: ignore[no-untyped-def]
    """An overflow row for point `i`, which has more cells than slots; its number."""
    row = used[1]
    if row >= 0:
        used[1] = following[row]
    else:
        row = used[0]
        used[0] += 1
        _initialise(cells, used, slots, far)
    owner[row] = i
    following[row] = more[i]
    more[i] = row
    return row


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _repack(state, local, slots, far):  # type: ignore[no-untyped-def]
    """Copy the cells of its bucket into the slots of every point that moved to another one.

    Means are taken from the bucket's corner, as u is.
    """
    cells, bucket, packed = state.cells, state.bucket, state.packed
    more, owner, following, used = state.more, state.owner, state.following, state.used
    first, cell, shift, table = local.first, local.cell, local.shift, local.table
    edge = np.float32(local.edge)
    for point in range(np.uint64(bucket.size)):
        a = bucket[point]
        if a == packed[point]:
            continue
        packed[point] = a
        row = more[point]
        while row >= 0:  # free its overflow rows
            _clear(cells, np.uint64(row), slots, far)
            after = following[row]
            following[row] = used[1]
            used[1] = row
            row = after
        more[point] = -1
        k, slot = _slot(point, slots), np.uint64(0)
        for entry in range(np.uint64(first[a]), np.uint64(first[a + 1])):
            if slot == slots:
                row = _further_row(cells, used, owner, following, more, point, slots, far)
                k, slot = _slot(np.uint64(row), slots), np.uint64(0)
            c, s = np.uint64(cell[entry]), shift[entry]
            cells[k] = table[c, _T0] + np.float32((s >> 8) - 8) * edge
            cells[k + _1] = table[c, _T1] + np.float32((s >> 4 & 15) - 8) * edge
            cells[k + _2] = table[c, _T2] + np.float32((s & 15) - 8) * edge
            cells[k + _3] = table[c, _T3]
            cells[k + _4] = table[c, _T4]
            cells[k + _5] = table[c, _T5]
            cells[k + _6] = table[c, _T6]
            cells[k + _7] = table[c, _T7]
            cells[k + _8] = table[c, _T8]
            k += _CELL
            slot += np.uint64(1)
        while slot < slots:
            cells[k] = far
            k += _CELL
            slot += np.uint64(1)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _copy_points(state):  # type: ignore[no-untyped-def]
    """Copy u and r of a point into its overflow rows."""
    points, owner = state.points, state.owner
    for row in range(np.uint64(state.bucket.size), np.uint64(state.used[0])):
        i = np.uint64(owner[row])
        there = (row // _BLOCK) * _6 + row % _BLOCK
        here = (i // _BLOCK) * _6 + i % _BLOCK
        for _ in range(POINT):
            points[there] = points[here]
            there += _1
            here += _1


@njit(nogil=True, error_model="numpy", boundscheck=False)
def forget_rows(state, slots, far):  # type: ignore[no-untyped-def]
    """Clear all overflow rows before a start, so that its sums do not depend on earlier starts."""
    n = state.bucket.size
    if state.used[0] == n:
        return
    for row in range(np.uint64(n), np.uint64(state.used[0])):
        _clear(state.cells, row, slots, far)
    state.used[0], state.used[1] = n, -1
    state.packed[:] = -1
    state.more[:] = -1


@njit(nogil=True, error_model="numpy", boundscheck=False)
def sums_at(state, points, R, lever, t, corner, local, seven, limit, sums):  # type: ignore[no-untyped-def]
    """The sums of one pose (see `_reduce`), without constants, into `sums`."""
    slots = np.uint64(1) if seven is None else np.uint64(7)
    far = np.float32(FAR * local.edge)
    _initialise(state.cells, state.used, slots, far)
    _locate(points, R, lever, t, corner, local.shape, local.edge, state.points, state.bucket)
    _repack(state, local, slots, far)
    _copy_points(state)
    sums[:] = 0.0
    _reduce(state.cells, state.points, -(-state.used[0] // BLOCK), limit, seven, sums)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _total_and_hits(best, n):  # type: ignore[no-untyped-def]
    """The sum and the number of the values above 0.

    In their order: with fastmath, the compiler chooses another one wherever it inlines this.
    """
    total, hits = 0.0, 0
    for i in range(n):
        total += best[i]
        hits += best[i] > 0.0
    return total, hits


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=True)
def best_of_cells(state, slots, limit):  # type: ignore[no-untyped-def]
    """At the pose last summed: the sum over points of their best cell's density, and the hits.

    A hit is a point with a cell within the root of `limit`; the direct modes give one that only
    the cells of empty slots exceed.
    """
    blocks = -(-state.used[0] // BLOCK)
    cells, points, best = state.cells, state.points, state.best
    best[:] = 0.0
    for block in range(blocks):
        own, out = np.uint64(block) * _6, np.uint64(block * BLOCK)
        for slot in range(slots):
            first = np.uint64(block * slots + slot) * _CELL
            for i in range(_BLOCK):
                k, j = first + i, own + i
                qx, qy, qz = (
                    points[j] - cells[k],
                    points[j + _1] - cells[k + _1],
                    points[j + _2] - cells[k + _2],
                )
                gx = cells[k + _3] * qx + cells[k + _4] * qy + cells[k + _5] * qz
                gy = cells[k + _4] * qx + cells[k + _6] * qy + cells[k + _7] * qz
                gz = cells[k + _5] * qx + cells[k + _7] * qy + cells[k + _8] * qz
                p = _exp2(-(qx * gx + qy * gy + qz * gz))
                p = p if qx * qx + qy * qy + qz * qz <= limit else _ZERO
                best[out + i] = max(best[out + i], p)
    n = state.bucket.size
    for row in range(n, state.used[0]):
        i = state.owner[row]
        best[i] = max(best[i], best[row])
    return _total_and_hits(best, n)
