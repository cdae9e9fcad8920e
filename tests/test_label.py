"""The starts and the localization error: the label of a sample point."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from literal_registration import Floats, expm
from scenes import UTM, scene
from test_registration import T_MAP_LIDAR, scan_of

from tilestream.errors import RegistrationError, UsageError
from tilestream.label import (
    disc_starts,
    localization_error,
    refined_pose,
    start_errors,
    start_poses,
)
from tilestream.ndt import cells_of
from tilestream.records import Cells, LocalizationError
from tilestream.registration import register
from tilestream.settings import RegistrationSettings, StartSettings


@pytest.fixture(scope="module")
def cells() -> Cells:
    return cells_of(scene("canyon", 1), 2.0)


@pytest.fixture(scope="module")
def scan() -> Floats:
    return scan_of(scene("canyon", 2), T_MAP_LIDAR, 1500)


@pytest.fixture(scope="module")
def label(cells: Cells, scan: Floats) -> LocalizationError:
    return localization_error(cells, scan, T_MAP_LIDAR)


# --- Starts


def test_the_papers_starts_are_317_with_i_slowest() -> None:
    starts = disc_starts()
    assert starts.shape == (317, 2)
    assert starts.dtype == np.float64
    expected = [
        (i * 0.2, j * 0.2) for i in range(-10, 11) for j in range(-10, 11) if i * i + j * j <= 100
    ]
    np.testing.assert_allclose(starts, expected, atol=1e-15)
    assert starts[0].tolist() == [-2.0, 0.0]
    assert starts[158].tolist() == [0.0, 0.0]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 3000), st.integers(50, 1000))
def test_disc_starts_are_decided_in_integers(radius_mm: int, step_mm: int) -> None:
    starts = disc_starts(radius_mm / 1000, step_mm / 1000)
    reach = radius_mm // step_mm
    expected = [
        (i * step_mm, j * step_mm)
        for i in range(-reach, reach + 1)
        for j in range(-reach, reach + 1)
        if (i * i + j * j) * step_mm**2 <= radius_mm**2
    ]
    assert np.rint(starts * 1000).astype(int).tolist() == [list(e) for e in expected]
    mirrored = {tuple(s) for s in np.rint(-starts * 1000).astype(int).tolist()}
    assert mirrored == set(expected)


@pytest.mark.parametrize(
    ("radius", "step"), [(-1.0, 0.2), (2.0, 0.0), (2.0, 0.0001), (math.nan, 1)]
)
def test_disc_starts_refuse_what_is_no_disc(radius: float, step: float) -> None:
    with pytest.raises(UsageError):
        disc_starts(radius, step)


def test_start_poses_move_the_position_and_keep_the_orientation() -> None:
    T = start_poses(T_MAP_LIDAR)
    assert T.shape == (317, 4, 4)
    assert (T[:, :3, :3] == T_MAP_LIDAR[:3, :3]).all()
    np.testing.assert_allclose(T[:, :2, 3] - T_MAP_LIDAR[:2, 3], disc_starts(), atol=1e-14)
    assert (T[:, 2, 3] == T_MAP_LIDAR[2, 3]).all()


def test_start_poses_try_every_yaw_and_height() -> None:
    how = StartSettings(radius=0.2, step=0.2, yaw=(-0.1, 0.0, 0.1), z=(0.0, 0.5))
    T = start_poses(T_MAP_LIDAR, how)
    assert T.shape == (5 * 2 * 3, 4, 4)
    np.testing.assert_allclose(T[4, :3, 3] - T_MAP_LIDAR[:3, 3], [-0.2, 0, 0.5], atol=1e-14)
    for k, yaw in enumerate(how.yaw):
        expected = expm(np.array([0, 0, yaw])) @ T_MAP_LIDAR[:3, :3]
        np.testing.assert_allclose(T[k::3, :3, :3], np.tile(expected, (10, 1, 1)), atol=1e-14)


# --- The label


def test_errors_are_in_the_frame_of_the_true_heading(
    label: LocalizationError, cells: Cells, scan: Floats
) -> None:
    found = register(cells, scan, start_poses(T_MAP_LIDAR))
    assert np.array_equal(found.T_map_lidar, label.registrations.T_map_lidar)
    heading = math.atan2(T_MAP_LIDAR[1, 0], T_MAP_LIDAR[0, 0])
    for k in range(0, 317, 40):
        final = found.T_map_lidar[k]
        off = final[:3, 3] - T_MAP_LIDAR[:3, 3]
        forward = np.array([math.cos(heading), math.sin(heading), 0.0])
        left = np.array([-math.sin(heading), math.cos(heading), 0.0])
        assert label.along[k] == pytest.approx(off @ forward, abs=1e-12)
        assert label.across[k] == pytest.approx(off @ left, abs=1e-12)
        assert label.up[k] == pytest.approx(off[2], abs=1e-12)
        assert label.error[k] == pytest.approx(np.linalg.norm(off))
        turned = math.atan2(final[1, 0], final[0, 0]) - heading
        assert label.yaw[k] == pytest.approx(math.remainder(turned, 2 * math.pi), abs=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1.8, 1.8), min_size=6, max_size=6),
    st.lists(st.floats(-50.0, 50.0), min_size=6, max_size=6),
)
def test_the_six_errors_lead_from_the_true_pose_to_the_final_one(
    turns: list[float], places: list[float]
) -> None:
    """Also where the lidar is tilted, and where a start ends upside down."""
    T_true, T_final = np.eye(4), np.eye(4)
    for T, half in ((T_true, slice(0, 3)), (T_final, slice(3, 6))):
        T[:3, :3], T[:3, 3] = expm(np.array(turns[half])), places[half]
    found = {name: float(values[0]) for name, values in start_errors(T_true, T_final[None]).items()}
    heading = math.atan2(T_true[1, 0], T_true[0, 0])
    c, s = math.cos(heading), math.sin(heading)
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    w = np.array([found[name] for name in ("roll", "pitch", "yaw_vector")]) @ axes
    moved = np.array([found[name] for name in ("along", "across", "up")]) @ axes
    assert np.linalg.norm(w) <= math.pi + 1e-9
    np.testing.assert_allclose(expm(w) @ T_true[:3, :3], T_final[:3, :3], atol=1e-9)
    np.testing.assert_allclose(T_true[:3, 3] + moved, T_final[:3, 3], atol=1e-9)


def test_each_rotation_error_has_its_axis_and_sign() -> None:
    """Of a vehicle that drives in map y: roll is a turn about y, pitch one about -x."""
    T_true = np.eye(4)
    T_true[:3, :3] = expm(np.array([0.0, 0.0, math.pi / 2]))
    T_final = np.tile(T_true, (3, 1, 1))
    for T, w in zip(T_final, 0.1 * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), strict=True):
        T[:3, :3] = expm(w) @ T_true[:3, :3]
    found = start_errors(T_true, T_final)
    for k, name in enumerate(("roll", "pitch", "yaw_vector")):
        np.testing.assert_allclose(found[name], 0.1 * np.eye(3)[k], atol=1e-12)
    np.testing.assert_allclose(found["yaw"], [0.0, 0.0, 0.1], atol=1e-12)
    ahead = T_final[1, :3, 0]
    assert ahead[2] < 0.0  # pitched down


def check_summary(label: LocalizationError) -> None:
    """Every summary, from the per-start results."""
    errors = label.error.tolist()
    held = sorted(e for e in errors if e <= 0.5)
    offsets = label.T_map_lidar_starts[:, :3, 3] - label.T_map_lidar[:3, 3]
    near = [e for e, o in zip(errors, offsets, strict=True) if np.linalg.norm(o) <= 1.0 + 1e-9]
    assert label.error_mean == pytest.approx(math.fsum(errors) / len(errors))
    assert label.p_fail == pytest.approx(1 - len(held) / len(errors))
    for name in ("along", "across", "up", "roll", "pitch", "yaw"):
        expected = math.fsum(abs(v) for v in getattr(label, name)) / len(errors)
        assert getattr(label, f"{name}_mean") == pytest.approx(expected)
    if held:
        assert label.mean_held == pytest.approx(math.fsum(held) / len(held))
        assert label.median_held == pytest.approx(np.quantile(held, 0.5))
        assert label.p95_held == pytest.approx(np.quantile(held, 0.95))
    else:
        assert math.isnan(label.mean_held)
        assert math.isnan(label.median_held)
        assert math.isnan(label.p95_held)
    if near:
        assert label.error_floor == pytest.approx(math.fsum(near) / len(near))
        assert label.error_tail == pytest.approx(label.error_mean - label.error_floor)
    else:
        assert math.isnan(label.error_floor)
        assert math.isnan(label.error_tail)


def test_summary_is_that_of_the_starts(label: LocalizationError) -> None:
    check_summary(label)
    assert len(label.error) == 317
    assert label.true_pose == "log"
    near = np.linalg.norm(disc_starts(), axis=1) <= 1.0 + 1e-9
    assert near.sum() == 81


def test_all_starts_failed_and_none_near(cells: Cells, scan: Floats) -> None:
    frozen = RegistrationSettings(iterations_max=0)
    far = localization_error(
        cells, scan, T_MAP_LIDAR, starts=[[1.2, 0.0], [0.0, -1.5]], settings=frozen
    )
    check_summary(far)
    assert far.p_fail == 1.0
    np.testing.assert_allclose(far.error, [1.2, 1.5])
    at_home = localization_error(cells, scan, T_MAP_LIDAR, starts=[[0.0, 0.0]], settings=frozen)
    check_summary(at_home)
    assert at_home.error_mean < 1e-9
    assert not at_home.converged[0]  # 30 iterations, or none: that is not convergence


def test_yaw_error_wraps(cells: Cells, scan: Floats) -> None:
    """A heading next to pi: an error across it is small, not two pi."""
    turn = math.pi - 0.35 - 1e-4
    Q = np.eye(4)
    Q[:3, :3] = expm(np.array([0, 0, turn]))
    T = T_MAP_LIDAR.copy()
    T[:3, :3] = T_MAP_LIDAR[:3, :3] @ Q[:3, :3]
    turned_scan = scan @ Q[:3, :3]
    how = StartSettings(radius=0.0, yaw=(-0.05, 0.0, 0.05))
    label = localization_error(cells, turned_scan, T, start_settings=how)
    assert np.abs(label.yaw).max() < 0.1
    check_summary(label)
    frozen = localization_error(
        cells, turned_scan, T, start_settings=how, settings=RegistrationSettings(iterations_max=0)
    )
    np.testing.assert_allclose(frozen.yaw, how.yaw, atol=1e-3)


def test_starts_can_be_offsets_poses_or_settings(
    label: LocalizationError, cells: Cells, scan: Floats
) -> None:
    offsets = localization_error(cells, scan, T_MAP_LIDAR, starts=disc_starts())
    poses = localization_error(cells, scan, T_MAP_LIDAR, starts=start_poses(T_MAP_LIDAR))
    named = localization_error(cells, scan, T_MAP_LIDAR, start_settings=StartSettings())
    for other in (offsets, poses, named):
        assert np.array_equal(other.error, label.error)
        assert other.error_mean == label.error_mean
    with pytest.raises(UsageError, match="both"):
        localization_error(
            cells, scan, T_MAP_LIDAR, starts=disc_starts(), start_settings=StartSettings()
        )
    for wrong in (np.zeros((0, 2)), np.zeros((3, 3)), np.zeros(3), [["a", "b"]]):
        with pytest.raises(UsageError, match="starts"):
            localization_error(cells, scan, T_MAP_LIDAR, starts=wrong)
    with pytest.raises(RegistrationError, match="not finite"):
        localization_error(cells, scan, T_MAP_LIDAR, starts=[[math.nan, 0.0]])
    with pytest.raises(RegistrationError, match="the true pose"):
        localization_error(cells, scan, 2 * T_MAP_LIDAR)


def test_a_label_does_not_depend_on_where_the_map_lies(
    label: LocalizationError, scan: Floats
) -> None:
    there = cells_of(scene("canyon", 1, offset=UTM), 2.0)
    T = T_MAP_LIDAR.copy()
    T[:3, 3] += UTM
    moved = localization_error(there, scan, T)
    assert np.mean(np.abs(moved.error - label.error) < 1e-6) > 0.9
    assert moved.median_held == pytest.approx(label.median_held, abs=1e-4)
    assert moved.p_fail == pytest.approx(label.p_fail, abs=0.02)


# --- The refined true pose


def test_refined_pose_is_the_best_of_the_fine_lattice(scan: Floats) -> None:
    fine = cells_of(scene("canyon", 1), 1.0)
    T_log = T_MAP_LIDAR.copy()
    T_log[:2, 3] += [0.2, -0.1]
    how = RegistrationSettings(scan_leaf=1.0)
    refined = refined_pose(fine, scan, T_log)
    rough = register(fine, scan, T_log, how).T_map_lidar[0]
    assert (refined[:3, :3] == rough[:3, :3]).all()
    assert refined[2, 3] == rough[2, 3]
    steps = (refined[:2, 3] - rough[:2, 3]) / 0.05
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert np.linalg.norm(steps) <= 10 + 1e-6
    lattice = start_poses(rough, StartSettings(radius=0.5, step=0.05))
    assert len(lattice) == 317
    scores = register(fine, scan, lattice, how.model_copy(update={"iterations_max": 0})).score
    at = register(fine, scan, refined, how.model_copy(update={"iterations_max": 0})).score[0]
    assert at == scores.max()
    assert np.linalg.norm(refined[:3, 3] - T_MAP_LIDAR[:3, 3]) < 0.15
    label = localization_error(fine, scan, refined, true_pose="refined")
    assert label.true_pose == "refined"


def test_refined_pose_refuses_what_it_cannot_refine(cells: Cells, scan: Floats) -> None:
    with pytest.raises(UsageError, match="1 m"):
        refined_pose(cells, scan, T_MAP_LIDAR)
    fine = cells_of(scene("canyon", 1), 1.0)
    with pytest.raises(RegistrationError, match="no convergence after 1 step"):
        refined_pose(fine, scan, T_MAP_LIDAR, RegistrationSettings(iterations_max=1, epsilon=1e-9))
