"""The table of factors: what it answers where there is little to see, and how it says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import UTM, facade, ground, in_map, scene

import tilestream as ts
from tilestream.errors import TileNotReadyError, UsageError
from tilestream.factors import table as table_module
from tilestream.factors.catalogue import COLUMNS, COUNTS, columns_of, markdown
from tilestream.factors.feature_sufficiency import dimensions, shape_shares
from tilestream.factors.table import TermsCache, factors
from tilestream.factors.terms import reach_mm, terms_table, tile_terms
from tilestream.formats.points.pcd import write_pcd
from tilestream.marks import Mark
from tilestream.store import POINTS, Tile, TileStore

Floats = NDArray[np.float64]
EYE = np.array([[10.0, 0.0, 2.0]])
ROUTE = np.column_stack([np.linspace(1.0, 19.0, 19), np.full(19, 0.3), np.full(19, 2.0)])


def store_of(folder: Path, points: Floats, tile_size: float = 20.0) -> TileStore:
    folder.mkdir(exist_ok=True)
    write_pcd(folder / "map.pcd", points)
    return ts.ingest([folder / "map.pcd"], folder / "map.zarr", tile_size=tile_size, map_leaf=0)


@pytest.fixture(scope="module")
def canyon(tmp_path_factory: pytest.TempPathFactory) -> TileStore:
    return store_of(tmp_path_factory.mktemp("canyon"), scene("canyon", 31))


# --- The catalogue


def test_the_catalogue_documents_every_column_once() -> None:
    names = [column.name for column in COLUMNS]
    assert len(set(names)) == len(names)
    faithful = columns_of("faithful")
    assert [c.name for c in faithful] == [
        *("feature_count", "D1_count", "D2_count", "D3_count"),
        *("D1_ratio", "D2_ratio", "D3_ratio", "occupancy_ratio"),
        *("euclidean_dist", "mahalanobis_dist", "r_average"),
        *("normal_H_8", "normal_H_16", "normal_H_90", "angular_H", "FDOP"),
        *("score_H", "pfh_sim_H", "pfh_sim_mnht", "bhatt_sim"),
    ]
    assert COLUMNS == (*faithful, *columns_of("robust")) == columns_of("all")
    for column in COLUMNS:
        assert column.meaning.endswith(".")
        assert column.unit
        assert column.source
    lines = markdown().splitlines()
    assert len(lines) == 2 + len(COLUMNS)
    assert all(line.replace("\\|", "").count("|") == 7 for line in lines)


def test_each_set_has_its_columns_then_status_and_reason(canyon: TileStore) -> None:
    for which in ("faithful", "robust", "all"):
        table = factors(canyon, EYE, which=which)
        assert list(table.columns) == [c.name for c in columns_of(which)] + ["status", "reason"]
        assert table["status"].tolist() == ["done"]
        assert table["reason"].tolist() == [""]
        assert table.drop(columns=["status", "reason"]).notna().all(axis=None)


# --- Laws


def test_entropies_and_shares_are_within_their_ranges(canyon: TileStore) -> None:
    table = factors(canyon, ROUTE, which="all")
    for name, bins in (
        *(("normal_H_8", 64), ("normal_H_16", 256), ("normal_H_90", 8100), ("angular_H", 90)),
        *(("score_H", 441), ("score_soft_H", 441), ("pfh_sim_H", 125), ("wall_H", 36)),
    ):
        assert table[name].between(0.0, np.log2(bins) + 1e-12).all(), name
    for kind in ("count", "ratio"):
        total = sum(table[f"D{d}_{kind}"] for d in (1, 2, 3))
        expected = table["feature_count"] if kind == "count" else 1.0
        np.testing.assert_allclose(total, expected, rtol=1e-12)
    np.testing.assert_allclose(sum(table[f"D{d}_share"] for d in (1, 2, 3)), 1.0, rtol=1e-5)
    assert (table["FDOP"] * table["r_average"] <= 1.0 + 1e-9).all()
    assert (table["wall_minor"] <= table["wall_major"]).all()


def test_flat_ground_is_all_planes_and_a_wall_bounds_one_direction(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    flat = in_map(rng.uniform((0, 0, 0), (30, 30, 0), (9000, 3)))
    lot = factors(store_of(tmp_path / "lot", flat), [[15.0, 15.0, 2.0]], which="all").iloc[0]
    assert lot["D2_ratio"] == 1.0
    assert np.isnan(lot["wall_H"])
    assert lot["empty_sector"] == pytest.approx(2 * np.pi)
    assert np.isnan(lot["normal_HDOP"])
    wall = facade(rng, (0.0, 12.0), (60.0, 12.0), 9.0, 0.3)
    street = in_map(np.vstack([ground(rng, 60.0, 20.0, 0.4), wall]))
    row = factors(store_of(tmp_path / "street", street), [[30.0, 0, 2]], which="all").iloc[0]
    assert np.abs(np.sin(row["weak_axis"])) < 0.02  # along x, as the wall
    assert row["wall_balance"] < 0.05
    assert row["score_cov_xx"] > 10 * row["score_cov_yy"]


def test_shape_shares_of_clear_shapes() -> None:
    lam = np.array([[1.0, 0, 0], [1.0, 1.0, 0], [1.0, 1.0, 1.0], [0, 0, 0], [4.0, 1.0, 0.0]])
    assert shape_shares(lam).tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1], [0.5, 0.5, 0]]
    assert dimensions(lam).tolist() == [1, 2, 3, 3, 1]  # the tie of the last goes to 1D


def test_the_order_of_places_and_the_size_of_chunks_do_not_matter(
    canyon: TileStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [column.name for column in COLUMNS]
    whole = factors(canyon, ROUTE, which="all")[names].to_numpy()
    backwards = factors(canyon, ROUTE[::-1], which="all")[names].to_numpy()[::-1]
    monkeypatch.setattr(table_module, "CHUNK", 4)
    small = factors(canyon, ROUTE, which="all")[names].to_numpy()
    assert np.array_equal(whole, backwards, equal_nan=True)
    assert np.array_equal(whole, small, equal_nan=True)


@pytest.mark.parametrize("tile_size", [4.4, 6.6, 15.4])
def test_tiles_that_cut_the_voxels_of_the_depth_image_see_the_same(
    tmp_path: Path, tile_size: float
) -> None:
    points = scene("park", 32, size=14.0, offset=UTM)
    eyes = EYE + UTM
    near = ts.VLP16.model_copy(update={"range_max": 12.0})
    one, cut = (
        factors(store_of(tmp_path / f"{size}", points, size), eyes, near, 1.1, "all")
        for size in (110.0, tile_size)
    )
    assert one.equals(cut)
    assert one["feature_count"][0] > 20


# --- Little to see


def test_an_empty_vicinity_is_missing_and_says_why(canyon: TileStore) -> None:
    places = np.array([[5e4, 0, 2], [10.0, 0, 2], [10.0, 0, 4000.0], [10.0, 0, np.nan]])
    table = factors(canyon, places, which="all")
    assert table["status"].tolist() == ["missing", "done", "missing", "missing"]
    names = [column.name for column in COLUMNS]
    for row, why in ((0, "empty"), (2, "empty"), (3, "ground")):
        assert why in table["reason"][row]
        for name in names:
            value = table[name][row]
            assert value == 0.0 if name in COUNTS else np.isnan(value), name


def test_a_single_cell_has_all_that_it_can_have(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    points = in_map(rng.uniform(0.2, 1.8, (20, 3)))
    row = factors(store_of(tmp_path, points), [[8.0, 1.0, 1.0]], which="all").iloc[0]
    assert row["feature_count"] == 1
    assert row["pfh_sim_mnht"] == row["bhatt_sim"] == 0.0
    for name in ("pfh_sim_H", "pfh_mean", "bhatt_mean", "sight_HDOP", "normal_HDOP"):
        assert np.isnan(row[name]), name
    assert row["angular_H"] == row["normal_H_90"] == 0.0
    assert row["status"] == "done"


def test_cells_of_identical_points_are_no_trouble(tmp_path: Path) -> None:
    points = np.repeat([[1.0, 1.0, 1.0], [3.0, 1.0, 1.0], [1.0, 3.0, 1.0], [5.0, 1.0, 2.0]], 7, 0)
    table = factors(store_of(tmp_path, points), [[-6.0, 0.0, 1.0]], which="all")
    assert table["D3_count"][0] == table["feature_count"][0] == 4
    values = table.drop(columns=["status", "reason"]).to_numpy()
    assert not np.isinf(values).any()


def test_a_failed_tile_fails_those_who_see_it_and_no_others(tmp_path: Path) -> None:
    points = np.vstack([scene("canyon", 33), scene("canyon", 34, offset=(2000.0, 0.0, 0.0))])
    store = store_of(tmp_path, points)
    key = store.grid.key_at(2010.0, 1.0)
    Tile(store, key).write_reason(POINTS, Mark("failed", "the disk was full"))
    table = factors(store, np.array([[10.0, 0, 2], [2010.0, 0, 2]]))
    assert table["status"].tolist() == ["done", "failed"]
    assert "the disk was full" in table["reason"][1]
    assert table.iloc[1, :20].isna().all()
    with pytest.raises(TileNotReadyError, match="disk"):
        tile_terms(store, key)


# --- Terms in the store and in memory


def test_terms_from_the_store_are_those_made_now(canyon: TileStore, tmp_path: Path) -> None:
    store = store_of(tmp_path, scene("canyon", 31))
    fresh = factors(store, ROUTE, which="all")
    table = terms_table(2000)
    for key in store.keys():
        arrays = tile_terms(store, key).arrays()
        now = Mark("done", identity=table.identity(store.grid, key, store.identities()))
        store.tile(key).write_table(table.name, arrays, now)
    assert factors(store, ROUTE, which="all").equals(fresh)
    odd = {**arrays, "mean": arrays["mean"] + 1.0}
    store.tile(key).write_table(table.name, odd, now)
    assert not factors(store, ROUTE, which="all").equals(fresh)
    store.tile(key).write_table(table.name, odd, replace(now, identity="of another map"))
    assert factors(store, ROUTE, which="all").equals(fresh), "out of date: made anew"


def test_a_small_cache_forgets_and_answers_the_same(canyon: TileStore) -> None:
    cache = TermsCache(canyon, limit_bytes=1)
    again = factors(canyon, ROUTE, cache=cache)
    assert again.equals(factors(canyon, ROUTE))
    assert sum(terms is not None for terms in cache._held.values()) <= 1


def test_terms_look_as_far_as_they_must() -> None:
    assert reach_mm(2000) == 10_000
    assert reach_mm(8000) == 16_000
    assert reach_mm(500) == 10_000


# --- Bad input


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros(3),
        np.zeros((2, 2)),
        [["a", "b", "c"]],
        [[np.nan, 0.0, 2.0]],
        [[0.0, np.inf, 2.0]],
        [[0.0, 0.0, np.inf]],
    ],
)
def test_positions_that_are_none_are_refused(canyon: TileStore, bad: object) -> None:
    with pytest.raises(UsageError, match="position"):
        factors(canyon, bad)  # type: ignore[arg-type]


def test_unknown_sets_and_sizes_are_refused(canyon: TileStore) -> None:
    with pytest.raises(UsageError, match="which"):
        factors(canyon, EYE, which="paper")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="cell"):
        factors(canyon, EYE, cell_size=3.0)


def test_no_positions_are_no_rows(canyon: TileStore) -> None:
    table = factors(canyon, np.zeros((0, 3)))
    assert len(table) == 0
    assert len(table.columns) == 22
