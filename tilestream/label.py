"""The label of a place: how far registrations end from the truth (definitions, section 5).

A scan is registered from 317 starts around its true pose; the mean of their errors is the label.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import RegistrationError, UsageError
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.kernels.fixed_order import norms, row_sums
from tilestream.matcher import RegistrationSettings
from tilestream.records import Cells, Float64, LocalizationError, TruePose
from tilestream.registration import register, rigid_poses
from tilestream.settings import StartSettings

FAILED = 0.5
"""3D error beyond which a start has failed [m]."""
NEAR = 1.0
"""Starts within this distance of the true position make `error_floor` [m]."""
FINE_CELL, FINE_RADIUS, FINE_STEP = 1.0, 0.5, 0.05
"""The refined true pose: cell size, search radius and step [m] (the paper's section VI)."""

_AXES = ("along", "across", "up", "roll", "pitch", "yaw")


def disc_starts(radius: float = 2.0, step: float = 0.2) -> Float64:
    """Offsets (i, j) * step with i^2 + j^2 <= (radius / step)^2, i slowest: the paper's particles.

    Compared in whole millimetres: exactly 317 by default, where floats would lose some.

    Args:
        radius: radius of the disc [m], whole millimetres.
        step: spacing [m], whole millimetres.

    Returns:
        (k, 2) offsets in map x and y [m].

    Raises:
        UsageError: not whole millimetres, a negative radius, a step that is not positive.

    Examples:
        >>> ts.disc_starts(radius=0.2, step=0.2).shape
        (5, 2)
    """
    radius_mm, step_mm = whole_mm(radius, "radius"), whole_mm(step, "step")
    if radius_mm < 0 or step_mm <= 0:
        raise UsageError(f"radius {radius!r} m, step {step!r} m: give >= 0 and > 0")
    reach = radius_mm // step_mm
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    inside = (i * i + j * j) * step_mm**2 <= radius_mm**2
    offsets: Float64 = np.column_stack([i, j])[inside] * step_mm / MM_PER_M
    return offsets


def start_poses(T_map_lidar: ArrayLike, settings: StartSettings | None = None) -> Float64:
    """The starts around a true pose: the disc, for each z, for each yaw (yaw fastest).

    Args:
        T_map_lidar: (4, 4) true pose.
        settings: the disc, and yaw and z offsets; default: 317 starts at true z and orientation.

    Returns:
        (k, 4, 4) poses.

    Raises:
        RegistrationError: the pose is not rigid or not finite.
    """
    settings = settings or StartSettings()
    T_map_true = rigid_poses(T_map_lidar, "the true pose")[0]
    disc = disc_starts(settings.radius, settings.step)
    yaws = np.zeros((len(settings.yaw), 3, 3))
    for turn, yaw in zip(yaws, settings.yaw, strict=True):
        c, s = math.cos(yaw), math.sin(yaw)
        turn[:] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    shape = (len(disc), len(settings.z), len(settings.yaw))
    poses = np.broadcast_to(T_map_true, (*shape, 4, 4)).copy()
    poses[..., :2, 3] += disc[:, None, None]
    poses[..., 2, 3] += np.array(settings.z)[:, None]
    if settings.yaw != (0.0,):
        poses[..., :3, :3] = yaws @ T_map_true[:3, :3]
    return poses.reshape(-1, 4, 4)


def localization_error(
    cells: Cells,
    scan_points: ArrayLike,
    T_map_lidar: ArrayLike,
    starts: ArrayLike | None = None,
    settings: RegistrationSettings | None = None,
    start_settings: StartSettings | None = None,
    true_pose: TruePose = "log",
) -> LocalizationError:
    """Where registrations end that start around the true pose: the label of a sample point.

    Args:
        cells: cells of the map around the scan (see `register`).
        scan_points: (n, 3) points in the lidar frame [m].
        T_map_lidar: (4, 4) true pose of the lidar.
        starts: (k, 2) offsets in map x and y [m] at true z and orientation, or (k, 4, 4) poses;
            None: the starts of `start_settings`.
        settings: the matcher; default `RegistrationSettings()`.
        start_settings: the starts; default the paper's 317.
        true_pose: where `T_map_lidar` is from; recorded.

    Raises:
        RegistrationError: as `register`.
        UsageError: `starts` and `start_settings` both given, or starts of another shape or none.
    """
    T_map_true = rigid_poses(T_map_lidar, "the true pose")[0]
    T_map_lidar_starts = _starts(T_map_true, starts, start_settings)
    found = register(cells, scan_points, T_map_lidar_starts, settings)
    errors = start_errors(T_map_true, found.T_map_lidar)
    distance = norms(T_map_lidar_starts[:, :3, 3] - T_map_true[:3, 3])
    return LocalizationError(
        T_map_lidar=T_map_true,
        true_pose=true_pose,
        T_map_lidar_starts=T_map_lidar_starts,
        registrations=found,
        **errors,
        **summary(errors, distance),
    )


def start_errors(T_map_true: Float64, T_map_final: Float64) -> dict[str, Any]:
    """The error of each start, in the frame of the true heading.

    `along`, `across`, `up` and the rotation vector (`roll`, `pitch`, `yaw_vector`) are the whole
    error: with the true pose they give the final one.

    Args:
        T_map_true: (4, 4) true pose.
        T_map_final: (k, 4, 4) final poses of the starts.

    Returns:
        (k,) each: `along`, `across`, `up` [m], `roll`, `pitch`, `yaw_vector`, `yaw` [rad], `error`
        (the 3D norm) [m], as the fields of `LocalizationError` say.
    """
    heading = math.atan2(T_map_true[1, 0], T_map_true[0, 0])
    c, s = math.cos(heading), math.sin(heading)
    offset = T_map_final[:, :3, 3] - T_map_true[:3, 3]
    turned = np.arctan2(T_map_final[:, 1, 0], T_map_final[:, 0, 0]) - heading
    rotation = _rotation_vectors(T_map_true[:3, :3], T_map_final[:, :3, :3])
    return {
        "along": offset[:, 0] * c + offset[:, 1] * s,
        "across": offset[:, 1] * c - offset[:, 0] * s,
        "up": offset[:, 2],
        "roll": rotation[:, 0] * c + rotation[:, 1] * s,
        "pitch": rotation[:, 1] * c - rotation[:, 0] * s,
        "yaw_vector": rotation[:, 2],
        "yaw": (turned + np.pi) % (2.0 * np.pi) - np.pi,
        "error": norms(offset),
    }


def _rotation_vectors(R_true: Float64, R_final: Float64) -> Float64:
    """(k, 3) rotation vectors w in the map frame [rad]: Exp(w) R_true = R_final, (k, 3, 3)."""
    products = (R_final[:, :, None] * R_true).reshape(-1, 3)
    R_error = row_sums(products).reshape(-1, 3, 3)  # R_final R_true^T
    vectors: Float64 = Rotation.from_matrix(R_error).as_rotvec()
    return vectors


def summary(errors: Mapping[str, Float64], distance: Float64) -> dict[str, Any]:
    """The label of a sample point from the errors of its starts.

    Args:
        errors: as `start_errors` gives them.
        distance: (k,) of each start from the true position [m].

    Returns:
        The summary fields of `LocalizationError`, by name; the mean of nothing is NaN.
    """
    error = errors["error"]
    held = error[error <= FAILED]
    error_floor = _mean(error[distance <= NEAR + 1e-9])
    return {
        "error_mean": _mean(error),
        "p_fail": _mean(error > FAILED),
        "mean_held": _mean(held),
        "median_held": float(np.median(held)) if held.size else math.nan,
        "p95_held": float(np.percentile(held, 95.0)) if held.size else math.nan,
        **{f"{name}_mean": _mean(np.abs(errors[name])) for name in _AXES},
        "error_floor": error_floor,
        "error_tail": _mean(error) - error_floor,
    }


def refined_pose(
    fine_cells: Cells,
    scan_points: ArrayLike,
    T_map_log: ArrayLike,
    settings: RegistrationSettings | None = None,
) -> Float64:
    """The paper's ground truth, in two steps on cells of 1.0 m, from the pose of a log.

    Register from the log's pose; then the best direct7 score over the 0.05 m lattice in map x and
    y within 0.5 m of where that ended, at its z and orientation (equal scores: the first, x
    slowest). The refined pose shares its scan with the registrations that it is the reference for:
    pass `true_pose="refined"` on.

    Args:
        fine_cells: cells of 1.0 m around the scan.
        scan_points: (n, 3) points in the lidar frame [m].
        T_map_log: (4, 4) pose of the log.
        settings: the matcher of the first step; default `RegistrationSettings(scan_leaf=1.0)`, as
            the paper thins the scan by the cell size.

    Returns:
        (4, 4) the refined pose.

    Raises:
        UsageError: cells of another size.
        RegistrationError: as `register`, or the first step did not converge.
    """
    if fine_cells.cell_size != FINE_CELL:
        raise UsageError(
            f"a refined pose needs cells of {FINE_CELL:g} m, not of {fine_cells.cell_size:g} m"
        )
    settings = settings or RegistrationSettings(scan_leaf=FINE_CELL)
    rough = register(fine_cells, scan_points, T_map_log, settings)
    if not rough.converged[0]:
        raise RegistrationError(
            f"the log's pose cannot be refined: no convergence after {rough.iterations[0]} steps"
        )
    particles = start_poses(rough.T_map_lidar[0], StartSettings(radius=FINE_RADIUS, step=FINE_STEP))
    scoring = settings.model_copy(update={"neighbours": "direct7", "iterations_max": 0})
    scores = register(fine_cells, scan_points, particles, scoring).score
    best: Float64 = particles[int(np.argmax(scores))]
    return best


def _starts(
    T_map_true: Float64, starts: ArrayLike | None, settings: StartSettings | None
) -> Float64:
    """(k, 4, 4) start poses from the arguments of `localization_error`."""
    if starts is None:
        return start_poses(T_map_true, settings)
    if settings is not None:
        raise UsageError("starts and start_settings are both given: give one of them")
    given = np.asarray(starts)
    if given.ndim == 3:
        return rigid_poses(given, "start")
    if given.ndim != 2 or given.shape[1] != 2 or not len(given) or given.dtype.kind not in "iuf":
        raise UsageError(
            f"starts have shape {given.shape}: give (k, 2) offsets [m] or (k, 4, 4) poses"
        )
    poses = np.repeat(T_map_true[None], len(given), axis=0)
    poses[:, :2, 3] += given
    return rigid_poses(poses, "start")


def _mean(values: NDArray[np.float64] | NDArray[np.bool_]) -> float:
    return float(values.mean()) if values.size else math.nan
