"""Where beams meet upright boxes: what stands or drives in a street for a while."""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]

X, Y, COS, SIN, LENGTH, WIDTH, TOP = range(7)
"""Columns of a box: centre from where the beams start [m], cosine and sine of its direction, half
length, half width, and height of its roof above where the beams start [m]. It reaches down without
end, into the ground."""


@njit(nogil=True, error_model="numpy")
def _between(at, d, half, begin, end):  # type: ignore[no-untyped-def]
    """The part of a ray's range `begin` to `end` [m] between two walls at +-half of an axis."""
    if d == 0.0:
        return (begin, end) if abs(at) <= half else (np.inf, -np.inf)
    first, second = (-half - at) / d, (half - at) / d
    return max(begin, min(first, second)), min(end, max(first, second))


@njit(nogil=True, error_model="numpy")
def stopped_by(boxes: Float64, directions: Float64, near: float, far: float) -> Float64:
    """Range at which each beam enters the first box [m]; inf: none.

    Args:
        boxes: (k, 7) columns `X` to `TOP`.
        directions: (n, 3) unit vectors of the beams, in the frame of the boxes.
        near: nothing nearer is met [m]; a box that holds the start is never met.
        far: nothing farther is met [m].
    """
    out = np.full(len(directions), np.inf)
    for b in range(len(boxes)):
        box = boxes[b]
        c, s = box[COS], box[SIN]
        x, y = -(c * box[X] + s * box[Y]), s * box[X] - c * box[Y]
        for n in range(len(directions)):
            dx = c * directions[n, 0] + s * directions[n, 1]
            dy = c * directions[n, 1] - s * directions[n, 0]
            dz = directions[n, 2]
            begin, end = _between(x, dx, box[LENGTH], near, min(far, out[n]))
            begin, end = _between(y, dy, box[WIDTH], begin, end)
            if dz > 0.0:
                end = min(end, box[TOP] / dz)
            elif dz < 0.0:
                begin = max(begin, box[TOP] / dz)
            elif box[TOP] < 0.0:
                end = -np.inf
            if near < begin <= end:
                out[n] = begin
    return out
