"""Colours of a report: told apart in grey and by the colour-blind, on light and on dark."""

from dataclasses import dataclass
from functools import cached_property

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from tilestream.records import Float64

THRESHOLDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.50)
"""Errors at which the colour changes [m]: what people ask of a localizer, the same in every report,
so that two of them can be compared."""
STEPS = 7
"""Colours of a run's own range, about."""
MISSING = "#9a9a9a"
"""Places without an estimate."""
ACTUAL, AGAIN, HELD_OUT = "#0072b2", "#56b4e9", "#d55e00"
"""Measured error of one drive and of another, and the estimate (Okabe and Ito's palette)."""
HERE = "#d55e00"
"""Of what marks the place that the page's address names."""
SEEN = "#e69f00"
"""What the lidar sees at a place."""
CRITERION = {"FS": "#0072b2", "RQ": "#e69f00", "LY": "#009e73", "LS": "#cc79a7", "OB": "#56b4e9"}
"""The paper's four criteria, and observability."""
OTHER = "#7f7f7f"
CHOICES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", OTHER)
"""Of the choices that are compared, in turn."""
LOWEST, HIGHEST = np.array([0.22, 0.26, 0.31]), np.array([0.93, 0.95, 0.97])
"""Of the heights of a map in 3D, greys: the colours of errors must stand out."""
TAILS = 0.02
"""Share of the heights that is left out at each end of the greys: strays."""
CLIP = 0.98
"""Quantile of the estimates at which the colours of a run's own range end: a few lost places must
not hide the rest."""


def to_rgb(colours: list[str]) -> Float64:
    """(n, 3) red, green and blue of colours, 0 to 1."""
    return np.asarray(mpl.colors.to_rgba_array(colours))[:, :3]


@dataclass(frozen=True)
class Scale:
    """From an error to one of a few colours."""

    edges: tuple[float, ...]
    """Where the colour changes, at least two, ascending [m]: an error of an edge has the lower
    one."""

    @cached_property
    def colours(self) -> list[str]:
        """Low to high, one more than edges: plasma without its ends, which vanish on a dark and on
        a light page.
        """
        ramp = mpl.colormaps["plasma"](np.linspace(0.1, 0.86, len(self.edges) + 1))
        return [mpl.colors.to_hex(colour) for colour in ramp]

    def step(self, error: Float64) -> NDArray[np.int64]:
        """(n,) index into the colours; -1 where there is no error."""
        step = np.searchsorted(self.edges, error, side="left")
        return np.where(np.isfinite(error), step, -1).astype(np.int64)

    def shades(self, error: Float64) -> list[str]:
        """(n,) colours of errors, grey where there is none."""
        colours = [*self.colours, MISSING]
        return [colours[step] for step in self.step(error)]

    def rgb(self, error: Float64) -> NDArray[np.uint8]:
        """(n, 3) the same as red, green and blue."""
        levels = to_rgb([*self.colours, MISSING])
        return (255.0 * levels[self.step(error)]).round().astype(np.uint8)

    def mappable(self, per_metre: float) -> ScalarMappable:
        """For a colour bar of matplotlib, in units of which so many are a metre."""
        edges = [edge * per_metre for edge in self.edges]
        norm = BoundaryNorm(edges, len(self.colours), extend="both")
        return ScalarMappable(norm, ListedColormap(self.colours))


FIXED = Scale(THRESHOLDS)
"""The scale of all reports."""


def scale_of(error: Float64) -> Scale:
    """A scale of some errors' own range: round edges from their least to their 98 % quantile."""
    known = error[np.isfinite(error)]
    low, high = (float(known.min()), float(np.quantile(known, CLIP))) if known.size else (0.0, 1.0)
    high = high if high > low else low + 0.01
    edges = tuple(float(edge) for edge in MaxNLocator(STEPS).tick_values(low, high)[1:-1])
    return Scale(edges if len(edges) > 1 else (low, high))


def height_range(z: Float64) -> tuple[float, float]:
    """Heights at which the greys begin and end [m]."""
    low, high = np.quantile(z, (TAILS, 1.0 - TAILS))
    return float(low), float(high)


def greys(z: Float64, span: tuple[float, float]) -> Float64:
    """(n, 3) greys of heights, in [0, 1]: from the lower end of a span to the higher [m]."""
    low, high = span
    share = np.clip((z - low) / max(high - low, 1e-3), 0.0, 1.0)
    rgb: Float64 = LOWEST + share[:, None] * (HIGHEST - LOWEST)
    return rgb
