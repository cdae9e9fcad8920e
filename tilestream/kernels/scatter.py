"""Points to whole millimetres, and to the tiles that own them.

The lattice is that of definitions, section 1: floor division of millimetres.
"""

import numpy as np

from tilestream.kernels.cache import njit

STEP = 2048
"""Points that are located at a time."""
SPLITMIX = np.uint64(0x9E3779B97F4A7C15)
"""2^64 / golden ratio, the increment of the splitmix64 generator (Steele et al. 2014)."""


@njit(nogil=True, inline="always")
def mix(z):  # type: ignore[no-untyped-def]
    """The mixing function of splitmix64: a 64-bit hash of 64 bits."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(nogil=True, inline="always")
def point_hash(x, y, z):  # type: ignore[no-untyped-def]
    """A 64-bit hash of three int64."""
    key = mix(np.uint64(x) * SPLITMIX + np.uint64(y))
    return mix(key * SPLITMIX + np.uint64(z))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _locate(numbers, start, tile_mm, window, tile_of, in_x, in_y, in_z):  # type: ignore[no-untyped-def]
    """Which tile owns each of as many points as `tile_of` is long, from the point `start`, and
    where in it they are [mm from its origin].

    In float64, where whole numbers below 2^53 are exact, as in `voxel_of`; with unsigned indices,
    none of which counts from the end: so it runs on vectors.
    """
    inverse = 1.0 / tile_mm
    ix_lo, iy_lo, rows = np.float64(window[0]), np.float64(window[1]), np.float64(window[2])
    for i in range(np.uint64(tile_of.size)):
        j = np.uint64(3) * (np.uint64(start) + np.uint64(i))
        x = np.rint(numbers[j] * 1000.0)
        y = np.rint(numbers[j + np.uint64(1)] * 1000.0)
        ix, iy = np.floor((x + 0.5) * inverse), np.floor((y + 0.5) * inverse)
        tile_of[i] = np.int32((ix - ix_lo) * rows + (iy - iy_lo))
        in_x[i] = np.int32(x - ix * tile_mm)
        in_y[i] = np.int32(y - iy * tile_mm)
        in_z[i] = np.int32(np.rint(numbers[j + np.uint64(2)] * 1000.0))


@njit(nogil=True, error_model="numpy", boundscheck=False)
def group_by_tile(points, tile_mm, window, counts, out):  # type: ignore[no-untyped-def]
    """Points as whole millimetres, half to even, tile by tile; those of a tile in their order.

    Twice over the points, in steps that stay in the fastest cache: how many each tile owns, then
    where each goes.

    Args:
        points: (n, 3) float64 [m], contiguous; in the window once they are whole millimetres.
        tile_mm: edge of a tile [mm].
        window: (3,) int64, lowest tile index in x and in y, and tiles in y. A tile has the number
            (ix - lowest) * rows + iy - lowest.
        counts: (tiles of the window,) int64 zeros, receives the points of each tile.
        out: (n, 3) int32, receives the millimetres from the tile's origin.
    """
    numbers, local, tile_of = (
        points.reshape(-1),
        np.empty((3, STEP), np.int32),
        np.empty(STEP, np.int32),
    )
    next_row = np.empty(0, np.int64)
    for placing in range(2):
        for start in range(0, points.shape[0], STEP):
            n = min(STEP, points.shape[0] - start)
            tiles, x, y, z = tile_of[:n], local[0, :n], local[1, :n], local[2, :n]
            _locate(numbers, start, tile_mm, window, tiles, x, y, z)
            if placing:
                _place(tiles, x, y, z, next_row, out)
            else:
                for i in range(np.uint64(n)):
                    counts[tiles[i]] += 1
        next_row = np.cumsum(counts) - counts


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _place(tile_of, x, y, z, next_row, out):  # type: ignore[no-untyped-def]
    """Write points to the next rows of their tiles."""
    for i in range(np.uint64(tile_of.size)):
        row = next_row[tile_of[i]]
        next_row[tile_of[i]] = row + 1
        out[row, 0], out[row, 1], out[row, 2] = x[i], y[i], z[i]


@njit(nogil=True, error_model="numpy", boundscheck=False)
def print_of(numbers):  # type: ignore[no-untyped-def]
    """The fingerprint of a set of points: two sums, modulo 2^64, each of a different 64-bit hash of
    every point. It is the same for any order, and that of two sets together is their sum.

    Args:
        numbers: (3 n,) int32, x, y, z of one point after the other [mm from the tile's origin].
    """
    first = second = np.uint64(0)
    for i in range(np.uint64(numbers.size // 3)):
        j = np.uint64(3) * np.uint64(i)  # unsigned: no index from the end, which would be a branch
        x, y, z = numbers[j], numbers[j + np.uint64(1)], numbers[j + np.uint64(2)]
        key = point_hash(np.int64(x), np.int64(y), np.int64(z))
        first += key
        second += mix(key + SPLITMIX)
    return first, second


@njit(nogil=True, error_model="numpy", boundscheck=False)
def prints_of(points, ends):  # type: ignore[no-untyped-def]
    """The fingerprints of sets of points that lie one after the other.

    Args:
        points: (n, 3) int32 [mm from the tile's origin].
        ends: (k,) int64, the row behind each set.

    Returns:
        (k, 2) uint64, the two sums of each.
    """
    out = np.empty((len(ends), 2), np.uint64)
    numbers, start = points.reshape(-1), 0
    for k in range(len(ends)):
        out[k, 0], out[k, 1] = print_of(numbers[3 * start : 3 * ends[k]])
        start = ends[k]
    return out
