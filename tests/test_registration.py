"""Registration against its literal reading, and by its laws."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from literal_registration import Floats, Matcher, euler_angles, expm, from_euler, thinned
from scenes import UTM, rotated_scene, scene

from tilestream.errors import RegistrationError, UsageError
from tilestream.kernels.newton import definite_step, raw_step
from tilestream.label import start_poses
from tilestream.local_map import LocalCells
from tilestream.ndt import cells_of
from tilestream.records import Cells, Registrations
from tilestream.registration import register
from tilestream.settings import RegistrationSettings, StartSettings

SCORE_ONLY = {"iterations_max": 0}
MODES = {
    "direct1": RegistrationSettings(neighbours="direct1"),
    "direct7": RegistrationSettings(),
    "raw": RegistrationSettings(solver="raw"),
    "radius": RegistrationSettings(neighbours="radius"),
    "autoware": RegistrationSettings.autoware(),
}


def pose(x: float, y: float, z: float, turn: tuple[float, float, float] = (0, 0, 0)) -> Floats:
    T = np.eye(4)
    T[:3, :3] = expm(np.array(turn, float))
    T[:3, 3] = x, y, z
    return T


T_MAP_LIDAR = pose(10.3, -0.7, 1.9, (0.01, -0.02, 0.35))


def scan_of(points: Floats, T: Floats, count: int, seed: int = 5) -> Floats:
    """Some of the points as a lidar at T would report them, with 2 cm of noise."""
    rng = np.random.default_rng(seed)
    chosen = points[rng.choice(len(points), count, replace=False)]
    return (chosen - T[:3, 3]) @ T[:3, :3] + rng.normal(0, 0.02, (count, 3))


@pytest.fixture(scope="module")
def cells() -> Cells:
    return cells_of(scene("canyon", 1), 2.0)


@pytest.fixture(scope="module")
def scan() -> Floats:
    return scan_of(scene("canyon", 2), T_MAP_LIDAR, 1500)


def starts_around(T: Floats, count: int = 12, spread: float = 0.6, seed: int = 3) -> Floats:
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        start = T.copy()
        start[:3, 3] += rng.normal(0, spread, 3) * [1, 1, 0.3]
        start[:3, :3] = expm(rng.normal(0, 0.02, 3)) @ T[:3, :3]
        out.append(start)
    return np.array(out)


def same_bits(a: Registrations, b: Registrations) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("T_map_lidar", "converged", "iterations", "score", "nvtl", "hits", "hessian")
    )


# --- The literal reading


@pytest.mark.parametrize("mode", MODES)
def test_score_hessian_and_hits_equal_the_literal_ones(
    mode: str, cells: Cells, scan: Floats
) -> None:
    literal = Matcher(cells, scan, MODES[mode])
    starts = starts_around(T_MAP_LIDAR)
    found = register(cells, scan, starts, MODES[mode].model_copy(update=SCORE_ONLY))
    assert found.points == len(literal.scan)
    assert not found.converged.any()
    for k, T in enumerate(starts):
        nvtl, hits = literal.nvtl_and_hits(T)
        _, H = literal.derivatives(T)
        assert found.score[k] == pytest.approx(literal.score(T), rel=1e-5)
        assert found.nvtl[k] == pytest.approx(nvtl, rel=1e-5)
        assert found.hits[k] == hits
        np.testing.assert_allclose(found.hessian[k], H, atol=1e-5 * np.abs(H).max())


@pytest.mark.parametrize("mode", MODES)
def test_a_step_equals_the_literal_one(mode: str, cells: Cells, scan: Floats) -> None:
    how = MODES[mode].model_copy(update={"iterations_max": 1})
    literal = Matcher(cells, scan, how)
    starts = starts_around(T_MAP_LIDAR)
    found = register(cells, scan, starts, how)
    expected = np.array([literal.step(T)[0] for T in starts])
    moved = np.linalg.norm(expected[:, :3, 3] - starts[:, :3, 3], axis=1)
    assert (moved > 0.02).any()
    # a step is H^-1 g: an error of 1e-6 in H counts as often as H is ill-conditioned
    np.testing.assert_allclose(found.T_map_lidar, expected, atol=2e-5)


@pytest.mark.parametrize("mode", MODES)
def test_a_registration_equals_the_literal_one(mode: str, cells: Cells, scan: Floats) -> None:
    literal = Matcher(cells, scan, MODES[mode])
    starts = starts_around(T_MAP_LIDAR, 3, 0.1)
    found = register(cells, scan, starts, MODES[mode])
    for k, start in enumerate(starts):
        T, iterations, converged = literal.register(start)
        assert found.iterations[k] == iterations
        assert found.converged[k] == converged
        np.testing.assert_allclose(found.T_map_lidar[k], T, atol=1e-4)


@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("neighbours", ["direct7", "radius"])
def test_literal_derivatives_are_those_of_the_score(
    euler: bool, neighbours: str, cells: Cells, scan: Floats
) -> None:
    how = RegistrationSettings(neighbours=neighbours, scan_leaf=4.0)
    literal = Matcher(cells, scan, how)
    T = starts_around(T_MAP_LIDAR, 1)[0]
    pairs = literal.pairs(T)  # held: a pair that comes or goes is a step of the score

    def moved(d: Floats) -> Floats:
        out = T.copy()
        out[:3, 3] += d[:3]
        if euler:
            out[:3, :3] = from_euler(euler_angles(T[:3, :3]) + d[3:])
        else:
            out[:3, :3] = expm(d[3:]) @ T[:3, :3]
        return out

    unit = np.eye(6)

    def at(d: Floats) -> float:
        return literal.score(moved(d), pairs)

    h = 1e-5
    g = np.array([at(h * u) - at(-h * u) for u in unit]) / (2 * h)
    h = 1e-4
    a, b = h * unit[:, None], h * unit[None]
    corners = [np.apply_along_axis(at, 2, d) for d in (a + b, a - b, b - a, -a - b)]
    H = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * h * h)
    gradient, hessian = literal.derivatives(T, euler)
    np.testing.assert_allclose(gradient, g, atol=1e-5 * np.abs(g).max())
    np.testing.assert_allclose(hessian, H, atol=1e-4 * np.abs(H).max())


def test_scan_is_thinned_to_centroids_once_and_for_all(cells: Cells, scan: Floats) -> None:
    starts = starts_around(T_MAP_LIDAR, 3)
    once = thinned(scan, 2.0)
    given_thinned = register(cells, once, starts)
    as_given = register(cells, once, starts, RegistrationSettings(scan_leaf=0.0))
    raw_scan = register(cells, scan, starts)
    assert raw_scan.points == as_given.points == len(once)
    for other in (given_thinned, as_given):
        np.testing.assert_allclose(other.T_map_lidar, raw_scan.T_map_lidar, atol=1e-6)


# --- The solvers


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-9, 1e-3, 1.0]))
def test_definite_step_is_the_eigenvalue_rule(seed: int, smallest: float) -> None:
    rng = np.random.default_rng(seed)
    V, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    e = rng.choice([-1.0, 1.0], 6) * 10 ** rng.uniform(-2, 5, 6)
    e[0] *= smallest
    D = np.diag([1, 1, 1, 10.0, 10.0, 10.0])
    H, g = D @ (V * e) @ V.T @ D, rng.normal(size=6) * 10
    H = (H + H.T) / 2
    Hs = H / np.outer(np.diag(D), np.diag(D))
    values, vectors = np.linalg.eigh(Hs)
    values = np.maximum(np.abs(values), 1e-6 * np.abs(values).max())
    expected = (vectors @ ((vectors.T @ (g / np.diag(D))) / values)) / np.diag(D)
    d = np.empty(6)
    norm = definite_step(g, H, 1e9, d)
    np.testing.assert_allclose(d, expected, atol=1e-6 * np.abs(expected).max())
    assert norm == pytest.approx(np.linalg.norm(expected))
    assert g @ d > 0
    assert definite_step(g, H, 0.1, d) <= 0.1 + 1e-12
    assert np.linalg.norm(d) <= 0.1 + 1e-12


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5))
def test_raw_step_is_the_least_squares_one(seed: int, nulls: int) -> None:
    rng = np.random.default_rng(seed)
    V, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    e = rng.choice([-1.0, 1.0], 6) * 10 ** rng.uniform(0, 3, 6)
    e[:nulls] = 0.0
    H = (V * e) @ V.T
    H = (H + H.T) / 2
    g = H @ rng.normal(size=6)
    expected = -np.linalg.lstsq(H, g, rcond=1e-10)[0]
    expected *= 1.0 if g @ expected > 0 else -1.0
    d = np.empty(6)
    norm = raw_step(g, H, 1e9, 0.0, d)
    np.testing.assert_allclose(d, expected, atol=1e-6 * np.abs(expected).max())
    assert norm == pytest.approx(np.linalg.norm(expected), rel=1e-6)
    assert raw_step(g, H, 1e-4, 0.0, d) == pytest.approx(1e-4)
    assert raw_step(g * 1e-9, H, 0.1, 0.005, d) == pytest.approx(0.005)
    assert np.linalg.norm(d) == pytest.approx(0.005)


def test_no_gradient_no_step() -> None:
    d = np.ones(6)
    assert definite_step(np.zeros(6), np.zeros((6, 6)), 0.1, d) == 0.0
    assert not d.any()
    assert raw_step(np.zeros(6), np.zeros((6, 6)), 0.1, 0.005, d) == 0.0
    assert not d.any()


# --- Laws


@pytest.mark.parametrize("mode", MODES)
def test_same_bits_in_any_company_and_order(mode: str, cells: Cells, scan: Floats) -> None:
    starts = start_poses(T_MAP_LIDAR, StartSettings(radius=1.0, step=0.2))
    together = register(cells, scan, starts, MODES[mode])
    order = np.random.default_rng(0).permutation(len(starts))
    shuffled = register(cells, scan, starts[order], MODES[mode])
    alone = [register(cells, scan, T, MODES[mode]) for T in starts[:8]]
    again = register(cells, scan[::-1], starts, MODES[mode])
    assert same_bits(together, again)
    for name in ("T_map_lidar", "iterations", "score", "nvtl", "hits", "hessian", "converged"):
        values = getattr(together, name)
        assert np.array_equal(values[order], getattr(shuffled, name)), name
        assert all(np.array_equal(values[k], getattr(r, name)[0]) for k, r in enumerate(alone))


@pytest.mark.parametrize("mode", ["direct7", "autoware"])
def test_cells_far_away_change_no_bit(mode: str, cells: Cells, scan: Floats) -> None:
    starts = starts_around(T_MAP_LIDAR, 4)
    wider = scene("canyon", 1)
    far = cells_of(np.vstack([wider, wider + np.array([400.0, 0.0, 0.0])]), 2.0)
    assert len(far) > len(cells)
    assert same_bits(
        register(far, scan, starts, MODES[mode]), register(cells, scan, starts, MODES[mode])
    )


@pytest.mark.parametrize("mode", MODES)
def test_scans_that_share_their_listed_cells_end_where_they_end_alone(
    mode: str, cells: Cells, scan: Floats
) -> None:
    places = [T_MAP_LIDAR, pose(4.0, 1.0, 1.9), pose(16.0, 0.5, 1.8, (0, 0, -0.2))]
    reach = np.linalg.norm(scan, axis=1).max() + 10.0
    shared = LocalCells.around(cells, np.array([T[:3, 3] for T in places]), reach, MODES[mode])
    for k, T in enumerate(places):
        some, starts = scan[k::2], starts_around(T, 6, seed=k)
        for how in (MODES[mode], MODES[mode].model_copy(update=SCORE_ONLY)):
            assert same_bits(
                register(shared, some, starts, how), register(cells, some, starts, how)
            )


def test_listed_cells_refuse_what_they_are_not_for(cells: Cells, scan: Floats) -> None:
    shared = LocalCells.around(cells, T_MAP_LIDAR[None, :3, 3], 120.0, MODES["direct7"])
    with pytest.raises(UsageError, match="another matcher: neighbours"):
        register(shared, scan, T_MAP_LIDAR, MODES["radius"])
    with pytest.raises(UsageError, match="beyond"):
        register(shared, scan, pose(150.0, 0, 0), MODES["direct7"])
    with pytest.raises(RegistrationError, match="no cells within"):
        LocalCells.around(cells, np.array([[10_000.0, 0.0, 0.0]]), 50.0, MODES["direct7"])
    wide = LocalCells.around(
        cells, np.array([[0.0, 0.0, 0.0], [10_000.0, 0.0, 0.0]]), 200.0, MODES["direct7"]
    )
    with pytest.raises(RegistrationError, match="no cells within"):
        register(wide, scan, pose(10_000.0, 0, 0), MODES["direct7"])


@pytest.mark.parametrize("mode", ["direct1", "direct7", "autoware"])
def test_moving_map_and_starts_by_the_lattice_moves_the_poses(
    mode: str, cells: Cells, scan: Floats
) -> None:
    starts = starts_around(T_MAP_LIDAR, 8, 0.3)
    here = register(cells, scan, starts, MODES[mode])
    for offset in ((20.0, -34.0, 6.0), UTM):
        moved_map = cells_of(scene("canyon", 1, offset=offset), 2.0)
        moved_starts = starts.copy()
        moved_starts[:, :3, 3] += offset
        there = register(moved_map, scan, moved_starts, MODES[mode])
        back = there.T_map_lidar.copy()
        back[:, :3, 3] -= offset
        assert np.array_equal(there.iterations, here.iterations)
        np.testing.assert_allclose(back, here.T_map_lidar, atol=1e-6)
        np.testing.assert_allclose(there.score, here.score, rtol=1e-6)


def test_turning_map_and_starts_by_quarter_turns_turns_the_poses(scan: Floats) -> None:
    points = scene("canyon", 1)
    # a voxel is half-open: a map point on a border would change its voxel in a turn
    points = points[(np.rint(points * 1000) % 2000 != 0).all(axis=1)]
    starts = starts_around(T_MAP_LIDAR, 6)
    here = register(cells_of(points, 2.0), scan, starts)
    for quarters in (1, 2, 3):
        Q = np.eye(4)
        Q[:3, :3] = np.rint(expm(np.array([0, 0, quarters * np.pi / 2])))
        turned_map = cells_of(rotated_scene(points, quarters), 2.0)
        turned = register(turned_map, scan, Q @ starts)
        np.testing.assert_allclose(turned.score, here.score, rtol=1e-3)
        np.testing.assert_allclose(Q.T @ turned.T_map_lidar, here.T_map_lidar, atol=1e-3)


@pytest.mark.parametrize("mode", MODES)
def test_close_starts_end_at_the_truth(mode: str, cells: Cells, scan: Floats) -> None:
    found = register(cells, scan, starts_around(T_MAP_LIDAR, 20, 0.15), MODES[mode])
    error = np.linalg.norm(found.T_map_lidar[:, :3, 3] - T_MAP_LIDAR[:3, 3], axis=1)
    turn = found.T_map_lidar[:, :3, :3].transpose(0, 2, 1) @ T_MAP_LIDAR[:3, :3]
    assert np.median(error) < 0.1
    assert np.median(np.abs(turn - np.eye(3)).max(axis=(1, 2))) < 0.01
    if mode != "autoware" and mode != "raw":
        assert found.converged.mean() > 0.8
    assert (found.hits > 0.9 * found.points).all()
    rotations = found.T_map_lidar[:, :3, :3]
    np.testing.assert_allclose(
        rotations.transpose(0, 2, 1) @ rotations, np.tile(np.eye(3), (20, 1, 1)), atol=1e-9
    )


@pytest.mark.parametrize("cell_size", [1.0, 3.0])
def test_other_cell_sizes_equal_the_literal_reading(cell_size: float, scan: Floats) -> None:
    fine = cells_of(scene("canyon", 1), cell_size)
    for how in (RegistrationSettings(), RegistrationSettings.autoware()):
        starts = starts_around(T_MAP_LIDAR, 3, 0.3)
        found = register(fine, scan, starts, how.model_copy(update=SCORE_ONLY))
        literal = Matcher(fine, scan, how)
        assert found.score == pytest.approx([literal.score(T) for T in starts], rel=1e-5)


def test_many_cells_per_point_spill_into_further_rows() -> None:
    rng = np.random.default_rng(4)
    full = cells_of(rng.uniform(0, 12, (40_000, 3)), 2.0)  # a filled block: 30 cells in reach
    scan = rng.uniform(-4, 4, (700, 3))
    how = RegistrationSettings(neighbours="radius", scan_leaf=0.0)
    T = pose(6.2, 5.9, 6.1)
    literal = Matcher(full, scan, how)
    assert max(map(len, literal.pairs(T))) > 5
    found = register(full, scan, [T], how.model_copy(update=SCORE_ONLY))
    assert found.score[0] == pytest.approx(literal.score(T), rel=1e-5)
    _, H = literal.derivatives(T)
    np.testing.assert_allclose(found.hessian[0], H, atol=1e-5 * np.abs(H).max())


def plane() -> Cells:
    rng = np.random.default_rng(6)
    return cells_of(rng.uniform([-40, -40, -0.01], [40, 40, 0.01], (200_000, 3)), 2.0)


@pytest.mark.parametrize("mode", MODES)
def test_a_bare_plane_does_not_explode(mode: str) -> None:
    rng = np.random.default_rng(7)
    scan = rng.uniform([-15, -15, -2.0], [15, 15, -2.0], (4000, 3))
    start = pose(0.3, -0.2, 2.25)
    found = register(plane(), scan, [start], MODES[mode])
    T = found.T_map_lidar[0]
    assert np.isfinite(T).all()
    assert abs(T[2, 3] - 2.0) < 0.02
    assert np.abs(T[2, :2]).max() < 0.01  # level
    assert np.linalg.norm(T[:2, 3] - start[:2, 3]) <= 3.0
    weak = np.linalg.eigvalsh(found.hessian[0][:2, :2])
    assert np.abs(weak).max() < 0.05 * abs(found.hessian[0][2, 2])


def test_directions_that_cannot_be_observed_keep_their_start() -> None:
    """One round cell, and points in a line through its mean: only height can be observed."""
    one = Cells(
        index=np.array([[0, 0, 0]]),
        count=np.array([100]),
        mean=np.array([[1.0, 1.0, 1.0]]),
        covariance=np.eye(3)[None] * 0.1,
    )
    scan = np.column_stack([np.zeros(12), np.zeros(12), np.linspace(-0.3, 0.3, 12)])
    start = pose(1.0, 1.0, 1.25, (0.0, 0.0, 0.4))
    for how in MODES.values():
        found = register(one, scan, [start], how.model_copy(update={"scan_leaf": 0.0}))
        T = found.T_map_lidar[0]
        assert found.converged[0]
        assert T[2, 3] == pytest.approx(1.0, abs=0.01)
        np.testing.assert_allclose(T[:2, 3], start[:2, 3], atol=1e-5)
        np.testing.assert_allclose(T[:3, :3], start[:3, :3], atol=1e-4)
        assert abs(found.hessian[0][5]).max() < 1e-3 * abs(found.hessian[0][2, 2])


# --- Bad input


@pytest.mark.parametrize(
    ("scan_points", "message"),
    [
        (np.zeros((9, 3)), "9 points"),
        (np.zeros((0, 3)), "0 points"),
        (np.zeros((200, 3)), "after thinning"),
        (np.full((20, 3), np.nan), "20 of 20 scan points are not finite"),
        (np.vstack([np.ones((20, 3)), [[np.inf, 0, 0]]]), "row 20"),
        (np.zeros((20, 2)), r"shape \(20, 2\)"),
        (np.full((20, 3), "x"), "type"),
        (np.full((20, 3), 3.95e6), "lidar frame"),
    ],
)
def test_a_scan_that_cannot_be_registered_is_refused(
    scan_points: Floats, message: str, cells: Cells
) -> None:
    with pytest.raises(RegistrationError, match=message):
        register(cells, scan_points, np.eye(4))


def broken_pose(row: int, column: int, value: float) -> Floats:
    T = np.tile(T_MAP_LIDAR, (3, 1, 1))
    T[1, row, column] = value
    return T


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        (broken_pose(0, 3, np.nan), "start 1 of 3 is not finite"),
        (broken_pose(0, 0, np.inf), "not finite"),
        (broken_pose(0, 0, 2.0), "start 1 of 3 is not a rotation"),
        (broken_pose(3, 0, 0.1), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (np.zeros((0, 4, 4)), "no poses"),
        (np.zeros((317, 2)), "give"),
    ],
)
def test_starts_that_are_not_rigid_are_refused(
    starts: Floats, message: str, cells: Cells, scan: Floats
) -> None:
    with pytest.raises(RegistrationError, match=message):
        register(cells, scan, starts)


def test_a_scan_outside_the_map_is_an_error_not_a_pose(cells: Cells, scan: Floats) -> None:
    with pytest.raises(RegistrationError, match="no cells within"):
        register(cells, scan, pose(10_000.0, 0, 0))
    nothing = Cells(np.zeros((0, 3), int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    with pytest.raises(RegistrationError, match="no cells within"):
        register(nothing, scan, np.eye(4))
    above = np.array([T_MAP_LIDAR, T_MAP_LIDAR])
    above[1, 2, 3] += 45.0
    with pytest.raises(
        RegistrationError, match="hits no cell from 1 of 2 starts, the first is row 1"
    ):
        register(cells, scan, above)


def test_settings_refuse_what_cannot_be() -> None:
    for wrong in (
        {"neighbours": "direct26"},
        {"step_max": 0.0},
        {"epsilon": -1.0},
        {"iterations_max": -1},
        {"outlier_ratio": 1.0},
        {"scan_leaf": -2.0},
        {"solvr": "raw"},
    ):
        with pytest.raises(UsageError):
            RegistrationSettings(**wrong)
    with pytest.raises(UsageError):
        RegistrationSettings.autoware(steps=3)
    assert RegistrationSettings.autoware(epsilon=0.02).epsilon == 0.02


# --- Without the compiler


PLAIN = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_registration import MODES, T_MAP_LIDAR, scan_of, starts_around
from scenes import scene
from tilestream.registration import register
from tilestream.ndt import cells_of
cells = cells_of(scene("canyon", 1, size=8.0), 2.0)
T = T_MAP_LIDAR.copy()
T[0, 3] = 4.0
scan = scan_of(scene("canyon", 2, size=8.0), T, 60)
for mode in ("direct1", "direct7", "autoware"):
    how = MODES[mode].model_copy(update={"iterations_max": 1, "scan_leaf": 3.0})
    found = register(cells, scan, starts_around(T, 2, 0.2), how)
    print(mode, *found.T_map_lidar.ravel(), *found.score, *found.nvtl, *found.hits)
"""


@pytest.mark.slow
def test_kernels_say_the_same_uncompiled() -> None:
    tests = str(Path(__file__).parent)
    told = []
    for disabled in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-c", PLAIN, tests],
            env=os.environ | {"NUMBA_DISABLE_JIT": disabled},
            capture_output=True,
            text=True,
            check=True,
        )
        told.append([line.split() for line in done.stdout.splitlines()])
    assert len(told[0]) == 3
    for compiled, plain in zip(*told, strict=True):
        assert compiled[0] == plain[0]
        np.testing.assert_allclose(
            np.array(compiled[1:], float), np.array(plain[1:], float), rtol=1e-5, atol=1e-5
        )
