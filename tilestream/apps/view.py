"""The window that shows a map and its errors in 3D: the one place that knows Open3D's viewer."""

import ctypes
import io
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.image import imsave

from tilestream.apps.camera import oblique
from tilestream.apps.scene import MOST_POINTS, Scene, scene_of
from tilestream.errors import DisplayError, UsageError
from tilestream.files import Files
from tilestream.kernels import cells as _numba_first  # noqa: F401  Open3D brings an older libtbb
from tilestream.report.pictures import NOTHING

WIDTH, HEIGHT = 1280, 800
"""Of the window [pixels]."""
POINT_SIZE = 3.0
"""Of a map point [pixels]."""
ESTIMATED = 0.7
"""Radius of an estimated place as a share of a measured one's."""
REFRESH = 0.01
"""Time between two looks at mouse and keys [s]."""
LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""What Open3D loads of a Linux, and Debian's package of each."""
DRIVERS = "libgl1-mesa-dri libglx-mesa0 libegl-mesa0"
"""Debian's packages that draw without a graphics card."""


def view(
    place: str | os.PathLike[str],
    *,
    tile: tuple[int, int] | None = None,
    screenshot: str | os.PathLike[str] | None = None,
    points: int = MOST_POINTS,
) -> Scene:
    """Show a map in 3D, the places of a run on it coloured by error; returns when it is closed.

    Grey points are the map by height; balls are the places, in the report's colours: large ones by
    their measured error, small ones by their estimate, grey ones have neither.

    Args:
        place: a tile store (a path or an fsspec URL: the map alone), or a run directory of `run`,
            `localize` or `factors`.
        tile: show only this tile; None: all.
        screenshot: write this PNG instead of opening a window; needs no display where Mesa or a
            driver of the graphics card can draw without one.
        points: show at most so many points of the map; of more, a fair sample.

    Returns:
        What is shown.

    Raises:
        UsageError, StoreNotFoundError, TileNotReadyError: as `scene_of`; or no name of a PNG.
        DisplayError: no display, or a library is missing; says which package has it.
    """
    require_display(screenshot)
    scene = scene_of(place, tile=tile, points=points)
    show(scene, screenshot)
    return scene


def require_display(screenshot: str | os.PathLike[str] | None) -> None:
    """Say at once, before a city is read, that `show` could not show it; errors as `view`."""
    if screenshot is not None and Path(screenshot).suffix.lower() != ".png":
        raise UsageError(f"{os.fspath(screenshot)}: name a file that ends with .png")
    with _opened(visible=False, display=screenshot is None):
        pass


def show(scene: Scene, screenshot: str | os.PathLike[str] | None = None) -> None:
    """Show a scene; arguments and errors as `view`."""
    seen = screenshot is None
    with _opened(visible=seen, display=seen) as window:
        window.add_geometry(_cloud(scene))
        if len(scene.places):
            window.add_geometry(_balls(scene))
        _look(window, scene)
        while window.poll_events() and screenshot is None:
            time.sleep(REFRESH)  # Open3D's own loop would be deaf to Ctrl-C
        if screenshot is None:
            return
        picture = np.asarray(window.capture_screen_float_buffer(do_render=True))
    with Files.at(screenshot).writing() as file:
        imsave(file, np.clip(picture, 0.0, 1.0), format="png")


def _open3d() -> Any:
    """Open3D, loaded when something is shown: it takes 0.6 s and 100 MB.

    Raises:
        DisplayError: it cannot be loaded; says what is missing.
    """
    try:
        import open3d  # noqa: PLC0415 - see the docstring
    except ImportError as missing:
        raise DisplayError(
            f"Open3D cannot be loaded: {missing}{_install(_missing_packages())}"
        ) from None
    return open3d


def _missing_packages() -> str:
    """Of what Open3D needs: the loader names the first that it misses only."""
    missing = []
    for library, package in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return " ".join(missing)


def _install(packages: str) -> str:
    there = packages and sys.platform == "linux"
    return f"; on Debian or Ubuntu: apt-get install {packages}" if there else ""


@contextmanager
def _opened(*, visible: bool, display: bool) -> Iterator[Any]:
    """A window, closed at the end.

    Args:
        visible: whether it is to be seen.
        display: whether it needs one; else it may be drawn without.

    Raises:
        DisplayError: it does not open; says why.
    """
    window = _open3d().visualization.Visualizer()
    try:
        with _listening() as told:
            opened = window.create_window("tilestream", WIDTH, HEIGHT, visible=visible)
        if display and re.search("No display|DISPLAY", told.getvalue()):
            raise DisplayError("no display: run it on a desktop, or with --screenshot F.png")
        if not opened:
            said = "; ".join(re.findall(r"WARNING\] ([^\x1b\n]*)", told.getvalue()))
            raise DisplayError(f"no window opens: {said}{_install(DRIVERS)}")
        yield window
    finally:
        window.destroy_window()


@contextmanager
def _listening() -> Iterator[io.StringIO]:
    """What Open3D says meanwhile; what the libraries below it say to stderr is dropped, for one
    line of ours tells it.
    """
    told, stderr = io.StringIO(), os.dup(2)
    with redirect_stdout(told), Path(os.devnull).open("w") as nothing:
        os.dup2(nothing.fileno(), 2)
        try:
            yield told
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def _cloud(scene: Scene) -> Any:
    open3d = _open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.points))
    cloud.colors = open3d.utility.Vector3dVector(scene.point_rgb())
    return cloud


def _balls(scene: Scene) -> Any:
    """All places as one mesh, which is drawn at once."""
    open3d, rows = _open3d(), scene.drawn()
    vector = open3d.utility.Vector3dVector
    ball = open3d.geometry.TriangleMesh.create_sphere(1.0, resolution=6)
    normals = np.asarray(ball.vertices)
    radius = scene.radius * np.where(scene.measured[rows], 1.0, ESTIMATED)
    corners = scene.places[rows, None] + radius[:, None, None] * normals
    first = len(normals) * np.arange(len(rows))
    triangles = first[:, None, None] + np.asarray(ball.triangles)
    mesh = open3d.geometry.TriangleMesh(
        vector(corners.reshape(-1, 3)),
        open3d.utility.Vector3iVector(triangles.reshape(-1, 3).astype(np.int32)),
    )
    mesh.vertex_normals = vector(np.tile(normals, (len(rows), 1)))
    mesh.vertex_colors = vector(np.repeat(scene.place_rgb()[rows], len(normals), axis=0))
    return mesh


def _look(window: Any, scene: Scene) -> None:
    """Set background, size of the points, and camera."""
    options, control = window.get_render_option(), window.get_view_control()
    options.background_color = mpl.colors.to_rgb(NOTHING)
    options.point_size = POINT_SIZE
    field_of_view = np.radians(control.get_field_of_view())
    camera = oblique(scene.seen, WIDTH / HEIGHT, field_of_view)
    extent = np.ptp(np.concatenate([scene.points, scene.places]), axis=0).max()
    control.set_lookat(camera.centre)
    control.set_front(camera.towards)
    control.set_up(camera.up)
    control.set_zoom(camera.distance * np.tan(field_of_view / 2.0) / extent)
