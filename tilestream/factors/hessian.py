"""How well a scan constrains the pose: the NDT Hessian at a place (definitions, section 4.4)."""

import math

import numpy as np

from tilestream.formats.logs.poses import transform
from tilestream.kernels.cells import cell_of_points, cell_sums
from tilestream.local_map import LocalCells
from tilestream.matcher import RegistrationSettings
from tilestream.records import Cells, Column, Float64, Int64
from tilestream.registration import register


def _column(name: str, unit: str, meaning: str, source: str = "definitions, section 4.4") -> Column:
    return Column(name, "OB", unit, meaning, source, "observability")


_SCHUR = "Schur complement of the axis in -H: L_ii - L_ir L_rr^-1 L_ri, L = -H in the route frame"
_COVARIANCE = "diagonal of -H^-1 in the route frame"
_WEAK = "2x2 Schur complement of along and across in -H"

HESSIAN_COLUMNS = (
    _column("ob_info_along", "1/m^2", "How sharply the score falls along the route.", _SCHUR),
    _column("ob_info_across", "1/m^2", "The same across the route.", _SCHUR),
    _column("ob_info_up", "1/m^2", "The same in map z.", _SCHUR),
    _column("ob_info_yaw", "1/rad^2", "The same for the heading.", _SCHUR),
    _column("ob_cov_along", "m^2", "Variance along; NaN: H has no maximum.", _COVARIANCE),
    _column("ob_cov_across", "m^2", "Variance across; NaN likewise.", _COVARIANCE),
    _column("ob_cov_up", "m^2", "Variance in map z; NaN likewise.", _COVARIANCE),
    _column("ob_cov_yaw", "rad^2", "Variance of the heading; NaN likewise.", _COVARIANCE),
    _column("ob_weak_info", "1/m^2", "How sharply the score falls where it is flattest.", _WEAK),
    _column("ob_weak_angle", "rad", "Angle of that axis to the heading, 0 to pi/2.", _WEAK),
)


def hessian_factors(
    cells: Cells | LocalCells,
    points: Float64,
    T_map_lidar: Float64,
    registration: RegistrationSettings,
) -> dict[str, float]:
    """How well a scan constrains the pose: the NDT Hessian and score at the place, without a step.

    Args:
        cells: the map around the place.
        points: (n, 3) the scan in the lidar frame [m].
        T_map_lidar: (4, 4) the place; the heading of the route is that of its x axis.
        registration: the matcher.

    Raises:
        RegistrationError: as `register`.
    """
    index = (cells.cells if isinstance(cells, LocalCells) else cells).index
    size = (cells.cells if isinstance(cells, LocalCells) else cells).cell_size
    voxels = _distinct(np.floor(transform(T_map_lidar, points) / size).astype(np.int64))
    still = registration.model_copy(update={"iterations_max": 0})
    found = register(cells, points, T_map_lidar, still)
    heading = math.atan2(T_map_lidar[1, 0], T_map_lidar[0, 0])
    return {
        **information(-found.hessian[0], heading),
        "ob_score": float(found.score[0]) / found.points,
        "ob_nvtl": float(found.nvtl[0]),
        "ob_points": float(found.points),
        "ob_cells": float((cell_of_points(voxels, 1, index) >= 0).sum()),
    }


def _distinct(voxels: Int64) -> Int64:
    """Voxels without repetition, lexicographic."""
    index, _ = cell_sums(voxels, 1)
    return index


def information(L_map: Float64, heading: float) -> dict[str, float]:
    """The information of -H per axis of the route, with the other axes free.

    Args:
        L_map: (6, 6) -H for steps (tau, w) in the map frame [m, rad].
        heading: of the route [rad].

    Returns:
        `HESSIAN_COLUMNS`. A Schur complement may be negative where H is not definite; there the
        variances are NaN. Where the part of the other axes is singular it is NaN.
    """
    R = np.eye(6)
    R[:2, :2] = R[3:5, 3:5] = turned_by(heading)
    L = R.T @ L_map @ R
    of = {"along": 0, "across": 1, "up": 2, "yaw": 5}
    found = {f"ob_info_{name}": float(_schur(L, [axis])[0, 0]) for name, axis in of.items()}
    definite = np.linalg.eigvalsh(L)[0] > 0.0
    variance = np.diag(np.linalg.inv(L)) if definite else np.full(6, math.nan)
    found |= {f"ob_cov_{name}": float(variance[axis]) for name, axis in of.items()}
    plane = _schur(L, [0, 1])
    if not np.isfinite(plane).all():
        return found | {"ob_weak_info": math.nan, "ob_weak_angle": math.nan}
    values, axes = np.linalg.eigh(plane)
    angle = math.atan2(abs(axes[1, 0]), abs(axes[0, 0]))
    return found | {"ob_weak_info": float(values[0]), "ob_weak_angle": angle}


def _schur(L: Float64, kept: list[int]) -> Float64:
    """The Schur complement of the axes `kept`, the others free; NaN where those are singular."""
    free = [axis for axis in range(len(L)) if axis not in kept]
    try:
        solved = np.linalg.solve(L[np.ix_(free, free)], L[np.ix_(free, kept)])
    except np.linalg.LinAlgError:
        return np.full((len(kept), len(kept)), math.nan)
    rest: Float64 = L[np.ix_(kept, kept)] - L[np.ix_(kept, free)] @ solved
    return rest


def turned_by(heading: float) -> Float64:
    """(2, 2) the rotation by a heading [rad]."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[c, -s], [s, c]])
