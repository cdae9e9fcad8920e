"""Filters side by side along one drive, each with its own registrations and covariances."""

import zlib
from collections.abc import Sequence

import numpy as np
import pandas as pd
from filter_covariances import Contestant, Scan
from filter_drives import Drive
from kalman import Gate, Odometry, States, driven, predicted, updated
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.errors import RegistrationError
from tilestream.label import FAILED, start_errors
from tilestream.model.covariance import in_map
from tilestream.moments import AXES
from tilestream.records import Registrations
from tilestream.registration import register

Floats = NDArray[np.float64]
BEGIN = np.array([0.1] * 3 + [np.deg2rad(0.5)] * 3)
"""Standard deviation of the first pose [m, rad]."""
FAR, FAR_WAY, DISC = 1.5, 10.0, 2.0
"""A filter is lost beyond FAR over more than FAR_WAY, and at once beyond DISC [m]."""


def run(
    drive: Drive, contestants: Sequence[Contestant], odometry: Odometry, seeds: int
) -> pd.DataFrame:
    """A row per contestant, seed and scan: `arc_length` [m]; error of the filter after the scan and
    its variance in the frame of the route (`e_along`, `v_along`, …); the same of the registration
    alone (`m_along`, `r_along`, …) with its squared normalised horizontal error `m_square`, whether
    it `held` and whether it was `taken`; whether the filter was `lost` there, and began anew.

    Where a scan cannot be registered the filters drive on without, and the registration is NaN.
    """
    truth, arc = drive.T_map_lidar, drive.labels["arc_length"].to_numpy()
    said, states = _begun(drive, odometry, seeds)
    said = np.tile(said, (len(contestants), 1, 1, 1))
    states = _repeated(states, len(contestants))
    heading = np.arctan2(truth[:, 1, 0], truth[:, 0, 0])
    far, rows = np.zeros(len(said)), []
    for i, (points, cells) in enumerate(drive.scans()):
        if i:
            states = predicted(states, said[:, i - 1], odometry)
        scan = Scan(i, points, cells, drive.settings.label.registration)
        states, row = _measured(scan, states, contestants, truth[i], heading[i])
        off = np.linalg.norm(row["e"][:, :3], axis=1)
        way = arc[i] - arc[i - 1] if i else 0.0
        far = np.where(off > FAR, far + way, 0.0)
        lost = (off > DISC) | (far > FAR_WAY)
        states = _restarted(states, lost, truth[i], odometry)
        far[lost] = 0.0
        names = np.repeat([one.name for one in contestants], seeds)
        seed = np.tile(np.arange(seeds), len(contestants))
        rows.append(_table(row).assign(contestant=names, seed=seed, lost=lost, arc_length=arc[i]))
    return pd.concat(rows, ignore_index=True).assign(drive=drive.name, road=drive.road)


def _begun(drive: Drive, odometry: Odometry, seeds: int) -> tuple[Floats, States]:
    """What the odometries say, (seeds, n - 1, 4, 4), and where filters begin: near the truth."""
    said, first = [], []
    for seed in range(seeds):
        rng = np.random.default_rng([seed, zlib.crc32(drive.name.encode())])
        pose, off = drive.T_map_lidar[0].copy(), BEGIN * rng.standard_normal(6)
        pose[:3, 3] += off[:3]
        pose[:3, :3] = Rotation.from_rotvec(off[3:]).as_matrix() @ pose[:3, :3]
        first.append(pose)
        said.append(driven(drive.T_map_lidar, odometry, rng))
    covariance = np.tile(_first(odometry), (seeds, 1, 1))
    return np.stack(said), States(np.stack(first), np.zeros(seeds), covariance)


def _first(odometry: Odometry) -> Floats:
    return np.diag([*BEGIN, odometry.scale]) ** 2


def _repeated(states: States, times: int) -> States:
    return States(
        np.tile(states.T_map_lidar, (times, 1, 1)),
        np.tile(states.scale, times),
        np.tile(states.covariance, (times, 1, 1)),
    )


def _measured(
    scan: Scan,
    states: States,
    contestants: Sequence[Contestant],
    T_map_true: Floats,
    heading: float,
) -> tuple[States, dict[str, Floats]]:
    """The filters with their registrations of a scan, and what there is to say of both."""
    k = len(states.scale)
    row = {"m": np.full((k, 6), np.nan), "r": np.full((k, 6), np.nan)}
    row |= {"m_square": np.full(k, np.nan), "taken": np.zeros(k, np.bool_)}
    try:
        found = register(scan.cells, scan.points, states.T_map_lidar, scan.matcher)
        parts = np.array_split(np.arange(k), len(contestants))
        each = [
            (one, one.corrected(scan, _some(found, rows)))
            for one, rows in zip(contestants, parts, strict=True)
        ]
        covariance = np.concatenate([one.covariance(scan, of) for one, of in each])
        T_measured = np.concatenate([of.T_map_lidar for _, of in each])
    except RegistrationError:
        pass
    else:
        states, row["taken"] = updated(states, T_measured, covariance, Gate())
        row["m"], own = _in_route(T_map_true, T_measured, covariance, heading)
        row["r"] = np.diagonal(own, axis1=1, axis2=2)
        off = row["m"][:, :2]
        row["m_square"] = np.einsum("ki,kij,kj->k", off, np.linalg.inv(own[:, :2, :2]), off)
    row["e"], own = _in_route(T_map_true, states.T_map_lidar, states.covariance[:, :6, :6], heading)
    row["v"] = np.diagonal(own, axis1=1, axis2=2)
    return states, row


def _some(found: Registrations, rows: NDArray[np.int64]) -> Registrations:
    own = {n: v[rows] if isinstance(v, np.ndarray) else v for n, v in vars(found).items()}
    return Registrations(**own)


def _in_route(
    T_map_true: Floats, T_map_lidar: Floats, covariance: Floats, heading: float
) -> tuple[Floats, Floats]:
    """(k, 6) errors of poses, `AXES`, and (k, 6, 6) covariances, in the frame of the route."""
    errors = start_errors(T_map_true, T_map_lidar)
    back = np.full(len(covariance), -heading)
    return np.column_stack([errors[axis] for axis in AXES]), in_map(covariance, back)


def _restarted(
    states: States, lost: NDArray[np.bool_], T_map_true: Floats, odometry: Odometry
) -> States:
    """With those that are lost at the truth."""
    poses, scale, covariance = states.T_map_lidar, states.scale, states.covariance
    return States(
        np.where(lost[:, None, None], T_map_true, poses),
        np.where(lost, 0.0, scale),
        np.where(lost[:, None, None], _first(odometry), covariance),
    )


def _table(row: dict[str, Floats]) -> pd.DataFrame:
    whole = {name: row[name] for name in ("m_square", "taken")}
    parts = {f"{name}_{axis}": row[name][:, j] for name in "evmr" for j, axis in enumerate(AXES)}
    held = np.linalg.norm(row["m"][:, :3], axis=1) <= FAILED
    return pd.DataFrame({**parts, **whole, "held": held})
