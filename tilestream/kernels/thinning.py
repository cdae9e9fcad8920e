"""Points in the order of their lattice voxels, and one point per voxel: the unweighted centroid.

Map points (definitions, section 1): integer sum / count, rounded to 1 mm (half to even), so that
the result depends neither on the order nor on the blocks in which the points arrive.
"""

import numpy as np

from tilestream.kernels.cache import njit


@njit(nogil=True, error_model="numpy")
def place_rows(points, keys, next_row, out):  # type: ignore[no-untyped-def]
    """Copy points to the rows of their keys: one pass of a stable counting sort.

    Args:
        points: (n, 3) int32.
        keys: (n,) int64, from 0.
        next_row: (largest key + 1,) int64, where the first point of each key goes; is advanced.
        out: (n, 3) int32, receives the points by key, in their old order where keys are equal.
    """
    for i in range(points.shape[0]):
        row = next_row[keys[i]]
        next_row[keys[i]] = row + 1
        out[row, 0] = points[i, 0]
        out[row, 1] = points[i, 1]
        out[row, 2] = points[i, 2]


@njit(nogil=True, inline="always")
def rounded_mean(base, total, count):  # type: ignore[no-untyped-def]
    """The whole number nearest to base + total / count, half to even; total >= 0, count > 0."""
    quotient = base + total // count
    twice = 2 * (total % count)
    if twice > count or (twice == count and quotient % 2 == 1):
        quotient += 1
    return quotient


@njit(nogil=True, error_model="numpy")
def voxel_end(points, start, edge, corner):  # type: ignore[no-untyped-def]
    """The end of a point's voxel among points that are sorted by voxel.

    Args:
        points: (n, 3) int32 [mm], the points of a voxel together.
        start: first point of the voxel.
        edge: edge of a voxel [mm].
        corner: (3,) int64, receives its lowest corner [mm].

    Returns:
        The row of the first later point in another voxel, or n.
    """
    for axis in range(3):
        corner[axis] = points[start, axis] // edge * edge
    stop = start + 1
    while stop < points.shape[0]:
        for axis in range(3):
            offset = points[stop, axis] - corner[axis]
            if offset < 0 or offset >= edge:
                return stop
        stop += 1
    return stop


@njit(nogil=True, error_model="numpy")
def centroids(points, edge, origin, out):  # type: ignore[no-untyped-def]
    """The centroid of each voxel, rounded as a coordinate of the map, whatever the tile.

    Args:
        points: (n, 3) int32 [mm from the tile's origin], the points of a voxel together.
        edge: edge of a voxel [mm].
        origin: (3,) int64, the tile's origin [mm].
        out: (n, 3) int32, receives the centroids in the order of the voxels.

    Returns:
        The number of voxels.
    """
    corner, total = np.empty(3, np.int64), np.empty(3, np.int64)
    start = voxels = 0
    while start < points.shape[0]:
        stop = voxel_end(points, start, edge, corner)
        total[:] = 0
        for i in range(start, stop):
            for axis in range(3):
                total[axis] += points[i, axis] - corner[axis]
        for axis in range(3):
            base = origin[axis] + corner[axis]
            out[voxels, axis] = rounded_mean(base, total[axis], stop - start) - origin[axis]
        voxels += 1
        start = stop
    return voxels


@njit(nogil=True, error_model="numpy")
def sort_in_voxels(points, edge):  # type: ignore[no-untyped-def]
    """Sort the points of each voxel by x, y, z, in place.

    Args:
        points: (n, 3) int32 [mm], the points of a voxel together.
        edge: edge of a voxel [mm], at most 2^20.
    """
    corner = np.empty(3, np.int64)
    start = 0
    while start < points.shape[0]:
        stop = voxel_end(points, start, edge, corner)
        packed = np.zeros(stop - start, np.int64)
        for i in range(start, stop):
            for axis in range(3):
                packed[i - start] = packed[i - start] * edge + points[i, axis] - corner[axis]
        packed.sort()
        for i in range(start, stop):
            rest = packed[i - start]
            for axis in range(2, -1, -1):
                points[i, axis] = corner[axis] + rest % edge
                rest //= edge
        start = stop
