"""One point per lattice voxel: the unweighted centroid, in whole millimetres.

definitions, section 1, "map points": integer sum / count, rounded to 1 mm (half to even), so that
the result depends neither on the order nor on the blocks in which the points arrive.
"""

import numba
import numpy as np

from tilestream.kernels.scatter import SPLITMIX, mix

EMPTY = np.int64(-1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_to_voxels(points, leaf, z_lo, columns, heights, keys, sums):  # type: ignore[no-untyped-def]
    """Add points to an open-addressing hash table of voxel sums.

    Args:
        points: (n, 3) int32 [mm from the tile's origin]; x, y >= 0.
        leaf: edge of a voxel [mm].
        z_lo: lowest voxel index in z.
        columns: voxels of the tile in y.
        heights: voxels of the tile in z, from `z_lo`.
        keys: (2^k,) int64, lexicographic number of the voxel of each slot, or EMPTY.
        sums: (2^k, 4) int64, x, y, z offsets from the voxel's corner [mm] and count, per slot.

    Returns:
        The number of slots that were newly taken. The caller keeps the table at most half full.
    """
    mask = np.int64(keys.shape[0] - 1)
    taken = 0
    last_key, last_slot = EMPTY, np.int64(0)
    for i in range(points.shape[0]):
        x, y, z = np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2])
        vx, vy, vz = x // leaf, y // leaf, z // leaf
        key = (vx * columns + vy) * heights + (vz - z_lo)
        slot = last_slot
        if key != last_key:
            slot = np.int64(mix(np.uint64(key) * SPLITMIX)) & mask
            while keys[slot] != key:
                if keys[slot] == EMPTY:
                    keys[slot] = key
                    taken += 1
                    break
                slot = (slot + 1) & mask
            last_key, last_slot = key, slot
        sums[slot, 0] += x - vx * leaf
        sums[slot, 1] += y - vy * leaf
        sums[slot, 2] += z - vz * leaf
        sums[slot, 3] += 1
    return taken


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rehash(keys, sums, new_keys, new_sums):  # type: ignore[no-untyped-def]
    """Move a table of voxel sums into a larger, empty one."""
    mask = np.int64(new_keys.shape[0] - 1)
    for old in range(keys.shape[0]):
        if keys[old] != EMPTY:
            slot = np.int64(mix(np.uint64(keys[old]) * SPLITMIX)) & mask
            while new_keys[slot] != EMPTY:
                slot = (slot + 1) & mask
            new_keys[slot] = keys[old]
            new_sums[slot] = sums[old]


@numba.njit(cache=True, nogil=True, inline="always")
def rounded_ratio(total, count):  # type: ignore[no-untyped-def]
    """The ratio total / count in whole numbers, half to even; total >= 0, count > 0."""
    quotient = total // count
    twice = 2 * (total - quotient * count)
    if twice > count or (twice == count and quotient % 2 == 1):
        quotient += 1
    return quotient


@numba.njit(cache=True, nogil=True, error_model="numpy")
def centroids(order, keys, sums, leaf, z_lo, columns, heights, out):  # type: ignore[no-untyped-def]
    """The centroid of each voxel of a table.

    Args:
        order: (m,) int64, slots in the order of their keys.
        keys: as in `add_to_voxels`.
        sums: as in `add_to_voxels`.
        leaf: edge of a voxel [mm].
        z_lo: lowest voxel index in z.
        columns: voxels of the tile in y.
        heights: voxels of the tile in z.
        out: (3, m) int32, receives the centroids [mm from the tile's origin].
    """
    for i in range(order.shape[0]):
        slot = order[i]
        key, count = keys[slot], sums[slot, 3]
        vz = key % heights + z_lo
        vy = (key // heights) % columns
        vx = key // (heights * columns)
        out[0, i] = vx * leaf + rounded_ratio(sums[slot, 0], count)
        out[1, i] = vy * leaf + rounded_ratio(sums[slot, 1], count)
        out[2, i] = vz * leaf + rounded_ratio(sums[slot, 2], count)
