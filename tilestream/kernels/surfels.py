"""Surfels of a map: a small disc, or a ball where nothing is flat, for every voxel with points.

Lengths that belong to a surfel are in edges of its voxel, 0.2 m by default.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.bounds import bounds
from tilestream.kernels.cache import njit
from tilestream.kernels.eigen import eigen

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

REACH = 2.25
"""Points within this distance decide the plane of a surfel [edges]: 0.45 m."""
THICKEST = 0.5
"""A surfel is flat while its points spread less than this across their plane [edges]: 0.10 m."""
FLATTEST = 0.6
"""… and while they spread less across it than this share of what they spread along it."""
LEAST = 5
"""… and while they are at least so many."""
BALL = 0.5
"""Radius of a surfel that is not flat [edges]: 0.1 m."""
LARGEST = 1.0
"""Largest radius of a surfel [edges]: 0.2 m."""
TOUCH = 0.75
"""Discs that are to touch reach this share of the distance from point to point …"""
WIDEST = 1.5
"""… and no farther than this [edges]."""
NARROW_MM = 1000
"""Largest edge of which the sums of neighbours fit into 32 bits: 343 voxels x (2.25 edges)^2."""
NONE = 2**62
"""Above all heights [mm]."""
NORMAL_ONE = 32767
"""A component of 1 of a stored normal."""


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _sums_within(x, y, z, at_x, at_y, at_z, limit, out):  # type: ignore[no-untyped-def]
    """1, x, x x^T over the points whose squared distance from a place is at most `limit`; without a
    branch, and in the type of the points: so it runs on vectors.
    """
    kind = x.dtype.type
    n = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = kind(0)
    for i in range(np.uint64(x.size)):
        dx, dy, dz = kind(x[i] - at_x), kind(y[i] - at_y), kind(z[i] - at_z)
        inside = kind(kind(kind(kind(dx * dx) + kind(dy * dy)) + kind(dz * dz)) <= limit)
        dx, dy, dz = kind(dx * inside), kind(dy * inside), kind(dz * inside)
        n = kind(n + inside)
        sx, sy, sz = kind(sx + dx), kind(sy + dy), kind(sz + dz)
        sxx, sxy = kind(sxx + kind(dx * dx)), kind(sxy + kind(dx * dy))
        sxz, syy = kind(sxz + kind(dx * dz)), kind(syy + kind(dy * dy))
        syz, szz = kind(syz + kind(dy * dz)), kind(szz + kind(dz * dz))
    out[0], out[1], out[2], out[3] = n, sx, sy, sz
    out[4], out[5], out[6], out[7], out[8], out[9] = sxx, sxy, sxz, syy, syz, szz


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _lowest_own(zs, first, corner, rows, own):  # type: ignore[no-untyped-def]
    """Height of the lowest point of a block's own columns from `own` on; `NONE`: there is none."""
    bottom = np.int64(NONE)
    for a in range(4):
        for b in range(4):
            if own[a, b] < first[corner + a * rows + b + 1]:
                bottom = min(bottom, np.int64(zs[own[a, b]]))
    return bottom


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _gather(points, first, corner, rows, lowest, bottom, top, near):  # type: ignore[no-untyped-def]
    """Copy the points between two heights of the 10 x 10 columns around a block to `near`; their
    count. `lowest` of each column is advanced: the next bottom is higher.
    """
    xs, ys, zs, count = points[0], points[1], points[2], 0
    for a in range(10):
        for b in range(10):
            j, stop = lowest[a, b], first[corner + (a - 3) * rows + b - 2]
            while j < stop and zs[j] < bottom:
                j += 1
            lowest[a, b] = j
            while j < stop and zs[j] < top:
                near[0, count], near[1, count], near[2, count] = xs[j], ys[j], zs[j]
                count += 1
                j += 1
    return count


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _neighbour_sums(points, first, rows, strip, reach, edge, row_of, out):  # type: ignore[no-untyped-def]
    """1, x, x x^T over the points within `reach` [mm] of each wanted point of a strip.

    x is the offset from that point [mm]: whole numbers, so their order has no effect. The points
    around a block of 4 x 4 x 4 voxels are gathered once for all that are in it.

    Args:
        points: (3, n) one per voxel [mm], by column of voxels, then by z; of a type that holds the
            sums.
        first: the first point of each column; there are `rows` columns to one x, and three or more
            without points on each side.
        rows: see there.
        strip: the first of its four columns in x.
        reach: at most 3 edges [mm].
        edge: edge of a voxel [mm].
        row_of: (n,) int32, the row of `out` of each wanted point; -1: not wanted.
        out: (m, 10) int64, receives the sums.
    """
    xs, ys, zs = points[0], points[1], points[2]
    near = np.empty((3, 10 * 10 * 10), points.dtype)
    lowest, own = np.empty((10, 10), np.int32), np.empty((4, 4), np.int32)
    limit = points.dtype.type(reach * reach)
    for begin in range(3, rows - 6, 4):
        corner = strip * rows + begin
        for a in range(10):
            for b in range(10):
                lowest[a, b] = first[corner + (a - 3) * rows + b - 3]
        own[:] = lowest[3:7, 3:7]
        bottom = _lowest_own(zs, first, corner, rows, own)
        while bottom < NONE:
            top = bottom + 4 * edge
            count = _gather(points, first, corner, rows, lowest, bottom - reach, top + reach, near)
            x, y, z = near[0, :count], near[1, :count], near[2, :count]
            for a in range(4):
                for b in range(4):
                    i, stop = own[a, b], first[corner + a * rows + b + 1]
                    while i < stop and zs[i] < top:
                        if row_of[i] >= 0:
                            _sums_within(x, y, z, xs[i], ys[i], zs[i], limit, out[row_of[i]])
                        i += 1
                    own[a, b] = i
            bottom = _lowest_own(zs, first, corner, rows, own)


@njit(nogil=True, error_model="numpy")
def _covariances(sums: Int64) -> Float64:
    """(n, 3, 3) unbiased covariances [mm^2] of the sums, exact in the numerator; 0 of one point."""
    out = np.zeros((len(sums), 3, 3))
    for i in range(len(sums)):
        n = sums[i, 0]
        if n < 2:
            continue
        k = 4
        for a in range(3):
            for b in range(a, 3):
                value = (n * sums[i, k] - sums[i, 1 + a] * sums[i, 1 + b]) / (n * (n - 1))
                out[i, a, b] = out[i, b, a] = value
                k += 1
    return out


@njit(nogil=True, error_model="numpy")
def _shape(points, sums, values, vectors, edge, touching, centre, normal, radius):  # type: ignore[no-untyped-def]
    """Write the disc or ball of each point, from the principal axes of the points around it;
    lengths [mm]. Discs that are `touching` leave no gap where the points are sparse.
    """
    for i in range(len(sums)):
        middle, least = np.sqrt(values[i, 1]), np.sqrt(values[i, 2])
        flat = sums[i, 0] >= LEAST and least < THICKEST * edge and least < FLATTEST * middle
        if not flat:
            for a in range(3):
                centre[i, a] = points[i, a]
                normal[i, a] = 0
            radius[i] = np.rint(BALL * edge)
            continue
        away = 0.0
        for a in range(3):
            away += sums[i, 1 + a] * vectors[i, a, 2]
        away /= sums[i, 0]
        for a in range(3):
            centre[i, a] = points[i, a] + np.rint(away * vectors[i, a, 2])
            normal[i, a] = np.rint(vectors[i, a, 2] * NORMAL_ONE)
        reach = min(LARGEST * edge, 0.25 * edge + 0.6 * middle)
        if touching:
            apart = REACH * edge * np.sqrt(np.pi / sums[i, 0])
            reach = min(WIDEST * edge, max(reach, TOUCH * apart))
        radius[i] = np.rint(reach)


def surfels_of(
    points_mm: Int64, index: Int64, edge_mm: int, own: NDArray[np.bool_], touching: bool = False
) -> tuple[Int64, NDArray[np.int16], NDArray[np.int32]]:
    """The surfels of voxels: their points' plane within 2.25 edges, or a ball.

    The plane is that of the least principal axis; the centre is the voxel's point moved onto it.

    Args:
        points_mm: (n, 3) one point per occupied voxel [mm, map frame], by rising `index`.
        index: (n, 3) voxels, lexicographic.
        edge_mm: edge of a voxel [mm].
        own: (n,) the voxels whose surfels are wanted; the others only contribute points.
        touching: whether discs are as large as the distance from point to point asks for.

    Returns:
        Of the wanted voxels, in their order: (m, 3) centres [mm, map frame]; (m, 3) unit normals,
        `NORMAL_ONE` for 1, sign arbitrary, 0 for a ball; (m,) radii [mm].
    """
    wanted = np.flatnonzero(own)
    centre = np.empty((len(wanted), 3), np.int64)
    normal = np.empty((len(wanted), 3), np.int16)
    radius = np.empty(len(wanted), np.int32)
    if not len(wanted):
        return centre, normal, radius
    lowest, highest = bounds(index)[:, :2]
    columns, rows = (highest - lowest + 10).tolist()  # three before, six behind: a block's overhang
    column = (index[:, 0] - lowest[0] + 3) * rows + index[:, 1] - lowest[1] + 3
    first = np.zeros(columns * rows + 1, np.int32)
    np.cumsum(np.bincount(column, minlength=columns * rows), out=first[1:])
    kind = np.int32 if edge_mm <= NARROW_MM else np.int64
    points = np.ascontiguousarray((points_mm - points_mm[0]).T.astype(kind))
    reach, row_of = int(REACH * edge_mm), np.full(len(points_mm), -1, np.int32)
    strip_of = (index[wanted, 0] - lowest[0]) // 4
    strips = np.arange(strip_of[0], strip_of[-1] + 2)
    ends = np.searchsorted(strip_of, strips)
    for strip, begin, end in zip(strips[:-1], ends[:-1], ends[1:], strict=True):
        some = wanted[begin:end]
        row_of[some] = np.arange(len(some))
        sums = np.zeros((len(some), 10), np.int64)
        _neighbour_sums(points, first, rows, 3 + 4 * strip, reach, edge_mm, row_of, sums)
        axes = eigen(_covariances(sums))
        out = centre[begin:end], normal[begin:end], radius[begin:end]
        _shape(points_mm[some], sums, *axes, edge_mm, touching, *out)
    return centre, normal, radius
