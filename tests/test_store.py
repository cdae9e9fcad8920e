"""The tile store: marks, halo reads, versions, remote protocols."""

import json
import pickle
import uuid
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tilestream as ts
from tilestream.errors import (
    DamagedError,
    StoreError,
    StoreNotFoundError,
    StoreVersionError,
    TileNotReadyError,
    UsageError,
)
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import TileKey
from tilestream.marks import MISSING, Mark, hash_of, identity_of
from tilestream.store import POINTS, Tile, cells_table
from tilestream.tables import read_mark


def make_store(folder: Path, points: np.ndarray, **settings: float) -> ts.TileStore:
    write_pcd(folder / "map.pcd", points)
    return ts.ingest(folder / "map.pcd", folder / f"{uuid.uuid4().hex}.zarr", **settings)


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    rng = np.random.default_rng(7)
    return np.round(rng.uniform((-30.0, -30.0, -2.0), (45.0, 38.0, 9.0), (5000, 3)), 3)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, cloud: np.ndarray) -> ts.TileStore:
    folder = tmp_path_factory.mktemp("store")
    return make_store(folder, cloud, tile_size=10.0, halo=4.0, map_leaf=0.0)


def as_set(points: np.ndarray) -> list[tuple[float, ...]]:
    return sorted(map(tuple, points.tolist()))


def test_tiles_own_every_point_once(store: ts.TileStore, cloud: np.ndarray) -> None:
    stored = np.concatenate([store.tile(key).points() for key in store.keys()])
    assert as_set(stored) == as_set(cloud)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    tile=st.sampled_from([2.0, 3.5, 10.0, 64.0]),
    halo=st.sampled_from([0.0, 0.4, 3.0, 11.0]),
    seed=st.integers(0, 5),
)
def test_a_halo_read_equals_a_brute_force_selection(
    tmp_path: Path, tile: float, halo: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    cloud = np.round(rng.uniform(-6.0, 6.0, (300, 3)), 3)
    made = make_store(tmp_path, cloud, tile_size=tile, halo=halo, map_leaf=0.0)
    for key in made.keys()[::5]:
        lo = np.array(key) * tile - halo
        hi = lo + tile + 2 * halo
        inside = ((cloud[:, :2] >= lo - 1e-9) & (cloud[:, :2] < hi - 1e-9)).all(axis=1)
        assert as_set(made.tile(key).points(halo=True)) == as_set(cloud[inside])


def test_a_failed_or_lost_neighbour_is_an_error(tmp_path: Path, cloud: np.ndarray) -> None:
    made = make_store(tmp_path, cloud[:500], tile_size=40.0, halo=4.0)
    key, other = made.keys()[:2]
    Tile(made, other).write_reason(POINTS, Mark("failed", "disk on fire"))
    assert len(made.tile(key).points())
    with pytest.raises(TileNotReadyError, match="disk on fire"):
        made.tile(key).points(halo=True)
    with pytest.raises(TileNotReadyError, match="disk on fire"):
        made.tile(other)
    made.remove(other)
    with pytest.raises(TileNotReadyError, match="lost"):
        made.tile(key).points(halo=True)


def test_tile_at_is_the_tile_that_owns_the_place(store: ts.TileStore) -> None:
    assert store.tile_at(-0.001, 9.999).key == TileKey(-1, 0)
    assert store.tile_at(0.0, 10.0).key == TileKey(0, 1)
    with pytest.raises(TileNotReadyError, match=r"tile 900_900 is missing"):
        store.tile_at(9005.0, 9005.0)
    with pytest.raises(UsageError, match="no place in the map"):
        store.tile_at(float("nan"), 0.0)


def test_a_table_without_its_mark_reads_as_missing(tmp_path: Path, cloud: np.ndarray) -> None:
    made = make_store(tmp_path, cloud[:100], tile_size=100.0)
    key = made.keys()[0]
    (Path(made.url) / str(key) / POINTS / "zarr.json").unlink()
    assert key not in made.keys()
    with pytest.raises(TileNotReadyError, match="missing"):
        made.tile(key)


def test_a_lost_chunk_is_an_error_and_not_zeros(tmp_path: Path, cloud: np.ndarray) -> None:
    made = make_store(tmp_path, cloud[:100], tile_size=100.0)
    tile = made.tile(made.keys()[0])
    (Path(made.url) / str(tile.key) / POINTS / "c" / "0").unlink()
    with pytest.raises(DamagedError, match=f"{tile.key}/points/c/0 is lost"):
        tile.points()


def test_tables_come_back_with_their_mark(tmp_path: Path, cloud: np.ndarray) -> None:
    made = make_store(tmp_path, cloud[:100], tile_size=100.0)
    tile = made.tile(made.keys()[0])
    columns = {"short": np.arange(3, dtype=np.int16), "flag": np.array([True, False, True])}
    columns |= {"count": np.arange(3), "mean": np.ones((3, 3)), "empty": np.zeros((0, 4))}
    tile.write_table("cells_1000", columns, Mark("done", identity="a", facts={"cells": 3}))
    read = tile.read_table("cells_1000")
    assert list(read) == list(columns)
    for name, column in columns.items():
        assert read[name].dtype == column.dtype
        assert read[name].flags.aligned
        np.testing.assert_array_equal(read[name], column)
    assert tile.mark("cells_1000").facts["cells"] == 3
    tile.write_reason("cells_1000", Mark("skipped", "too few points"))
    with pytest.raises(TileNotReadyError, match="skipped: too few points"):
        tile.read_table("cells_1000")


def test_the_same_work_is_known_by_its_identity() -> None:
    assert Mark("done", identity="a", facts={"points": 3}).is_of("a")
    assert not Mark("done", identity="a").is_of("b")
    assert not Mark("failed", "why", identity="a").is_of("a")
    assert hash_of("a", 1.5, [2]) == hash_of("a", 1.5, (2,)) != hash_of("a", 1.5, [3])
    one, rows = ("stage", 1, {"a": 1}, {"b": ["x"]}), np.arange(6)
    others = [("other", *one[1:]), ("stage", 2, *one[2:]), (*one[:2], {"a": 2}, one[3])]
    others += [(*one[:3], {"b": ["y"]}), (*one[:2], {"a": rows}, one[3])]
    others += [(*one[:2], {"a": rows.reshape(2, 3)}, one[3])]
    assert len({identity_of(*what) for what in (one, *others)}) == 1 + len(others)
    with pytest.raises(TypeError, match="no canonical form"):
        hash_of(object())


def test_cells_are_read_from_their_table_while_it_is_up_to_date(
    tmp_path: Path, cloud: np.ndarray
) -> None:
    tile = make_store(tmp_path, cloud, tile_size=100.0, map_leaf=0.0).tile_at(1.0, 1.0)
    made = tile.cells(2.0)
    table, key = cells_table(2000), tile.key
    identity = table.identity(tile.store.grid, key, {key: tile.mark(POINTS).identity})
    columns = {"index": made.index, "count": made.count + 1, "mean": made.mean}
    columns |= {"covariance": made.covariance}
    tile.write_table(table.name, columns, Mark("done", identity=identity))
    np.testing.assert_array_equal(tile.cells(2.0).count, made.count + 1)
    tile.write_table(table.name, columns, Mark("done", identity="of other points"))
    np.testing.assert_array_equal(tile.cells(2.0).count, made.count)


def test_what_is_no_store_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(StoreNotFoundError, match=r"no tile store at .*nowhere.zarr"):
        ts.open_store(str(tmp_path / "nowhere.zarr"))
    (tmp_path / "other.zarr").mkdir()
    (tmp_path / "other.zarr" / "zarr.json").write_text('{"attributes": {}}')
    with pytest.raises(StoreError, match="of no tile store"):
        ts.open_store(str(tmp_path / "other.zarr"))
    (tmp_path / "busy").mkdir()
    (tmp_path / "busy" / "letter.txt").write_text("dear reader")
    write_pcd(tmp_path / "a.pcd", np.zeros((1, 3)))
    with pytest.raises(StoreError, match="choose another path"):
        ts.ingest(tmp_path / "a.pcd", tmp_path / "busy")
    assert (tmp_path / "busy" / "letter.txt").read_text() == "dear reader"


def test_a_newer_store_is_refused(tmp_path: Path, cloud: np.ndarray) -> None:
    made = make_store(tmp_path, cloud[:10], tile_size=100.0)
    path = Path(made.url) / "zarr.json"
    known = json.loads(path.read_text())
    known["attributes"]["tilestream"]["schema"] = 99
    path.write_text(json.dumps(known))
    with pytest.raises(StoreVersionError, match="schema 99"):
        ts.open_store(made.url)


def test_a_store_says_what_it_is(store: ts.TileStore) -> None:
    assert "56 tiles of 10 m, 5,000 points, CRS local" in repr(store)
    page = store._repr_html_()
    assert "<td>-3_-3</td><td>done</td>" in page
    assert "and 36 more" in page
    assert "Tile 0_0 (done:" in repr(store.tile((0, 0)))


def test_a_store_travels_to_workers(store: ts.TileStore) -> None:
    key = store.keys()[0]
    there = pickle.loads(pickle.dumps(store))
    np.testing.assert_array_equal(there.tile(key).points(), store.tile(key).points())


def test_memory_stores_work(tmp_path: Path, cloud: np.ndarray) -> None:
    write_pcd(tmp_path / "map.pcd", cloud[:1000])
    made = ts.ingest(tmp_path / "map.pcd", f"memory://{uuid.uuid4().hex}/map.zarr", map_leaf=0.0)
    stored = np.concatenate([made.tile(key).points() for key in made.keys()])
    assert as_set(stored) == as_set(cloud[:1000])


def test_a_store_over_the_s3_protocol_holds_the_same_tiles(
    tmp_path: Path, cloud: np.ndarray, s3_bucket: str
) -> None:
    write_pcd(tmp_path / "map.pcd", cloud)
    near = ts.ingest(tmp_path / "map.pcd", tmp_path / "map.zarr", tile_size=30.0)
    far = ts.ingest(tmp_path / "map.pcd", f"{s3_bucket}/map.zarr", tile_size=30.0)
    assert far.marks() == near.marks()
    for key in near.keys():
        np.testing.assert_array_equal(
            far.tile(key).points(halo=True), near.tile(key).points(halo=True)
        )
    assert ts.open_store(f"{s3_bucket}/map.zarr").sources() == near.sources()


def test_what_version_0_1_wrote_is_refused_with_what_to_do(
    tmp_path: Path, cloud: np.ndarray
) -> None:
    made = make_store(tmp_path, cloud[:10], tile_size=100.0)
    path = Path(made.url) / "zarr.json"
    path.write_text(path.read_text().replace('"schema": 3', '"schema": 2'))
    with pytest.raises(StoreVersionError, match=r"schema 2.*another path.*ingest"):
        ts.open_store(made.url)
    table = pa.table({"a": [1]}).replace_schema_metadata({"tilestream": '{"identity": "x"}'})
    pq.write_table(table, tmp_path / "old.parquet")
    assert read_mark(str(tmp_path / "old.parquet")) == MISSING
