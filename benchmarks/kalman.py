"""An error-state Kalman filter of a pose, with odometry and measured poses; k of them side by side.

The state is the pose of the lidar in the map and the scale error of its odometry. Errors are true
minus estimated: of the position in map x, y, z, of the rotation w, Exp(w) R = R_true, in the map
frame (as `tilestream.label.start_errors` has them), of the scale. Jacobians and update are the
textbook's (e.g. Sola, Quaternion kinematics for the error-state Kalman filter, sections 5 and 6).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

Floats = NDArray[np.float64]
STATES = 7


@dataclass(frozen=True)
class Odometry:
    """How good increments of poses are; all noise is white but that of the scale."""

    scale: float = 0.02
    """Standard deviation of the scale error of the way along, a Gauss-Markov process …"""
    scale_length: float = 20.0
    """… whose correlation falls to 1/e over this way [m]."""
    along: float = 0.01
    """Besides, of the way along [m/sqrt(m)] …"""
    across: float = 0.005
    """… across …"""
    up: float = 0.005
    """… and up."""
    roll: float = 0.05
    """Of the turn [deg/sqrt(m)] …"""
    pitch: float = 0.05
    yaw: float = 0.1

    @property
    def white(self) -> Floats:
        """(6,) standard deviations after 1 m, of the way and of the turn [m, rad]."""
        turns = np.deg2rad([self.roll, self.pitch, self.yaw])
        return np.concatenate([[self.along, self.across, self.up], turns])

    def kept(self, way: Floats) -> Floats:
        """What is left of the scale error after a way [m]."""
        kept: Floats = np.exp(-way / self.scale_length)
        return kept


@dataclass(frozen=True, eq=False)
class States:
    """What k filters believe."""

    T_map_lidar: Floats
    """(k, 4, 4) poses."""
    scale: Floats
    """(k,) scale errors of the odometry, as a share of the way along."""
    covariance: Floats
    """(k, 7, 7) of the errors [m, rad, 1]."""


@dataclass(frozen=True)
class Gate:
    """Which measurements are taken."""

    share: float = 0.999
    """Of good measurements, by the chi-square of the innovation."""
    distance: float = 1.0
    """Largest horizontal distance from the prediction [m]."""


def driven(T_map_lidar: Floats, odometry: Odometry, rng: np.random.Generator) -> Floats:
    """(n - 1, 4, 4) what an odometry says of the way along (n, 4, 4) true poses."""
    found = np.linalg.solve(T_map_lidar[:-1], T_map_lidar[1:])
    way = np.linalg.norm(found[:, :3, 3], axis=1)
    noise = odometry.white * np.sqrt(way)[:, None] * rng.standard_normal((len(way), 6))
    scale = rng.standard_normal() * odometry.scale
    for k, kept in enumerate(odometry.kept(way)):
        found[k, 0, 3] *= 1.0 + scale
        scale = kept * scale + np.sqrt(1.0 - kept**2) * odometry.scale * rng.standard_normal()
    found[:, :3, 3] += noise[:, :3]
    found[:, :3, :3] @= Rotation.from_rotvec(noise[:, 3:]).as_matrix()
    return found


def predicted(states: States, increments: Floats, odometry: Odometry) -> States:
    """After (k, 4, 4) increments of the odometry."""
    R = states.T_map_lidar[:, :3, :3]
    way = np.linalg.norm(increments[:, :3, 3], axis=1)
    step = increments.copy()
    step[:, 0, 3] /= 1.0 + states.scale
    T_map_lidar = states.T_map_lidar @ step
    F = np.tile(np.eye(STATES), (len(R), 1, 1))
    F[:, :3, 3:6] = -_cross(np.einsum("kij,kj->ki", R, step[:, :3, 3]))
    F[:, :3, 6] = -R[:, :, 0] * (step[:, 0, 3] / (1.0 + states.scale))[:, None]
    kept = odometry.kept(way)
    F[:, 6, 6] = kept
    Q = np.zeros((len(R), STATES, STATES))
    white = odometry.white**2 * way[:, None]
    Q[:, :3, :3] = (R * white[:, None, :3]) @ R.transpose(0, 2, 1)
    R = T_map_lidar[:, :3, :3]
    Q[:, 3:6, 3:6] = (R * white[:, None, 3:]) @ R.transpose(0, 2, 1)
    Q[:, 6, 6] = (1.0 - kept**2) * odometry.scale**2
    covariance = F @ states.covariance @ F.transpose(0, 2, 1) + Q
    return States(T_map_lidar, kept * states.scale, covariance)


def updated(
    states: States, T_measured: Floats, covariance: Floats, gate: Gate
) -> tuple[States, NDArray[np.bool_]]:
    """With (k, 4, 4) measured poses of (k, 6, 6) covariances [m, rad], as far as the gate lets them
    in; and (k,) whether it did.
    """
    innovation = difference(states.T_map_lidar, T_measured)
    P, H = states.covariance, np.eye(6, STATES)
    inverse = np.linalg.inv(P[:, :6, :6] + covariance)
    gain = P[:, :, :6] @ inverse
    unlikely = np.einsum("ki,kij,kj->k", innovation, inverse, innovation)
    good = unlikely <= chi2.ppf(gate.share, 6)
    good &= np.hypot(innovation[:, 0], innovation[:, 1]) <= gate.distance
    gain[~good] = 0.0
    correction = np.einsum("kij,kj->ki", gain, innovation)
    rest = np.eye(STATES) - gain @ H
    P = rest @ P @ rest.transpose(0, 2, 1) + gain @ covariance @ gain.transpose(0, 2, 1)
    T_map_lidar = states.T_map_lidar.copy()
    T_map_lidar[:, :3, 3] += correction[:, :3]
    turn = Rotation.from_rotvec(correction[:, 3:6]).as_matrix()
    T_map_lidar[:, :3, :3] = turn @ T_map_lidar[:, :3, :3]
    return States(T_map_lidar, states.scale + correction[:, 6], P), good


def difference(T_one: Floats, T_other: Floats) -> Floats:
    """(k, 6) from poses to others: position, and rotation vector in the map frame [m, rad]."""
    turn = T_other[:, :3, :3] @ T_one[:, :3, :3].transpose(0, 2, 1)
    return np.hstack([T_other[:, :3, 3] - T_one[:, :3, 3], Rotation.from_matrix(turn).as_rotvec()])


def _cross(v: Floats) -> Floats:
    """(k, 3, 3) the matrices of v x."""
    found = np.zeros((len(v), 3, 3))
    x, y, z = v.T
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 2] = -z, y, -x
    return found - found.transpose(0, 2, 1)
