"""Layout: how the cells are arranged around the sample point (the paper, section V.C).

The robust twins mend what the paper's factors lose (definitions, section 4.1). `FDOP` is a
distance, so true dilutions of precision stand beside it. Flat ground alone fills `normal_H_90` with
noise, and a wall's normal straddles two of its rows, so walls are told apart by their axis only.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.vicinity import HISTOGRAMS, STANDING, Sums, Terms, ratio
from tilestream.kernels.pairs import entropy_of_counts
from tilestream.records import Cells, Column, Float64, Int64

FLAT = 0.9
"""A cell with |n_z| of at least this is ground or ceiling: it says nothing about x and y."""
WALL_BINS = HISTOGRAMS["wall"]
WALL_WEIGHTS = (1, 2, 3, 2, 1)
"""Weights that smooth the histogram of wall directions, from two bins before to two after."""
SINGULAR = 1e-6
"""Directions whose smallest principal mean square is below this do not span space."""
_SECTIONS = "definitions, section 4.1: "

COLUMNS = (
    Column(
        "r_average",
        "LY",
        "m",
        "Mean distance of the cells.",
        "eq. 11, with the 1/m that it lacks: mean of |mu - P|",
    ),
    *(
        Column(
            f"normal_H_{m}",
            "LY",
            "bit",
            "Entropy of the normals' directions.",
            f"eqs. 9 and 10: histogram of {m} azimuths x {m} elevations of the normals",
        )
        for m in (8, 16, 90)
    ),
    Column(
        "angular_H",
        "LY",
        "bit",
        "Entropy of the azimuths in which cells lie.",
        "eqs. 7 and 8: histogram of atan2(mu_y - P_y, mu_x - P_x) in 90 bins",
    ),
    Column(
        "FDOP",
        "LY",
        "1/m",
        "The paper's dilution of precision: the inverse of the root mean square distance.",
        "eqs. 5 and 6, variance about P: 1 / sqrt(mean of |mu - P|^2)",
    ),
    *(
        Column(
            f"{kind}_{axis}DOP",
            "LY",
            "1",
            f"{meaning}, {'horizontally' if axis == 'H' else 'vertically'}: the error of the place "
            "per error of one measured distance and root of N. NaN where they do not span space.",
            f"{_SECTIONS}C = (sum of {vector} / N)^-1, "
            + ("sqrt(C_xx + C_yy)" if axis == "H" else "sqrt(C_zz)"),
            "robust",
        )
        for kind, meaning, vector in (
            (
                "sight",
                "True dilution of precision of distances along the sight lines",
                "u u^T, u = (mu - P)/|mu - P|",
            ),
            (
                "normal",
                "True dilution of precision of surfaces, which measure along their normals",
                "n n^T",
            ),
        )
        for axis in "HV"
    ),
    Column(
        "wall_H",
        "LY",
        "bit",
        "Entropy of the directions of walls. Axial, so a normal's sign does not matter; smoothed, "
        "so a wall on a bin's edge is not two; without ground, which is everywhere. NaN: no wall.",
        f"{_SECTIONS}cells with |n_z| < 0.9, atan2(n_y, n_x) mod pi in {WALL_BINS} bins, smoothed "
        "round the circle with (1, 2, 3, 2, 1)/9",
        "robust",
    ),
    Column(
        "wall_major",
        "LY",
        "1",
        "Cells' worth of walls that fix the best fixed horizontal direction.",
        f"{_SECTIONS}larger eigenvalue of the sum of (n_x, n_y) (n_x, n_y)^T over V(P)",
        "robust",
    ),
    Column(
        "wall_minor",
        "LY",
        "1",
        "Cells' worth of walls that fix the worst fixed horizontal direction: near 0 in a tunnel.",
        f"{_SECTIONS}smaller eigenvalue of the sum of (n_x, n_y) (n_x, n_y)^T over V(P)",
        "robust",
    ),
    Column(
        "wall_balance",
        "LY",
        "1",
        "How evenly walls fix the two horizontal directions, 0 to 1; does not grow with the count.",
        f"{_SECTIONS}wall_minor / wall_major",
        "robust",
    ),
    Column(
        "weak_axis",
        "LY",
        "rad",
        "The horizontal direction that walls fix least, an axis in [0, pi) from the map's x axis. "
        "NaN where no direction is worse than another.",
        f"{_SECTIONS}eigenvector of wall_minor",
        "robust",
    ),
    Column(
        "empty_sector",
        "LY",
        "rad",
        "Largest sector of azimuths in which nothing stands; 2 pi where nothing stands at all. "
        "Flat cells do not count: ground is on every side.",
        f"{_SECTIONS}longest run of empty bins of 4 deg, cells of V(P) with |n_z| < 0.9",
        "robust",
    ),
)


def _bin(x: Float64, low: float, width: float) -> Int64:
    bins: Int64 = np.floor((x - low) / width + 1e-9).astype(np.int64)
    return bins


def _azimuth(normal: Float64) -> Float64:
    flat = np.hypot(normal[:, 0], normal[:, 1]) < 1e-9
    return np.where(flat, 0.0, np.arctan2(normal[:, 1], normal[:, 0]))


def normal_bins(normal: Float64, m: int) -> Int64:
    """Bin of each normal in m azimuths (a full circle) x m elevations (a closed range)."""
    around = _bin(_azimuth(normal), -np.pi, 2 * np.pi / m) % m
    up = _bin(np.arcsin(np.clip(normal[:, 2], -1.0, 1.0)), -np.pi / 2, np.pi / m)
    return around * m + np.clip(up, 0, m - 1)


def terms(cells: Cells, points_mm: Int64, cell_of_point: Int64) -> Terms:  # noqa: ARG001
    """Bins of the normals, products of their components, and whether a cell is no ground or
    ceiling.
    """
    n = cells.normal
    standing = np.abs(n[:, 2]) < FLAT
    wall = _bin(_azimuth(n) % np.pi, 0.0, np.pi / WALL_BINS) % WALL_BINS
    products = {
        f"normal_{'xyz'[a]}{'xyz'[b]}": n[:, a] * n[:, b] for a in range(3) for b in range(a, 3)
    }
    return {
        **{f"normal_{m}": normal_bins(n, m) for m in (8, 16, 90)},
        "wall": np.where(standing, wall, -1),
        STANDING: standing,
        **products,
    }


def factors(sums: Sums) -> dict[str, Float64]:
    """The columns from the sums of a vicinity."""
    cells = sums["cells"]
    major, minor, weak_axis = _walls(sums)
    return {
        "r_average": ratio(sums["range"], cells),
        **{f"normal_H_{m}": entropy_of_counts(sums[f"normal_{m}"]) for m in (8, 16, 90)},
        "angular_H": entropy_of_counts(sums["azimuth"]),
        "FDOP": ratio(np.ones(len(cells)), np.sqrt(ratio(sums["range_squared"], cells))),
        **_dilution(sums, "sight"),
        **_dilution(sums, "normal"),
        "wall_H": _smooth_entropy(sums["wall"]),
        "wall_major": major,
        "wall_minor": minor,
        "wall_balance": ratio(minor, major),
        "weak_axis": weak_axis,
        "empty_sector": _longest_run(sums["azimuth_standing"] == 0) * np.radians(4.0),
    }


def _dilution(sums: Sums, kind: str) -> dict[str, Float64]:
    """Horizontal and vertical dilution of precision of the directions summed as `kind`."""
    xx, xy, xz, yy, yz, zz = (
        ratio(sums[f"{kind}_{axes}"], sums["cells"])
        for axes in ("xx", "xy", "xz", "yy", "yz", "zz")
    )
    minor_x, minor_y, minor_z = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    determinant = xx * minor_x - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # The trace is 1, so the sum of minors is about the middle eigenvalue times the largest, and the
    # determinant over it about the least.
    minors = minor_x + minor_y + minor_z
    with np.errstate(invalid="ignore", divide="ignore"):
        spans = (minors > SINGULAR) & (determinant > SINGULAR * minors)
        horizontal = np.sqrt((minor_x + minor_y) / np.where(spans, determinant, np.nan))
        vertical = np.sqrt(minor_z / np.where(spans, determinant, np.nan))
    return {f"{kind}_HDOP": horizontal, f"{kind}_VDOP": vertical}


def _walls(sums: Sums) -> tuple[Float64, Float64, Float64]:
    """Eigenvalues and weak axis of the horizontal structure tensor."""
    xx, xy, yy = sums["normal_xx"], sums["normal_xy"], sums["normal_yy"]
    middle, half = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    strong = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    weak = np.where(half > 1e-9 * middle, (strong + np.pi / 2) % np.pi, np.nan)
    return middle + half, np.maximum(middle - half, 0.0), weak


def _smooth_entropy(counts: NDArray[np.int32]) -> Float64:
    """Entropy [bit] of counts on a circle, smoothed; NaN without any."""
    smooth = np.zeros(counts.shape, np.int32)
    for shift, weight in zip(range(-2, 3), WALL_WEIGHTS, strict=True):
        smooth += weight * np.roll(counts, shift, axis=1)
    entropy: Float64 = entropy_of_counts(smooth)
    return entropy


def _longest_run(empty: NDArray[np.bool_]) -> Float64:
    """Length of the longest run of True round the circle, per row of (k, b)."""
    bins = empty.shape[1]
    run, longest = np.zeros(len(empty), np.int64), np.zeros(len(empty), np.int64)
    for b in range(2 * bins):
        run = np.where(empty[:, b % bins], run + 1, 0)
        longest = np.maximum(longest, run)
    return np.minimum(longest, bins).astype(np.float64)
