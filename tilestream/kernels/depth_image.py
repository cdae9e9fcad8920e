"""Which pixels of a lidar's depth image the map fills (factor `occupancy_ratio`).

Exact, though most points are never looked at: a block of points is passed over when the pixels that
its bounding sphere can touch are all full already, and beyond some distance nearly all of them are.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tilestream.kernels.azimuth import azimuth_bin_exactly, is_unsure, turns_guess

COLUMNS = 360
"""Azimuth columns of the image, 1 deg each."""
WORD = 64
"""Rows that share a word of a column's bits."""


@njit(cache=True, nogil=True)
def thin(index: NDArray[np.int64], sums: NDArray[np.int64], edge_mm: int) -> NDArray[np.int64]:
    """Centroids of voxels, integer sum / count, rounded to whole millimetres, half to even.

    Args:
        index: (n, 3) voxel indices.
        sums: (n, 4 or more) count and sums of the offsets from the voxel's corner [1, mm].
        edge_mm: edge of a voxel [mm].

    Returns:
        (n, 3) points [mm].
    """
    out = np.empty(index.shape, np.int64)
    for i in range(len(index)):
        count = sums[i, 0]
        for a in range(3):
            total = sums[i, 1 + a]
            whole = total // count
            twice = 2 * (total - whole * count)
            # The parity that decides a tie is that of the coordinate, not of the offset.
            at = index[i, a] * edge_mm + whole
            out[i, a] = at + (twice > count or (twice == count and at % 2 == 1))
    return out


@njit(cache=True, nogil=True, boundscheck=False)
def _row_of(s, edges, guess):  # type: ignore[no-untyped-def]
    """Row of the sine of an elevation; what lies beyond the outer edges is in the outer rows."""
    last = len(edges) - 2
    slot = np.int64((s - edges[0]) * (len(guess) / (edges[-1] - edges[0])))
    row = guess[min(max(slot, 0), len(guess) - 1)]
    while row < last and s >= edges[row + 1]:
        row += 1
    while row > 0 and s < edges[row]:
        row -= 1
    return row


@njit(cache=True, nogil=True)
def row_guesses(edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """A row near each of 1024 even steps from the lowest to the highest edge."""
    steps = 1024
    guess = np.empty(steps, np.int64)
    row = 0
    for k in range(steps):
        s = edges[0] + (edges[-1] - edges[0]) * k / steps
        while row < len(edges) - 2 and s >= edges[row + 1]:
            row += 1
        guess[k] = row
    return guess


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _in_view(spheres, first, last, place, reach, edges, out):  # type: ignore[no-untyped-def]
    """Spheres first to last that reach into the range and between the outer edges; their number."""
    px, py, pz = place[0], place[1], place[2]
    low, high = edges[0], edges[-1]
    low_cos, high_cos = np.sqrt(1.0 - low * low), np.sqrt(1.0 - high * high)
    found = 0
    for i in range(first, last):
        x, y, z = spheres[0, i] - px, spheres[1, i] - py, spheres[2, i] - pz
        radius = spheres[3, i]
        flat = np.sqrt(x * x + y * y)
        far = x * x + y * y + z * z > (reach + radius) * (reach + radius)
        above = z * high_cos - flat * high > radius
        below = flat * low - z * low_cos > radius
        out[found] = i
        found += not (far | above | below)
    return found


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _is_full(spheres, i, place, edges, guess, image):  # type: ignore[no-untyped-def]
    """Whether no point of sphere i, which is in view, can fill a pixel that is still empty."""
    x, y, z = spheres[0, i] - place[0], spheres[1, i] - place[1], spheres[2, i] - place[2]
    radius = spheres[3, i]
    flat_squared = x * x + y * y
    if radius * radius > 0.5 * flat_squared:
        return False
    flat, inverse = np.sqrt(flat_squared), 1.0 / np.sqrt(flat_squared + z * z)
    # The sphere is seen within asin(radius / distance) of its centre's elevation, and within
    # asin(radius / flat) <= 1.5 radius / flat of its azimuth; the margins are for rounding.
    sine = radius * inverse
    cosine = np.sqrt(1.0 - sine * sine)
    row_lo = _row_of((z * cosine - flat * sine) * inverse - 1e-6, edges, guess)
    row_hi = _row_of((z * cosine + flat * sine) * inverse + 1e-6, edges, guess)
    middle = turns_guess(x, y) * COLUMNS
    spread = radius / flat * (1.5 * COLUMNS / (2.0 * np.pi)) + 1e-2
    column_lo, column_hi = np.int64(np.floor(middle - spread)), np.int64(np.floor(middle + spread))
    for word in range(image.shape[1]):
        first, last = max(row_lo - word * WORD, 0), min(row_hi - word * WORD, WORD - 1)
        if first > last:
            continue
        ones = np.uint64(0xFFFFFFFFFFFFFFFF)
        need = (ones >> np.uint64(WORD - 1 - last)) & (ones << np.uint64(first))
        for c in range(column_lo, column_hi + 1):
            column = c + COLUMNS if c < 0 else (c - COLUMNS if c >= COLUMNS else c)
            if image[column, word] & need != need:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _fill(x, y, z, place, reach, edges, guess, image, sines, turns, fresh, found):  # type: ignore[no-untyped-def]
    """Fill the pixels of some points; those that filled an empty one are added to `fresh`."""
    px, py, pz = place[0], place[1], place[2]
    for i in range(len(x)):
        dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
        rr = dx * dx + dy * dy + dz * dz
        r = np.sqrt(rr)
        sines[i] = dz / r if (rr > 0.0) & (r <= reach) else 2.0
        turns[i] = turns_guess(dx, dy)
    for i in range(len(x)):
        if not edges[0] <= sines[i] <= edges[-1]:
            continue
        column = np.int64(turns[i] * COLUMNS)
        if is_unsure(turns[i], COLUMNS):
            column = azimuth_bin_exactly(x[i] - px, y[i] - py, COLUMNS)
        row = _row_of(sines[i], edges, guess)
        bit = np.uint64(1) << np.uint64(row % WORD)
        if not image[column, row // WORD] & bit:
            image[column, row // WORD] |= bit
            fresh[0, found], fresh[1, found], fresh[2, found] = x[i], y[i], z[i]
            found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def add_points(
    places: NDArray[np.float64],
    reach: float,
    edges: NDArray[np.float64],
    guess: NDArray[np.int64],
    xyz: NDArray[np.float64],
    start: NDArray[np.int64],
    spheres: NDArray[np.float64],
    group_start: NDArray[np.int64],
    group_spheres: NDArray[np.float64],
    images: NDArray[np.uint64],
) -> None:
    """Fill the pixels of the depth images of k sample points that hold a point of one tile.

    A point with 0 < range <= reach fills the pixel of its azimuth (`COLUMNS` bins of the full
    circle) and elevation (rows between the edges, half-open upwards, the last one closed). The
    points that filled the image before are tried first: most of them fill a pixel again.

    Args:
        places: (k, 3) sample points [m, map frame], best in the order of a route.
        reach: range of the sensor [m].
        edges: (rows + 1,) sines of the elevations of the rows' edges, rising.
        guess: (1024,) `row_guesses` of these edges.
        xyz: (3, n) points [m, map frame], block by block.
        start: (b + 1,) starts of the blocks.
        spheres: (4, b) spheres around the blocks: centre and radius [m].
        group_start: (g + 1,) starts of groups of blocks.
        group_spheres: (4, g) spheres around the groups.
        images: (k, COLUMNS, words) bits of the rows per column; receives the pixels.
    """
    blocks, groups = spheres.shape[1], group_spheres.shape[1]
    pixels = (len(edges) - 1) * COLUMNS
    largest = max(pixels, np.max(np.diff(start)) if blocks else 0)
    sines, turns = np.empty(largest), np.empty(largest)
    near_groups, near_blocks = np.empty(groups + 1, np.int64), np.empty(blocks + 1, np.int64)
    fresh, before, found = np.empty((3, pixels)), np.empty((3, pixels)), 0
    for p in range(len(places)):
        place, image = places[p], images[p]
        fresh, before = before, fresh
        x, y, z = before[0, :found], before[1, :found], before[2, :found]
        found = _fill(x, y, z, place, reach, edges, guess, image, sines, turns, fresh, 0)
        for g in near_groups[
            : _in_view(group_spheres, 0, groups, place, reach, edges, near_groups)
        ]:
            if _is_full(group_spheres, g, place, edges, guess, image):
                continue
            first, last = group_start[g], group_start[g + 1]
            for b in near_blocks[
                : _in_view(spheres, first, last, place, reach, edges, near_blocks)
            ]:
                if _is_full(spheres, b, place, edges, guess, image):
                    continue
                i, j = start[b], start[b + 1]
                x, y, z = xyz[0, i:j], xyz[1, i:j], xyz[2, i:j]
                found = _fill(
                    x, y, z, place, reach, edges, guess, image, sines, turns, fresh, found
                )


@njit(cache=True, nogil=True)
def filled(images: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Number of pixels set in each of (k, COLUMNS, words) images."""
    out = np.zeros(len(images), np.int64)
    for p in range(len(images)):
        for bits in images[p].flat:
            while bits:
                bits &= bits - np.uint64(1)
                out[p] += 1
    return out
