"""Points to whole millimetres, and to the tiles that own them.

The lattice is that of definitions, section 1: floor division of millimetres.
"""

import numpy as np

from tilestream.kernels.cache import njit

SPLITMIX = np.uint64(0x9E3779B97F4A7C15)
"""2^64 / golden ratio, the increment of the splitmix64 generator (Steele et al. 2014)."""


@njit(nogil=True, error_model="numpy")
def round_to_mm(points, limits_mm, out):  # type: ignore[no-untyped-def]
    """Coordinates in metres to whole millimetres, half to even.

    Args:
        points: (n, 3) float64 [m].
        limits_mm: (3,) float64, largest magnitude per axis [mm].
        out: (n, 3) int64, receives the millimetres.

    Returns:
        The row of the first point beyond the limits, or -1.
    """
    for i in range(points.shape[0]):
        for axis in range(3):
            mm = np.rint(points[i, axis] * 1000.0)
            if not abs(mm) <= limits_mm[axis]:
                return i
            out[i, axis] = np.int64(mm)
    return -1


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


@njit(nogil=True, error_model="numpy")
def tile_bounds(points_mm, tile_mm):  # type: ignore[no-untyped-def]
    """The lowest and highest tile index of the points, as (ix_lo, iy_lo, ix_hi, iy_hi)."""
    x_lo = x_hi = points_mm[0, 0]
    y_lo = y_hi = points_mm[0, 1]
    for i in range(1, points_mm.shape[0]):
        x, y = points_mm[i, 0], points_mm[i, 1]
        x_lo, x_hi = min(x_lo, x), max(x_hi, x)
        y_lo, y_hi = min(y_lo, y), max(y_hi, y)
    return x_lo // tile_mm, y_lo // tile_mm, x_hi // tile_mm, y_hi // tile_mm


@njit(nogil=True, error_model="numpy")
def tile_of_points(points_mm, tile_mm, ix_lo, iy_lo, rows, tile_of, counts):  # type: ignore[no-untyped-def]
    """Which tile of a dense window owns each point, and how many each tile owns.

    Args:
        points_mm: (n, 3) int64 [mm].
        tile_mm: edge of a tile [mm].
        ix_lo: lowest tile index in x of the window.
        iy_lo: lowest tile index in y of the window.
        rows: tiles of the window in y.
        tile_of: (n,) int32, receives the number of the tile: (ix - ix_lo) * rows + iy - iy_lo.
        counts: (tiles of the window,) int64, the points of each tile are added.
    """
    # the floor of a float64 quotient of whole numbers is exact below 2^52, and far faster
    for i in range(points_mm.shape[0]):
        ix = np.int64(np.floor(points_mm[i, 0] / tile_mm))
        iy = np.int64(np.floor(points_mm[i, 1] / tile_mm))
        tile_of[i] = (ix - ix_lo) * rows + iy - iy_lo
    for i in range(points_mm.shape[0]):
        counts[tile_of[i]] += 1


@njit(nogil=True, error_model="numpy")
def group_by_tile(points_mm, tile_of, tile_mm, ix_lo, iy_lo, rows, next_row, out, prints):  # type: ignore[no-untyped-def]
    """Copy the points tile by tile, relative to their tile's origin, and add up each tile's
    fingerprint.

    The fingerprint of a set of points is two sums, modulo 2^64, each of a different 64-bit hash of
    every point: the same for any order and any split into blocks.

    Args:
        points_mm: (n, 3) int64 [mm].
        tile_of: (n,) int32 number of each point's tile in the window.
        tile_mm: edge of a tile [mm].
        ix_lo: lowest tile index in x of the window.
        iy_lo: lowest tile index in y of the window.
        rows: tiles of the window in y.
        next_row: (tiles,) int64, first row of each tile in `out`; is advanced.
        out: (n, 3) int32, receives the millimetres from the tile's origin.
        prints: (tiles, 2) uint64, the fingerprints are added.
    """
    last, x_lo, y_lo = -1, 0, 0
    for i in range(points_mm.shape[0]):
        tile = tile_of[i]
        if tile != last:
            last = tile
            x_lo, y_lo = (ix_lo + tile // rows) * tile_mm, (iy_lo + tile % rows) * tile_mm
        row = next_row[tile]
        next_row[tile] = row + 1
        x = points_mm[i, 0] - x_lo
        y = points_mm[i, 1] - y_lo
        z = points_mm[i, 2]
        out[row, 0] = x
        out[row, 1] = y
        out[row, 2] = z
        key = point_hash(x, y, z)
        prints[tile, 0] += key
        prints[tile, 1] += mix(key + SPLITMIX)


@njit(nogil=True, error_model="numpy")
def add_print(points, found):  # type: ignore[no-untyped-def]
    """Add the fingerprint of points to another: as `group_by_tile` makes it.

    Args:
        points: (n, 3) int32 [mm from the tile's origin].
        found: (2,) uint64, the fingerprint is added.
    """
    for i in range(points.shape[0]):
        key = point_hash(np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2]))
        found[0] += key
        found[1] += mix(key + SPLITMIX)
