"""Terms of a cell that compare it with its neighbours: PFH (Rusu) and Bhattacharyya.

The lists of neighbours are those of `neighbours_within`: symmetric and in rising order. The value
of a pair of cells is computed once, from the smaller to the larger row, and shared.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

BINS = 125
"""Bins of a histogram: 5 each of alpha, phi (on [-1, 1]) and theta (on [-pi, pi])."""
SKIPPED = 255
"""The bin of a pair that is skipped."""
UNKNOWN = 254
"""The bin of a pair that is not computed yet."""


@njit(nogil=True, error_model="numpy", inline="always")
def _fifth(x, low, width):  # type: ignore[no-untyped-def]
    """Bin of x in five equal bins of a closed range."""
    return min(max(int(np.floor((x - low) / width + 1e-9)), 0), 4)


@njit(nogil=True, error_model="numpy", inline="always")
def _snapped(x):  # type: ignore[no-untyped-def]
    """0 for magnitudes below 1e-9: on exact planes rounding would decide between -pi and pi."""
    return 0.0 if abs(x) < 1e-9 else x


@njit(nogil=True, error_model="numpy")
def _pair_bin(mean, normal, i, j):  # type: ignore[no-untyped-def]
    """Bin of the Darboux angles of cells i and j, of which i comes first lexicographically.

    Source s: the cell with the larger |n.d| / |d|, i if they differ by <= 1e-9. With d from
    source to target t: u = n_s, v = d x u / |d x u|, w = u x v; alpha = v.n_t, phi = u.d / |d|,
    theta = atan2(w.n_t, u.n_t), where magnitudes below 1e-9 are 0.
    """
    dx, dy, dz = mean[j, 0] - mean[i, 0], mean[j, 1] - mean[i, 1], mean[j, 2] - mean[i, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length == 0.0:
        return SKIPPED
    ux, uy, uz = normal[i, 0], normal[i, 1], normal[i, 2]
    tx, ty, tz = normal[j, 0], normal[j, 1], normal[j, 2]
    along_i = abs(ux * dx + uy * dy + uz * dz) / length
    along_j = abs(tx * dx + ty * dy + tz * dz) / length
    if along_j > along_i + 1e-9:
        ux, uy, uz, tx, ty, tz = tx, ty, tz, ux, uy, uz
        dx, dy, dz = -dx, -dy, -dz
    vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
    size = np.sqrt(vx * vx + vy * vy + vz * vz)
    if size <= 1e-6 * length:
        return SKIPPED
    vx, vy, vz = vx / size, vy / size, vz / size
    wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    alpha = vx * tx + vy * ty + vz * tz
    phi = (ux * dx + uy * dy + uz * dz) / length
    sine, cosine = wx * tx + wy * ty + wz * tz, ux * tx + uy * ty + uz * tz
    theta = np.arctan2(_snapped(sine), _snapped(cosine))
    fifths = 5 * _fifth(alpha, -1.0, 0.4) + _fifth(phi, -1.0, 0.4)
    return 5 * fifths + _fifth(theta, -np.pi, 0.4 * np.pi)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def pfh_counts(
    mean: NDArray[np.float64],
    normal: NDArray[np.float64],
    start: NDArray[np.int64],
    near: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Pairs per bin over all unordered pairs of {cell + its neighbours} (definitions, section 3.1).

    A pair (i, j) counts for every cell c whose set has both, and c is then in the sets of both. So
    for each i, loop over the c in its set, and over the j > i in the set of c.

    Args:
        mean: (m, 3) means [m], any common origin.
        normal: (m, 3) unit normals.
        start: (m + 1,) starts of the lists of neighbours.
        near: (k,) neighbours.

    Returns:
        (m, 125) counts; bin = 25 alpha + 5 phi + theta. A row is zero for a cell with fewer than
        3 neighbours, which has no histogram.
    """
    m = len(mean)
    counts = np.zeros((m, BINS + 1), np.int32)  # the last column takes what is skipped
    bin_of = np.full(m, UNKNOWN, np.uint8)  # of the pair (i, j), by j
    touched = np.empty(m, np.int64)
    for i in range(m):
        seen = 0
        for at in range(start[i] - 1, start[i + 1]):
            c = i if at < start[i] else np.int64(near[at])
            if start[c + 1] - start[c] < 3:
                continue
            for other in range(start[c] - 1, start[c + 1]):
                j = c if other < start[c] else np.int64(near[other])
                if j <= i:
                    continue
                pair = bin_of[j]
                if pair == UNKNOWN:
                    pair = _pair_bin(mean, normal, i, j)
                    pair = min(pair, BINS)
                    bin_of[j] = pair
                    touched[seen] = j
                    seen += 1
                counts[c, pair] += 1
        for k in range(seen):
            bin_of[touched[k]] = UNKNOWN
    return counts[:, :BINS].copy()


@njit(nogil=True, error_model="numpy")
def entropy_of_counts(counts: NDArray[np.int32]) -> NDArray[np.float64]:
    """Entropy of each row of counts [bit]; an empty bin adds 0, an empty row has NaN.

    H = log2 n - (sum of c log2 c) / n.

    Args:
        counts: (m, b) counts.
    """
    out = np.empty(len(counts))
    for i in range(len(counts)):
        total, weighted = 0, 0.0
        for count in counts[i]:
            if count > 0:
                total += count
                weighted += count * np.log2(count)
        out[i] = max(np.log2(total) - weighted / total, 0.0) if total > 0 else np.nan
    return out


@njit(nogil=True, error_model="numpy", boundscheck=False)
def histogram_distances(
    counts: NDArray[np.int32], start: NDArray[np.int64], near: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum over a cell's neighbours of the L1 distance of the histograms, where both have one.

    Eqs. 14 and 15: L1(c, k) = sum over the bins of |h_c - h_k|, h normalised to sum 1.

    Args:
        counts: (m, 125) counts of `pfh_counts`.
        start: (m + 1,) starts of the lists of neighbours.
        near: (k,) neighbours.

    Returns:
        (m,) sums, no unit, and (m,) numbers of the neighbours summed.
    """
    m = len(counts)
    share = np.zeros((m, BINS))
    filled = np.zeros(m, np.bool_)
    for i in range(m):
        total = counts[i].sum()
        filled[i] = total > 0
        if total > 0:
            share[i] = counts[i] / total
    sums, numbers = np.zeros(m), np.zeros(m, np.int64)
    gap = np.empty(BINS)
    for i in range(m):
        if not filled[i]:
            continue
        gap[:] = 0.0
        for at in range(start[i], start[i + 1]):
            k = near[at]
            if filled[k]:
                numbers[i] += 1
                for b in range(BINS):
                    gap[b] += abs(share[i, b] - share[k, b])
        for b in range(BINS):
            sums[i] += gap[b]
    return sums, numbers


@njit(nogil=True, error_model="numpy", inline="always")
def _determinant(a, b, c, d, e, f):  # type: ignore[no-untyped-def]
    """Determinant of the symmetric [[a, b, c], [b, d, e], [c, e, f]]."""
    return a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def bhattacharyya_sums(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    start: NDArray[np.int64],
    near: NDArray[np.int32],
) -> NDArray[np.float64]:
    """Sum over a cell's neighbours of their Bhattacharyya distances (eqs. 17 and 18).

    DB = 1/8 d^T S^-1 d + 1/2 ln(|S| / sqrt(|S_i| |S_j|)), S = (S_i + S_j) / 2, d = mu_j - mu_i.

    Args:
        mean: (m, 3) means [m], any common origin.
        covariance: (m, 3, 3) regularised covariances [m^2].
        start: (m + 1,) starts of the lists of neighbours.
        near: (k,) neighbours.

    Returns:
        (m,) sums, no unit; 0 for a cell without neighbours.
    """
    m = len(mean)
    packed = np.empty((m, 6))
    determinant = np.empty(m)
    for i in range(m):
        s = covariance[i]
        packed[i, 0], packed[i, 1], packed[i, 2] = s[0, 0], s[0, 1], s[0, 2]
        packed[i, 3], packed[i, 4], packed[i, 5] = s[1, 1], s[1, 2], s[2, 2]
        determinant[i] = _determinant(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])
    sums = np.zeros(m)
    for i in range(m):
        for at in range(start[i], start[i + 1]):
            j = np.int64(near[at])
            if j < i:
                continue
            a = 0.5 * (packed[i, 0] + packed[j, 0])
            b = 0.5 * (packed[i, 1] + packed[j, 1])
            c = 0.5 * (packed[i, 2] + packed[j, 2])
            d = 0.5 * (packed[i, 3] + packed[j, 3])
            e = 0.5 * (packed[i, 4] + packed[j, 4])
            f = 0.5 * (packed[i, 5] + packed[j, 5])
            x, y, z = mean[j, 0] - mean[i, 0], mean[j, 1] - mean[i, 1], mean[j, 2] - mean[i, 2]
            whole = _determinant(a, b, c, d, e, f)
            # d^T adj(S) d
            form = x * x * (d * f - e * e) + y * y * (a * f - c * c) + z * z * (a * d - b * b)
            form += 2.0 * x * y * (c * e - b * f) + 2.0 * x * z * (b * e - c * d)
            form += 2.0 * y * z * (b * c - a * e)
            spread = whole / np.sqrt(determinant[i] * determinant[j])
            distance = form / whole / 8.0 + 0.5 * np.log(spread)
            sums[i] += distance
            sums[j] += distance
    return sums
