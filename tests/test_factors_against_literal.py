"""The fast factors equal the literal reading of their definitions, on random and regular streets.

Counts and ratios exactly; entropies of histograms are of the same counts, so they agree to
rounding; sums of distances are rounded to fixed point inside. Only what comes from the score field
owes its tolerance to arithmetic in single precision.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from literal import (
    FAITHFUL,
    ROBUST,
    factors_of,
    literal_cells,
    literal_thinned,
    view_from,
    world_of,
)
from numpy.typing import NDArray
from scenes import PLACES, UTM, in_map, scene

import tilestream as ts
from tilestream.formats.points.pcd import write_pcd
from tilestream.ndt import cells_of

Floats = NDArray[np.float64]
HERE = (0.0, 0.0, 0.0)
NAMES = [factor.__name__ for factor in FAITHFUL]
ALL = (*FAITHFUL, *ROBUST)
ROBUST_NAMES = {factor.__name__ for factor in ROBUST}
COUNTS = NAMES[:4]
EXACT = {*NAMES[:7], "occupancy_ratio", "loose_share", "empty_sector", "score_peaks"}
TOLERANCE = dict.fromkeys(NAMES, 1e-6) | {"score_H": 2e-5}
ROBUST_TOLERANCE = 1e-4
UNEVEN = ts.Sensor(
    name="uneven",
    range_max=9.0,
    elevations_deg=(-40.0, -22.0, -9.0, -3.5, 0.0, 2.0, 11.0, 34.0),
    fov_deg=(-43.0, 37.5),
    azimuth_step_deg=1.0,
    rate_hz=10.0,
)
"""Short of sight, with beams as uneven as can be."""


@dataclass(frozen=True)
class Case:
    place: str
    seed: int
    sensor: ts.Sensor = ts.VLP16
    cell_size: float = 2.0
    tile_size: float = 60.0
    offset: tuple[float, float, float] = HERE
    leaf: float = 0.0
    size: float = 16.0
    spacing: float = 0.4
    least_cells: int = 20

    def __str__(self) -> str:
        at = "origin" if self.offset == HERE else "utm"
        return (
            f"{self.place}-{self.seed}-{self.sensor.name}-l{self.cell_size:g}"
            f"-tile{self.tile_size:g}-{at}-leaf{self.leaf:g}"
        )


CASES = (
    Case("canyon", 11),
    Case("canyon", 12, cell_size=1.0, tile_size=7.0, offset=UTM, size=11.0),
    Case("diagonal", 13, sensor=ts.HDL64, tile_size=12.0, offset=UTM),
    Case("crossing", 14, sensor=ts.OS1_128, cell_size=3.0, tile_size=9.0),
    Case("tunnel", 15, sensor=UNEVEN, tile_size=8.0, offset=UTM),
    Case("park", 16, cell_size=1.0, tile_size=20.0, sensor=ts.OS1_128, size=12.0),
    Case("park", 17, cell_size=3.0, offset=UTM, leaf=0.6),
    Case("empty_lot", 18, sensor=UNEVEN, tile_size=4.0),
    Case("regular", 19, tile_size=10.0),
    Case("regular", 20, cell_size=1.0, offset=UTM, leaf=0.2, size=7.0),
)


def store_of(folder: Path, points: Floats, tile_size: float, leaf: float = 0.0) -> ts.TileStore:
    folder.mkdir(exist_ok=True)
    write_pcd(folder / "map.pcd", points)
    return ts.ingest([folder / "map.pcd"], folder / "map.zarr", tile_size=tile_size, map_leaf=leaf)


def places_of_interest(points: Floats, cell_size: float, offset: Iterable[float]) -> Floats:
    """The middle, the rim, beside the map, above it, and right on the mean of a cell."""
    around = np.array([(6, 0, 2), (0.6, -3.1, 1.7), (-14.3, 4, 3), (5.2, 1, 9.5)], float)
    means = cells_of(points, cell_size).mean
    return np.vstack([around + np.array(offset), means[len(means) // 2]])


def same(name: str, ours: float, literally: float) -> bool:
    if name in EXACT:
        return ours == pytest.approx(literally, rel=1e-15, nan_ok=True)
    if name == "weak_axis":  # an axis: 0 and pi are one
        ours = literally + (ours - literally + math.pi / 2) % math.pi - math.pi / 2
    limit = TOLERANCE.get(name, ROBUST_TOLERANCE)
    if name.endswith("DOP") and name != "FDOP":  # 1/sqrt of an eigenvalue summed in steps of 2^-20
        limit = max(limit, 2.0**-20 * literally**2)
    if name.startswith("score_") and name in ROBUST_NAMES:  # a softmax of sums in single precision
        limit = 1e-3
    # A single point between two means that are level to 1e-7 m may bend the field of a few points.
    least = 5e-3 if name.startswith("score_curvature") else 0.1 * limit
    return ours == pytest.approx(literally, rel=limit, abs=least, nan_ok=True)


def check(case: Case, folder: Path, places: Sequence[int] = range(5)) -> None:
    points = scene(case.place, case.seed, case.size, case.spacing, case.offset)
    store = store_of(folder, points, case.tile_size, case.leaf)
    mapped = literal_thinned(points, case.leaf)
    positions = places_of_interest(mapped, case.cell_size, case.offset)[list(places)]
    table = ts.factors(store, positions, sensor=case.sensor, cell_size=case.cell_size, which="all")
    world = world_of(mapped, case.cell_size)
    found, seen = [], 0
    for row, P in enumerate(positions):
        view = view_from(world, P, case.sensor)
        seen += len(view.members)
        for name, value in factors_of(view, ALL).items():
            ours = float(table[name].iloc[row])
            if not same(name, ours, value):
                found.append(f"row {row} {name}: {ours!r}, literally {value!r}")
    assert found == []
    assert seen >= case.least_cells


@pytest.mark.parametrize("case", CASES, ids=str)
def test_factors_agree(case: Case, tmp_path: Path) -> None:
    check(case, tmp_path, places=(0, 1 + case.seed % 4))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_factors_agree_on_many_scenes(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(1000 + seed)
    cell_size = float(rng.choice([0.5, 1.0, 1.6, 2.0, 3.0]))
    case = Case(
        place=str(rng.choice([place for place in PLACES if place != "regular"])),
        seed=seed,
        sensor=(ts.VLP16, ts.HDL64, ts.OS1_128, UNEVEN)[rng.integers(4)],
        cell_size=cell_size,
        tile_size=cell_size * int(rng.integers(3, 40)),
        offset=(HERE, UTM)[rng.integers(2)],
        leaf=float(rng.choice([0.0, cell_size / 4])),
        size=16.0 if cell_size >= 1.0 else 8.0,
        spacing=min(0.4, 0.4 * cell_size),
        least_cells=1,
    )
    check(case, tmp_path)


def test_the_table_has_a_row_per_position_and_the_columns_of_the_definitions(
    tmp_path: Path,
) -> None:
    store = store_of(tmp_path, scene("canyon", 1), 20.0)
    table = ts.factors(store, np.array([[10.0, 0, 2], [5e3, 0, 2]]), cell_size=2.0)
    assert len(table) == 2
    assert [name for name in table.columns if name in NAMES] == NAMES
    assert (table[COUNTS].iloc[1] == 0).all()
    assert table[NAMES[4:]].iloc[1].isna().all()
    assert table[NAMES].iloc[0].notna().all()


def test_nothing_depends_on_the_tiling_or_on_the_order_of_points(tmp_path: Path) -> None:
    points = scene("canyon", 2, offset=UTM)
    positions = places_of_interest(points, 2.0, UTM)
    tables = [
        ts.factors(store_of(tmp_path / name, given, tile), positions, cell_size=2.0)[NAMES]
        for name, given, tile in (
            ("one", points, 100.0),
            ("many", points, 6.0),
            ("mixed", np.random.default_rng(0).permutation(points), 14.0),
        )
    ]
    for other in tables[1:]:
        assert np.array_equal(other.to_numpy(), tables[0].to_numpy(), equal_nan=True)


def test_a_map_at_utm_has_the_factors_of_the_same_map_at_the_origin(tmp_path: Path) -> None:
    points = scene("regular", 3)
    eyes = np.array([[10.0, 0.5, 2.0], [3.3, -1.2, 1.8]])
    here = ts.factors(store_of(tmp_path / "here", points, 20.0), eyes)[NAMES]
    far = ts.factors(store_of(tmp_path / "far", in_map(points, UTM), 20.0), eyes + UTM)[NAMES]
    np.testing.assert_allclose(far.to_numpy(), here.to_numpy(), rtol=1e-7)


@pytest.mark.parametrize("place", sorted(PLACES))
@pytest.mark.parametrize("cell_size", [1.0, 2.0, 3.0])
def test_cells_agree(place: str, cell_size: float) -> None:
    points = scene(place, 21, offset=UTM)
    cells, expected = cells_of(points, cell_size), literal_cells(points, cell_size)
    assert np.array_equal(cells.index, expected.index)
    assert np.array_equal(cells.count, expected.count)
    np.testing.assert_allclose(cells.mean, expected.mean, rtol=0, atol=1e-9)
    for ours, theirs in (
        (cells.covariance, expected.covariance),
        (cells.eigenvalues, expected.eigenvalues),
        (cells.regularised, expected.regularised),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(cells.normal, expected.normal, atol=1e-8)


def test_ingest_thins_as_the_definitions_say(tmp_path: Path) -> None:
    points = scene("park", 22, offset=UTM)
    store = store_of(tmp_path, points, 12.0, leaf=0.6)
    stored = np.vstack([store.tile(key).points() for key in store.keys()])
    expected = literal_thinned(points, 0.6)
    assert np.array_equal(stored[np.lexsort(stored.T)], expected[np.lexsort(expected.T)])
    assert len(expected) < 0.8 * len(points)
