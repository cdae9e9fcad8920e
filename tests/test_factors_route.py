"""The factors job: the same tables from any tiling, workers and interruptions; bad places named."""

import json
import pickle
import tracemalloc
from pathlib import Path

import distributed
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scenes import PLACES

import tilestream as ts
from tilestream.cli import run
from tilestream.errors import SourceError, UsageError
from tilestream.factors.rows import samples_by_tile
from tilestream.factors.sample_points import raised
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import resample, route_of, write_geojson_route
from tilestream.grid import TileGrid
from tilestream.marks import Mark
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.records import Float64, RouteZ
from tilestream.store import POINTS, Tile

SENSOR = ts.VLP16.model_copy(update={"name": "short", "range_max": 25.0})


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street of 60 m as a PCD file."""
    path = tmp_path_factory.mktemp("street") / "street.pcd"
    write_pcd(path, PLACES["canyon"](np.random.default_rng(3), 60.0, 0.3))
    return path


@pytest.fixture(scope="module")
def store(street: Path) -> ts.TileStore:
    return ts.ingest(street, street.parent / "map.zarr", tile_size=20.0)


@pytest.fixture(scope="module")
def route() -> ts.Route:
    """Down the street, along no axis, out of the last tile by a few metres."""
    points = np.array([[5.0, -1.0, np.nan], [30.0, 1.5, np.nan], [58.0, 0.0, np.nan]])
    return route_of("down the street", points)


@pytest.fixture(scope="module")
def table(store: ts.TileStore, route: ts.Route, street: Path) -> pd.DataFrame:
    return ts.factors_along(store, [route], street.parent / "out", spacing=3.0, sensor=SENSOR)


def test_rows_follow_the_route_and_say_what_the_factors_of_their_places_are(
    store: ts.TileStore, route: ts.Route, table: pd.DataFrame
) -> None:
    assert table["sample"].tolist() == list(range(len(table)))
    np.testing.assert_allclose(np.diff(table["arc_length"]), 3.0)
    points = ts.sample_points(route, store, spacing=3.0)
    np.testing.assert_array_equal(table[["x", "y", "z"]], points.positions)
    np.testing.assert_array_equal(table["heading"], points.heading)
    assert (table["status"] == "done").all()
    direct = ts.factors(store, points.positions, sensor=SENSOR, which="all")
    pd.testing.assert_frame_equal(
        table[direct.columns.tolist()], direct, check_dtype=False, check_exact=True
    )


def test_the_tables_name_their_map(store: ts.TileStore, table: pd.DataFrame, street: Path) -> None:
    assert len(table)
    assert map_of(street.parent / "out").url == store.url


def winding(name: str, seed: int) -> ts.Route:
    """A route of some kilometres that crosses itself, without z."""
    steps = np.random.default_rng(seed).normal([15.0, 5.0], 30.0, (80, 2))
    return route_of(name, np.column_stack([steps.cumsum(axis=0), np.full(80, np.nan)]))


def test_the_tiles_part_the_sample_points_among_them() -> None:
    grid, routes = TileGrid.of(100.0, 10.0), [winding("a", 1), winding("b", 2)]
    wanted: dict[ts.TileKey, list[tuple[object, ...]]] = {}
    for each in routes:
        points = resample(each, 3.0)
        for n, (x, y, _) in enumerate(points.positions.tolist()):
            row = (each.route_id, n, points.arc_length[n], points.heading[n], x, y)
            wanted.setdefault(grid.key_at(x, y), []).append(row)
    found = samples_by_tile(grid, routes, 3.0)
    assert list(found) == sorted(wanted)
    for key, samples in found.items():
        rows = [(samples.route_ids[r], *rest) for r, *rest, _ in samples.rows.tolist()]
        assert rows == wanted[key]
        assert np.isnan(samples.rows["z"]).all()


def test_a_sample_point_of_a_plan_is_fifty_bytes() -> None:
    routes = [winding(str(n), n) for n in range(10)]
    tracemalloc.start()
    try:
        samples = samples_by_tile(TileGrid.of(100.0, 10.0), routes, 0.5)
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    count = sum(len(part) for part in samples.values())
    assert count > 50_000
    assert held < 52 * count
    assert sum(len(pickle.dumps(part)) for part in samples.values()) < 52 * count


def test_sample_points_lie_a_sensor_height_above_the_ground(
    store: ts.TileStore, route: ts.Route
) -> None:
    points = ts.sample_points(route, store, spacing=5.0, sensor_height=1.5).positions
    cloud = np.concatenate([store.tile(key).points() for key in store.keys()])
    for x, y, z in points:
        near = (cloud[:, 0] - x) ** 2 + (cloud[:, 1] - y) ** 2 <= 1.0
        assert z == pytest.approx(np.percentile(cloud[near, 2], 5.0) + 1.5, abs=1e-9)


@pytest.mark.parametrize("above", [-1.0, 0.0, 0.3, 1.7, 4.0])
def test_z_of_a_route_is_what_it_is_said_to_be(store: ts.TileStore, above: float) -> None:
    flat = route_of("flat", np.array([[10.0, 0.0, np.nan], [30.0, 0.0, np.nan]]))
    ground = ts.sample_points(flat, store, spacing=5.0, sensor_height=0.0).positions[:, 2]
    at = np.column_stack([np.linspace(10.0, 30.0, 5), np.zeros(5), ground + above])

    def heights(route_z: RouteZ) -> Float64:
        return raised(at, store, 2.0, route_z).lidar[:, 2] - ground

    np.testing.assert_allclose(heights("ground"), 2.0, atol=1e-9)
    np.testing.assert_allclose(heights("road"), above + 2.0, atol=1e-9)
    np.testing.assert_allclose(heights("lidar"), above, atol=1e-9)


@pytest.mark.parametrize("tile_size", [pytest.param(10.0, marks=pytest.mark.slow), 64.0])
def test_no_tiling_and_no_number_of_workers_shows(
    street: Path,
    route: ts.Route,
    table: pd.DataFrame,
    tmp_path: Path,
    tile_size: float,
    workers: distributed.Client,
) -> None:
    other = ts.ingest(street, tmp_path / "map.zarr", tile_size=tile_size)
    found = ts.factors_along(
        other, [route], tmp_path / "out", spacing=3.0, sensor=SENSOR, client=workers
    )
    pd.testing.assert_frame_equal(found, table, check_exact=True)


def rows_made(outcomes: list[Outcome]) -> int:
    return sum(outcome.facts.get("rows", 0) for outcome in outcomes if outcome.made)


def test_what_is_done_is_not_done_again_and_a_changed_map_is(
    street: Path, route: ts.Route, tmp_path: Path
) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=20.0)
    results: list[Outcome] = []

    def work(**changes: object) -> pd.DataFrame:
        results.clear()
        watch = lambda outcome, *_: results.append(outcome)  # noqa: E731
        how: dict[str, object] = {"spacing": 6.0, "sensor": SENSOR, "watch": watch} | changes
        return ts.factors_along(store, [route], tmp_path / "out", **how)

    first = work()
    pd.testing.assert_frame_equal(work(), first)
    assert results
    assert not any(outcome.made for outcome in results)
    (tmp_path / "out" / "factors" / "0_-1.parquet").unlink()
    pd.testing.assert_frame_equal(work(), first)
    there = (first["x"] < 20.0) & (first["y"] < 0.0)
    assert rows_made(results) == there.sum() > 0
    assert work(sensor_height=1.0)["z"].tolist() != first["z"].tolist()


def test_a_route_elsewhere_redoes_nothing_here(
    store: ts.TileStore, route: ts.Route, tmp_path: Path
) -> None:
    rows: dict[str, object] = {}
    watch = lambda outcome, *_: rows.update({outcome.key: outcome.made})  # noqa: E731
    how: dict[str, object] = {"spacing": 6.0, "sensor": SENSOR, "watch": watch}
    alone = ts.factors_along(store, [route], tmp_path, **how)
    here = {key for key in rows if key.startswith("factors")}
    away = route_of("away", np.array([[100.0, 50.0, 0.0], [112.0, 50.0, 0.0]]))
    both = ts.factors_along(store, [away, route], tmp_path, **how)
    assert {rows[key] for key in here} == {False}
    pd.testing.assert_frame_equal(both[3:].reset_index(drop=True), alone, check_exact=True)


def test_every_column_is_documented_in_the_file(table: pd.DataFrame, street: Path) -> None:
    (path, *_) = (street.parent / "out" / "factors").glob("*.parquet")
    schema = pq.read_schema(path)
    assert schema.names == table.columns.tolist()
    for field in schema:
        assert field.metadata[b"meaning"], field.name
    data_set = json.loads(schema.metadata[b"tilestream"])["facts"]["data_set"]
    assert data_set["sensor"]["name"] == "short"
    assert data_set["cell_size"] == 2.0


def test_a_tile_that_failed_fails_those_who_see_it_and_no_others(
    street: Path, tmp_path: Path
) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=10.0)
    Tile(store, ts.TileKey(5, 0)).write_reason(POINTS, Mark("failed", "disk on fire"))
    line = route_of("line", np.array([[1.0, 0.5, 0.2], [51.0, 0.5, 0.2]]))
    near = SENSOR.model_copy(update={"range_max": 12.0})
    table = ts.factors_along(store, [line], tmp_path / "out", spacing=5.0, sensor=near)
    failed = table["status"] == "failed"
    assert table["reason"][failed].str.contains("tile 5_0 is failed: disk on fire").all()
    # terms look 10 m beyond their tile: tile 4_0 cannot be had either, nor who sees it
    assert failed.tolist() == [False] * 6 + [True] * 5
    assert table.loc[failed, "feature_count"].isna().all()
    assert (table.loc[~failed, "feature_count"] > 0).all()


def test_places_without_map_are_rows_that_say_so(store: ts.TileStore, tmp_path: Path) -> None:
    away = route_of("away", np.array([[50.0, 0.0, np.nan], [300.0, 0.0, np.nan]]))
    table = ts.factors_along(store, [away], tmp_path / "out", spacing=50.0, sensor=SENSOR)
    assert table["status"].tolist() == ["done"] + ["missing"] * 5
    assert table["reason"][1:].str.contains("no ground").all()
    assert (table["feature_count"][1:] == 0).all()
    assert table["FDOP"][1:].isna().all()
    high = ts.factors(store, [[30.0, 0.0, 500.0]], sensor=SENSOR)
    assert high["status"].tolist() == ["missing"]
    assert "vicinity is empty" in high["reason"][0]


def test_routes_need_names_of_their_own(
    store: ts.TileStore, route: ts.Route, tmp_path: Path
) -> None:
    for routes in ([], [route, route]):
        with pytest.raises(UsageError, match="its own name"):
            ts.factors_along(store, routes, tmp_path / "out")
    with pytest.raises(UsageError, match="cell size of"):
        ts.factors_along(store, [route], tmp_path / "out", cell_size=3.0)
    (tmp_path / "tokyo.csv").write_text("x,y\n139.70,35.69\n139.71,35.70\n139.72,35.70\n")
    with pytest.raises(SourceError, match="degrees"):
        ts.read_routes(tmp_path / "tokyo.csv")


def test_the_command(
    store: ts.TileStore, route: ts.Route, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_geojson_route(tmp_path / "route.geojson", [route])
    (tmp_path / "short.yaml").write_text(json.dumps(SENSOR.model_dump()))
    command = ["factors", store.url, "--route", str(tmp_path / "route.geojson")]
    command += ["--out", str(tmp_path / "out"), "--sensor", str(tmp_path / "short.yaml")]
    assert run([*command, "--spacing", "6", "--dry-run"]) == 0
    assert "terms" in capsys.readouterr().out
    assert run([*command, "--spacing", "6", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "sample_points": 9,
        "done": 9,
        "notes": {},
    }
    assert run([*command, "--spacing", "6"]) == 0
    assert "feature_count" in capsys.readouterr().out
    assert run([*command, "--sensor", "VLP17"]) == 2
    assert "known are VLP16, HDL64, OS1_128" in capsys.readouterr().err
    far = route_of("far", np.array([[200.0, 0.0, np.nan], [290.0, 0.0, np.nan]]))
    write_geojson_route(tmp_path / "route.geojson", [far])
    assert run([*command, "--spacing", "60"]) == 1
    assert "1 m to raise the sample point from (far 0, far 1)" in capsys.readouterr().err
