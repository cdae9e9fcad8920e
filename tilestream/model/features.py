"""Which factors a model may read, with directions in the map turned into the route's."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from tilestream.records import Column, Float64

WEAK_ALONG = Column(
    "weak_along",
    "LY",
    "1",
    "How much the direction that walls fix least is that of travel, 0 to 1.",
    "abs(cos(weak_axis - heading))",
    "robust",
)
SPREAD_ALONG, SPREAD_ACROSS = (
    Column(
        f"score_var_{axis}",
        "LS",
        "m^2",
        f"Variance of where the map's points would be found, {axis} the direction of travel.",
        "u^T C u, C of score_cov_xx, _xy, _yy, u the direction",
        "robust",
    )
    for axis in ("along", "across")
)
IN_MAP_AXES: dict[str, Column | None] = {
    "weak_axis": WEAK_ALONG,
    "score_cov_xx": SPREAD_ALONG,
    "score_cov_yy": SPREAD_ACROSS,
    "score_cov_xy": None,
}
"""Directions in the map identify a street as its position does. By name: what replaces each of
them, relative to the direction of travel; None: nothing."""


def features_of(columns: Sequence[Column]) -> tuple[Column, ...]:
    """The factors of a catalogue that may be features, map axes turned into the route's."""
    factors = (column for column in columns if column.criterion not in ("place", "label"))
    turned = (IN_MAP_AXES.get(column.name, column) for column in factors)
    return tuple(column for column in turned if column is not None)


def with_derived(factors: pd.DataFrame) -> pd.DataFrame:
    """A factor table with the columns that replace those in map axes (`IN_MAP_AXES`).

    They follow from `heading` [rad, map frame]; a table without it is given back as it is.
    """
    if "heading" not in factors:
        return factors
    heading = factors["heading"].to_numpy(np.float64)
    c, s = np.cos(heading), np.sin(heading)
    turned: dict[str, Float64] = {}
    if "weak_axis" in factors:
        turned["weak_along"] = np.abs(np.cos(factors["weak_axis"].to_numpy(np.float64) - heading))
    if {"score_cov_xx", "score_cov_xy", "score_cov_yy"} <= set(factors):
        xx, xy, yy = (factors[f"score_cov_{a}"].to_numpy(np.float64) for a in ("xx", "xy", "yy"))
        turned["score_var_along"] = c * c * xx + 2.0 * c * s * xy + s * s * yy
        turned["score_var_across"] = s * s * xx - 2.0 * c * s * xy + c * c * yy
    return factors.assign(**turned)


def observed(columns: Sequence[Column]) -> list[Column]:
    """The factors that look from a place: observability and the virtual drive, and with them those
    of the user's own; none where there is no observability.
    """
    if not any(column.factor_set == "observability" for column in columns):
        return []
    return [column for column in columns if column.factor_set in ("observability", "own")]
