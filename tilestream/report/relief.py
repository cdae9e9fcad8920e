"""The map behind the dots: from above, the higher the darker, see-through on any page."""

import io

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from tilestream.from_above import FromAbove

GREY = 128
"""Of all that is drawn: on a light page and on a dark one it is told by how opaque it is."""
FAINT, STRONG = 0.24, 0.85
"""How opaque the ground is, and what stands `HIGH` or more above it."""
HIGH = 15.0
"""Height above the ground from which on all is alike [m]."""
BLOCK = 40.0
"""The ground of a pixel is the lowest of the square of this width around it [m]."""
SHADES = 12
"""Steps of opacity: few make small files."""


def relief(found: FromAbove) -> NDArray[np.uint8]:
    """(rows, columns, 4) red, green, blue and opacity, the highest y first; nothing is clear."""
    there = np.isfinite(found.height)
    height = np.where(there, found.height, np.inf)
    ground = minimum_filter(height, size=1 + 2 * round(0.5 * BLOCK / found.pixel), mode="nearest")
    above = np.zeros(height.shape)
    np.subtract(height, ground, out=above, where=there)
    share = np.clip(np.floor(above / HIGH * SHADES), 0, SHADES - 1) / (SHADES - 1)
    image = np.full((*height.shape, 4), GREY, np.uint8)
    image[..., 3] = np.where(there, np.round(255.0 * (FAINT + (STRONG - FAINT) * share)), 0.0)
    return image[::-1]


def relief_png(found: FromAbove) -> bytes:
    """The same as PNG; the same map gives the same bytes."""
    buffer = io.BytesIO()
    options = {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}}
    mpl.image.imsave(buffer, relief(found), format="png", **options)  # type: ignore[arg-type]
    return buffer.getvalue()
