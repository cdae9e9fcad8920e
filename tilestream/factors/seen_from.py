"""How often, and from how near, the survey saw what a scan meets (definitions, section 4.4).

A map does not say how its streets were driven, but shows it: what was seen once or from afar has
few points, and a single pass leaves thin walls, for no other disagrees with it.
"""

import math

import numpy as np

from tilestream.formats.logs.poses import transform
from tilestream.kernels.cells import cell_of_points
from tilestream.records import Cells, Column, Float64, Int64

THIN_SHARE = 0.25
"""Share of the cells that are thinner than `ob_thickness`: those of walls and road, as a rule."""


def _column(name: str, unit: str, meaning: str) -> Column:
    return Column(name, "OB", unit, meaning, "definitions, section 4.4", "observability")


SURVEY_COLUMNS = (
    _column("ob_density", "1", "Map points in the cell of a return, mean over the returns."),
    _column("ob_thickness", "m", "Thickness of the thinner cells that returns lie in."),
)


def survey_factors(cells: Cells, points: Float64, T_map_lidar: Float64) -> dict[str, float]:
    """What the map shows of its survey where a scan meets it.

    Args:
        cells: the map around the place.
        points: (n, 3) the scan in the lidar frame [m].
        T_map_lidar: (4, 4) the place.

    Returns:
        `SURVEY_COLUMNS`. The density is 0, and the thickness NaN, where no point of the scan lies
        in a cell.
    """
    voxels: Int64 = np.floor(transform(T_map_lidar, points) / cells.cell_size).astype(np.int64)
    row = cell_of_points(voxels, 1, cells.index)
    row = row[row >= 0]
    if not len(row):
        return {"ob_density": 0.0, "ob_thickness": math.nan}
    across = np.sort(np.sqrt(cells.eigenvalues[np.unique(row), 2]))
    return {
        "ob_density": float(cells.count[row].mean()),
        "ob_thickness": float(across[int(THIN_SHARE * len(across))]),
    }
