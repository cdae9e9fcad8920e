"""Feature sufficiency: how much there is to match (the paper, section V.A; eqs. 3 and 4).

The faithful counts choose one class per cell; the robust shares let a cell be a little of each, so
that a cell between two shapes does not flip. a1 + a2 + a3 = 1 for every cell.
"""

import numpy as np

from tilestream.factors.vicinity import Sums, Terms, ratio
from tilestream.records import Cells, Column, Float64, Int64

TIE = 1e-12
"""Shares this close are equal; the lower dimension has it."""
POINT_LIKE = 1e-6
"""A cell whose largest standard deviation [m] is no larger than this counts as 3D."""

COLUMNS = (
    Column(
        "feature_count",
        "FS",
        "1",
        "Cells in the vicinity.",
        "N = |V(P)|: cells with 0 < |mu - P| <= R, elevation within the field of view",
    ),
    *(
        Column(
            f"D{d}_count",
            "FS",
            "1",
            f"Cells that are {shape}.",
            f"eq. 3: {largest} the largest of a1 = (s1 - s2)/s1, a2 = (s2 - s3)/s1, a3 = s3/s1",
        )
        for d, shape, largest in (
            (1, "linear: poles, edges", "a1"),
            (2, "planar: walls, ground", "a2"),
            (3, "scattered: foliage, clutter", "a3"),
        )
    ),
    *(
        Column(
            f"D{d}_ratio", "FS", "1", f"Share of the cells that are {d}D.", f"eq. 4: D{d}_count / N"
        )
        for d in (1, 2, 3)
    ),
    Column(
        "occupancy_ratio",
        "FS",
        "1",
        "Share of the depth image's pixels that hold a map point.",
        "360 columns of 1 deg x a row per beam; map points thinned to 0.5 m with 0 < range <= R",
    ),
    *(
        Column(
            f"D{d}_share",
            "FS",
            "1",
            f"Mean share of {shape} in a cell's shape; a cell between two shapes does not flip, as "
            f"it does in D{d}_ratio.",
            f"definitions, section 4.1: sum of a{d} over V(P) / N, a1 + a2 + a3 = 1",
            "robust",
        )
        for d, shape in ((1, "line"), (2, "plane"), (3, "scatter"))
    ),
    Column(
        "loose_share",
        "FS",
        "1",
        "Share of the map points in view that lie in voxels with too few points for a cell: what "
        "the map shows and the matcher cannot use.",
        "definitions, section 4.1: points of voxels with n < 6 whose mean is in view / all points "
        "of voxels in view",
        "robust",
    ),
)


def shape_shares(eigenvalues: Float64) -> Float64:
    """(n, 3) shares a1, a2, a3 of line, plane and scatter (eq. 3); they sum to 1.

    Args:
        eigenvalues: (n, 3) raw eigenvalues [m^2], descending.
    """
    s = np.sqrt(eigenvalues)
    s1 = np.where(s[:, 0] > POINT_LIKE, s[:, 0], 1.0)
    shares = np.column_stack([s[:, 0] - s[:, 1], s[:, 1] - s[:, 2], s[:, 2]]) / s1[:, None]
    shares[s[:, 0] <= POINT_LIKE] = 0.0, 0.0, 1.0
    return shares


def dimensions(eigenvalues: Float64) -> Int64:
    """(n,) 1, 2 or 3: the largest share, ties to the lower dimension."""
    a1, a2, a3 = shape_shares(eigenvalues).T
    planar = np.where(a2 >= a3 - TIE, 2, 3)
    return np.where(a1 >= np.maximum(a2, a3) - TIE, 1, planar).astype(np.int64)


def terms(cells: Cells, points_mm: Int64, cell_of_point: Int64) -> Terms:  # noqa: ARG001
    """Shape classes, shape shares and number of points of each cell."""
    dimension = dimensions(cells.eigenvalues)
    shares = shape_shares(cells.eigenvalues)
    return {
        **{f"is_{d}D": dimension == d for d in (1, 2, 3)},
        **{f"share_{d}D": shares[:, d - 1].copy() for d in (1, 2, 3)},
        "points": cells.count,
    }


def factors(sums: Sums) -> dict[str, Float64]:
    """The columns from the sums of a vicinity."""
    cells = sums["cells"]
    return {
        "feature_count": cells,
        **{f"D{d}_count": sums[f"is_{d}D"] for d in (1, 2, 3)},
        **{f"D{d}_ratio": ratio(sums[f"is_{d}D"], cells) for d in (1, 2, 3)},
        "occupancy_ratio": ratio(sums["occupied"], sums["pixels"]),
        **{f"D{d}_share": ratio(sums[f"share_{d}D"], cells) for d in (1, 2, 3)},
        "loose_share": ratio(sums["loose_points"], sums["loose_points"] + sums["points"]),
    }
