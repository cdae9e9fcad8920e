"""The observe job: the same tables from any tiling, workers and interruptions; bad places named."""

import json
from pathlib import Path

import distributed
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scenes import PLACES

import tilestream as ts
from tilestream.errors import PlanError, UsageError
from tilestream.factors.observability import observability
from tilestream.factors.rows import samples_by_tile
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import route_of
from tilestream.marks import Mark
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.along_routes import observe_along, plan_observe
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import Observing
from tilestream.settings import DEFAULT_MEMORY, VirtualSettings
from tilestream.store import POINTS, Tile

SENSOR = ts.VLP16.model_copy(update={"name": "short", "azimuth_step_deg": 3.0})
SEEING = VirtualSettings(range_max=15.0, starts=8, draws=2, worlds=1)
HOW = {"spacing": 6.0, "sensor": SENSOR, "seeing": SEEING}


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
    return observe_along(store, [route], street.parent / "out", **HOW)


def test_rows_follow_the_route_and_say_what_is_observed_from_their_places(
    store: ts.TileStore, route: ts.Route, table: pd.DataFrame
) -> None:
    points = ts.sample_points(route, store, spacing=6.0)
    np.testing.assert_array_equal(table[["x", "y", "z"]], points.positions)
    np.testing.assert_array_equal(table["heading"], points.heading)
    assert (table["status"] == "done").all(), table["reason"].tolist()
    matcher = ts.RegistrationSettings.autoware()
    direct = observability(store, points.positions, points.heading, SENSOR, SEEING, matcher)
    pd.testing.assert_frame_equal(
        table[direct.columns.tolist()], direct, check_dtype=False, check_exact=True
    )


def test_no_tiling_and_no_number_of_workers_shows(
    street: Path, route: ts.Route, table: pd.DataFrame, tmp_path: Path, workers: distributed.Client
) -> None:
    other = ts.ingest(street, tmp_path / "map.zarr", tile_size=10.0)
    found = observe_along(other, [route], tmp_path / "out", client=workers, **HOW)
    pd.testing.assert_frame_equal(found, table, check_exact=True)


def rows_made(outcomes: list[Outcome]) -> int:
    return sum(outcome.facts.get("rows", 0) for outcome in outcomes if outcome.made)


def test_what_is_done_is_not_done_again_and_other_settings_are(
    street: Path, route: ts.Route, tmp_path: Path
) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=20.0)
    results: list[Outcome] = []

    def work(**changes: object) -> pd.DataFrame:
        results.clear()
        watch = lambda outcome, *_: results.append(outcome)  # noqa: E731
        how: dict[str, object] = HOW | {"watch": watch} | changes
        return observe_along(store, [route], tmp_path / "out", **how)

    first = work()
    assert rows_made(results) == len(first)
    pd.testing.assert_frame_equal(work(), first, check_exact=True)
    assert results
    assert not any(outcome.made for outcome in results)
    (tmp_path / "out" / "observability" / "0_-1.parquet").unlink()
    pd.testing.assert_frame_equal(work(), first, check_exact=True)
    there = (first["x"] < 20.0) & (first["y"] < 0.0)
    assert rows_made(results) == there.sum() > 0
    ours = ts.RegistrationSettings()
    assert work(registration=ours)["vd_mean"].tolist() != first["vd_mean"].tolist()
    blind = SEEING.model_copy(update={"blind_rear_deg": 180.0})
    assert work(seeing=blind)["ob_points"].mean() < 0.8 * first["ob_points"].mean()


def test_every_column_and_every_setting_is_in_the_file(table: pd.DataFrame, street: Path) -> None:
    (path, *_) = (street.parent / "out" / "observability").glob("*.parquet")
    schema = pq.read_schema(path)
    assert schema.names == table.columns.tolist()
    for field in schema:
        assert field.metadata[b"meaning"], field.name
    data_set = json.loads(schema.metadata[b"tilestream"])["facts"]["data_set"]
    assert data_set["sensor"]["name"] == "short"
    assert data_set["seeing"]["range_max"] == 15.0
    assert data_set["registration"]["solver"] == "raw"
    assert data_set["cell_size"] == 2.0


def test_a_tile_that_failed_fails_those_who_see_it_and_no_others(
    street: Path, tmp_path: Path
) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=20.0)
    Tile(store, ts.TileKey(2, 0)).write_reason(POINTS, Mark("failed", "disk on fire"))
    line = route_of("line", np.array([[1.0, 0.5, 0.2], [37.0, 0.5, 0.2]]))
    near = SEEING.model_copy(update={"range_max": 8.0})
    table = observe_along(store, [line], tmp_path / "out", **(HOW | {"seeing": near}))
    failed = table["status"] == "failed"
    # planes look 0.8 m beyond their tile: those of tile 1_0 cannot be had, nor what sees them
    assert failed.tolist() == [False] * 2 + [True] * 5
    assert table["reason"][failed].str.contains("tile 2_0 is failed: disk on fire").all()
    assert table.loc[failed, "vd_mean"].isna().all()
    assert (table.loc[~failed, "vd_mean"] > 0).all()


def test_places_without_map_are_rows_that_say_so(store: ts.TileStore, tmp_path: Path) -> None:
    away = route_of("away", np.array([[50.0, 0.0, np.nan], [300.0, 0.0, np.nan]]))
    table = observe_along(store, [away], tmp_path / "out", **(HOW | {"spacing": 50.0}))
    assert table["status"].tolist() == ["done"] + ["missing"] * 5
    assert table["reason"][1:].str.contains("no ground").all()
    assert table["vd_mean"][1:].isna().all()


def test_the_plan_says_what_it_needs(store: ts.TileStore, route: ts.Route, tmp_path: Path) -> None:
    observing = Observing(SENSOR, SEEING, ts.RegistrationSettings(), 2.0, 2.0)
    samples, known = samples_by_tile(store.grid, [route], 6.0), MapPlan.of_store(store)
    plan = plan_observe(known, samples, tmp_path, observing, DEFAULT_MEMORY)
    assert [stage for stage, *_ in plan.describe()] == ["cells", "surfels", "observe"]
    observe = [task for task in plan.tasks if task.stage == "observe"]
    assert sum(task.work for task in observe) == 9
    keys = {task.key for task in plan.tasks}
    assert all(set(task.needs) <= keys for task in observe)
    with pytest.raises(PlanError, match="allow more"):
        plan_observe(known, samples, tmp_path, observing, 10**8)
    for routes in ([], [route, route]):
        with pytest.raises(UsageError, match="its own name"):
            observe_along(store, routes, tmp_path / "out")
    with pytest.raises(UsageError, match="cell size of"):
        observe_along(store, [route], tmp_path / "out", cell_size=3.0)
