"""The covariances that a filter is given for its registrations, each by its own way of knowing."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from filter_drives import Drive
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import ModelError
from tilestream.local_map import LocalCells
from tilestream.matcher import RegistrationSettings
from tilestream.model.covariance import (
    BIAS,
    Calibration,
    about_bias,
    calibrated,
    cores,
    errors_in_map,
    in_map,
    matrices,
)
from tilestream.model.covariance_training import calibration_of
from tilestream.model.dataset import Dataset
from tilestream.moments import PAIRS
from tilestream.records import Registrations
from tilestream.registration import register
from tilestream.settings import PREDICTION_ERROR

Floats = NDArray[np.float64]
AUTOWARE = np.diag([0.15] * 3 + [0.025] * 3) ** 2
"""`output_pose_covariance` of Autoware's ndt_scan_matcher as it ships [m^2, rad^2]."""
OFFSETS = np.array([[0, 0.5], [0, -0.5], [0.5, 0], [-0.5, 0], [1, 0], [-1, 0]], np.float64)
"""`initial_pose_offset_model_x` and `_y` there [m, vehicle frame]."""
TRUE_WIDTH, TRUE_REACH = 1.5, 3.0
"""Standard deviation and end of the kernel over which true moments are averaged [m]."""
WITHOUT_BIAS = "ours, without bias"
NEAR = tuple(f"near_{a}_{b}" for a, b in PAIRS)


@dataclass(frozen=True, eq=False)
class Scan:
    """What registrations were made of."""

    number: int
    """Along the drive."""
    points: Floats
    cells: LocalCells
    matcher: RegistrationSettings


@dataclass(frozen=True)
class Contestant:
    """A way of knowing the covariance of a registration."""

    name: str
    covariance: Callable[[Scan, Registrations], Floats]
    """(k, 6, 6) of a scan's k registrations, in the map frame [m^2, rad^2]."""
    registrations: int = 1
    """What a scan costs."""
    bias: Floats | None = None
    """(n, 6) what is taken off the registration of each scan, in the map frame [m, rad]."""

    def corrected(self, scan: Scan, found: Registrations) -> Registrations:
        """The registrations without their bias."""
        if self.bias is None:
            return found
        bias, T_map_lidar = self.bias[scan.number], found.T_map_lidar.copy()
        T_map_lidar[:, :3, 3] -= bias[:3]
        back = Rotation.from_rotvec(-bias[3:]).as_matrix()
        T_map_lidar[:, :3, :3] = back @ T_map_lidar[:, :3, :3]
        return replace(found, T_map_lidar=T_map_lidar)


# --- At run time, as Autoware does


def of_hessian(_scan: Scan, found: Registrations) -> Floats:
    """LAPLACE_APPROXIMATION: the inverse of the negative Hessian in map x and y; the constant where
    that is no covariance.
    """
    negative = -found.hessian[:, :2, :2]
    definite = np.linalg.eigvalsh(negative)[:, 0] > 0.0
    xy = np.tile(AUTOWARE[:2, :2], (len(found), 1, 1))
    xy[definite] = np.linalg.inv(negative[definite])
    return _with_xy(xy)


def of_starts(scan: Scan, found: Registrations) -> Floats:
    """MULTI_NDT: of where registrations end that start around the result, with the result; divided
    by n^2 / (n - 1), as Autoware does.
    """
    ends = found.T_map_lidar
    starts = np.repeat(ends[:, None], len(OFFSETS), axis=1)
    starts[..., :2, 3] += np.einsum("kij,oj->koi", ends[:, :2, :2], OFFSETS)
    others = register(scan.cells, scan.points, starts.reshape(-1, 4, 4), scan.matcher)
    places = others.T_map_lidar.reshape(starts.shape)[..., :2, 3]
    places = np.concatenate([ends[:, None, :2, 3], places], axis=1)
    off, n = places - places.mean(axis=1, keepdims=True), places.shape[1]
    return _with_xy(np.einsum("koi,koj->kij", off, off) * (n - 1) / n**2)


def as_shipped(
    covariance: Callable[[Scan, Registrations], Floats],
) -> Callable[[Scan, Registrations], Floats]:
    """The same with the constant as its least variance along and across the vehicle, as Autoware
    publishes it.
    """

    def raised(scan: Scan, found: Registrations) -> Floats:
        R = found.T_map_lidar[:, :2, :2]
        own = R.transpose(0, 2, 1) @ covariance(scan, found)[:, :2, :2] @ R
        for axis in (0, 1):
            own[:, axis, axis] = np.maximum(own[:, axis, axis], AUTOWARE[axis, axis])
        return _with_xy(R @ own @ R.transpose(0, 2, 1))

    return raised


def _with_xy(xy: Floats) -> Floats:
    found = np.tile(AUTOWARE, (len(xy), 1, 1))
    found[:, :2, :2] = xy
    return found


AT_RUN_TIME = (
    Contestant("constant, Autoware", lambda _, found: np.tile(AUTOWARE, (len(found), 1, 1))),
    Contestant("Hessian", of_hessian),
    Contestant("Hessian, as shipped", as_shipped(of_hessian)),
    Contestant("starts", of_starts, 1 + len(OFFSETS)),
    Contestant("starts, as shipped", as_shipped(of_starts), 1 + len(OFFSETS)),
)


# --- Known before, of a place


@dataclass(frozen=True, eq=False)
class Believed:
    """What is believed of the registrations of a drive's scans before they are made."""

    covariance: Floats
    """(n, 6, 6) in the map frame [m^2, rad^2]."""
    bias: Floats | None
    """(n, 6) as of a `Contestant`."""

    def contestant(self, name: str, factor: float) -> Contestant:
        """Of which so many times the covariance is believed."""
        table = factor * self.covariance
        return Contestant(
            name,
            lambda scan, found: np.tile(table[scan.number], (len(found), 1, 1)),
            bias=self.bias,
        )


@dataclass(frozen=True, eq=False)
class Learnt:
    """What training drives say."""

    constant: Floats
    """(6, 6) in the frame of the route."""
    calibration: Calibration

    def believed(self, drive: Drive) -> dict[str, Believed]:
        """By name what is believed of a drive's scans; the constant fitted where a place has no
        covariance of its own.
        """
        labels, heading = drive.labels, drive.labels["heading"].to_numpy()
        constant = np.tile(self.constant, (len(heading), 1, 1))
        core = cores(drive.seen, PREDICTION_ERROR, self.calibration.width)
        core = calibrated(core, self.calibration)
        found = {
            "constant, fitted": constant,
            "ours": matrices(core),
            WITHOUT_BIAS: about_bias(core),
            "true": _true(drive),
            "true, other scans": _true(drive, own=False),
            "constant, true": np.tile(_mean(labels), (len(heading), 1, 1)),
        }
        bias = {WITHOUT_BIAS: errors_in_map(core[list(BIAS)].fillna(0.0).to_numpy(), heading)}
        return {
            name: Believed(in_map(_filled(table, constant), heading), bias.get(name))
            for name, table in found.items()
        }


def learnt_from(dataset: Dataset) -> Learnt:
    """What is learnt of the labels of a dataset.

    Raises:
        ModelError: none of them has moments.
    """
    calibration = calibration_of(dataset)
    if calibration is None:
        raise ModelError("no labels with moments to train on: run the training jobs again")
    return Learnt(_mean(dataset.rows), calibration)


def _mean(labels: pd.DataFrame) -> Floats:
    """(6, 6) the mean second moments of the errors of near starts that hold."""
    return matrices(labels[list(NEAR)].mean().to_frame().T, "near_")[0]


def _true(drive: Drive, own: bool = True) -> Floats:
    """(n, 6, 6) the same of each scan and those around, of which more starts hold the more they
    count; without its own of the others alone. NaN where nothing holds.
    """
    labels, arc = drive.labels, drive.labels["arc_length"].to_numpy()
    away = np.abs(arc[:, None] - arc)
    weight = np.exp(-0.5 * (away / TRUE_WIDTH) ** 2) * (away <= TRUE_REACH)
    weight *= 1.0 - labels["near_p_fail"].to_numpy()
    if not own:
        np.fill_diagonal(weight, 0.0)
    moments = labels[list(NEAR)].fillna(0.0)
    with np.errstate(invalid="ignore"):
        mean = weight @ moments.to_numpy() / weight.sum(axis=1, keepdims=True)
    return matrices(pd.DataFrame(mean, columns=moments.columns), "near_")


def _filled(table: Floats, constant: Floats) -> Floats:
    """With the constant where a place has none."""
    known = np.isfinite(table).all(axis=(1, 2))
    return np.where(known[:, None, None], table, constant)
