"""Colours of a report: told apart in grey and by the colour-blind, on light and on dark."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from tilestream.records import Float64

STEPS = 256
MISSING = "#9a9a9a"
"""Places without an estimate."""
ACTUAL, AGAIN, HELD_OUT = "#0072b2", "#56b4e9", "#d55e00"
"""Measured error of one drive and of another, and the estimate (Okabe and Ito's palette)."""
CRITERION = {"FS": "#0072b2", "RQ": "#e69f00", "LY": "#009e73", "LS": "#cc79a7", "OB": "#56b4e9"}
"""The paper's four criteria, and observability."""
OTHER = "#7f7f7f"
CHOICES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", OTHER)
"""Of the choices that are compared, in turn."""
CLIP = 0.98
"""Quantile of the estimates at which the colours end: a few lost places must not hide the rest."""


def palette() -> list[str]:
    """Low to high: plasma without its ends, which vanish on a dark and on a light page."""
    ramp = mpl.colormaps["plasma"](np.linspace(0.1, 0.86, STEPS))
    return [mpl.colors.to_hex(colour) for colour in ramp]


def to_rgb(colours: list[str]) -> Float64:
    """(n, 3) red, green and blue of colours, 0 to 1."""
    return np.asarray(mpl.colors.to_rgba_array(colours))[:, :3]


@dataclass(frozen=True)
class Scale:
    """From an estimate to a colour."""

    low: float
    """Estimates up to this have the first colour [m]."""
    high: float
    """Estimates from this on have the last [m]."""

    def step(self, estimate: Float64) -> NDArray[np.int64]:
        """(n,) index into the palette; -1 where there is no estimate."""
        share = (estimate - self.low) / (self.high - self.low)
        known = np.isfinite(estimate)
        step = np.clip(np.floor(np.where(known, share, 0.0) * STEPS), 0, STEPS - 1)
        return np.where(known, step, -1).astype(np.int64)

    def rgb(self, estimate: Float64) -> NDArray[np.uint8]:
        """(n, 3) colours of estimates, grey where there is none."""
        return (255.0 * to_rgb([*palette(), MISSING])[self.step(estimate)]).round().astype(np.uint8)


def scale_of(estimate: Float64) -> Scale:
    """The scale of some estimates: from their least to their 98 % quantile."""
    known = estimate[np.isfinite(estimate)]
    if not known.size:
        return Scale(0.0, 1.0)
    low, high = float(known.min()), float(np.quantile(known, CLIP))
    return Scale(low, high if high > low else low + 0.01)
