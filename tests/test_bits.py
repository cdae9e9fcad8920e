"""One machine, the same bits for any split: a row alone is the row in any company (`tilestream`).

The labels of a drive, the tables of factors and of observability, the cells and the surfels of a
map are compared for other tilings and splits beside their own subjects.
"""

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import processors
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_data import dataset
from numpy.typing import NDArray
from scenes import scene
from threadpoolctl import threadpool_limits

import tilestream as ts
from tilestream.factors.along_route import AVERAGED, WIDTHS, averaged_along
from tilestream.factors.local_similarity import covariances, curvatures, entropy
from tilestream.formats.logs.degrade import select
from tilestream.formats.logs.deskew import Sweep, deskew
from tilestream.formats.logs.poses import interpolate, matrices, transform
from tilestream.formats.points.pcd import write_pcd
from tilestream.kernels.fixed_order import norms, row_sums, turned
from tilestream.label import start_errors
from tilestream.model.domain import domain_of
from tilestream.model.features import with_derived
from tilestream.model.registry import COMPETITORS
from tilestream.model.splits import block_splits
from tilestream.records import Scan, Trajectory

Floats = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)
MOST = 70
"""Rows of the whole that parts are compared with."""


@st.composite
def rows(draw: st.DrawFn) -> NDArray[np.int64]:
    """Some of `MOST` rows, one at least: a slice that begins anywhere, or so many in any order."""
    count = draw(st.integers(1, MOST))
    if draw(st.booleans()):
        return draw(st.integers(0, MOST - count)) + np.arange(count)
    return np.random.default_rng(draw(SEEDS)).permutation(MOST)[:count]


def same(some: NDArray[np.int64], made: Callable[[NDArray[np.int64]], Floats]) -> None:
    np.testing.assert_array_equal(made(some), made(np.arange(MOST))[some])


def poses(seed: int, count: int = MOST) -> Floats:
    """Rigid motions as far out as UTM's coordinates."""
    numbers = np.random.default_rng(seed).normal(size=(count, 7))
    return matrices(numbers * [5.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0] + [3.7e5, 3.9e6, *[0.0] * 5])


# --- What all of it rests on

ONE = ("sin", "cos", "tan", "exp", "log", "log2", "sqrt", "arcsin", "arctan", "degrees")
TWO = ("arctan2", "hypot", "divide", "remainder")


@pytest.mark.parametrize("name", [*ONE, *TWO])
@given(some=rows(), seed=SEEDS, stride=st.integers(1, 3))
@settings(max_examples=20)
def test_numpy_gives_a_number_the_same_bits_in_any_array(
    name: str, some: NDArray[np.int64], seed: int, stride: int
) -> None:
    numbers = np.random.default_rng(seed).uniform(0.01, 1.0, (2 if name in TWO else 1, MOST))
    numbers *= 1.0 if name == "arcsin" else 6.0
    wide = np.repeat(numbers[:, some], stride, axis=1)[:, ::stride]
    function = getattr(np, name)
    np.testing.assert_array_equal(function(*wide), function(*numbers)[some])


@given(some=rows(), seed=SEEDS, columns=st.integers(1, 60))
@settings(max_examples=30)
def test_products_and_sums_of_rows_round_by_the_row_alone(
    some: NDArray[np.int64], seed: int, columns: int
) -> None:
    rng = np.random.default_rng(seed)
    points, R = rng.normal(size=(MOST, 3)) * 50.0, rng.normal(size=(MOST, 3, 3))
    values = rng.normal(size=(MOST, columns))
    same(some, lambda r: turned(R[0], points[r]))
    same(some, lambda r: turned(R[r], points[r]))
    same(some, lambda r: transform(poses(seed)[0], points[r]))
    for layout in (np.ascontiguousarray, np.asfortranarray):
        same(some, lambda r, layout=layout: row_sums(layout(values[r])))
        same(some, lambda r, layout=layout: norms(layout(values[r])))
    np.testing.assert_allclose(turned(R, points), np.einsum("nij,nj->ni", R, points), rtol=1e-9)
    np.testing.assert_allclose(row_sums(values), values.sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(norms(values), np.linalg.norm(values, axis=1), rtol=1e-14)


@given(seed=SEEDS)
@settings(max_examples=10)
def test_a_motion_rounds_as_rotation_and_shift_do(seed: int) -> None:
    T, points = poses(seed)[0], np.random.default_rng(seed).normal(size=(MOST, 3)) * 50.0
    points[3, 1] = np.nan
    np.testing.assert_array_equal(transform(T, points), turned(T[:3, :3], points) + T[:3, 3])


# --- Every table


@given(some=rows(), seed=SEEDS)
@settings(max_examples=30)
def test_the_error_of_a_start(some: NDArray[np.int64], seed: int) -> None:
    T_map_true, T_map_final = poses(seed, 1)[0], poses(seed)
    for name in ("along", "across", "up", "roll", "pitch", "yaw_vector", "yaw", "error"):
        same(some, lambda r, name=name: start_errors(T_map_true, T_map_final[r])[name])


@given(some=rows(), seed=SEEDS)
@settings(max_examples=30)
def test_what_441_scores_are_made_into(some: NDArray[np.int64], seed: int) -> None:
    scores = np.random.default_rng(seed).uniform(1.0, 4.0, (MOST, 441))
    soft = scores / row_sums(scores)[:, None]
    same(some, lambda r: entropy(scores[r]))
    for k in range(2):
        same(some, lambda r, k=k: curvatures(scores[r])[k])
    for k in range(3):
        same(some, lambda r, k=k: covariances(soft[r])[k])


@pytest.fixture(scope="module")
def canyon(tmp_path_factory: pytest.TempPathFactory) -> tuple[ts.TileStore, Floats, pd.DataFrame]:
    """A map, places in it, and their factors."""
    folder = tmp_path_factory.mktemp("canyon")
    write_pcd(folder / "map.pcd", scene("canyon", 31))
    store = ts.ingest(folder / "map.pcd", folder / "map.zarr", tile_size=20.0)
    at = np.linspace(0.0, 1.0, MOST)
    places = np.column_stack([1.0 + 18.0 * at, np.sin(9.0 * at), 2.0 + 0.1 * at])
    return store, places, ts.factors(store, places, which="all")


@given(some=rows())
@settings(max_examples=10)
def test_the_factors_of_a_place(
    canyon: tuple[ts.TileStore, Floats, pd.DataFrame], some: NDArray[np.int64]
) -> None:
    store, places, whole = canyon
    part = ts.factors(store, places[some], which="all")
    expected = whole.iloc[some].reset_index(drop=True)
    pd.testing.assert_frame_equal(part, expected, check_exact=True)


@given(some=rows(), step=st.sampled_from([0.05, 0.3, 1.0]), seed=SEEDS)
@settings(max_examples=10)
def test_the_virtual_drive_of_a_place_with_its_neighbours(
    some: NDArray[np.int64], step: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    places = pd.DataFrame(
        {
            "route_id": "r",
            "arc_length": step * np.arange(MOST),
            "status": rng.choice(["done", "failed"], MOST, p=[0.9, 0.1]),
            **{name: rng.normal(size=MOST) for name in AVERAGED},
        }
    )
    reach = places["arc_length"].to_numpy()
    width = float(rng.choice(WIDTHS))
    near = np.abs(reach[:, None] - reach[some]).min(axis=1) <= 2.0 * width + 1e-3
    part = averaged_along(places[near].sample(frac=1.0, random_state=seed), width)
    expected = averaged_along(places, width).loc[some]
    pd.testing.assert_frame_equal(part.loc[some], expected, check_exact=True)


@given(some=rows(), seed=SEEDS)
@settings(max_examples=10)
def test_how_far_a_place_is_from_the_training_places(some: NDArray[np.int64], seed: int) -> None:
    X = np.random.default_rng(seed).normal(size=(MOST, 40))
    domain = domain_of(X, np.repeat(["a", "b"], MOST // 2))
    for layout in (np.ascontiguousarray, np.asfortranarray):
        same(some, lambda r, layout=layout: domain.distance(layout(X[r])))
    axes = pd.DataFrame(
        X[:, :5], columns=["heading", "weak_axis", *(f"score_cov_{a}" for a in ("xx", "xy", "yy"))]
    )
    for name in ("weak_along", "score_var_along", "score_var_across"):
        same(some, lambda r, name=name: with_derived(axes.iloc[r])[name].to_numpy())


@given(some=rows(), seed=SEEDS)
@settings(max_examples=30)
def test_a_point_of_a_scan_taken_in_motion(some: NDArray[np.int64], seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = Trajectory(10**8 * np.arange(9), poses(seed, 9), "lidar")
    track.T_map_lidar[:, :3, 3] *= 0.01  # no vehicle is faster
    scan = Scan(3 * 10**8, rng.normal(size=(MOST, 3)) * 20.0, time_offset=rng.uniform(0, 0.3, MOST))
    stamps = rng.integers(0, 8 * 10**8, MOST)
    same(some, lambda r: interpolate(track, stamps[r], 1.0)[0])
    whole = deskew(scan, track).points
    keep = np.isin(np.arange(MOST), some)
    np.testing.assert_array_equal(deskew(select(scan, keep), track).points, whole[keep])
    same(some, lambda r: Sweep(0.1).time_offsets(scan.points[r]))


def test_how_many_threads_share_a_product_does_not_show() -> None:
    """A process of its own has as many as the machine has cores, a Dask worker one."""
    data = dataset(1, related=0.9, lengths={"a": 1500, "b": 1500})
    split = block_splits(data)[0]
    train, test = data.take(split.train), data.take(split.test)
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(COMPETITORS["pcr"].fit(train, "error_mean").predict(test.rows))
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
def test_another_processor_agrees_within_what_is_stated(tmp_path: Path) -> None:
    """The oldest kernels of Numba and OpenBLAS (no AVX, no FMA) against those of this processor."""
    oldest = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "OPENBLAS_CORETYPE": "Nehalem"}
    environment = os.environ | oldest | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    program = [sys.executable, processors.__file__, str(tmp_path)]
    subprocess.run(program, check=True, env=environment)
    here, there = processors.figures(tmp_path / "here"), np.load(tmp_path / "figures.npz")
    np.testing.assert_array_equal(here["cells"], there["cells"])
    for name, close in (("factors", 1e-5), ("hessian", 1e-4)):
        largest = np.nanmax(np.abs(here[name]), axis=0)
        np.testing.assert_allclose(here[name] / largest, there[name] / largest, rtol=0, atol=close)
    assert (np.abs(here["error"] - there["error"]) < 1e-3).mean() > 0.98


# --- Where a product of matrices may stay

MAY = {
    "apps/camera.py": "a picture, no table",
    "apps/changes.py": "over all places of two runs, for words",
    "factors/local_similarity.py": "the weights of a fit: a constant",
    "factors/hessian.py": "6 x 6 of one place",
    "factors/virtual_drive.py": "over the starts of one place",
    "formats/logs/frames.py": "4 x 4 of one pose",
    "formats/logs/lidar_poses.py": "4 x 4 of one pose",
    "formats/logs/pose_tracks.py": "4 x 4 of one pose",
    "formats/logs/poses.py": "4 x 4 of one pose",
    "formats/logs/together.py": "4 x 4 of one pose",
    "kernels/neighbours.py": "whole numbers",
    "label.py": "3 x 3 of one pose",
    "local_map.py": "3 x 3 of one cell",
    "model/bootstrap.py": "over all labelled places, which no task shares out",
    "model/corrected.py": "over the leaves of one tree",
    "model/correlation.py": "over the pieces of all routes, which no task shares out",
    "model/covariance.py": "6 x 6 of one place",
    "model/covariance_training.py": "3 x 3 of one place",
    "model/domain.py": "over all training places, in one thread",
    "model/explain.py": "over all training places, in one thread",
    "model/figures.py": "over the blocks of all labelled places",
    "model/intervals.py": "over the blocks of all labelled places",
    "model/repeats.py": "over the blocks of all labelled places",
    "notebook.py": "a picture, no table",
    "registration.py": "3 x 3 of one pose or one cell",
    "report/log_poses.py": "over one drive",
    "sensor.py": "3 x 3 of one mount",
    "simulation/drive.py": "over one drive",
    "simulation/lidar.py": "over one scan",
    "simulation/mesh.py": "over one tree",
}
"""Files with products that go through BLAS or LAPACK, and what they are over: never over rows that
another split would share out otherwise."""
PRODUCTS = {"dot", "vdot", "vecdot", "matvec", "matmul", "einsum", "tensordot", "corrcoef", "cov"}


def products(source: str) -> list[str]:
    """Products of matrices in a source, and what else goes through BLAS or LAPACK, by line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            found.append(f"{node.lineno} @")
        elif isinstance(node, ast.Attribute) and node.attr in PRODUCTS | {"linalg"}:
            found.append(f"{node.lineno} {node.attr}")
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
            found += [f"{node.lineno} {name}" for name in names if "linalg" in name]
    return found


def test_products_of_matrices_stay_where_no_split_shows() -> None:
    root = Path(ts.__file__).parent
    found = {
        path.relative_to(root).as_posix(): products(path.read_text())
        for path in sorted(root.rglob("*.py"))
    }
    assert {name for name, lines in found.items() if lines} == set(MAY), found


@pytest.mark.parametrize(
    "source",
    [
        *("a = b @ c", "a @= b", "a.dot(b)", "np.einsum('i', a)", "np.linalg.norm(a)"),
        *("from scipy import linalg", "from numpy.linalg import lstsq", "import scipy.linalg"),
    ],
)
def test_a_product_of_matrices_is_seen(source: str) -> None:
    assert products(source)
