"""Virtual drives averaged along their route (definitions, section 4.5).

Where a registration ends is random to a degree, and places 1 m apart see nearly the same: their
drives are repeated samples of one value.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from tilestream.factors.virtual_drive import PART_COLUMNS
from tilestream.records import Float64, Int64

AVERAGED = tuple(column.name for column in PART_COLUMNS)
"""Columns that are averaged."""
WIDTHS = (0.0, 1.0, 1.5, 2.0, 3.0)
"""Standard deviations of the kernel among which a training chooses [m]; 0: each place alone."""
WIDTH = 1.5
"""That of a job without a model [m]."""
CUT = 2.0
"""Where the kernel ends, in standard deviations."""
REACH = CUT * max(WIDTHS)
"""Farthest along the route that a place has neighbours [m]."""
SLACK = 1e-6
"""Arc lengths are sums: neighbours at the full distance may lie this much beyond it [m]."""


def averaged_along(
    places: pd.DataFrame,
    width: float,
    columns: Sequence[str] = AVERAGED,
    by: Sequence[str] = ("route_id",),
) -> pd.DataFrame:
    """The virtual drives of sample points, averaged with those of their neighbours on the route.

    The kernel is a Gaussian of standard deviation `width`, cut off at `CUT` of it, over the points
    that are done. It is symmetric: the neighbours are taken in pairs, the first behind with the
    first ahead and so on, as long as both are within its reach. At the end of a route no side
    outweighs the other, and the last point stands for itself.

    Args:
        places: a row per sample point: `by`, `arc_length` [m], `status`, `columns`. The average of
            a point is right if all points of its route within `CUT * width` of it are there.
        width: of the kernel [m]; 0: the table is given back as it is.
        columns: what is averaged.
        by: the columns that together name a route.

    Returns:
        The table, rows in the same order, `columns` of the points that are done as weighted means:
        the same to the bit in any company.
    """
    if width == 0.0:
        return places
    route = places.groupby(list(by), sort=False).ngroup().to_numpy().astype(np.int64)
    arc = places["arc_length"].to_numpy(np.float64)
    values = places[list(columns)].to_numpy(np.float64, copy=True)
    done = np.flatnonzero((places["status"] == "done").to_numpy())
    done = done[np.lexsort((arc[done], route[done]))]
    values[done] = _means(route[done], arc[done], values[done], width)
    return places.assign(**dict(zip(columns, values.T, strict=True)))


def _means(route: Int64, arc: Float64, values: Float64, width: float) -> Float64:
    """(n, k) weighted means of (n, k) values at (n,) arc lengths that rise along each of the (n,)
    rising routes.
    """
    total, weights = values.copy(), np.ones(len(arc))
    rows = np.arange(len(arc))
    first, end = np.searchsorted(route, route), np.searchsorted(route, route, "right")
    pairs = np.minimum(rows - first, end - 1 - rows)
    for step in range(1, len(arc)):
        rows = rows[pairs[rows] >= step]
        behind, ahead = arc[rows] - arc[rows - step], arc[rows + step] - arc[rows]
        paired = np.maximum(behind, ahead) <= CUT * width + SLACK
        rows = rows[paired]
        if not rows.size:
            break
        for at, away in ((rows - step, behind[paired]), (rows + step, ahead[paired])):
            weight = np.exp(-0.5 * (away / width) ** 2)
            total[rows] += weight[:, None] * values[at]
            weights[rows] += weight
    mean: Float64 = total / weights[:, None]
    return mean
