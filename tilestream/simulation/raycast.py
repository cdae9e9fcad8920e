"""First hits of rays on triangles: the one place that knows Open3D."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.kernels import cells as _numba_first  # noqa: F401  Open3D brings an older libtbb
from tilestream.records import Float64
from tilestream.simulation.mesh import Mesh


def _open3d() -> Any:
    """Open3D, loaded when the first scene is built: it takes seconds and 100 MB.

    Raises:
        UsageError: it cannot be loaded; says what is missing.
    """
    try:
        import open3d  # noqa: PLC0415 - see the docstring
    except ImportError as missing:
        raise UsageError(
            f"the simulation needs Open3D, which cannot be loaded: {missing}. Install open3d-cpu; "
            "on a bare Debian also: apt-get install libgl1 libegl1 libx11-6 libusb-1.0-0"
        ) from None
    return open3d


class Scene:
    """Triangles that rays are cast at, relative to an origin so that float32 suffices.

    Args:
        mesh: the triangles [m, map frame].
        origin: (3,) a place near all of them [m]; sub-millimetre within 5 km of it.
    """

    def __init__(self, mesh: Mesh, origin: Float64) -> None:
        self.origin = np.asarray(origin, np.float64)
        self._material = mesh.material
        self._scene = _open3d().t.geometry.RaycastingScene()
        if len(mesh):
            corners = (mesh.corners - self.origin).astype(np.float32).reshape(-1, 3)
            rows = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
            self._scene.add_triangles(_tensor(corners), _tensor(rows))
        self._empty = not len(mesh)

    def first_hits(
        self, start: Float64, direction: Float64
    ) -> tuple[Float64, Float64, NDArray[np.uint8]]:
        """What rays meet first.

        Args:
            start: (n, 3) where rays begin [m, map frame].
            direction: (n, 3) unit vectors.

        Returns:
            (n,) ranges [m], infinite where nothing is met; (n,) cosines of incidence in [0, 1];
            (n,) materials, 0 where nothing is met.
        """
        n = len(start)
        if self._empty:
            return np.full(n, np.inf), np.zeros(n), np.zeros(n, np.uint8)
        rays = np.empty((n, 6), np.float32)
        rays[:, :3] = start - self.origin
        rays[:, 3:] = direction
        hit = self._scene.cast_rays(_tensor(rays), nthreads=1)
        ranges = hit["t_hit"].numpy().astype(np.float64)
        normal = hit["primitive_normals"].numpy().astype(np.float64)
        cosine = np.minimum(np.abs((normal * direction).sum(axis=1)), 1.0)
        met = np.isfinite(ranges)
        triangle = np.where(met, hit["primitive_ids"].numpy(), 0).astype(np.int64)
        return ranges, np.where(met, cosine, 0.0), np.where(met, self._material[triangle], 0)


def _tensor(array: Any) -> Any:
    return _open3d().core.Tensor.from_numpy(array)
