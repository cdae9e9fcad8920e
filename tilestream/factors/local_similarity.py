"""Local similarity: how much parts of the surroundings look alike (the paper, section V.B).

The robust twins mend what the paper's factors lose (definitions, section 4.1): `score_H` with raw
normalisation hardly moves, so a softmax of the mean score takes its place; `pfh_sim_mnht` and
`bhatt_sim` mostly count cells, so they are divided by their pairs.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.vicinity import Sums, Terms, ratio
from tilestream.kernels.density import magnusson_constants
from tilestream.kernels.fixed_order import row_sums
from tilestream.kernels.nearest import group_by_cell
from tilestream.kernels.neighbours import cells_around, neighbours_within
from tilestream.kernels.pairs import (
    bhattacharyya_sums,
    entropy_of_counts,
    histogram_distances,
    pfh_counts,
)
from tilestream.kernels.score_field import SIDE, STEP, reach_of_shifts, score_sums
from tilestream.records import Cells, Column, Float64, Int64

NEIGHBOUR_RADIUS = 5.0
"""Cells whose means are this near are neighbours [m]."""
TEMPERATURE = 0.05
"""Difference of mean scores at which one shift is e times as likely as another."""
PEAK = 0.01
"""A secondary peak is at least this share of the highest."""
FIT = 2
"""The curvature is fitted to the shifts up to this many steps from the middle."""
_SECTION = "definitions, section 4.1"
_SOFT = "P(v) ~ exp(s(v) / 0.05), s the mean over the vicinity points of the score"

COLUMNS = (
    Column(
        "score_H",
        "LS",
        "bit",
        "Entropy of the scores of the map's points against its cells over 441 shifts.",
        "eqs. 12 and 13: P(v) = score(v) / sum, v = (i/5, j/5) m, i, j = -10..10",
    ),
    Column(
        "pfh_sim_H",
        "LS",
        "bit",
        "Mean entropy of the cells' point feature histograms. NaN: no cell has one.",
        "Rusu's PFH, 125 bins, over all pairs of a cell and its neighbours within 5 m",
    ),
    Column(
        "pfh_sim_mnht",
        "LS",
        "1",
        "Sum of the L1 distances of the histograms of neighbours; grows with the count.",
        "eqs. 14 to 16: sum over V(P) and over neighbours of L1(pfh_c, pfh_k)",
    ),
    Column(
        "bhatt_sim",
        "LS",
        "1",
        "Sum of the Bhattacharyya distances of neighbours; grows with the count.",
        "eqs. 17 and 18, regularised covariances",
    ),
    Column(
        "score_soft_H",
        "LS",
        "bit",
        "Entropy of where the map's points would be found against its cells.",
        f"{_SECTION}: {_SOFT}",
        "robust",
    ),
    *(
        Column(
            f"score_curvature_{end}",
            "LS",
            "1/m^2",
            f"How sharply the mean score falls off in the direction where it does so {how}.",
            f"{_SECTION}: {which} eigenvalue of -H, s(v) ~ c + g.v + v^T H v / 2 fitted to 5 x 5 "
            "shifts",
            "robust",
        )
        for end, how, which in (("min", "least", "smaller"), ("max", "most", "larger"))
    ),
    Column(
        "score_peaks",
        "LS",
        "1",
        "Secondary peaks: places that could be mistaken for the true one.",
        f"{_SECTION}: shifts above their 8 neighbours, not the highest, P at least 0.01 of its",
        "robust",
    ),
    *(
        Column(
            f"score_cov_{a}{b}",
            "LS",
            "m^2",
            "Covariance of where the map's points would be found, in the map's axes.",
            f"{_SECTION}: covariance of v_{a} and v_{b} under {_SOFT}",
            "robust",
        )
        for a, b in ("xx", "xy", "yy")
    ),
    Column(
        "pfh_mean",
        "LS",
        "1",
        "Mean L1 distance of the histograms of two neighbours, 0 to 2.",
        f"{_SECTION}: pfh_sim_mnht / pairs of neighbours with histograms",
        "robust",
    ),
    Column(
        "bhatt_mean",
        "LS",
        "1",
        "Mean Bhattacharyya distance of two neighbours.",
        f"{_SECTION}: bhatt_sim / pairs of neighbours",
        "robust",
    ),
)


def terms(cells: Cells, points_mm: Int64, cell_of_point: Int64) -> Terms:
    """Histograms and distances of each cell and its neighbours; the scores of its points."""
    start, near = neighbours_within(cells.index, cells.mean, cells.cell_size, NEIGHBOUR_RADIUS)
    counts = pfh_counts(cells.mean, cells.normal, start, near)
    filled = counts.sum(axis=1) > 0
    distances, pairs = histogram_distances(counts, start, near)
    return {
        "score": _score(cells, points_mm, cell_of_point),
        "pfh_entropy": np.where(filled, entropy_of_counts(counts), 0.0),
        "pfh_cells": filled,
        "pfh_distance": distances,
        "pfh_pairs": pairs,
        "bhattacharyya": bhattacharyya_sums(cells.mean, cells.regularised, start, near),
        "neighbours": np.diff(start),
    }


def _score(cells: Cells, points_mm: Int64, cell_of_point: Int64) -> Float64:
    start, order = group_by_cell(cell_of_point, len(cells))
    around = cells_around(cells.index, reach_of_shifts(cells.cell_size))
    scores: Float64 = score_sums(
        points_mm,
        start,
        order,
        cells.index,
        cells.cell_mm,
        cells.mean,
        cells.regularised,
        cells.precision,
        *around,
        *magnusson_constants(cells.cell_size),
    )
    return scores


def factors(sums: Sums) -> dict[str, Float64]:
    """The columns from the sums of a vicinity."""
    empty = sums["cells"] == 0
    mean_score = ratio(sums["score"], sums["points"][:, None])
    soft = _softmax(mean_score)
    low, high = curvatures(mean_score)
    xx, xy, yy = covariances(soft)
    return {
        "score_H": entropy(sums["score"]),
        "pfh_sim_H": ratio(sums["pfh_entropy"], sums["pfh_cells"]),
        "pfh_sim_mnht": np.where(empty, np.nan, sums["pfh_distance"]),
        "bhatt_sim": np.where(empty, np.nan, sums["bhattacharyya"]),
        "score_soft_H": entropy(soft),
        "score_curvature_min": low,
        "score_curvature_max": high,
        "score_peaks": np.where(empty, np.nan, secondary_peaks(soft)),
        "score_cov_xx": xx,
        "score_cov_xy": xy,
        "score_cov_yy": yy,
        "pfh_mean": ratio(sums["pfh_distance"], sums["pfh_pairs"]),
        "bhatt_mean": ratio(sums["bhattacharyya"], sums["neighbours"]),
    }


def entropy(weights: NDArray[np.float64]) -> Float64:
    """Entropy of each row of weights [bit], normalised to sum 1; NaN where all are 0."""
    share = ratio(weights, row_sums(weights)[:, None])
    log = np.log2(share, out=np.zeros_like(share), where=share > 0)
    bits: Float64 = np.maximum(-row_sums(share * log), 0.0)
    return bits


def _softmax(mean_score: Float64) -> Float64:
    """P(v) ~ exp(s(v) / temperature), each row of sum 1."""
    highest = mean_score.max(axis=1, keepdims=True)
    weight = np.exp((mean_score - highest) / TEMPERATURE)
    soft: Float64 = weight / row_sums(weight)[:, None]
    return soft


def _shifts() -> tuple[Float64, Float64]:
    """v_x and v_y of the 441 shifts [m], i slowest."""
    steps = STEP * (np.arange(SIDE) - SIDE // 2)
    return np.repeat(steps, SIDE), np.tile(steps, SIDE)


def curvatures(mean_score: Float64) -> tuple[Float64, Float64]:
    """Smaller and larger eigenvalue of minus the Hessian of s at v = 0 [1/m^2].

    Least squares of c + g.v + (a x^2 + 2 b x y + d y^2) / 2 over the shifts within `FIT` steps.

    Args:
        mean_score: (k, 441) s(v).
    """
    x, y = _shifts()
    inner = np.maximum(np.abs(x), np.abs(y)) <= (FIT + 0.5) * STEP
    x, y = x[inner], y[inner]
    design = np.column_stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
    weights = np.linalg.pinv(design)[3:]
    xx, xy, yy = (-row_sums(mean_score[:, inner] * w) for w in weights)
    middle, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return middle - radius, middle + radius


def covariances(soft: Float64) -> tuple[Float64, Float64, Float64]:
    """Variances and covariance (xx, xy, yy) of the shift under P [m^2].

    Args:
        soft: (k, 441) P(v), rows of sum 1.
    """
    x, y = _shifts()
    dx = x - row_sums(soft * x)[:, None]
    dy = y - row_sums(soft * y)[:, None]
    return row_sums(soft * dx * dx), row_sums(soft * dx * dy), row_sums(soft * dy * dy)


def secondary_peaks(soft: Float64) -> Float64:
    """Number of local maxima besides the highest, of at least `PEAK` of it.

    A shift is one if none of its 8 neighbours (fewer at the edge) is as high; of equal neighbours
    the first in the order of the shifts counts as the higher one.

    Args:
        soft: (k, 441) P(v).
    """
    field = soft.reshape(-1, SIDE, SIDE)
    padded = np.pad(field, ((0, 0), (1, 1), (1, 1)), constant_values=-1.0)
    above = field >= PEAK * field.max(axis=(1, 2), keepdims=True, initial=0.0)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            beside = padded[:, 1 + di : 1 + di + SIDE, 1 + dj : 1 + dj + SIDE]
            if (di, dj) < (0, 0):
                above &= field > beside
            elif (di, dj) > (0, 0):
                above &= field >= beside
    count: Float64 = above.sum(axis=(1, 2)) - 1.0
    return count
