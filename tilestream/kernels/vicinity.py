"""Sums over the vicinity of many sample points (definitions, section 2), as whole numbers.

Everything summed is an integer (counts, or fixed point), so that a sum is the same bits in any
order: tile after tile, or as the difference from the previous sample point's vicinity. Along
a route only a few percent of the cells enter or leave from one point to the next.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.azimuth import azimuth_bin_exactly, is_unsure, turns_guess
from tilestream.kernels.cache import njit

ONE = 2.0**40
"""Fixed point of what depends on the sample point: 1 (of r/R, (r/R)^2, u u^T) is this number."""

N_CELLS, RANGE, RANGE_SQUARED, UXX, UXY, UXZ, UYY, UYZ = range(8)
"""Columns of the sums that depend on the place: 1, r/R, (r/R)^2 and of u u^T, u = (mu - P)/r, all
but u_z^2 = 1 - u_x^2 - u_y^2."""

AT_PLACE = 1e-9
"""What is no farther than this from a sample point [m] is at it: float64 resolves 1e-9 m at
coordinates of 4e6 m."""

AZIMUTHS = 90
"""Bins of the azimuths of cells around a sample point."""


@njit(nogil=True)
def blocks_of(order_key: NDArray[np.int64], x, y, z):  # type: ignore[no-untyped-def]
    """Blocks: runs of equal keys, and their bounding boxes.

    Args:
        order_key: (n,) keys, sorted.
        x: (n,) coordinates, in the order of the keys.
        y: as x.
        z: as x.

    Returns:
        (b + 1,) starts of the runs, and (b, 6) lowest x, y, z and highest x, y, z.
    """
    n = len(order_key)
    start = np.empty(n + 1, np.int64)
    b = 0
    for i in range(n):
        if i == 0 or order_key[i] != order_key[i - 1]:
            start[b] = i
            b += 1
    start[b] = n
    box = np.empty((b, 6))
    for k in range(b):
        box[k, :3], box[k, 3:] = np.inf, -np.inf
        for i in range(start[k], start[k + 1]):
            box[k, 0], box[k, 3] = min(box[k, 0], x[i]), max(box[k, 3], x[i])
            box[k, 1], box[k, 4] = min(box[k, 1], y[i]), max(box[k, 4], y[i])
            box[k, 2], box[k, 5] = min(box[k, 2], z[i]), max(box[k, 5], z[i])
    return start[: b + 1].copy(), box


@njit(nogil=True, error_model="numpy")
def _out_of_view(box, place, reach, low, high):  # type: ignore[no-untyped-def]
    """Whether nothing in a box can be in the vicinity: all of it too far, too high or too low."""
    near, far = 0.0, 0.0
    for a in range(3):
        under, over = place[a] - box[a], box[3 + a] - place[a]
        near += max(-under, -over, 0.0) ** 2
        far += max(under, over) ** 2
    near, far = np.sqrt(near), np.sqrt(far)
    margin = 1e-6
    ceiling = high * (far if high > 0.0 else near)
    floor = low * (far if low < 0.0 else near)
    return (
        near > reach + margin
        or box[2] - place[2] > ceiling + margin
        or box[5] - place[2] < floor - margin
    )


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _view_block(x, y, z, place, reach, low, high, inside, sector, view):  # type: ignore[no-untyped-def]
    """Find which cells of a block are in the vicinity (`inside`) and their azimuth bin (`sector`;
    others: AZIMUTHS), and add the sums that depend on the sample point to `view`.

    0 < r <= reach and low <= (mu_z - P_z)/r <= high. One loop without a branch, for the compiler
    to vectorise.
    """
    px, py, pz = place[0], place[1], place[2]
    unit, square_unit = ONE / reach, ONE / (reach * reach)
    count = np.int64(0)
    r_sum, rr_sum = np.int64(0), np.int64(0)
    xx, xy, xz = np.int64(0), np.int64(0), np.int64(0)
    yy, yz = np.int64(0), np.int64(0)
    unsure = np.int64(0)
    for i in range(len(x)):
        dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
        rr = dx * dx + dy * dy + dz * dz
        r = np.sqrt(rr)
        member = (r > AT_PLACE) & (r <= reach) & (dz >= low * r) & (dz <= high * r)
        w = 1.0 if member else 0.0
        u = w * ONE / max(rr, 1e-300)
        count += np.int64(w)
        r_sum += np.int64(np.rint(w * r * unit))
        rr_sum += np.int64(np.rint(w * rr * square_unit))
        xx += np.int64(np.rint(dx * dx * u))
        xy += np.int64(np.rint(dx * dy * u))
        xz += np.int64(np.rint(dx * dz * u))
        yy += np.int64(np.rint(dy * dy * u))
        yz += np.int64(np.rint(dy * dz * u))
        inside[i] = member
        turns = turns_guess(dx, dy)
        sector[i] = np.int32(turns * AZIMUTHS) if member else np.int32(AZIMUTHS)
        unsure += np.int64(is_unsure(turns, AZIMUTHS))
    view[N_CELLS] += count
    view[RANGE] += r_sum
    view[RANGE_SQUARED] += rr_sum
    view[UXX] += xx
    view[UXY] += xy
    view[UXZ] += xz
    view[UYY] += yy
    view[UYZ] += yz
    if unsure > 0:
        for i in range(len(x)):
            dx, dy = x[i] - px, y[i] - py
            if inside[i] and is_unsure(turns_guess(dx, dy), AZIMUTHS):
                sector[i] = azimuth_bin_exactly(dx, dy, AZIMUTHS)


@njit(nogil=True, boundscheck=False)
def _enter_or_leave(c, sign, narrow, wide, exponent, bins, sums, wide_sums, counts):  # type: ignore[no-untyped-def]
    """Add the terms of cell c to a sample point's sums (`sign` 1), or subtract them (-1)."""
    for j in range(narrow.shape[1]):
        sums[j] += sign * narrow[c, j]
    shift = np.int64(exponent[c])
    if sign > 0:
        for j in range(wide.shape[1]):
            wide_sums[j] += np.int64(wide[c, j]) << shift
    else:
        for j in range(wide.shape[1]):
            wide_sums[j] -= np.int64(wide[c, j]) << shift
    for j in range(bins.shape[1]):
        counts[bins[c, j]] += np.int32(sign)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def add_cells(
    places: NDArray[np.float64],
    reach: float,
    low: float,
    high: float,
    xyz: NDArray[np.float64],
    start: NDArray[np.int64],
    box: NDArray[np.float64],
    standing: NDArray[np.bool_],
    narrow: NDArray[np.int64],
    wide: NDArray[np.int32],
    exponent: NDArray[np.uint8],
    bins: NDArray[np.int16],
    out_view: NDArray[np.int64],
    out_azimuth: NDArray[np.int64],
    out_sums: NDArray[np.int64],
    out_wide: NDArray[np.int64],
    out_counts: NDArray[np.int32],
) -> None:
    """Add the cells of one tile to the sums of the vicinities of k sample points.

    The sums of terms are written as changes from the previous sample point: take a cumulative sum
    over the sample points after all tiles are added.

    Args:
        places: (k, 3) sample points [m, map frame], best in the order of a route.
        reach: range of the sensor [m].
        low: sine of the lowest elevation in the field of view.
        high: sine of the highest one.
        xyz: (3, n) means of the cells [m, map frame], block by block.
        start: (b + 1,) starts of the blocks.
        box: (b, 6) boxes of the blocks (`blocks_of`).
        standing: (n,) whether a cell's normal is not vertical.
        narrow: (n, m) terms of a cell, fixed point.
        wide: (n, 441) terms of a cell, as wide 2^exponent.
        exponent: (n,) exponents of `wide`.
        bins: (n, h) bins of a cell in the histograms that stand side by side in `out_counts`.
        out_view: (k, 8) receives the sums `N_CELLS` to `UYZ`.
        out_azimuth: (k, 2, AZIMUTHS) receives the number of cells per azimuth, all and standing.
        out_sums: (k, m) receives the changes of the sums of `narrow`.
        out_wide: (k, 441) receives the changes of the sums of `wide`.
        out_counts: (k, bins in all) receives the changes of the histograms.
    """
    n, blocks = xyz.shape[1], len(start) - 1
    was = np.zeros(n, np.bool_)
    held = np.zeros(blocks, np.bool_)
    largest = np.max(np.diff(start)) if blocks else 0
    inside, sector = np.empty(largest, np.bool_), np.empty(largest, np.int32)
    sectors = np.zeros((2, AZIMUTHS + 1), np.int64)
    one = np.int64(1)
    for p in range(len(places)):
        sectors[:] = 0
        for b in range(blocks):
            first, last = start[b], start[b + 1]
            if _out_of_view(box[b], places[p], reach, low, high):
                if not held[b]:
                    continue
                inside[: last - first] = False
            else:
                x, y, z = xyz[0, first:last], xyz[1, first:last], xyz[2, first:last]
                _view_block(x, y, z, places[p], reach, low, high, inside, sector, out_view[p])
                for i in range(last - first):
                    sectors[np.uint64(standing[first + i]), np.uint64(sector[i])] += one
            held[b] = False
            changed = 0
            for i in range(last - first):
                held[b] |= inside[i]
                changed += inside[i] != was[first + i]
            if changed > 0:
                for i in range(last - first):
                    c = first + i
                    if inside[i] != was[c]:
                        was[c] = inside[i]
                        _enter_or_leave(
                            c,
                            one if inside[i] else -one,
                            narrow,
                            wide,
                            exponent,
                            bins,
                            out_sums[p],
                            out_wide[p],
                            out_counts[p],
                        )
        out_azimuth[p, 0] += sectors[0, :AZIMUTHS] + sectors[1, :AZIMUTHS]
        out_azimuth[p, 1] += sectors[1, :AZIMUTHS]


@njit(nogil=True, error_model="numpy", boundscheck=False)
def add_weights(
    places: NDArray[np.float64],
    reach: float,
    low: float,
    high: float,
    xyz: NDArray[np.float64],
    start: NDArray[np.int64],
    box: NDArray[np.float64],
    weight: NDArray[np.int64],
    out: NDArray[np.int64],
) -> None:
    """Add the weights of what lies in the vicinity of each of k sample points.

    Args:
        places: (k, 3) as in `add_cells`.
        reach: as in `add_cells`.
        low: as in `add_cells`.
        high: as in `add_cells`.
        xyz: (3, n) positions of the weights [m, map frame], block by block.
        start: (b + 1,) starts of the blocks.
        box: (b, 6) boxes of the blocks.
        weight: (n,) weights.
        out: (k,) receives the sums.
    """
    for p in range(len(places)):
        px, py, pz = places[p, 0], places[p, 1], places[p, 2]
        total = np.int64(0)
        for b in range(len(start) - 1):
            if _out_of_view(box[b], places[p], reach, low, high):
                continue
            for i in range(start[b], start[b + 1]):
                dx, dy, dz = xyz[0, i] - px, xyz[1, i] - py, xyz[2, i] - pz
                rr = dx * dx + dy * dy + dz * dz
                r = np.sqrt(rr)
                member = (r > AT_PLACE) & (r <= reach) & (dz >= low * r) & (dz <= high * r)
                total += weight[i] if member else np.int64(0)
        out[p] += total
