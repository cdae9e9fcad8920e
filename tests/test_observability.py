"""Observability and the virtual drive: closed forms, invariances, any tiling, bad places named."""

import math
import sys
from itertools import combinations_with_replacement, product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scenes import PLACES

import tilestream as ts
from tilestream.errors import UsageError
from tilestream.factors.beams import Beams
from tilestream.factors.hessian import hessian_factors, information
from tilestream.factors.observability import (
    COLUMNS,
    observability,
)
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import Surfels, can_be_met, in_view, surfels_in
from tilestream.factors.virtual_drive import (
    AXES,
    MOMENT_COLUMNS,
    PART_COLUMNS,
    RINGS,
    SPREAD_COLUMNS,
    Ends,
    ends_of,
    stratified_starts,
    virtual_drive,
    weighted_median,
)
from tilestream.factors.virtual_drive import COLUMNS as VIRTUAL
from tilestream.factors.virtual_scan import cast
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import Box
from tilestream.label import localization_error
from tilestream.marks import Mark
from tilestream.registration import register
from tilestream.settings import VirtualSettings
from tilestream.store import POINTS, Tile

SENSOR = ts.VLP16.model_copy(update={"name": "short", "range_max": 15.0, "azimuth_step_deg": 3.0})
SEEING = VirtualSettings(starts=8, draws=2, worlds=1)
PLACE = (20.0, 0.5, 2.0)


def look(store: ts.TileStore, places: object, headings: object, **changes: object) -> pd.DataFrame:
    how: dict[str, object] = {"sensor": SENSOR, "seeing": SEEING} | changes
    return observability(store, places, headings, **how)  # type: ignore[arg-type]


def cloud(folder: Path, place: str, size: float = 40.0) -> Path:
    path = folder / f"{place}.pcd"
    write_pcd(path, PLACES[place](np.random.default_rng(3), size, 0.25))
    return path


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cloud(tmp_path_factory.mktemp("street"), "canyon")


@pytest.fixture(scope="module")
def store(street: Path) -> ts.TileStore:
    return ts.ingest(street, street.parent / "map.zarr", tile_size=20.0)


@pytest.fixture(scope="module")
def tunnel(tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    folder = tmp_path_factory.mktemp("tunnel")
    return ts.ingest(cloud(folder, "tunnel"), folder / "map.zarr")


# --- The Hessian


def test_information_of_independent_axes_is_their_own() -> None:
    L = np.diag([4.0, 9.0, 25.0, 100.0, 200.0, 400.0])
    found = information(L, 0.0)
    assert found["ob_info_along"] == pytest.approx(4.0)
    assert found["ob_info_yaw"] == pytest.approx(400.0)
    assert found["ob_cov_across"] == pytest.approx(1.0 / 9.0)
    assert found["ob_weak_info"] == pytest.approx(4.0)
    assert found["ob_weak_angle"] == pytest.approx(0.0)
    turned = information(L, math.pi / 2)
    assert turned["ob_info_along"] == pytest.approx(9.0)
    assert turned["ob_weak_angle"] == pytest.approx(math.pi / 2)


def test_information_leaves_the_other_axes_free() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 9))
    L = half @ half.T
    for heading in (0.0, 0.7, -2.0):
        found = information(L, heading)
        for name in ("along", "across", "up", "yaw"):
            assert found[f"ob_info_{name}"] * found[f"ob_cov_{name}"] == pytest.approx(1.0)
        assert found["ob_weak_info"] <= min(found["ob_info_along"], found["ob_info_across"]) + 1e-9
    values, axes = np.linalg.eigh(np.linalg.inv(np.linalg.inv(L)[:2, :2]))
    along_weak = math.atan2(axes[1, 0], axes[0, 0])
    found = information(L, along_weak)
    assert found["ob_weak_info"] == pytest.approx(values[0])
    assert found["ob_weak_angle"] == pytest.approx(0.0, abs=1e-9)
    assert found["ob_info_along"] == pytest.approx(values[0])


def test_a_saddle_has_no_variance_and_says_so() -> None:
    found = information(np.diag([-1.0, 9.0, 25.0, 100.0, 200.0, 400.0]), 0.0)
    assert found["ob_info_along"] == -1.0
    assert math.isnan(found["ob_cov_along"])
    assert math.isnan(found["ob_cov_yaw"])
    singular = information(np.diag([1.0, 9.0, 0.0, 1.0, 1.0, 1.0]), 0.0)
    assert math.isnan(singular["ob_info_along"])
    assert math.isnan(singular["ob_weak_info"])


def test_the_hessian_is_that_of_the_matcher_on_all_cells(store: ts.TileStore) -> None:
    cells = store.cells_in(Box(-10_000, -30_000, 50_000, 30_000), 2.0)
    points = np.random.default_rng(1).uniform((-8, -8, -2), (8, 8, 4), (400, 3))
    T = np.eye(4)
    T[:3, 3] = PLACE
    for settings in (ts.RegistrationSettings(), ts.RegistrationSettings.autoware()):
        found = hessian_factors(cells, points, T, settings)
        still = settings.model_copy(update={"iterations_max": 0})
        whole = register(cells, points, T, still)
        expected = information(-whole.hessian[0], 0.0)
        assert {name: found[name] for name in expected} == pytest.approx(expected, nan_ok=True)
        assert found["ob_score"] == whole.score[0] / whole.points
        assert found["ob_nvtl"] == whole.nvtl[0]
        assert found["ob_points"] == whole.points
        held = {tuple(v) for v in np.floor((points + PLACE) / 2.0).astype(int).tolist()}
        assert found["ob_cells"] == len(held & {tuple(v) for v in cells.index.tolist()})


def test_a_tunnel_holds_across_and_not_along(tunnel: ts.TileStore) -> None:
    row = look(tunnel, [[20.0, 0.2, 2.0]], [0.0]).iloc[0]
    assert row["status"] == "done", row["reason"]
    assert row["ob_info_along"] < 0.2 * row["ob_info_across"]
    assert row["ob_weak_angle"] < math.radians(10.0)
    assert row["vd_along"] > 1.5 * row["vd_across"]
    other_way = look(tunnel, [[20.0, 0.2, 2.0]], [math.pi / 2]).iloc[0]
    assert other_way["ob_info_across"] < 0.2 * other_way["ob_info_along"]
    assert other_way["ob_weak_angle"] > math.radians(80.0)


# --- The virtual drive


def test_the_starts_stand_for_the_whole_disc() -> None:
    whole = stratified_starts(None)
    assert len(whole.offset) == 317
    np.testing.assert_allclose(whole.weight, 1.0 / 317)
    known = {tuple(start) for start in whole.offset.tolist()}
    for count, draw in product((16, 32, 64), (0, 1, 4)):
        starts = stratified_starts(count, draw)
        radius = np.hypot(*starts.offset.T)
        assert len(starts.offset) == count
        assert len({tuple(start) for start in starts.offset.tolist()} & known) == count
        assert starts.weight.sum() == pytest.approx(1.0)
        mean = np.hypot(*whole.offset.T).mean()
        assert starts.weight @ radius == pytest.approx(mean, abs=0.05)
        assert np.abs(starts.weight @ starts.offset).max() < 0.1
        inside = [radius <= 1.0 + 1e-9, radius <= 1.5 + 1e-9]
        np.testing.assert_array_equal(starts.ring, 2 - inside[0].astype(int) - inside[1])
    assert np.bincount(stratified_starts(32).ring).tolist() == [8, 8, 16]
    several = [{tuple(s) for s in stratified_starts(32, k).offset.tolist()} for k in range(5)]
    assert len(set.union(*several)) > 100


def test_with_all_starts_it_is_the_label_of_the_virtual_scan(store: ts.TileStore) -> None:
    cells = store.cells_in(Box(-10_000, -30_000, 50_000, 30_000), 2.0)
    points = store.tile_at(20.0, 0.5).points()[::7] - PLACE
    T = np.eye(4)
    T[:3, 3] = PLACE
    settings = ts.RegistrationSettings.autoware()
    found = virtual_drive([ends_of(cells, points, T, settings, stratified_starts(None))])
    label = localization_error(cells, points, T, settings=settings)
    for name, expected in (
        ("vd_mean", label.error_mean),
        ("vd_floor", label.error_floor),
        ("vd_tail", label.error_tail),
        ("vd_p_fail", label.p_fail),
        ("vd_along", label.along_mean),
        ("vd_across", label.across_mean),
        ("vd_up", label.up_mean),
    ):
        assert found[name] == pytest.approx(expected, abs=1e-12), name
    held = np.sort(label.error[label.error <= 0.5])
    assert held[(len(held) - 1) // 2] <= found["vd_median"] <= held[len(held) // 2]
    near = np.hypot(*(label.T_map_lidar_starts[:, :2, 3] - T[:2, 3]).T) <= 1.0 + 1e-9
    core = near & (label.error <= 0.5)
    assert 0.0 < found["vd_near_p_fail"] < 1.0
    assert found["vd_near_p_fail"] == pytest.approx(1.0 - core.sum() / near.sum(), abs=1e-12)
    assert found["vd_near_across"] == pytest.approx(label.across[core].mean(), abs=1e-12)
    product_of = (label.along * label.up)[core].mean()
    assert found["vd_near_along_up"] == pytest.approx(product_of, abs=1e-12)
    ends_at = label.registrations
    assert found["vd_near_tp"] == pytest.approx(ends_at.score[core].mean() / ends_at.points)
    nvtl = (ends_at.nvtl / ends_at.hits)[core] * ends_at.points
    assert found["vd_near_nvtl"] == pytest.approx(nvtl.mean())
    assert found["vd_near_nvtl_sd"] == pytest.approx(nvtl.std())


def ends(seed: int, count: int = 32) -> Ends:
    """A draw whose registrations end anywhere."""
    rng = np.random.default_rng(seed)
    axes, scores = rng.normal(0.0, 0.2, (count, 6)), rng.uniform(1.0, 3.0, (2, count))
    return Ends(stratified_starts(count, seed), np.linalg.norm(axes[:, :3], axis=1), axes, *scores)


def test_a_place_is_the_mean_of_its_draws_and_tells_their_spread() -> None:
    draws = [ends(k) for k in range(4)]
    found, alone = virtual_drive(draws), [virtual_drive([one]) for one in draws]
    for name in (column.name for column in PART_COLUMNS):
        each = np.array([one[name] for one in alone])
        assert found[name] == pytest.approx(each.mean())
        assert found[f"{name}_sd"] == pytest.approx(each.std(ddof=1))
        assert all(math.isnan(one[f"{name}_sd"]) for one in alone)
    assert found["vd_draws"] == 4.0
    assert set(found) == {column.name for column in VIRTUAL}


def test_the_moments_are_those_of_the_starts_of_a_ring_that_hold() -> None:
    draws = [ends(k) for k in range(3)]
    found = virtual_drive(draws)
    axes = np.vstack([one.axes for one in draws])
    ring = np.concatenate([one.starts.ring for one in draws])
    held = np.concatenate([one.error for one in draws]) <= 0.5
    assert 0 < held.sum() < len(held)
    for number, name in enumerate(RINGS):
        here = (ring == number) & held
        assert found[f"vd_{name}_p_fail"] == pytest.approx(
            1.0 - here.sum() / (ring == number).sum()
        )
        mean = np.array([found[f"vd_{name}_{axis}"] for axis in AXES])
        np.testing.assert_allclose(mean, axes[here].mean(axis=0))
        second = np.zeros((6, 6))
        for (i, a), (j, b) in combinations_with_replacement(enumerate(AXES), 2):
            second[i, j] = second[j, i] = found[f"vd_{name}_{a}_{b}"]
        covariance = second - np.outer(mean, mean)
        np.testing.assert_allclose(covariance, np.cov(axes[here].T, ddof=0), atol=1e-12)


def test_a_weighted_median_has_half_of_the_weight_on_each_side() -> None:
    values, weight = np.array([3.0, 1.0, 2.0]), np.array([0.1, 0.2, 0.7])
    assert weighted_median(values, weight) == 2.0
    assert weighted_median(values, np.array([0.1, 0.8, 0.1])) == 1.0
    assert math.isnan(weighted_median(values[:0], weight[:0]))


# --- The table


def test_every_column_is_there_and_documented(store: ts.TileStore) -> None:
    table = look(store, [PLACE], [0.1])
    assert table.columns.tolist() == [c.name for c in COLUMNS] + ["status", "reason"]
    assert table["status"].tolist() == ["done"]
    assert table[[c.name for c in COLUMNS]].notna().all(axis=None)
    assert all(c.factor_set == "observability" for c in COLUMNS)
    assert {c.name for c in COLUMNS if c.criterion != "OB"} == {
        c.name for c in (*SPREAD_COLUMNS, *MOMENT_COLUMNS)
    } | {"vd_draws"}
    assert all(c.unit and c.meaning and c.source for c in COLUMNS)


def test_all_draws_may_be_in_other_streets_or_none(store: ts.TileStore) -> None:
    rows = {
        worlds: look(store, [PLACE], [0.1], seeing=SEEING.model_copy(update={"worlds": worlds}))
        for worlds in (0, 1, 2)
    }
    for table in rows.values():
        assert table["status"].tolist() == ["done"]
        assert table["vd_draws"].tolist() == [2.0]
    assert len({table["vd_near_along_along"][0] for table in rows.values()}) == 3
    for name in ("ob_returns", "ob_score", "ob_info_along"):  # of the street as it was mapped
        assert len({table[name][0] for table in rows.values()}) == 1
    alone = look(store, [PLACE], [0.1], seeing=SEEING.model_copy(update={"draws": 1, "worlds": 0}))
    assert math.isnan(alone["vd_mean_sd"][0])
    assert alone["vd_mean"][0] > 0.0


def test_a_draw_that_cannot_be_registered_is_left_out(
    store: ts.TileStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A car that stands around the lidar leaves no scan; the other draw counts alone."""
    empty = np.zeros((0, 3))
    monkeypatch.setattr(sys.modules[observability.__module__], "scan_in_world", lambda *_: empty)
    table = look(store, [PLACE], [0.1])
    assert table["status"].tolist() == ["done"]
    assert table["vd_draws"].tolist() == [1.0]
    table = look(store, [PLACE], [0.1], seeing=SEEING.model_copy(update={"worlds": 2}))
    assert table["status"].tolist() == ["failed"]
    assert "0 points" in table["reason"][0]
    assert math.isnan(table["vd_mean"][0])


def test_neither_tiling_nor_company_nor_order_shows(street: Path, tmp_path: Path) -> None:
    places = np.array([[12.0, 0.5, 2.0], [20.0, 0.5, 2.0], [28.0, -1.0, 2.0]])
    headings = np.array([0.1, 0.0, 3.0])
    tables = []
    for size in (100.0, 10.0):
        other = ts.ingest(street, tmp_path / f"{size}.zarr", tile_size=size)
        tables.append(look(other, places, headings))
        back = look(other, places[::-1], headings[::-1])[::-1].reset_index(drop=True)
        pd.testing.assert_frame_equal(back, tables[-1], check_exact=True)
    alone = look(other, places[1:2], headings[1:2])
    pd.testing.assert_frame_equal(tables[0], tables[1], check_exact=True)
    assert alone.iloc[0].tolist() == tables[0].iloc[1].tolist()


def test_what_is_mapped_is_what_this_place_has_in_view(tmp_path: Path) -> None:
    """Where the road ends, a block stands that only the other place sees."""
    rng = np.random.default_rng(5)
    ground = rng.uniform((0, 0, 0), (40, 60, 0.02), (60_000, 3))
    block = rng.uniform((48.5, 20.5, 0), (49.5, 21.5, 2), (6_000, 3))
    write_pcd(tmp_path / "ground.pcd", np.vstack([ground, block]))
    store = ts.ingest(tmp_path / "ground.pcd", tmp_path / "map.zarr")
    places = np.array([[26.0, 25.0, 2.0], [39.0, 25.0, 2.0]])  # which share a scene
    together = look(store, places, [0.0, 0.0])["ob_unmapped"]
    alone = [look(store, places[k : k + 1], [0.0])["ob_unmapped"][0] for k in range(2)]
    assert together.tolist() == alone
    assert 0.0 < alone[0] < 1.0


def test_a_wider_crop_of_the_map_shows_nothing_more(store: ts.TileStore) -> None:
    everything = surfels_in(store, Box(-10_000, -30_000, 50_000, 30_000))
    place = np.array([PLACE])
    seen = in_view(everything, place, SENSOR.fov_deg, SENSOR.range_max)
    assert 0 < len(seen) < 0.8 * len(everything)
    place_mm, beams = np.rint(place[0] * 1000).astype(np.int64), Beams.of(SENSOR, SEEING)
    found = []
    for surfels in (everything, seen):
        scene = Scene.of(surfels, place_mm[None], 200)
        ranges, cosine = np.empty(len(beams.direction)), np.empty(len(beams.direction))
        row = np.empty(len(beams.direction), np.int32)
        cast(scene.bricks, place_mm, beams.direction, 0.0, 15_000.0, ranges, cosine, row)
        found.append(ranges)
    np.testing.assert_array_equal(*found)
    nothing = everything.where(np.zeros(len(everything), np.bool_))
    assert len(in_view(nothing, place, SENSOR.fov_deg, 15.0)) == 0


def test_traffic_in_the_map_is_looked_through_and_reported(tmp_path: Path) -> None:
    """A car that passed, without a hole in the ground beneath it."""
    street = PLACES["canyon"](np.random.default_rng(3), 40.0, 0.15)
    car = np.random.default_rng(4).uniform((24, -1, 0.5), (28, 1, 1.6), (4000, 3))
    path = tmp_path / "street.pcd"
    write_pcd(path, np.vstack([street, car]))
    store = ts.ingest(path, tmp_path / "map.zarr")
    seen = SEEING.model_copy(update={"without_ghosts": False})
    left_out, kept = (look(store, [PLACE], [0.0], seeing=s).iloc[0] for s in (SEEING, seen))
    assert left_out["status"] == kept["status"] == "done"
    assert kept["ob_ghosts"] == 0.0
    assert 0.01 < left_out["ob_ghosts"] < 0.2
    assert left_out["vd_mean"] != kept["vd_mean"]


def test_the_rim_of_the_map_shows_in_the_unmapped_share(store: ts.TileStore) -> None:
    table = look(store, [[20.0, 0.5, 2.0], [39.5, 0.5, 2.0]], [0.0, 0.0])
    assert table["status"].tolist() == ["done", "done"]
    assert table["ob_unmapped"][0] < 0.05
    assert table["ob_unmapped"][1] > 0.3
    assert table["ob_returns"][1] < table["ob_returns"][0]


def test_bad_places_are_rows_that_say_so(store: ts.TileStore) -> None:
    places = [
        [20.0, 0.5, np.nan],
        [900.0, 0.5, 2.0],
        [20.0, 0.5, 60.0],
        [20.0, 7.99, 3.0],
        [20.0, 0.5, 2.0],
    ]
    table = look(store, places, np.zeros(5))
    assert table["status"].tolist() == ["missing", "missing", "missing", "failed", "done"]
    assert "no ground" in table["reason"][0]
    assert "nothing in view: 0 of 1920 beams" in table["reason"][1]
    assert "nothing in view" in table["reason"][2]
    assert "inside a wall" in table["reason"][3]
    assert table["vd_mean"][:4].isna().all()
    thin = SENSOR.model_copy(update={"azimuth_step_deg": 90.0})
    short = VirtualSettings(starts=8, draws=2, worlds=1, range_max=8.0)
    few = look(store, [PLACE], [0.0], sensor=thin, seeing=short)
    assert few["status"].tolist() == ["failed"]
    assert "points" in few["reason"][0]
    assert few["ob_returns"][0] > 0


def test_a_tile_that_failed_fails_those_who_see_it(street: Path, tmp_path: Path) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=10.0)
    Tile(store, ts.TileKey(3, 0)).write_reason(POINTS, Mark("failed", "disk on fire"))
    near = VirtualSettings(starts=8, draws=2, worlds=1, range_max=8.0)
    table = look(store, [[5.0, 0.5, 2.0], [28.0, 0.5, 2.0]], [0.0, 0.0], seeing=near)
    assert table["status"].tolist() == ["done", "failed"]
    assert "tile 3_0 is failed: disk on fire" in table["reason"][1]


def test_what_cannot_be_is_refused(store: ts.TileStore) -> None:
    for places, headings, match in (
        ([PLACE], [0.0, 1.0], "headings have shape"),
        ([PLACE], [np.nan], "headings have shape"),
        ([[1.0, 2.0]], [0.0], "positions have shape"),
        ([[np.inf, 2.0, 1.0]], [0.0], "position 0"),
    ):
        with pytest.raises(UsageError, match=match):
            look(store, places, headings)
    with pytest.raises(UsageError, match="cell_size"):
        look(store, [PLACE], [0.0], cell_size=3.0)
    with pytest.raises(UsageError, match="worlds 3: give no more than draws, 2"):
        VirtualSettings(draws=2, worlds=3)
    with pytest.raises(UsageError, match="did you mean range_max"):
        VirtualSettings(range_maxx=3.0)  # type: ignore[call-arg]


@pytest.mark.parametrize("fov_deg", [(-25.0, 3.0), (-15.0, 15.0), (2.0, 10.0), (-90.0, 90.0)])
def test_what_can_be_met_is_the_field_of_view_and_a_metre_more(
    fov_deg: tuple[float, float],
) -> None:
    rng = np.random.default_rng(5)
    centre = rng.integers(-40_000, 40_000, (4000, 3))
    places = rng.uniform(-3.0, 3.0, (5, 3))
    none = np.zeros(len(centre), np.bool_)
    surfels = Surfels(centre, np.zeros((len(centre), 3), np.int16), np.ones(len(centre), int), none)
    met = can_be_met(surfels, places, fov_deg, 20.0, 0.5)
    offset = centre[:, None] / 1000.0 - places  # (n, places, 3)
    away = np.linalg.norm(offset[..., :2], axis=2)
    low, high = np.tan(np.radians(np.clip(fov_deg, -89.0, 89.0)))
    inside = (away <= 20.0) & (offset[..., 2] >= low * away) & (offset[..., 2] <= high * away)
    assert met[inside.any(axis=1)].all()
    spread = 2.0 * float(np.abs(places).max()) + 2.0
    assert not met[away.min(axis=1) > 20.0 + 2.0 * spread].any()
    assert 0 < met.sum() < len(met)
