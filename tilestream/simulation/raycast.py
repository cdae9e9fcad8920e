"""First hits of rays on triangles: the one place that knows Embree, and who brings it."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.kernels import cells as _numba_first  # noqa: F401  Open3D brings an older libtbb
from tilestream.kernels.fixed_order import norms
from tilestream.records import Float64
from tilestream.simulation.mesh import Mesh

Float32 = NDArray[np.float32]


class Caster(Protocol):
    """Triangles in float32 that rays are cast at."""

    def cast(
        self, start: Float32, direction: Float32
    ) -> tuple[Float32, NDArray[np.int32], Float32]:
        """What rays meet first.

        Args:
            start: (n, 3) where rays begin [m].
            direction: (n, 3) unit vectors.

        Returns:
            (n,) ranges [m]; (n,) numbers of the triangles, -1 where nothing is met; (n, 3) their
            normals, of any length. Ranges and normals mean nothing where nothing is met.
        """


class Embree:
    """Embree by its own Python binding, a wheel without system libraries.

    Args:
        corners: (m, 3, 3) corners of the triangles [m].

    Raises:
        ImportError: embreex cannot be loaded.
    """

    def __init__(self, corners: Float32) -> None:
        from embreex.mesh_construction import TriangleMesh  # noqa: PLC0415 - 40 MB, and optional
        from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415

        # Robust: no ray slips through the edge that two triangles share.
        self._scene: Any = EmbreeScene(robust=True)
        TriangleMesh(self._scene, corners)

    def cast(
        self, start: Float32, direction: Float32
    ) -> tuple[Float32, NDArray[np.int32], Float32]:
        """See `Caster`."""
        hit = self._scene.run(start, direction, output=True)
        return hit["tfar"], hit["primID"], hit["Ng"]


class Open3D:
    """The Embree inside Open3D, for where embreex has no wheel; needs libGL, libX11 and others.

    Args:
        corners: (m, 3, 3) corners of the triangles [m].

    Raises:
        ImportError: Open3D cannot be loaded.
    """

    def __init__(self, corners: Float32) -> None:
        from open3d import core, t  # noqa: PLC0415 - seconds and 100 MB

        self._tensor = core.Tensor.from_numpy
        self._scene = t.geometry.RaycastingScene()
        rows = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(self._tensor(corners.reshape(-1, 3)), self._tensor(rows))

    def cast(
        self, start: Float32, direction: Float32
    ) -> tuple[Float32, NDArray[np.int32], Float32]:
        """See `Caster`."""
        hit = self._scene.cast_rays(self._tensor(np.hstack([start, direction])), nthreads=1)
        triangle = hit["primitive_ids"].numpy().view(np.int32)  # its invalid number becomes -1
        return hit["t_hit"].numpy(), triangle, hit["primitive_normals"].numpy()


def caster_of(corners: Float32) -> Caster:
    """The first caster that can be loaded here.

    Raises:
        UsageError: none can; says what is missing.
    """
    missing = []
    for caster in (Embree, Open3D):
        try:
            return caster(corners)
        except ImportError as error:
            missing.append(str(error))
    raise UsageError(
        "the simulation casts rays with embreex, or with Open3D where embreex has no wheel; "
        f"neither can be loaded: {'; '.join(missing)}. Run pip install embreex; if it finds no "
        "wheel, pip install open3d, which on a bare Debian also needs apt-get install libgl1 "
        "libegl1 libx11-6 libusb-1.0-0"
    )


class Scene:
    """Triangles that rays are cast at, relative to an origin so that float32 suffices.

    Args:
        mesh: the triangles [m, map frame].
        origin: (3,) a place near all of them [m]; sub-millimetre within 5 km of it.

    Raises:
        UsageError: no caster can be loaded.
    """

    def __init__(self, mesh: Mesh, origin: Float64) -> None:
        self.origin = np.asarray(origin, np.float64)
        self._material = mesh.material
        corners = (mesh.corners - self.origin).astype(np.float32)
        self._caster = caster_of(corners) if len(mesh) else None

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
        ranges, cosine, material = np.full(n, np.inf), np.zeros(n), np.zeros(n, np.uint8)
        if self._caster is None:
            return ranges, cosine, material
        reach, triangle, normal = self._caster.cast(
            (start - self.origin).astype(np.float32), direction.astype(np.float32)
        )
        met = triangle >= 0
        ranges[met] = reach[met]
        across = normal[met].astype(np.float64)
        along = np.abs((across * direction[met]).sum(axis=1))
        cosine[met] = np.minimum(along / norms(across), 1.0)
        material[met] = self._material[triangle[met]]
        return ranges, cosine, material
