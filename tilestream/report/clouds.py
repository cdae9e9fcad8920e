"""The worst places as small point clouds that turn in the page, drawn by K3D's own viewer."""

import base64
import gzip
import re
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from tilestream.records import Float64
from tilestream.report.colours import SEEN, to_rgb
from tilestream.report.pictures import ABOVE, BELOW, HEIGHTS, NOTHING

MOST_POINTS, MOST_RETURNS = 12_000, 4_000
"""Points of the map and of the scan in a cloud; of more, a fair and repeatable sample. Ten clouds
are about 1 MB of the page."""
APART = 0.25
"""Edge of the voxels of which one map point is kept [m]: walls are not denser than needed."""
STEP = 1 / 32
"""What positions are rounded to [m], so that they take less room."""
POINT, RETURN, PLACE = 0.3, 0.35, 2.0
"""Diameters of what is drawn [m]."""
AHEAD = 11.0
"""Length of the line in the direction of travel [m]."""
BEHIND, OVER = 34.0, 26.0
"""Where the camera is at first, behind and above the place [m]."""
FONTS_OUTSIDE = re.compile(r',url\(fonts/[^)]*\) format\("(?:woff|truetype)"\)')
"""Fonts that K3D would ask a server for, beside those that it has inside."""


@cache
def viewer() -> str:
    """The script of K3D: it defines the module `k3d`; asks for nothing that is not inside."""
    script = Path(_k3d().__file__).with_name("static") / "standalone.js"
    return FONTS_OUTSIDE.sub("", script.read_text(encoding="utf-8"))


def packed(text: str) -> str:
    """A script as base64 of gzip: a third of its size."""
    return base64.b64encode(gzip.compress(text.encode("utf-8"), 9, mtime=0)).decode("ascii")


def cloud(points: Float64, place: Float64, heading: float, colour: int, seen: Float64) -> bytes:
    """The map round a place as K3D's viewer takes it: coloured by height as in the pictures, the
    place a ball with a line ahead, what the lidar sees there in orange.

    Args:
        points: (n, 3) map points [m].
        place: (3,) the place of the lidar [m].
        heading: of travel there [rad].
        colour: of the ball, red * 65536 + green * 256 + blue.
        seen: (k, 3) returns of a virtual scan [m]; none: it was not taken.
    """
    k3d = _k3d()
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    camera = [*(OVER * np.array([0.0, 0.0, 1.0]) - BEHIND * ahead), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    plot = k3d.plot(
        grid_visible=False,
        menu_visibility=False,
        axes_helper=0.0,
        camera_auto_fit=False,
        camera=[float(value) for value in camera],
        camera_mode="orbit",
        camera_up_axis="z",
        background_color=_packed_rgb(NOTHING),
    )
    offset = _thinned(points - place)
    drawn = [
        k3d.points(_rounded(offset), _by_height(offset), point_size=POINT, shader="flat"),
        k3d.points(np.zeros((1, 3), np.float32), color=colour, point_size=PLACE, shader="3d"),
        k3d.line(_rounded(np.stack([0.0 * ahead, AHEAD * ahead])), color=colour, width=0.25),
    ]
    if len(seen):
        returns = _rounded(_some(seen - place, MOST_RETURNS))
        shade = _packed_rgb(SEEN)
        drawn.append(k3d.points(returns, color=shade, point_size=RETURN, shader="flat"))
    for number, one in enumerate(drawn, start=1):
        one.id = number  # K3D's own differs from run to run
        plot += one
    snapshot: bytes = plot.get_binary_snapshot()
    return snapshot


def _k3d() -> Any:
    """K3D, loaded when a page has a cloud: it takes 0.3 s."""
    import k3d  # noqa: PLC0415 - see the docstring

    return k3d


def _thinned(offset: Float64) -> Float64:
    """One point of each voxel, and of these a fair sample; always the same."""
    voxel = np.floor(offset / APART).astype(np.int64)
    order = np.lexsort((*offset.T, *voxel.T))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(voxel[order], axis=0) != 0).any(axis=1)
    return _some(offset[order[first]], MOST_POINTS)


def _some(points: Float64, most: int) -> Float64:
    if len(points) <= most:
        return points
    kept = np.sort(np.random.default_rng(0).permutation(len(points))[:most])
    some: Float64 = points[kept]
    return some


def _rounded(offset: Float64) -> "np.ndarray[tuple[int, ...], np.dtype[np.float32]]":
    return (np.rint(offset / STEP) * STEP).astype(np.float32)


def _by_height(offset: Float64) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint32]]":
    share = np.clip((offset[:, 2] + BELOW) / (ABOVE + BELOW), 0.0, 1.0)
    rgb = mpl.colormaps[HEIGHTS](share, bytes=True)[:, :3].astype(np.uint32)
    return ((rgb[:, 0] << 16) | (rgb[:, 1] << 8) | rgb[:, 2]).astype(np.uint32)


def _packed_rgb(colour: str) -> int:
    red, green, blue = (to_rgb([colour])[0] * 255.0).round().astype(int).tolist()
    return int(red << 16 | green << 8 | blue)
