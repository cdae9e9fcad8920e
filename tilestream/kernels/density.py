"""The density of a cell and its constants (definitions, section 1; Magnusson 2009, section 6.2).

p(y; c) = exp(-d2/2 (y - mu)^T Sigma'^-1 (y - mu)); the score of a point is -d1 p >= 0.
"""

import math


def magnusson_constants(cell_size: float, outlier_ratio: float = 0.55) -> tuple[float, float]:
    """The constants (d1, d2) that approximate Magnusson's mixture of normal and uniform.

    c1 = 10 (1 - o), c2 = o / l^3, d3 = -ln c2, d1 = -ln(c1 + c2) - d3,
    d2 = -2 ln((-ln(c1 e^-1/2 + c2) - d3) / d1).

    Args:
        cell_size: edge l of a cell [m], positive.
        outlier_ratio: expected share o of outliers, inside (0, 1), no unit.

    Returns:
        d1 < 0 and d2 > 0, no unit; at l = 2: -4.1965 and 0.2485.
    """
    c1, c2 = 10.0 * (1.0 - outlier_ratio), outlier_ratio / cell_size**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    d2 = -2.0 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)
    return d1, d2
