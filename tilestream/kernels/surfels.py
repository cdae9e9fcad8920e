"""Surfels of a map: a small disc, or a ball where nothing is flat, for every voxel with points.

Lengths that belong to a surfel are in edges of its voxel, 0.2 m by default.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit
from tilestream.kernels.cells import eigen

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
CHUNK = 2**16
"""Surfels whose sums and axes are held at once: 20 MB."""
NORMAL_ONE = 32767
"""A component of 1 of a stored normal."""


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _neighbour_sums(points, column, first, rows, reach, wanted, out):  # type: ignore[no-untyped-def]
    """1, x, x x^T over the points within `reach` [mm] of each wanted point.

    x is the offset from that point [mm]: whole numbers, so their order has no effect. `points` are
    sorted by column (`column`, of which there are `rows` to one x; `first` of each), then by z.
    Going up a column, the lowest neighbour in any other column only moves up too.
    """
    limit = reach * reach
    lowest = np.zeros((7, 7), np.int64)
    was = np.int64(-1)
    for k in range(len(wanted)):
        i = wanted[k]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        fresh = column[i] != was
        was = column[i]
        for a in range(7):
            for b in range(7):
                near = column[i] + (a - 3) * rows + b - 3
                stop = first[near + 1]
                j = first[near] if fresh else lowest[a, b]
                while j < stop and points[j, 2] < z - reach:
                    j += 1
                lowest[a, b] = j
                while j < stop and points[j, 2] <= z + reach:
                    dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    if dx * dx + dy * dy + dz * dz <= limit:
                        out[k, 0] += 1
                        out[k, 1] += dx
                        out[k, 2] += dy
                        out[k, 3] += dz
                        out[k, 4] += dx * dx
                        out[k, 5] += dx * dy
                        out[k, 6] += dx * dz
                        out[k, 7] += dy * dy
                        out[k, 8] += dy * dz
                        out[k, 9] += dz * dz
                    j += 1


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
    low = index.min(axis=0)[:2] - 3
    columns, rows = (int(s) for s in index.max(axis=0)[:2] + 4 - low)
    column = (index[:, 0] - low[0]) * rows + index[:, 1] - low[1]
    first = np.zeros(columns * rows + 1, np.int32)
    np.cumsum(np.bincount(column, minlength=columns * rows), out=first[1:])
    for begin in range(0, len(wanted), CHUNK):
        part = slice(begin, begin + CHUNK)
        some = wanted[part]
        sums = np.zeros((len(some), 10), np.int64)
        _neighbour_sums(points_mm, column, first, rows, int(REACH * edge_mm), some, sums)
        axes = eigen(_covariances(sums))
        out = centre[part], normal[part], radius[part]
        _shape(points_mm[some], sums, *axes, edge_mm, touching, *out)
    return centre, normal, radius
