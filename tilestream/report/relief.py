"""The map behind the dots: from above, the higher the darker, see-through on any page."""

import io

import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from tilestream.from_above import FromAbove
from tilestream.records import Float64

GREY = 128
"""Of all that is drawn: on a light page and on a dark one it is told by how opaque it is."""
FAINT, STRONG = 0.24, 0.85
"""How opaque the ground is, and what stands `HIGH` or more above it."""
HIGH = 15.0
"""Height above the ground from which on all is alike [m]."""
BLOCK = 10.0
"""Edge of the squares that a ground is found for [m], at least four pixels."""
LOW = 0.1
"""A square is as high as this quantile of its pixels: strays below the road are no ground …"""
LEAST = 4
"""… nor is what has fewer pixels …"""
AROUND = 5
"""… and its ground is the lowest of so many squares by so many: a roof has that of its street."""
SHADES = 12
"""Steps of opacity: few make small files."""


def relief(found: FromAbove) -> NDArray[np.uint8]:
    """(rows, columns, 4) red, green, blue and opacity, the highest y first; nothing is clear."""
    there = np.isfinite(found.height)
    above = np.nan_to_num(found.height - _ground(found))
    share = np.clip(np.floor(above / HIGH * SHADES), 0, SHADES - 1) / (SHADES - 1)
    image = np.full((*above.shape, 4), GREY, np.uint8)
    image[..., 3] = np.where(there, np.round(255.0 * (FAINT + (STRONG - FAINT) * share)), 0.0)
    return np.ascontiguousarray(image[::-1])


def _ground(found: FromAbove) -> Float64:
    """(rows, columns) height of the ground [m]; NaN where none is known."""
    edge = max(LEAST, round(BLOCK / found.pixel))
    rows, columns = found.height.shape
    down, across = -(-rows // edge), -(-columns // edge)
    padded = np.full((down * edge, across * edge), np.inf)
    padded[:rows, :columns] = np.where(np.isfinite(found.height), found.height, np.inf)
    squares = padded.reshape(down, edge, across, edge).swapaxes(1, 2).reshape(down, across, -1)
    squares = np.sort(squares, axis=2)
    count = np.isfinite(squares).sum(axis=2)
    rank = (LOW * np.maximum(count - 1, 0)).astype(np.int64)
    low = np.take_along_axis(squares, rank[:, :, None], axis=2)[:, :, 0]
    ground = minimum_filter(np.where(count < LEAST, np.inf, low), size=AROUND, mode="nearest")
    ground = np.where(np.isfinite(ground), ground, np.nan)
    whole: Float64 = ground.repeat(edge, axis=0).repeat(edge, axis=1)[:rows, :columns]
    return whole


def relief_png(found: FromAbove) -> bytes:
    """The same as PNG; the same map gives the same bytes."""
    buffer = io.BytesIO()
    options = {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}}
    imsave(buffer, relief(found), format="png", **options)  # type: ignore[arg-type]
    return buffer.getvalue()
