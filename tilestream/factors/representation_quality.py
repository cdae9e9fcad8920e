"""Representation quality: how well cells represent the map points (the paper, section V.D)."""

from tilestream.factors.vicinity import Sums, Terms, ratio
from tilestream.kernels.nearest import REACH, group_by_cell, nearest_mean_sums
from tilestream.kernels.neighbours import cells_around
from tilestream.records import Cells, Column, Float64, Int64

_NEAREST = "over the map points in the voxels of V(P); mu the nearest mean among all cells"

COLUMNS = (
    Column(
        "euclidean_dist",
        "RQ",
        "m",
        "Mean distance of a map point from the nearest cell's mean.",
        f"eq. 21: mean of |x - mu| {_NEAREST}",
    ),
    Column(
        "mahalanobis_dist",
        "RQ",
        "1",
        "The same in standard deviations of that cell.",
        f"eqs. 19 and 20: mean of sqrt((x - mu)^T Sigma'^-1 (x - mu)) {_NEAREST}",
    ),
)


def terms(cells: Cells, points_mm: Int64, cell_of_point: Int64) -> Terms:
    """Sums over each cell's points of the distances to the nearest mean."""
    start, order = group_by_cell(cell_of_point, len(cells))
    around = cells_around(cells.index, (REACH, REACH, REACH))
    euclidean, mahalanobis = nearest_mean_sums(
        points_mm,
        start,
        order,
        cells.index,
        cells.cell_mm,
        cells.mean,
        cells.precision,
        *around,
    )
    return {"euclidean": euclidean, "mahalanobis": mahalanobis}


def factors(sums: Sums) -> dict[str, Float64]:
    """The columns from the sums of a vicinity."""
    return {
        "euclidean_dist": ratio(sums["euclidean"], sums["points"]),
        "mahalanobis_dist": ratio(sums["mahalanobis"], sums["points"]),
    }
