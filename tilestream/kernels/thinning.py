"""Points in the order of their lattice voxels, and one point per voxel: the unweighted centroid.

Map points (definitions, section 1): integer sum / count, rounded to 1 mm (half to even), so that
the result depends neither on the order nor on the blocks in which the points arrive.

A point is packed into one number, its voxel above its offset there, x above y above z in both:
numbers sort many times faster than rows.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.bounds import bounds
from tilestream.kernels.cache import njit
from tilestream.kernels.cells import voxel_of

Int64 = NDArray[np.int64]

STEP = 4096
"""Points whose sums are held at once: in the fastest cache."""


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _pack(points, edge, low, bits, keys):  # type: ignore[no-untyped-def]
    """Points as numbers that sort by voxel, x slowest, then by x, y, z.

    Args:
        points: (n, 3) whole numbers [mm], contiguous.
        edge: edge of a voxel [mm].
        low: (3,) int64, the lowest voxel of each axis.
        bits: (4,) int64, bits of a voxel above the lowest, per axis, and of an offset in it;
            `bits[0] + bits[1] + bits[2] + 3 bits[3]` is at most 63.
        keys: (n,) int64, receives the numbers.
    """
    inverse, numbers = 1.0 / edge, points.reshape(-1)
    lx, ly, lz = low[0], low[1], low[2]
    ny, nz, e = bits[1], bits[2], bits[3]
    for i in range(np.uint64(keys.size)):
        j = np.uint64(3) * np.uint64(i)  # unsigned: no index from the end, which would be a branch
        x = np.int64(numbers[j])
        y = np.int64(numbers[j + np.uint64(1)])
        z = np.int64(numbers[j + np.uint64(2)])
        vx, vy, vz = voxel_of(x, inverse), voxel_of(y, inverse), voxel_of(z, inverse)
        voxel = ((((vx - lx) << ny) | (vy - ly)) << nz) | (vz - lz)
        x, y, z = x - vx * edge, y - vy * edge, z - vz * edge
        keys[i] = (((((voxel << e) | x) << e) | y) << e) | z


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _unpack(keys, edge, low, bits, out):  # type: ignore[no-untyped-def]
    """The points of `_pack`, as (3, n) [mm] in `out`."""
    lx, ly, lz = low[0], low[1], low[2]
    ny, nz, e = bits[1], bits[2], bits[3]
    of_y, of_z, of_e = (1 << ny) - 1, (1 << nz) - 1, (1 << e) - 1
    for i in range(keys.shape[0]):
        key = keys[i]
        voxel = key >> (3 * e)
        out[0, i] = ((voxel >> (ny + nz)) + lx) * edge + ((key >> (2 * e)) & of_e)
        out[1, i] = (((voxel >> nz) & of_y) + ly) * edge + ((key >> e) & of_e)
        out[2, i] = ((voxel & of_z) + lz) * edge + (key & of_e)


@njit(nogil=True, error_model="numpy", inline="always")
def rounded_mean(base, total, count):  # type: ignore[no-untyped-def]
    """The whole number nearest to base + total / count, half to even; 0 <= total < 2^53."""
    part = np.int64(
        total / count
    )  # exact: a quotient that is not whole is 1 / count below the next
    twice = 2 * (total - part * count)
    nearest = base + part
    return nearest + np.int64((twice > count) | ((twice == count) & (nearest & 1 == 1)))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _centroids(keys, edge, low, bits, origin, out):  # type: ignore[no-untyped-def]
    """The centroid of each voxel, rounded as a coordinate of the map, whatever the tile.

    Args:
        keys: (n,) int64, sorted numbers of `_pack`; fewer than 2^31.
        edge: edge of a voxel [mm], at most 2^21.
        low: as `_pack` took it.
        bits: as `_pack` took them.
        origin: (3,) int64, the tile's origin [mm].
        out: (3, n), receives the centroids in the order of the voxels.

    Returns:
        The number of voxels.
    """
    ny, nz, e = bits[1], bits[2], bits[3]
    of_y, of_z, of_e = (1 << ny) - 1, (1 << nz) - 1, (1 << e) - 1
    # of each voxel: its number, its end, and the sums of all offsets up to there; in row 0 those of
    # the voxel before
    voxel, end = np.zeros(STEP + 2, np.int64), np.zeros(STEP + 2, np.int64)
    to_x, to_y, to_z = np.zeros_like(end), np.zeros_like(end), np.zeros_like(end)
    x = y = z = np.int64(0)
    last, row, voxels = np.int64(-1), 0, 0
    for start in range(0, keys.size, STEP):
        stop = min(start + STEP, keys.size)
        for i in range(start, stop):
            key = keys[i]
            row += (key >> (3 * e)) != last
            last = key >> (3 * e)
            x += (key >> (2 * e)) & of_e
            y += (key >> e) & of_e
            z += key & of_e
            voxel[row], end[row] = last, i + 1
            to_x[row], to_y[row], to_z[row] = x, y, z
        whole = row if stop == keys.size else row - 1  # the last one may go on
        for r in range(1, whole + 1):
            k, count = voxels + r - 1, end[r] - end[r - 1]
            cx = ((voxel[r] >> (ny + nz)) + low[0]) * edge + origin[0]
            cy = (((voxel[r] >> nz) & of_y) + low[1]) * edge + origin[1]
            cz = ((voxel[r] & of_z) + low[2]) * edge + origin[2]
            out[0, k] = rounded_mean(cx, to_x[r] - to_x[r - 1], count) - origin[0]
            out[1, k] = rounded_mean(cy, to_y[r] - to_y[r - 1], count) - origin[1]
            out[2, k] = rounded_mean(cz, to_z[r] - to_z[r - 1], count) - origin[2]
        voxels += whole
        for r in range(2):  # the end of the last whole one, and the one that goes on
            at = min(whole + r, row)
            voxel[r], end[r], to_x[r], to_y[r], to_z[r] = (
                voxel[at],
                end[at],
                to_x[at],
                to_y[at],
                to_z[at],
            )
        row -= whole
    return voxels


def thin(points: NDArray[Any], edge: int, origin: Int64) -> NDArray[Any]:
    """One point per voxel, its centroid, in the order of the voxels.

    Args:
        points: (n, 3) int32 or int64, any order [mm].
        edge: edge of a voxel [mm], at most 2^21.
        origin: (3,) what is added to a coordinate for its rounding: that of the map is even [mm].

    Returns:
        (3, m) of the type of the points [mm].
    """
    parts = []
    for keys, low, bits in _in_order(points, edge):
        out = np.empty((3, len(keys)), points.dtype)
        parts.append(out[:, : _centroids(keys, edge, low, bits, origin, out)])
    return np.concatenate(parts, axis=1)


def thinned(points_mm: Int64, edge: int) -> tuple[Int64, Int64]:
    """The occupied voxels (m, 3), lexicographic, and their centroids (m, 3) [mm, map frame].

    Args:
        points_mm: (n, 3) any order [mm, map frame].
        edge: edge of a voxel [mm], at most 2^21.
    """
    centroids = np.ascontiguousarray(thin(points_mm, edge, np.zeros(3, np.int64)).T)
    return centroids // edge, centroids


def sort(points: NDArray[Any], edge: int) -> NDArray[Any]:
    """All of (n, 3) points, as (3, n) of their type, by voxel, x slowest, then by x, y, z [mm]."""
    parts = []
    for keys, low, bits in _in_order(points, edge):
        parts.append(np.empty((3, len(keys)), points.dtype))
        _unpack(keys, edge, low, bits, parts[-1])
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _in_order(points: NDArray[Any], edge: int) -> Iterator[tuple[Int64, Int64, Int64]]:
    """Points as sorted numbers: what `_pack` makes of them, and how.

    They are in one part, or in several where they are too far apart for numbers of 63 bits.
    """
    points = np.ascontiguousarray(points)
    low, high = bounds(points).astype(np.int64) // edge
    bits = np.array([int(span).bit_length() for span in (*(high - low), edge - 1)])
    if bits.sum() + 2 * bits[3] <= 63:
        keys = np.empty(len(points), np.int64)
        _pack(points, edge, low, bits, keys)
        keys.sort()
        yield keys, low, bits
        return
    axis = int(np.argmax(high > low))
    below = points[:, axis] < edge * ((low[axis] + high[axis] + 1) // 2)
    for half in (below, ~below):
        yield from _in_order(points[half], edge)
