"""Normal distributions from points: exact integer sums per voxel, moments, normals.

Everything up to the covariance is integers, so it depends neither on the order of the points nor
on the tiling (definitions, section 1). Lengths are millimetres in the sums and metres after them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.bounds import bounds
from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

EXACT_MM = 2**50
"""Coordinates below this [mm] have an exact voxel index (`voxel_of`)."""

STEP = 2048
"""Points that are summed at a time: what is known of them stays in the fastest cache."""
COUNT, SX, SY, SZ, SXX, SXY, SXZ, SYY, SYZ, SZZ = range(10)
"""Columns of the sums of a voxel: 1, x, x x^T over its points [1, mm, mm^2]."""


@njit(nogil=True, error_model="numpy", inline="always")
def voxel_of(x_mm, inverse_edge):  # type: ignore[no-untyped-def]
    """floor(x / edge) of whole millimetres, given 1 / edge [1/mm].

    (x + 1/2) / edge is at least 1 / (2 edge) away from the next integer, and the two roundings
    move it by less than 2^-52 x / edge: exact for |x| < `EXACT_MM`.
    """
    return np.int64(np.floor((x_mm + 0.5) * inverse_edge))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _locate(numbers, unit_mm, edge_mm, low, span, start, voxel, dx, dy, dz):  # type: ignore[no-untyped-def]
    """The voxels of as many points as `voxel` is long, from the point `start`: the number of each
    in the box, and the point's offset from its lower corner [mm].

    All in float64, where whole numbers below 2^53 are exact (see `voxel_of`); with unsigned
    indices, none of which counts from the end: so it runs on vectors.
    """
    inverse, edge = 1.0 / edge_mm, np.float64(edge_mm)
    lx, ly, lz = np.float64(low[0]), np.float64(low[1]), np.float64(low[2])
    ny, nz = np.float64(span[1]), np.float64(span[2])
    for i in range(np.uint64(voxel.size)):
        j = np.uint64(3) * (np.uint64(start) + np.uint64(i))
        x = np.rint(numbers[j] * unit_mm)
        y = np.rint(numbers[j + np.uint64(1)] * unit_mm)
        z = np.rint(numbers[j + np.uint64(2)] * unit_mm)
        vx, vy = np.floor((x + 0.5) * inverse), np.floor((y + 0.5) * inverse)
        vz = np.floor((z + 0.5) * inverse)
        dx[i], dy[i], dz[i] = x - vx * edge, y - vy * edge, z - vz * edge
        voxel[i] = np.int32(((vx - lx) * ny + (vy - ly)) * nz + (vz - lz))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _number(voxel, table, used):  # type: ignore[no-untyped-def]
    """Turn voxels into rows: new ones get the next, from `used`; returns the rows in use."""
    for i in range(np.uint64(voxel.size)):
        row = table[voxel[i]]
        if row < 0:
            row = used
            table[voxel[i]] = row
            used += np.int32(1)
        voxel[i] = row
    return used


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _add(row, dx, dy, dz, rows):  # type: ignore[no-untyped-def]
    """Add points to the sums of their rows."""
    for i in range(np.uint64(row.size)):
        x, y, z = np.int64(dx[i]), np.int64(dy[i]), np.int64(dz[i])
        r = np.uint64(row[i])
        rows[r, COUNT] += 1
        rows[r, SX] += x
        rows[r, SY] += y
        rows[r, SZ] += z
        rows[r, SXX] += x * x
        rows[r, SXY] += x * y
        rows[r, SXZ] += x * z
        rows[r, SYY] += y * y
        rows[r, SYZ] += y * z
        rows[r, SZZ] += z * z


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _sum_voxels(points, unit_mm, edge_mm, low, span, table):  # type: ignore[no-untyped-def]
    """Give every occupied voxel of the box a row 0, 1, ... in `table`; returns their sums. Rows are
    two cache lines wide, of which ten columns are used.

    Step by step, and each step in loops of its own: what is between them stays in the cache, and
    adding to a row does not wait for the next point's row.
    """
    numbers = points.reshape(-1)
    rows, used = np.zeros((STEP, 16), np.int64), np.int32(0)
    voxel, offset = np.empty(STEP, np.int32), np.empty((3, STEP))
    for start in range(0, points.shape[0], STEP):
        n = min(STEP, points.shape[0] - start)
        row, dx, dy, dz = voxel[:n], offset[0, :n], offset[1, :n], offset[2, :n]
        _locate(numbers, unit_mm, edge_mm, low, span, start, row, dx, dy, dz)
        used = _number(row, table, used)
        if used > len(rows) - STEP:
            wider = np.zeros((2 * len(rows), 16), np.int64)
            wider[: len(rows)] = rows
            rows = wider
        _add(row, dx, dy, dz, rows)
    return rows[:used]


@njit(nogil=True)
def _in_order(rows, low, span, table, min_points):  # type: ignore[no-untyped-def]
    """Index and sums of the voxels with at least `min_points` points, by rising voxel index."""
    kept = 0
    for r in range(rows.shape[0]):
        kept += rows[r, COUNT] >= min_points
    index, sums = np.empty((kept, 3), np.int64), np.empty((kept, 10), np.int64)
    k = 0
    for v in range(table.size):
        r = table[v]
        if r >= 0 and rows[r, COUNT] >= min_points:
            index[k, 0] = v // (span[1] * span[2]) + low[0]
            index[k, 1] = v // span[2] % span[1] + low[1]
            index[k, 2] = v % span[2] + low[2]
            sums[k] = rows[r, :10]
            k += 1
    return index, sums


def _cut(low: Int64, span: Int64, items: int) -> tuple[int, int] | None:
    """Where to halve a box of voxels that is too large for a table: axis and first voxel of the
    upper half. None where the table is small, or no larger than twice the number of `items`.
    """
    if float(span[0]) * float(span[1]) * float(span[2]) <= max(2**20, 2 * items):
        return None
    axis = int(np.argmax(span))
    return axis, int(low[axis] + span[axis] // 2)


def lexicographic_order(index: Int64) -> Int64:
    """The order that sorts voxel indices (n, 3) lexicographically, x slowest."""
    return np.lexsort((index[:, 2], index[:, 1], index[:, 0]))


def cell_sums(points_mm: Int64, edge_mm: int, min_points: int = 1) -> tuple[Int64, Int64]:
    """Exact sums of 1, x, x x^T per voxel; x is the offset from the voxel's lower corner.

    Args:
        points_mm: (n, 3) points [mm, map frame], |coordinates| < `EXACT_MM`, any order.
        edge_mm: edge of a voxel [mm], with n edge_mm^2 < 2^63.
        min_points: voxels with fewer points are left out.

    Returns:
        (k, 3) voxel indices, lexicographic, and (k, 10) sums [1, mm, mm^2] in the columns `COUNT`
        to `SZZ`.
    """
    points_mm = np.ascontiguousarray(points_mm)
    return cell_sums_in(bounds(points_mm), points_mm, 1, edge_mm, min_points)


def cell_sums_in(
    box: NDArray[Any], points: NDArray[Any], unit_mm: int, edge_mm: int, min_points: int
) -> tuple[Int64, Int64]:
    """As `cell_sums`, of points whose `bounds` are known.

    They are in units of `unit_mm` (1: whole millimetres, 1000: metres); the whole millimetres, half
    to even, are meant.
    """
    low, high = np.rint(box * unit_mm).astype(np.int64) // edge_mm
    span = high - low + 1
    cut = _cut(low, span, len(points))
    if cut is not None:
        axis, voxel = cut
        below = np.rint(points[:, axis] * unit_mm) < voxel * edge_mm
        halves = [
            cell_sums_in(bounds(half), half, unit_mm, edge_mm, min_points)
            for half in (points[below], points[~below])
        ]
        index, sums = (np.concatenate(parts) for parts in zip(*halves, strict=True))
        order = lexicographic_order(index)
        return index[order], sums[order]
    table = np.full(int(np.prod(span)), -1, np.int32)
    rows = _sum_voxels(points, float(unit_mm), edge_mm, low, span, table)
    found: tuple[Int64, Int64] = _in_order(rows, low, span, table, min_points)
    return found


@njit(nogil=True, error_model="numpy", inline="always")
def _covariance_mm2(n, sx, sy, sxy, exact):  # type: ignore[no-untyped-def]
    if exact:
        return (n * sxy - sx * sy) / (np.float64(n) * (n - 1))
    return (sxy - np.float64(sx) * sy / n) / (n - 1)


@njit(nogil=True, error_model="numpy")
def moments(index: Int64, sums: Int64, edge_mm: int) -> tuple[Float64, Float64]:
    """Mean [m, map frame] and unbiased covariance [m^2] from the sums of `cell_sums`.

    mean = (n corner + Sx) / (1000 n), the quotient of two integers rounded once (while the
    numerator is below 2^53 mm: two million points in one cell at UTM northings).
    Sigma_xy = (n Sxy - Sx Sy) / (n (n - 1)) after moving the sums to the whole millimetre next to
    the mean; that numerator is exact while n Sxx < 2^62, and beyond it nothing cancels.
    A covariance of one point is 0.
    """
    k = index.shape[0]
    mean = np.empty((k, 3))
    covariance = np.zeros((k, 3, 3))
    for i in range(k):
        n = sums[i, COUNT]
        for a in range(3):
            total = index[i, a] * edge_mm * n + sums[i, SX + a]
            if abs(total) < 2**53:
                mean[i, a] = total / (n * 1000)
            else:
                whole = total // (n * 1000)
                mean[i, a] = whole + (total - whole * n * 1000) / (n * 1000)
        if n < 2:
            continue
        mx, my, mz = sums[i, SX] // n, sums[i, SY] // n, sums[i, SZ] // n
        sx, sy, sz = sums[i, SX] - n * mx, sums[i, SY] - n * my, sums[i, SZ] - n * mz
        # the sum of (x - m)(y - m') = Sxy - m' Sx - m Sy + n m m', with sx = Sx - n m
        sxx = sums[i, SXX] - mx * (sums[i, SX] + sx)
        syy = sums[i, SYY] - my * (sums[i, SY] + sy)
        szz = sums[i, SZZ] - mz * (sums[i, SZ] + sz)
        sxy = sums[i, SXY] - mx * sums[i, SY] - my * sx
        sxz = sums[i, SXZ] - mx * sums[i, SZ] - mz * sx
        syz = sums[i, SYZ] - my * sums[i, SZ] - mz * sy
        exact = np.float64(n) * max(sxx, syy, szz, n) < 2.0**62
        covariance[i, 0, 0] = _covariance_mm2(n, sx, sx, sxx, exact) * 1e-6
        covariance[i, 1, 1] = _covariance_mm2(n, sy, sy, syy, exact) * 1e-6
        covariance[i, 2, 2] = _covariance_mm2(n, sz, sz, szz, exact) * 1e-6
        covariance[i, 0, 1] = covariance[i, 1, 0] = _covariance_mm2(n, sx, sy, sxy, exact) * 1e-6
        covariance[i, 0, 2] = covariance[i, 2, 0] = _covariance_mm2(n, sx, sz, sxz, exact) * 1e-6
        covariance[i, 1, 2] = covariance[i, 2, 1] = _covariance_mm2(n, sy, sz, syz, exact) * 1e-6
    return mean, covariance


@njit(nogil=True, error_model="numpy")
def normals(eigenvalues: Float64, eigenvectors: Float64) -> Float64:
    """Unit normals (n, 3), each with the map-wide sign (definitions, section 1).

    The eigenvector of lam3; where lam2 - lam3 <= 1e-9 lam1 it is z x e1, normalised, and the
    x axis if e1 is vertical. The component of largest magnitude is positive; magnitudes within
    1e-6 count as equal, the first of x, y, z decides.
    """
    k = eigenvalues.shape[0]
    out = np.empty((k, 3))
    for i in range(k):
        x, y, z = eigenvectors[i, 0, 2], eigenvectors[i, 1, 2], eigenvectors[i, 2, 2]
        if eigenvalues[i, 1] - eigenvalues[i, 2] <= 1e-9 * eigenvalues[i, 0]:
            x, y, z = -eigenvectors[i, 1, 0], eigenvectors[i, 0, 0], 0.0
            horizontal = np.sqrt(x * x + y * y)
            if horizontal < 1e-9:
                x, y = 1.0, 0.0
            else:
                x, y = x / horizontal, y / horizontal
        largest = max(abs(x), abs(y), abs(z)) - 1e-6
        leading = x if abs(x) >= largest else (y if abs(y) >= largest else z)
        sign = -1.0 if leading < 0.0 else 1.0
        out[i, 0], out[i, 1], out[i, 2] = sign * x, sign * y, sign * z
    return out


@njit(nogil=True, error_model="numpy")
def regularise(eigenvalues: Float64, eigenvectors: Float64) -> tuple[Float64, Float64]:
    """Regularised covariances [m^2] and their inverses [1/m^2], (n, 3, 3) each.

    lam_i' = max(lam_i, 0.01 lam1, (0.01 m)^2), same eigenvectors (definitions, section 1).
    """
    k = eigenvalues.shape[0]
    covariance = np.empty((k, 3, 3))
    inverse = np.empty((k, 3, 3))
    for i in range(k):
        floor = max(0.01 * eigenvalues[i, 0], 1e-4)
        l0, l1 = max(eigenvalues[i, 0], floor), max(eigenvalues[i, 1], floor)
        l2 = max(eigenvalues[i, 2], floor)
        for a in range(3):
            for b in range(a, 3):
                e0 = eigenvectors[i, a, 0] * eigenvectors[i, b, 0]
                e1 = eigenvectors[i, a, 1] * eigenvectors[i, b, 1]
                e2 = eigenvectors[i, a, 2] * eigenvectors[i, b, 2]
                covariance[i, a, b] = covariance[i, b, a] = l0 * e0 + l1 * e1 + l2 * e2
                inverse[i, a, b] = inverse[i, b, a] = e0 / l0 + e1 / l1 + e2 / l2
    return covariance, inverse


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _look_up(points_mm, edge_mm, low, span, table):  # type: ignore[no-untyped-def]
    inverse = 1.0 / edge_mm
    lx, ly, lz = low[0], low[1], low[2]
    nx, ny, nz = np.uint64(span[0]), np.uint64(span[1]), np.uint64(span[2])
    out = np.empty(points_mm.shape[0], np.int64)
    for i in range(points_mm.shape[0]):
        jx = np.uint64(voxel_of(points_mm[i, 0], inverse) - lx)
        jy = np.uint64(voxel_of(points_mm[i, 1], inverse) - ly)
        jz = np.uint64(voxel_of(points_mm[i, 2], inverse) - lz)
        inside = (jx < nx) & (jy < ny) & (jz < nz)
        out[i] = table[(jx * ny + jy) * nz + jz] if inside else -1
    return out


def cell_of_points(points_mm: Int64, edge_mm: int, index: Int64) -> Int64:
    """The row in `index` of the voxel that holds each point; -1 where that voxel has no row.

    Args:
        points_mm: (n, 3) points [mm, map frame], |coordinates| < `EXACT_MM`.
        edge_mm: edge of a voxel [mm].
        index: (k, 3) voxel indices, no two alike.
    """
    if not len(index):
        return np.full(len(points_mm), -1, np.int64)
    low, high = bounds(np.ascontiguousarray(index))
    span = high - low + 1
    cut = _cut(low, span, 4 * (len(points_mm) + len(index)))
    if cut is not None:
        axis, voxel = cut
        out = np.empty(len(points_mm), np.int64)
        points_below, cells_below = points_mm[:, axis] < voxel * edge_mm, index[:, axis] < voxel
        for of_points, of_cells in ((points_below, cells_below), (~points_below, ~cells_below)):
            rows = np.append(np.flatnonzero(of_cells), -1)
            out[of_points] = rows[cell_of_points(points_mm[of_points], edge_mm, index[of_cells])]
        return out
    table = np.full(int(np.prod(span)), -1, np.int32)
    table[np.ravel_multi_index(tuple((index - low).T), tuple(span))] = np.arange(len(index))
    points_mm = np.ascontiguousarray(points_mm, np.int64)
    found: Int64 = _look_up(points_mm, edge_mm, low, span, table)
    return found
