"""What is told of a filter's registration at a place: its ellipse, what is lost, its scores."""

import numpy as np
import pandas as pd
from scipy.stats import chi2

from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.moments import SCORES
from tilestream.records import Float64
from tilestream.report.formatting import CM_PER_M, percent

WITHIN = 0.95
"""Share of the registrations that hold whose positions lie in the ellipse."""


def ellipses(places: pd.DataFrame) -> tuple[Float64, Float64]:
    """The ellipses of the horizontal position, each as (n, 2) semi-axes [m], the longer first, and
    (n,) the angle of the longer one from the heading to the left, -pi/2 to pi/2; NaN: not known.
    """
    along, both, across = (
        places[f"cov_{name}"].to_numpy(np.float64)
        for name in ("along_along", "along_across", "across_across")
    )
    middle, half = 0.5 * (along + across), np.hypot(0.5 * (along - across), both)
    variance = np.column_stack([middle + half, np.maximum(middle - half, 0.0)])
    angle = 0.5 * np.arctan2(2.0 * both, along - across)
    return np.sqrt(chi2.ppf(WITHIN, 2) * variance), angle


def registrations_told(places: pd.DataFrame) -> dict[str, list[str]]:
    """Of each place, in words: `ellipse`, `lost`, a normal `nvtl` and `tp`; empty: not known."""
    if not {column.name for column in COVARIANCE_COLUMNS} <= set(places):
        return {name: [""] * len(places) for name in ("ellipse", "lost", *SCORES)}
    axes, angle = ellipses(places)
    rows = zip(axes * CM_PER_M, np.degrees(angle), strict=True)
    known = places["cov_along_along"].notna()
    scores = {
        name: [
            f"{mean:.2f}, normal {low:.2f} to {high:.2f}" if np.isfinite(mean) else ""
            for mean, low, high in places[[name, f"{name}_low", f"{name}_high"]].to_numpy()
        ]
        for name in SCORES
    }
    return {
        "ellipse": [_told(both, turned) if np.isfinite(turned) else "" for both, turned in rows],
        "lost": [
            percent(lost) if there else ""
            for lost, there in zip(places["p_lost"], known, strict=True)
        ],
        **scores,
    }


def _told(axes: Float64, turned: float) -> str:
    side = "left" if turned > 0.0 else "right"
    away = f"{abs(turned):.0f}° {side} of ahead" if round(abs(turned)) else "ahead"
    return f"semi-axes {axes[0]:.1f} × {axes[1]:.1f} cm, the longer {away}"
