"""Cells: exact sums against whole numbers, eigenvectors and normals against numpy, any order."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from literal import literal_cells
from numpy.typing import NDArray
from scenes import UTM, scene

from tilestream.errors import UsageError
from tilestream.kernels import cells as kernels
from tilestream.kernels.bounds import bounds
from tilestream.kernels.eigen import LANES, eigen
from tilestream.ndt import cells_of, cells_of_mm
from tilestream.records import Cells

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def same_bits(a: Cells, b: Cells) -> bool:
    fields = ("index", "count", "mean", "covariance", "eigenvalues", "normal", "regularised")
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in fields)


def literal_moments(points_mm: Ints) -> tuple[list[float], list[list[float]]]:
    """Mean [m] and unbiased covariance [m^2] in exact fractions."""
    n = len(points_mm)
    columns = [[int(v) for v in axis] for axis in points_mm.T]
    mean = [Fraction(sum(axis), n) for axis in columns]
    away = [[v - m for v in axis] for axis, m in zip(columns, mean, strict=True)]
    covariance = [
        [
            float(Fraction(sum(a * b for a, b in zip(p, q, strict=True)), (n - 1) * 10**6))
            for q in away
        ]
        for p in away
    ]
    return [float(m / 1000) for m in mean], covariance


# --- Sums, mean, covariance


@pytest.mark.interpreted
@given(st.integers(0, 2**32), st.sampled_from([1, 7, 200, 2000, 12345]), st.integers(0, 300))
@settings(max_examples=40, deadline=None)
def test_sums_are_those_of_a_plain_loop(seed: int, edge: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(-3 * edge, 3 * edge, (n, 3)) + rng.integers(-(10**9), 10**9, 3)
    index, sums = kernels.cell_sums(points, edge)
    expected: dict[tuple[int, ...], list[int]] = {}
    for p in points.tolist():
        voxel = tuple(v // edge for v in p)
        x, y, z = (v - c * edge for v, c in zip(p, voxel, strict=True))
        terms = (1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
        so_far = expected.get(voxel, [0] * 10)
        expected[voxel] = [a + b for a, b in zip(so_far, terms, strict=True)]
    assert [tuple(i) for i in index.tolist()] == sorted(expected)
    assert sums.tolist() == [expected[v] for v in sorted(expected)]


@pytest.mark.interpreted
def test_voxels_at_lattice_planes_far_out_are_exact() -> None:
    for edge in (1, 3, 200, 2000, 999_983):
        planes = np.array([-(10**11), -(10**6), -1, 0, 1, 10**6, 10**11]) // edge * edge
        x = (planes[:, None] + [-1, 0, 1]).ravel()
        points = np.column_stack([x, x[::-1], np.roll(x, 1)])
        index, sums = kernels.cell_sums(points, edge)
        assert np.array_equal(index, np.unique(points // edge, axis=0))
        assert sums[:, kernels.COUNT].sum() == len(points)


@pytest.mark.interpreted
@given(st.integers(0, 2**32), st.sampled_from([50, 2000, 100_000]))
@settings(max_examples=25, deadline=None)
def test_moments_are_those_of_exact_fractions(seed: int, edge: int) -> None:
    rng = np.random.default_rng(seed)
    corner = rng.integers(-(10**6), 10**6, 3) * edge
    spread = rng.integers(1, edge, 3, endpoint=True)
    points = corner + rng.integers(0, spread, (int(rng.integers(2, 40)), 3))
    cells = cells_of_mm(points, edge, min_points=2)
    mean, covariance = literal_moments(points)
    assert cells.mean[0].tolist() == mean
    scale = np.abs(covariance).max()
    assert np.abs(cells.covariance[0] - covariance).max() <= 4e-16 * scale


def test_very_full_and_very_large_cells_do_not_overflow() -> None:
    rng = np.random.default_rng(5)
    edge, n = 1_000_000, 300_000  # n Sxx is about 1e22: beyond int64
    points = rng.integers(0, edge, (n, 3)) + np.array([370, 3950, -1]) * edge
    cells = cells_of_mm(points, edge)
    away = points / 1000.0 - points.mean(axis=0) / 1000.0
    assert cells.count.tolist() == [n]
    assert cells.mean[0] == pytest.approx(points.mean(axis=0) / 1000.0, rel=1e-15)
    assert cells.covariance[0] == pytest.approx(away.T @ away / (n - 1), rel=1e-9, abs=1e-6)
    flat = points.copy()
    flat[:, 2] = 17 + rng.integers(0, 2, n)  # a thin sheet in the same huge cell
    thin = cells_of_mm(flat, edge).covariance[0, 2, 2]
    assert thin == pytest.approx(np.var(flat[:, 2] / 1000.0, ddof=1), rel=1e-9)


def test_points_scattered_over_a_continent_need_no_memory_for_what_lies_between() -> None:
    rng = np.random.default_rng(6)
    towns = rng.integers(-(10**9), 10**9, (12, 3))
    points = rng.permutation((towns[:, None] + rng.integers(0, 5000, (12, 200, 3))).reshape(-1, 3))
    index, sums = kernels.cell_sums(points, 2000)
    assert np.array_equal(index, np.unique(points // 2000, axis=0))
    rows = kernels.cell_of_points(points, 2000, index)
    assert np.array_equal(index[rows], points // 2000)
    assert np.array_equal(np.bincount(rows), sums[:, kernels.COUNT])
    kept = index[::3]
    rows = kernels.cell_of_points(points, 2000, kept)
    inside = (points[:, None] // 2000 == kept).all(axis=2)
    assert np.array_equal(rows, np.where(inside.any(axis=1), inside.argmax(axis=1), -1))


def test_cells_agree_with_the_literal_reading() -> None:
    for place in ("canyon", "park"):
        points = scene(place, seed=2)
        cells, expected = cells_of(points), literal_cells(points, 2.0)
        assert np.array_equal(cells.index, expected.index)
        assert np.array_equal(cells.count, expected.count)
        assert np.abs(cells.mean - expected.mean).max() < 1e-12
        assert np.abs(cells.covariance - expected.covariance).max() < 1e-14
        assert np.abs(cells.regularised - expected.regularised).max() < 1e-12
        assert np.abs(cells.normal - expected.normal).max() < 1e-8


def test_six_points_make_a_cell_unless_told_otherwise() -> None:
    points = np.random.default_rng(1).uniform(0, 2, (6, 3))
    assert len(cells_of(points)) == 1
    assert len(cells_of(points[:5])) == 0
    assert len(cells_of(points[:5], min_points=5)) == 1


# --- Nothing depends on order, place or tiling


@pytest.mark.parametrize("cell_size", [0.5, 1.0, 2.0, 3.3])
def test_order_does_not_matter(cell_size: float) -> None:
    points = scene("crossing", seed=4, offset=UTM)
    shuffled = np.random.default_rng(0).permutation(points)
    assert same_bits(cells_of(points, cell_size), cells_of(shuffled, cell_size))


@pytest.mark.parametrize("tile_mm", [2000, 8000, 100_000])
def test_tiles_together_are_the_map(tile_mm: int) -> None:
    points_mm = np.rint(scene("diagonal", seed=5, offset=UTM) * 1000.0).astype(np.int64)
    tiles = np.unique(points_mm[:, :2] // tile_mm, axis=0)
    parts = [
        cells_of_mm(points_mm[(points_mm[:, :2] // tile_mm == tile).all(axis=1)], 2000)
        for tile in tiles
    ]
    fields = ("index", "count", "mean", "covariance")
    joined = Cells(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))
    assert same_bits(joined, cells_of_mm(points_mm, 2000))


def test_utm_coordinates_lose_nothing() -> None:
    near, far = (cells_of(scene("canyon", seed=6, offset=o)) for o in ((0.0, 0.0, 0.0), UTM))
    assert np.array_equal(near.covariance, far.covariance)
    assert np.array_equal(near.normal, far.normal)
    assert np.abs(far.mean - UTM - near.mean).max() < 1e-6


def test_millimetres_are_rounded_half_to_even() -> None:
    halves, whole = [[0.0005, 0.0015, -0.0025]] * 2, [[0.0, 0.002, -0.002]] * 2
    assert same_bits(cells_of(halves, 0.004, 2), cells_of(whole, 0.004, 2))


@pytest.mark.parametrize("dtype", [np.float64, np.int64, np.int32])
@pytest.mark.parametrize("at", [0, 1, -1])
def test_the_bounds_of_points_are_those_of_numpy(dtype: type, at: int) -> None:
    points = np.random.default_rng(0).integers(-(10**9), 10**9, (1000, 3)).astype(dtype)
    points[at] = [10**9, -(10**9), 10**9]
    np.testing.assert_array_equal(bounds(points), [points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize("row", [0, 3, 999])
def test_points_that_are_not_numbers_have_no_bounds(row: int) -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3))
    points[row, row % 3] = np.nan
    assert np.isnan(bounds(points)).all()


# --- Eigenvalues, normals, inverse


def random_covariances(n: int, seed: int = 0) -> Floats:
    """Covariances of every shape: eigenvalues over twelve orders of magnitude, many of them 0."""
    rng = np.random.default_rng(seed)
    lam = 10.0 ** rng.uniform(-12, 0, (n, 3)) * (rng.random((n, 3)) < 0.8)
    q = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    matrices = q * lam[:, None, :] @ q.transpose(0, 2, 1)
    return (matrices + matrices.transpose(0, 2, 1)) / 2


@pytest.mark.interpreted
def test_eigenvalues_are_those_of_lapack() -> None:
    covariance = random_covariances(400)
    values, vectors = eigen(covariance)
    expected = np.maximum(np.linalg.eigvalsh(covariance)[:, ::-1], 0.0)
    scale = np.maximum(expected[:, :1], 1e-300)
    assert (np.abs(values - expected) / scale).max() < 5e-15
    assert (values[:, :-1] >= values[:, 1:]).all()
    assert (values >= 0.0).all()
    again = vectors * values[:, None, :] @ vectors.transpose(0, 2, 1)
    assert (np.abs(again - covariance).max(axis=(1, 2)) / scale[:, 0]).max() < 5e-15
    eye = vectors.transpose(0, 2, 1) @ vectors
    assert np.abs(eye - np.eye(3)).max() < 5e-15


@pytest.mark.parametrize("company", [2, LANES, LANES + 1, 3 * LANES - 1])
def test_a_matrix_has_the_same_axes_in_any_company(company: int) -> None:
    covariance = random_covariances(company, seed=1)
    together, alone = eigen(covariance), [eigen(one[None]) for one in covariance]
    for part in range(2):
        assert together[part].tobytes() == b"".join(found[part].tobytes() for found in alone)


@pytest.mark.interpreted
@pytest.mark.parametrize("lam", [(0, 0, 0), (1, 0, 0), (0, 0, 2), (1, 1, 0), (3, 3, 3), (1, 2, 3)])
def test_eigenvalues_of_diagonal_matrices_are_exact(lam: tuple[int, int, int]) -> None:
    values, vectors = eigen(np.diag(np.array(lam, float))[None])
    assert values[0].tolist() == sorted(lam, reverse=True)
    assert np.abs(vectors[0].T @ vectors[0]).tolist() == np.eye(3).tolist()


def test_a_negative_eigenvalue_is_rounding_and_counts_as_zero() -> None:
    values, _ = eigen(np.diag([1.0, 1e-3, -1e-18])[None])
    assert values[0].tolist() == [1.0, 1e-3, 0.0]


def test_the_normal_of_flat_ground_points_up() -> None:
    rng = np.random.default_rng(7)
    xy = rng.uniform(0, 2, (50, 2))
    cells = cells_of(np.column_stack([xy, np.full(50, 0.5)]))
    assert np.abs(cells.normal - [0, 0, 1]).max() < 1e-12
    assert cells.eigenvalues[0, 2] == 0.0


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("along", "normal"), [((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (1, 0, 0))]
)
def test_the_normal_of_a_thin_pole_is_fixed(
    along: tuple[int, ...], normal: tuple[int, ...]
) -> None:
    t = np.linspace(0.1, 1.9, 10)
    points = 0.5 + 0.6 * (1 - np.array(along)) + (t[:, None] - 0.5) * np.array(along)
    cells = cells_of(points)
    assert cells.normal[0] == pytest.approx(normal, abs=1e-9)
    assert cells.eigenvalues[0, 1] <= 1e-9 * cells.eigenvalues[0, 0]


@pytest.mark.parametrize("angle_deg", np.arange(0, 360, 15))
def test_a_wall_has_one_normal_whatever_its_cells(angle_deg: int) -> None:
    """Also at 45 degrees, where two components are equal but for rounding."""
    rng = np.random.default_rng(8)
    a = np.radians(angle_deg)
    s, z = rng.uniform(0, 30, 6000), rng.uniform(0, 8, 6000)
    wall = np.column_stack([s * np.cos(a), s * np.sin(a), z])
    cells = cells_of(np.round(wall / 0.001) * 0.001, 2.0)
    broad = cells.eigenvalues[:, 1] > 0.01  # not the slivers where the wall cuts a voxel's edge
    normal = cells.normal[broad]
    largest = np.abs(normal).max(axis=1)
    first = np.argmax(np.abs(normal) >= largest[:, None] - 1e-6, axis=1)
    assert (np.take_along_axis(normal, first[:, None], axis=1) > 0).all()
    true = np.abs([np.sin(a), -np.cos(a), 0.0])
    assert np.abs(np.abs(normal) - true).max() < 5e-3


@pytest.mark.interpreted
def test_the_regularised_covariance_has_its_floors_and_its_inverse() -> None:
    covariance = random_covariances(200, seed=9)
    values, vectors = eigen(covariance)
    regular, inverse = kernels.regularise(values, vectors)
    floors = np.maximum(values, np.maximum(0.01 * values[:, :1], 1e-4))
    expected = vectors * floors[:, None, :] @ vectors.transpose(0, 2, 1)
    assert np.abs(regular - expected).max() < 1e-14
    assert np.abs(inverse @ regular - np.eye(3)).max() < 1e-11


def test_golden_cells_of_the_matchers(shared_data: Path) -> None:
    given = np.load(shared_data / "matchers" / "cells_2m.npz")
    backwards = {k: given[k][::-1] for k in ("index", "count", "mean", "covariance")}
    cells = Cells(**backwards)
    assert len(cells) == 4721
    assert np.array_equal(cells.index, given["index"])
    expected = np.linalg.eigvalsh(cells.covariance)[:, ::-1]
    assert (np.abs(cells.eigenvalues - expected) / expected[:, :1]).max() < 3e-15
    _, vectors = np.linalg.eigh(cells.covariance)
    clear = expected[:, 1] - expected[:, 2] > 1e-3 * expected[:, 0]
    cosine = np.abs((cells.normal * vectors[:, :, 0]).sum(axis=1))
    assert clear.sum() > 4000
    assert cosine[clear].min() > 1 - 1e-12
    assert np.abs(cells.precision @ cells.regularised - np.eye(3)).max() < 1e-11


# --- The record


def some_cells(n: int = 4) -> dict[str, NDArray[np.generic]]:
    index = np.arange(3 * n).reshape(n, 3)
    mean = 2.0 * index + 1.0
    return {
        "index": index,
        "count": np.full(n, 9),
        "mean": mean,
        "covariance": np.tile(np.eye(3), (n, 1, 1)),
    }


def test_rows_are_sorted_and_the_given_arrays_are_left_alone() -> None:
    given = some_cells()
    order = [2, 0, 3, 1]
    shuffled = {k: v[order] for k, v in given.items()}
    cells = Cells(**shuffled)
    assert np.array_equal(cells.index, given["index"])
    assert np.array_equal(cells.mean, given["mean"])
    cells.mean[:] = 0.0
    assert np.array_equal(shuffled["mean"], given["mean"][order])
    assert repr(Cells(**given)) == (
        "Cells(4 of 2 m, x 1.0 to 19.0, y 3.0 to 21.0, z 5.0 to 23.0 m, 36 points)"
    )
    assert len(Cells(**some_cells(0))) == 0


@pytest.mark.parametrize(
    ("name", "bad", "says"),
    [
        ("index", np.zeros((4, 2), int), "shape"),
        ("index", np.zeros((4, 3), int), "two cells"),
        ("index", np.full((4, 3), 0.5), "whole"),
        ("index", np.array(7), "shape"),
        ("index", np.array(["a"] * 4), "whole numbers"),
        ("count", np.zeros(4, int), "below 1"),
        ("count", np.ones(3, int), "shape"),
        ("mean", np.full((4, 3), np.nan), "finite"),
        ("mean", np.zeros((4, 4)), "shape"),
        ("mean", [["a"] * 3] * 4, "numbers"),
        ("covariance", np.zeros((4, 3)), "shape"),
        ("covariance", np.full((4, 3, 3), np.inf), "finite"),
        ("covariance", np.arange(36.0).reshape(4, 3, 3), "symmetric"),
    ],
)
def test_cells_that_make_no_sense_are_refused(name: str, bad: object, says: str) -> None:
    given: dict[str, object] = {**some_cells(), name: bad}
    with pytest.raises(UsageError, match=says):
        Cells(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [0.0, -2.0, 0.0005, np.nan, np.inf])
def test_cell_sizes_that_make_no_lattice_are_refused(size: float) -> None:
    with pytest.raises(UsageError, match="cell_size"):
        Cells(**some_cells(), cell_size=size)
    with pytest.raises(UsageError, match="cell_size"):
        cells_of(np.zeros((9, 3)), size)


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros(3),
        np.zeros((5, 2)),
        np.full((5, 3), np.nan),
        np.full((5, 3), 1e15),
        [["a", "b", "c"]],
        np.zeros((5, 3), complex),
    ],
)
def test_points_that_are_none_are_refused(bad: object) -> None:
    with pytest.raises(UsageError, match="point"):
        cells_of(bad)  # type: ignore[arg-type]


def test_a_covariance_needs_two_points() -> None:
    with pytest.raises(UsageError, match="min_points"):
        cells_of(np.zeros((9, 3)), min_points=1)


def test_no_points_are_no_cells() -> None:
    cells = cells_of(np.zeros((0, 3)))
    assert len(cells) == 0
    assert cells.eigenvalues.shape == (0, 3)
    assert cells.normal.shape == (0, 3)
    assert cells.regularised.shape == (0, 3, 3)
