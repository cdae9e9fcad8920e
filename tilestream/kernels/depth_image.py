"""The pixels of a lidar's depth image that the map fills (factor `occupancy_ratio`).

Exact, though most points are never read: a block of points is skipped when all pixels that its box
can touch are full already. Beyond some distance nearly all of them are.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.azimuth import azimuth_bin_exactly, is_unsure, turns_guess
from tilestream.kernels.cache import njit
from tilestream.kernels.vicinity import AT_PLACE

COLUMNS = 360
"""Azimuth columns of the image, 1 deg each."""
MARGIN = 1e-6
"""Safety margin for rounding in the bounds of a box [m, or sine]."""


@njit(nogil=True)
def row_guesses(edges: NDArray[np.float64]) -> NDArray[np.int32]:
    """A look-up table: the row at the beginning of each of many equal steps from the lowest to the
    highest edge.

    Steps are so short that each holds at most one edge (but there are at most 2^16 of them).
    """
    rows = len(edges) - 1
    thinnest = np.min(np.diff(edges))
    steps = np.int64(min(max(np.ceil((edges[-1] - edges[0]) / thinnest), 256.0) + 1.0, 65536.0))
    guess = np.empty(steps, np.int32)
    row = 0
    for k in range(steps):
        s = edges[0] + (edges[-1] - edges[0]) * (k - 1e-6) / steps
        while row < rows - 1 and s >= edges[row + 1]:
            row += 1
        guess[k] = row
    return guess


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _row_of(s, edges, guess):  # type: ignore[no-untyped-def]
    """Row of an elevation, given its sine; beyond the outer edges: the outer rows."""
    last = len(edges) - 2
    slot = np.int64((s - edges[0]) * (len(guess) / (edges[-1] - edges[0])))
    row = np.int64(guess[min(max(slot, 0), len(guess) - 1)])
    while row < last and s >= edges[row + 1]:
        row += 1
    while row > 0 and s < edges[row]:
        row -= 1
    return row


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _in_view(box, first, last, place, reach, edges, out):  # type: ignore[no-untyped-def]
    """Write to `out` which of the boxes first to last can be in range and between the outer edges;
    their number.
    """
    px, py, pz = place[0], place[1], place[2]
    low = edges[0] / np.sqrt(1.0 - edges[0] * edges[0])
    high = edges[-1] / np.sqrt(1.0 - edges[-1] * edges[-1])
    found = 0
    for i in range(first, last):
        x0, y0, z0 = box[0, i] - px, box[1, i] - py, box[2, i] - pz
        x1, y1, z1 = box[3, i] - px, box[4, i] - py, box[5, i] - pz
        x_near, y_near = max(x0, -x1, 0.0), max(y0, -y1, 0.0)
        x_far, y_far = max(-x0, x1), max(-y0, y1)
        z_near = max(z0, -z1, 0.0)
        near = x_near * x_near + y_near * y_near
        beyond = near + z_near * z_near > reach * reach + MARGIN
        near, far = np.sqrt(near), np.sqrt(x_far * x_far + y_far * y_far)
        above = z0 > high * (far if high > 0.0 else near) + MARGIN
        below = z1 < low * (far if low < 0.0 else near) - MARGIN
        out[found] = i
        found += not (beyond | above | below)
    return found


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _is_full(box, i, place, edges, guess, image):  # type: ignore[no-untyped-def]
    """Whether no point of box i, which is in view, can fill a pixel that is still empty."""
    x0, y0, z0 = box[0, i] - place[0], box[1, i] - place[1], box[2, i] - place[2]
    x1, y1, z1 = box[3, i] - place[0], box[4, i] - place[1], box[5, i] - place[2]
    x_near, y_near = max(x0, -x1, 0.0), max(y0, -y1, 0.0)
    x_far, y_far = max(-x0, x1), max(-y0, y1)
    near, far = x_near * x_near + y_near * y_near, x_far * x_far + y_far * y_far
    if near < 0.1:
        return False
    lowest = z0 / np.sqrt((near if z0 < 0.0 else far) + z0 * z0)
    highest = z1 / np.sqrt((near if z1 > 0.0 else far) + z1 * z1)
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    # No corner is farther from the middle's azimuth than the largest cross product over the
    # smallest dot product with it; an angle is less than its tangent.
    across = abs(x) * half_y + abs(y) * half_x
    along = x * x + y * y - abs(x) * half_x - abs(y) * half_y
    if across >= along:
        return False
    middle = turns_guess(x, y) * COLUMNS
    spread = across / along * (COLUMNS / (2.0 * np.pi)) + 1e-2
    column_lo, column_hi = np.int64(np.floor(middle - spread)), np.int64(np.floor(middle + spread))
    row_lo = _row_of(lowest - MARGIN, edges, guess)
    row_hi = _row_of(highest + MARGIN, edges, guess)
    for row in range(row_lo, row_hi + 1):
        for c in range(column_lo, column_hi + 1):
            column = c + COLUMNS if c < 0 else (c - COLUMNS if c >= COLUMNS else c)
            if not image[row * COLUMNS + column]:
                return False
    return True


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _directions(x, y, z, place, reach, sines, turns):  # type: ignore[no-untyped-def]
    """Sines of the elevations and azimuths [turns] of points; a sine of 2 where out of range.

    A loop of its own, without a branch or a table, for the compiler to vectorise.
    """
    px, py, pz = place[0], place[1], place[2]
    for i in range(len(x)):
        dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
        rr = dx * dx + dy * dy + dz * dz
        r = np.sqrt(rr)
        sines[i] = dz / r if (r > AT_PLACE) & (r <= reach) else 2.0
        turns[i] = turns_guess(dx, dy)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _fill(x, y, z, place, reach, edges, guess, image, sines, turns, fresh, found):  # type: ignore[no-untyped-def]
    """Fill the pixels of some points; points that filled an empty pixel are added to `fresh`.
    Returns the number of points in `fresh`.
    """
    _directions(x, y, z, place, reach, sines, turns)
    low, high, last = edges[0], edges[-1], np.int64(len(edges) - 2)
    scale, steps = len(guess) / (high - low), np.int64(len(guess) - 1)
    for i in range(len(x)):
        s = sines[i]
        if not low <= s <= high:
            continue
        row = np.int64(guess[np.uint64(min(np.int64((s - low) * scale), steps))])
        row += (s >= edges[np.uint64(row + 1)]) & (row < last)
        column = np.int64(turns[i] * COLUMNS)
        if is_unsure(turns[i], COLUMNS):
            column = azimuth_bin_exactly(x[i] - place[0], y[i] - place[1], COLUMNS)
        pixel = np.uint64(row * COLUMNS + column)
        if not image[pixel]:
            image[pixel] = True
            fresh[0, found], fresh[1, found], fresh[2, found] = x[i], y[i], z[i]
            found += 1
    return found


@njit(nogil=True, error_model="numpy", boundscheck=False)
def add_points(
    places: NDArray[np.float64],
    reach: float,
    edges: NDArray[np.float64],
    guess: NDArray[np.int32],
    xyz: NDArray[np.float64],
    start: NDArray[np.int64],
    box: NDArray[np.float64],
    group_start: NDArray[np.int64],
    group_box: NDArray[np.float64],
    images: NDArray[np.bool_],
) -> None:
    """Fill the pixels of the depth images of k sample points that hold a point of one tile.

    A point with 0 < range <= reach fills the pixel of its azimuth (`COLUMNS` bins of the full
    circle) and elevation (rows between the edges, half-open upwards, the last one closed). The
    points that filled the previous image are tried first: most of them fill a pixel again.

    Args:
        places: (k, 3) sample points [m, map frame], best in the order of a route.
        reach: range of the sensor [m].
        edges: (rows + 1,) sines of the elevations of the rows' edges, rising.
        guess: `row_guesses` of these edges.
        xyz: (3, n) points [m, map frame], block by block.
        start: (b + 1,) starts of the blocks.
        box: (6, b) lowest x, y, z and highest x, y, z of the blocks [m].
        group_start: (g + 1,) starts of groups of blocks.
        group_box: (6, g) those of the groups.
        images: (k, rows * COLUMNS) pixels, row by row; receives True for those that are filled.
    """
    blocks, groups = box.shape[1], group_box.shape[1]
    pixels = images.shape[1]
    largest = max(pixels, np.max(np.diff(start)) if blocks else 0)
    sines, turns = np.empty(largest), np.empty(largest)
    near_groups, near_blocks = np.empty(groups + 1, np.int64), np.empty(blocks + 1, np.int64)
    fresh, before, found = np.empty((3, pixels)), np.empty((3, pixels)), 0
    for p in range(len(places)):
        place, image = places[p], images[p]
        fresh, before = before, fresh
        x, y, z = before[0, :found], before[1, :found], before[2, :found]
        found = _fill(x, y, z, place, reach, edges, guess, image, sines, turns, fresh, 0)
        n_groups = _in_view(group_box, 0, groups, place, reach, edges, near_groups)
        for g in near_groups[:n_groups]:
            if _is_full(group_box, g, place, edges, guess, image):
                continue
            first, last = group_start[g], group_start[g + 1]
            n_blocks = _in_view(box, first, last, place, reach, edges, near_blocks)
            for b in near_blocks[:n_blocks]:
                if _is_full(box, b, place, edges, guess, image):
                    continue
                i, j = start[b], start[b + 1]
                x, y, z = xyz[0, i:j], xyz[1, i:j], xyz[2, i:j]
                found = _fill(
                    x, y, z, place, reach, edges, guess, image, sines, turns, fresh, found
                )
