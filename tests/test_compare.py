"""Comparing choices: each as if alone, the cell size of a tile by its cap, a page that is whole."""

import json
import re
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import pandas as pd
import pytest
from chromium import calm, chromium_page, opened
from hypothesis import given
from hypothesis import strategies as st
from report_json import charts, source
from scenes import PLACES

import tilestream as ts
from tilestream.apps.choices import Choice, choices_of
from tilestream.apps.compare import compare, plan_compare
from tilestream.cli import run
from tilestream.errors import UsageError
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import route_of
from tilestream.pipeline.jobs.along_routes import observe_along
from tilestream.report import write_comparison
from tilestream.report.comparison import CELL_BYTES, CHOICE_COLUMNS, Comparison
from tilestream.settings import DEFAULT_MEMORY, VirtualSettings
from tilestream.store import cells_table
from tilestream.tables import read_tables

Told = pytest.CaptureFixture[str]

SENSOR = ts.VLP16.model_copy(update={"name": "short", "azimuth_step_deg": 4.0})
SEEING = VirtualSettings(starts=8, draws=2, worlds=1)
HOW: dict[str, Any] = {"spacing": 8.0, "seeing": SEEING}
CHOICES = choices_of([SENSOR], [8.0, 16.0], [0.0], [1.0, 2.0])
CAP = 0.15
HOSTILE = "</script><img src=x onerror=fail()> 'ö\"&amp;"


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street of 40 m as a PCD file."""
    path = tmp_path_factory.mktemp("street") / "street.pcd"
    write_pcd(path, PLACES["canyon"](np.random.default_rng(3), 40.0, 0.3))
    return path


@pytest.fixture(scope="module")
def store(street: Path) -> ts.TileStore:
    return ts.ingest(street, street.parent / "map.zarr", tile_size=20.0)


@pytest.fixture(scope="module")
def route() -> ts.Route:
    """Down the street and beyond its end, where there is no map."""
    return route_of(HOSTILE, np.array([[4.0, -1.0, np.nan], [52.0, 0.0, np.nan]]))


@pytest.fixture(scope="module")
def found(store: ts.TileStore, route: ts.Route, street: Path) -> Comparison:
    return compare(store, [route], street.parent / "out", CHOICES, **HOW)


def made_up(
    estimates: dict[str, list[tuple[str, float]]], cells: dict[float, int] | None = None
) -> Comparison:
    """A comparison of one vehicle: by cell size as text, (tile, estimate) of each sample point."""
    rows = [
        (f"car-{size}", "way", k, 40.0 * k, 40.0 * k, 0.0, 0.0, 0.0, tile, value)
        + (0.0, value, 0.0)
        + (("done", "") if np.isfinite(value) else ("failed", "too few points"))
        for size, points in estimates.items()
        for k, (tile, value) in enumerate(points)
    ]
    names = [f"car-{size}" for size in estimates]
    sizes = [float(size) for size in estimates]
    counts = cells or {size: round(1000 / size) for size in sizes}
    tiles = sorted({tile for points in estimates.values() for tile, _ in points} | {"9_9"})
    columns = ["choice", "route_id", "sample", "arc_length", "x", "y", "z"]
    columns += ["above_ground", "tile"]
    columns += ["vd_mean", "vd_p_fail", "vd_along", "vd_across", "status", "reason"]
    return Comparison(
        pd.DataFrame(rows, columns=columns),
        pd.DataFrame(
            {"choice": names, "vehicle": "car", "sensor": "car", "range_max": 9.0}
            | {"blind_rear_deg": 0.0, "scan_leaf": 2.0, "cell_size": sizes}
        )[list(CHOICE_COLUMNS)],
        pd.DataFrame(
            [(tile, size, count) for tile in tiles for size, count in counts.items()],
            columns=["tile", "cell_size", "cells"],
        ),
    )


# --- The job


@pytest.mark.parametrize("number", [0, 3])
def test_each_choice_is_as_if_it_were_alone(
    number: int, found: Comparison, store: ts.TileStore, route: ts.Route, tmp_path: Path
) -> None:
    choice = CHOICES[number]
    alone = observe_along(
        store,
        [route],
        tmp_path,
        spacing=8.0,
        sensor=SENSOR,
        seeing=SEEING.model_copy(update={"range_max": choice.range_max}),
        cell_size=choice.cell_size,
    )
    rows = found.rows[found.rows["choice"] == choice.name].reset_index(drop=True)
    shared = [column for column in rows if column in alone]
    assert len(shared) == len(rows.columns) - 2
    pd.testing.assert_frame_equal(rows[shared], alone[shared], check_exact=True)
    assert rows["tile"].tolist() == [
        str(store.grid.key_at(x, y)) for x, y in zip(alone["x"], alone["y"], strict=True)
    ]


def test_a_leaf_thins_the_scans_of_its_choice_alone(
    store: ts.TileStore, route: ts.Route, tmp_path: Path
) -> None:
    matcher = ts.RegistrationSettings.autoware()
    how: dict[str, Any] = {"spacing": 24.0, "seeing": SEEING}
    choices = choices_of([SENSOR], [12.0], [0.0], [2.0], [None, 0.5])
    both = compare(store, [route], tmp_path / "both", choices, **how)
    assert both.choices["choice"].tolist() == ["short-12m-cell2m", "short-12m-leaf0.5m-cell2m"]
    assert both.choices["scan_leaf"].tolist() == [2.0, 0.5]
    assert "registration.scan_leaf" not in both.facts
    assert both.facts["registration.solver"] == "raw"
    for choice, leaf in zip(both.choices["choice"], (2.0, 0.5), strict=True):
        alone = observe_along(
            store,
            [route],
            tmp_path / choice,
            spacing=24.0,
            sensor=SENSOR,
            seeing=SEEING.model_copy(update={"range_max": 12.0}),
            registration=matcher.model_copy(update={"scan_leaf": leaf}),
        )
        rows = both.rows[both.rows["choice"] == choice].reset_index(drop=True)
        shared = [column for column in rows if column in alone]
        pd.testing.assert_frame_equal(rows[shared], alone[shared], check_exact=True)
    thick, thin = (part["vd_mean"].dropna() for _, part in both.rows.groupby("choice", sort=False))
    assert (thick.to_numpy() != thin.to_numpy()).any()


def test_more_range_never_makes_fewer_returns(found: Comparison, street: Path) -> None:
    def returns(choice: Choice) -> pd.Series:
        folder = street.parent / "out" / choice.name / "observability"
        table = read_tables([str(path) for path in sorted(folder.glob("*.parquet"))])
        share: pd.Series = table.set_index("sample")["ob_returns"]
        return share.dropna()

    short, far = (returns(choice) for choice in (CHOICES[0], CHOICES[2]))
    assert len(short) >= 5
    assert (far[short.index] >= short).all()
    assert far.sum() > short.sum()


def test_the_plan_makes_what_choices_share_once(
    store: ts.TileStore, route: ts.Route, tmp_path: Path
) -> None:
    how = (8.0, ts.RegistrationSettings(), 2.0, "ground", SEEING, DEFAULT_MEMORY)
    plan = plan_compare(store, [route], tmp_path, CHOICES, *how)
    keys = [task.key for task in plan.tasks]
    assert len(keys) == len(set(keys))
    tiles = len(store.keys())
    assert sum(key.startswith("cells-1000-") for key in keys) == tiles
    assert sum(key.startswith("cells-2000-") for key in keys) == tiles
    assert sum(key.startswith("surfels-") for key in keys) == tiles
    for at, task in enumerate(plan.tasks):
        assert not set(task.needs) & set(keys[at:]), task.key
    fine = plan_compare(store, [route], tmp_path, CHOICES[:1], *how)
    assert not any(task.key.startswith("cells-2000-") for task in fine.tasks), "nobody asked"


@pytest.mark.slow
def test_no_number_of_workers_shows_and_what_is_done_is_kept(
    street: Path, route: ts.Route, found: Comparison, tmp_path: Path, workers: distributed.Client
) -> None:
    store = ts.ingest(street, tmp_path / "map.zarr", tile_size=20.0)
    results: list[object] = []
    watch = lambda outcome, *_: results.append(outcome.made)  # noqa: E731
    other = compare(store, [route], tmp_path / "out", CHOICES, client=workers, **HOW)
    pd.testing.assert_frame_equal(other.rows, found.rows, check_exact=True)
    pd.testing.assert_frame_equal(other.cells, found.cells, check_exact=True)
    again = compare(store, [route], tmp_path / "out", CHOICES[1:], watch=watch, **HOW)
    assert results
    assert not any(results)
    kept = found.rows[found.rows["choice"] != CHOICES[0].name].reset_index(drop=True)
    pd.testing.assert_frame_equal(again.rows, kept, check_exact=True)


def test_the_summary_counts_what_the_rows_and_the_store_say(
    found: Comparison, store: ts.TileStore
) -> None:
    for figures, choice in zip(found.summaries(0.05), CHOICES, strict=True):
        rows = found.rows[found.rows["choice"] == choice.name]
        done = rows[rows["status"] == "done"]["vd_mean"]
        assert figures["choice"] == choice.name
        assert figures["estimated"] == len(done) > 0
        assert figures["median"] == done.median()
        assert figures["p95"] == pytest.approx(done.quantile(0.95), rel=1e-12)
        assert figures["over_share"] == (done > 0.05).mean()
        assert sum(figures["missing"].values()) == len(rows) - len(done) > 0
        assert any("no ground" in reason for reason in figures["missing"])
        size_mm = round(choice.cell_size * 1000)
        marks = store.marks(cells_table(size_mm).name).values()
        assert figures["cells"] == sum(mark.facts["cells"] for mark in marks) > 100
        assert figures["map_bytes"] == figures["cells"] * CELL_BYTES


# --- The cell size of a tile

VALUE = st.one_of(st.just(np.nan), st.floats(0.0, 0.4))
TILES = ("0_0", "0_1", "1_0")


@given(
    st.integers(1, 8).flatmap(
        lambda n: st.tuples(
            st.lists(st.sampled_from(TILES), min_size=n, max_size=n),
            *[st.lists(VALUE, min_size=n, max_size=n)] * 3,
        )
    ),
    st.permutations((1.0, 2.0, 4.0)),
    st.permutations((100, 200, 300)),
)
def test_the_cell_size_of_a_tile_is_the_cheapest_that_obeys_the_cap(
    drawn: tuple[list[str], list[float], list[float], list[float]],
    order: list[float],
    counts: list[int],
) -> None:
    tiles, *values = drawn
    estimates = {
        str(size): list(zip(tiles, of, strict=True)) for size, of in zip(order, values, strict=True)
    }
    cells = dict(zip(order, counts, strict=True))
    (vehicle,) = made_up(estimates, cells).cell_sizes(CAP)
    assert vehicle["baseline"] == order[0]
    assert [line["tile"] for line in vehicle["tiles"]] == sorted({*tiles, "9_9"})
    for line in vehicle["tiles"]:
        here = np.array([[v for t, v in estimates[s] if t == line["tile"]] for s in estimates])
        judged = here[:, np.isfinite(here).any(axis=0)]
        whole = [bool(np.isfinite(row).all()) for row in judged]
        obeys = [
            size
            for size, row, all_there in zip(order, judged, whole, strict=True)
            if judged.size and all_there and np.quantile(row, 0.95) <= CAP
        ]
        assert line["places"] == here.shape[1]
        if not judged.size:
            assert (line["cell_size"], line["suffices"], line["p95"]) == (order[0], None, None)
        elif obeys:
            cheapest = min(obeys, key=lambda size: cells[size])
            assert (line["cell_size"], line["suffices"]) == (cheapest, True)
            assert line["p95"] <= CAP
        else:
            assert line["suffices"] is False
            assert line in vehicle["over"]
            chosen = judged[order.index(line["cell_size"])]
            fewest = min(int(np.isnan(row).sum()) for row in judged)
            assert int(np.isnan(chosen).sum()) == fewest
    assert vehicle["cells"] == sum(cells[line["cell_size"]] for line in vehicle["tiles"])


@given(st.lists(st.tuples(VALUE, VALUE), min_size=1, max_size=9))
def test_what_a_cell_size_costs_is_the_other_way_round_for_the_other_as_baseline(
    values: list[tuple[float, float]],
) -> None:
    """Neither of two sizes is favoured: which is named first decides the sign alone."""
    small, large = ([("0_0", pair[k]) for pair in values] for k in (0, 1))
    (one,) = made_up({"1.0": small, "2.0": large}).cell_sizes(CAP)
    (two,) = made_up({"2.0": large, "1.0": small}).cell_sizes(CAP)
    assert (one["baseline"], two["baseline"]) == (1.0, 2.0)
    both = [b - a for a, b in values if np.isfinite(a) and np.isfinite(b)]
    forth, back = one["sizes"][1], two["sizes"][1]
    if both:
        assert forth["change"] == pytest.approx(np.median(both)) == pytest.approx(-back["change"])
        assert forth["worse"] == np.mean(np.array(both) > 0.0)
        assert back["worse"] == np.mean(np.array(both) < 0.0)
    else:
        assert forth["change"] is back["change"] is None
    for size in (1.0, 2.0):
        costs = [next(s for s in v["sizes"] if s["cell_size"] == size) for v in (one, two)]
        assert costs[0]["cells"] == costs[1]["cells"] == 2 * round(1000 / size)
        assert costs[0]["suffices"] == costs[1]["suffices"]
    assert {line["cell_size"] for line in one["tiles"] if line["suffices"]} == {
        line["cell_size"] for line in two["tiles"] if line["suffices"]
    }


def test_where_no_size_suffices_the_best_is_taken_and_listed() -> None:
    nan = np.nan
    comparison = made_up(
        {
            "1.0": [("0_0", 0.30), ("0_1", 0.20), ("0_1", 0.20), ("1_0", 0.1)],
            "2.0": [("0_0", 0.25), ("0_1", 0.01), ("0_1", nan), ("1_0", 0.2)],
        }
    )
    (vehicle,) = comparison.cell_sizes(CAP)
    lines = {line["tile"]: line for line in vehicle["tiles"]}
    assert (lines["0_0"]["cell_size"], lines["0_0"]["suffices"]) == (2.0, False)
    assert (lines["0_1"]["cell_size"], lines["0_1"]["suffices"]) == (1.0, False)
    assert (lines["1_0"]["cell_size"], lines["1_0"]["suffices"]) == (1.0, True)
    assert (lines["9_9"]["cell_size"], lines["9_9"]["suffices"]) == (1.0, None)
    assert [line["tile"] for line in vehicle["over"]] == ["0_0", "0_1"]
    assert vehicle["map_bytes"] == (500 + 3 * 1000) * CELL_BYTES
    assert [one["map_bytes"] for one in vehicle["sizes"]] == [
        4 * 1000 * CELL_BYTES,
        4 * 500 * CELL_BYTES,
    ]
    (first, *_) = comparison.differing()
    assert (first["best"], first["worst"]) == ("car-2.0", "car-1.0")
    assert first["difference"] == pytest.approx(0.19)
    assert [figures["lost"] for figures in comparison.summaries(0.25)] == [0, 1]


# --- The page and the command


def test_a_browser_shows_the_page(found: Comparison, tmp_path: Path) -> None:
    write_comparison(found, tmp_path, threshold=0.25, cap=CAP)
    with chromium_page() as browser:
        calm(opened(browser, tmp_path / "compare.html"))


def test_the_page_says_everything_and_is_the_same_every_time(
    found: Comparison, tmp_path: Path
) -> None:
    content = write_comparison(found, tmp_path / "a", threshold=0.25, cap=CAP)
    write_comparison(found, tmp_path / "b", threshold=0.25, cap=CAP)
    for name in ("compare.html", "compare.json", "compare.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    told = json.loads((tmp_path / "a" / "compare.json").read_text(), parse_constant=pytest.fail)
    assert told == content
    table = pd.read_csv(tmp_path / "a" / "compare.csv", float_precision="round_trip")
    np.testing.assert_array_equal(table["vd_mean"], found.rows["vd_mean"])
    page = (tmp_path / "a" / "compare.html").read_text()
    assert HOSTILE not in page
    assert "<img src=x" not in page
    outside = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)  # BokehJS has strings
    assert not re.search(r'(src|href)="https?://', outside)
    chart = charts(tmp_path / "a" / "compare.html")["route-0"]
    for choice in CHOICES:
        assert f"<b>{choice.name}</b>" in page
        line = source(chart, choice.name)
        rows = found.rows[found.rows["choice"] == choice.name]
        np.testing.assert_allclose(line["estimate"], rows["vd_mean"] * 100.0, rtol=1e-12)
    assert "no sample points" in page
    assert len(told["cell_sizes"]) == 2


def test_the_command_compares_and_explains_itself(
    store: ts.TileStore, tmp_path: Path, capsys: Told
) -> None:
    sensor, way = tmp_path / "mine.yaml", tmp_path / "way.csv"
    sensor.write_text(json.dumps(SENSOR.model_dump(mode="json")))
    way.write_text("x,y\n8,0\n24,0\n")
    base = ["compare", store.url, "--route", str(way), "--out", str(tmp_path / "out")]
    line = [*base, "--sensor", str(sensor), "--range", "8,12", "--cell-size", "2.0"]
    assert run([*line, "--dry-run"]) == 0
    assert "observe" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert run([*line, "--spacing", "16", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [choice["choice"] for choice in told["choices"]] == [
        "short-8m-cell2m",
        "short-12m-cell2m",
    ]
    assert told["facts"]["matcher"] == "autoware"
    assert any("without a model" in sentence for sentence in told["worth"]["told"])
    assert told["worth"]["told"][0] in (tmp_path / "out" / "compare.html").read_text()
    assert run([*line, "--spacing", "16"]) == 0
    shown = capsys.readouterr().out
    assert "short-12m-cell2m" in shown
    assert "matcher autoware" in shown
    assert "compare.html" in shown
    for wrong, why in (
        (["--cell-size", "2.0,3.0"], "sizes that fit are .* 1, .* 2, .* fit tiles of 18 m"),
        (["--cell-size", "two"], "give numbers"),
        (["--range", "500"], "VLP16 sees 100 m"),
        (["--range", "-1"], "--range-max is -1.0"),
        (["--blind-rear", "400"], "--blind-rear-deg is 400.0"),
        (["--scan-leaf", "-1"], "--scan-leaf is -1.0"),
        (["--range", "30,30"], "two choices are named VLP16-30m-cell2m"),
        (["--sensor", "VLP99"], "no such sensor"),
        (["--cap", "0"], "give metres above 0"),
    ):
        assert run([*base, *wrong]) == 2, wrong
        assert re.search(why, capsys.readouterr().err), wrong


def test_names_are_safe_and_told_apart() -> None:
    choice = Choice(SENSOR.model_copy(update={"name": "../a b/ö"}), 30.0, 120.0, 1.5)
    assert re.fullmatch(r"[A-Za-z0-9_+-][A-Za-z0-9_+.-]*", choice.name)
    assert choice.name.endswith("-30m-rear120-cell1.5m")
    assert Choice(ts.VLP16).name == "VLP16-cell2m"
    assert Choice(ts.VLP16, scan_leaf=0.5).vehicle == "VLP16-leaf0.5m"
    assert Choice(ts.VLP16, scan_leaf=0.0).name == "VLP16-leaf0m-cell2m"
    with pytest.raises(UsageError, match="whole millimetres"):
        Choice(ts.VLP16, cell_size=0.00015)
    with pytest.raises(UsageError, match="give more than 0"):
        Choice(ts.VLP16, cell_size=-1.0)


def test_nothing_and_the_same_twice_are_refused(
    store: ts.TileStore, route: ts.Route, tmp_path: Path, found: Comparison
) -> None:
    with pytest.raises(UsageError, match="at least one"):
        compare(store, [route], tmp_path, [])
    alike = [Choice(ts.VLP16), Choice(ts.VLP16.model_copy(update={"name": "vlp16"}))]
    with pytest.raises(UsageError, match="two choices"):
        compare(store, [route], tmp_path, alike)
    with pytest.raises(UsageError, match="its own name"):
        compare(store, [], tmp_path, CHOICES)
    with pytest.raises(UsageError, match="do not agree"):
        Comparison(found.rows, found.choices[1:], found.cells)
    with pytest.raises(UsageError, match="same sample points"):
        Comparison(found.rows[1:], found.choices, found.cells)
