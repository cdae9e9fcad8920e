"""The filter of benchmarks/filter.py: its covariance is that of its errors."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

FILE = Path(__file__).resolve().parents[1] / "benchmarks" / "kalman.py"
NOISE = np.array([0.2, 0.05, 0.1, 0.01, 0.02, 0.005])
"""Standard deviations of a measurement [m, rad]."""


@pytest.fixture(scope="module")
def kalman() -> Any:
    spec = importlib.util.spec_from_file_location("kalman", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kalman"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["kalman"]


def moved(T: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Poses with errors (k, 6) in the map frame added."""
    found = np.array(np.broadcast_to(T, (len(error), 4, 4)))
    found[:, :3, 3] += error[:, :3]
    found[:, :3, :3] = Rotation.from_rotvec(error[:, 3:]).as_matrix() @ found[:, :3, :3]
    return found


def bend(scans: int) -> np.ndarray:
    """Poses 2 m apart round a bend that climbs."""
    turn = Rotation.from_euler("ZY", [[0.05 * k, -0.03] for k in range(scans)]).as_matrix()
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, :3, :3] = turn
    poses[1:, :3, 3] = np.cumsum(2.0 * turn[:-1, :, 0], axis=0)
    return poses


def some_states(kalman: Any, rng: np.random.Generator) -> Any:
    root = rng.normal(size=(7, 7)) * 0.1
    T = moved(np.eye(4), rng.normal(size=(1, 6)))
    return kalman.States(T, np.array([0.03]), (root @ root.T)[None])


def normalised(kalman: Any, told: float) -> np.ndarray:
    """(6,) mean normalised squared errors of filters that are told so many times the noise."""
    rng, odometry, truth, k = np.random.default_rng(1), kalman.Odometry(), bend(40), 300
    first = np.array([0.1] * 3 + [0.01] * 3)
    covariance = np.tile(np.diag([*first, odometry.scale]) ** 2, (k, 1, 1))
    begin = moved(truth[0], first * rng.standard_normal((k, 6)))
    states = kalman.States(begin, np.zeros(k), covariance)
    said = np.stack([kalman.driven(truth, odometry, rng) for _ in range(k)])
    R = np.tile(np.diag((told * NOISE) ** 2), (k, 1, 1))
    errors = []
    for i, T_map_true in enumerate(truth):
        if i:
            states = kalman.predicted(states, said[:, i - 1], odometry)
        measured = moved(T_map_true, NOISE * rng.standard_normal((k, 6)))
        states, _ = kalman.updated(states, measured, R, kalman.Gate(1.0 - 1e-12, np.inf))
        off = kalman.difference(states.T_map_lidar, np.tile(T_map_true, (k, 1, 1)))
        errors.append(off**2 / np.diagonal(states.covariance, axis1=1, axis2=2)[:, :6])
    return np.mean(errors, axis=(0, 1))


def test_errors_have_the_covariance_that_the_filter_says(kalman: Any) -> None:
    assert normalised(kalman, 1.0) == pytest.approx(1.0, abs=0.08)


def test_and_not_where_it_is_told_another_noise(kalman: Any) -> None:
    assert (normalised(kalman, 2.0) < 0.8).all()


def test_a_prediction_moves_errors_as_its_covariance_says(kalman: Any) -> None:
    """Against differences: an odometry without noise changes the covariance by F P F^T only."""
    rng, size = np.random.default_rng(2), 1e-6
    exact = kalman.Odometry(0.02, 1e12, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    states, step = some_states(kalman, rng), moved(np.eye(4), rng.normal(size=(1, 6)))
    after = kalman.predicted(states, step, exact)
    columns = []
    for error in size * np.eye(7):
        begin = moved(states.T_map_lidar[0], error[None, :6])
        other = kalman.predicted(
            kalman.States(begin, states.scale + error[6], states.covariance), step, exact
        )
        off = kalman.difference(after.T_map_lidar, other.T_map_lidar)[0]
        columns.append([*off, (other.scale - after.scale)[0]])
    F = np.array(columns).T / size
    assert after.covariance[0] == pytest.approx(F @ states.covariance[0] @ F.T, abs=1e-6)


def test_an_update_adds_information(kalman: Any) -> None:
    """The covariance in its other form: P'^-1 = P^-1 + H^T R^-1 H."""
    states = some_states(kalman, np.random.default_rng(3))
    R = np.diag(NOISE**2)
    after, good = kalman.updated(states, states.T_map_lidar, R[None], kalman.Gate())
    information = np.linalg.inv(states.covariance[0])
    information[:6, :6] += np.linalg.inv(R)
    assert good.all()
    assert after.T_map_lidar == pytest.approx(states.T_map_lidar)
    assert after.covariance[0] == pytest.approx(np.linalg.inv(information), rel=1e-6, abs=1e-9)


def test_what_the_gate_keeps_out_changes_nothing(kalman: Any) -> None:
    states = some_states(kalman, np.random.default_rng(4))
    R = np.diag(NOISE**2)[None]
    for off, gate in ((1.1, kalman.Gate(1.0 - 1e-12, 1.0)), (0.9, kalman.Gate(1e-3, 1.0))):
        measured = moved(states.T_map_lidar[0], np.array([[off, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        after, good = kalman.updated(states, measured, R, gate)
        assert not good.any()
        assert (after.T_map_lidar == states.T_map_lidar).all()
        assert (after.covariance == states.covariance).all()
