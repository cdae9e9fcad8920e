"""Where a scene is seen from: obliquely from above, as near as all of it fits."""

from dataclasses import dataclass

import numpy as np

from tilestream.records import Float64

ELEVATION = np.radians(52.0)
"""How far the camera looks down: streets are seen between their walls, and walls as walls."""
TURN = np.radians(55.0)
"""How far it stands beside the line across the long side of what it sees."""

MARGIN, ROOM = 20.0, 1.1
"""The eye stands farther back than what it sees demands, by this [m] and by this factor, to see
what is around it."""
ROUNDS = 20
"""Of moving the camera aside, until what it sees is in the middle, and back, until it fits."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera whose picture has z upwards."""

    centre: Float64
    """(3,) what is in the middle of the picture [m]."""
    towards: Float64
    """(3,) unit vector from there to the eye."""
    up: Float64
    """(3,) unit vector to the upper edge of the picture."""
    distance: float
    """Of the eye from there [m]."""


def oblique(points: Float64, aspect: float, field_of_view: float) -> Camera:
    """The camera that sees all points, the long side of them across the picture.

    Args:
        points: (n, 3) what must be in the picture [m], n at least 1.
        aspect: width of the picture over its height.
        field_of_view: from the lower to the upper edge of the picture [rad].
    """
    across = _south_of_long_side(points[:, :2])
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    towards = np.append(np.cos(ELEVATION) * (turn @ across), np.sin(ELEVATION))
    right = np.cross([0.0, 0.0, 1.0], towards) / np.cos(ELEVATION)
    axes = np.stack([right, np.cross(towards, right), towards])
    seen = points @ axes.T
    offset, nearer = seen[:, :2], seen[:, 2]
    half = np.tan(field_of_view / 2.0) * np.array([aspect, 1.0])
    aside, depth = offset.mean(axis=0), nearer.mean()

    def far_enough() -> float:
        return float((ROOM * np.abs(offset - aside) / half + nearer[:, None]).max()) + MARGIN

    for _ in range(ROUNDS):
        back = far_enough()
        picture = (offset - aside) / (back - nearer)[:, None]
        aside = aside + (back - depth) * (picture.max(axis=0) + picture.min(axis=0)) / 2.0
    back = far_enough()  # also where moving aside has not settled
    return Camera(np.append(aside, depth) @ axes, towards, axes[1], back - depth)


def _south_of_long_side(at: Float64) -> Float64:
    """(2,) unit vector across the long side of places, rather to the south."""
    _, axes = np.linalg.eigh(np.cov(at.T, bias=True))
    across: Float64 = axes[:, 0]
    return -across if across[1] > 0.0 else across
