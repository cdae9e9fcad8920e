"""The page of a comparison of two maps: its figures, its map, and what a browser makes of it."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import TIPS, calm, chromium_page, opened, point_at
from map_diffs import TILE, UTM, between, updated, words
from pyproj import Transformer
from report_findings import HOSTILE, places_of
from report_json import charts, source, sources

from tilestream.from_above import FromAbove
from tilestream.report import diff_gate, write_diff
from tilestream.report.city_map import MOST
from tilestream.report.colours import FIXED
from tilestream.report.diff.data import MapDiff, Side
from tilestream.report.diff.map import CHANGE, MARKERS
from tilestream.report.formatting import cm


@pytest.fixture(scope="module")
def found() -> MapDiff:
    height = np.add.outer(np.arange(20.0), np.arange(90.0))
    above = FromAbove(height, (368_000.0, 3_950_000.0), 4.0)
    return between(*updated(), above=lambda: above, notes={"old.zarr": ["a note"]})


@pytest.fixture(scope="module")
def folder(found: MapDiff, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diff") / "new"
    write_diff(found, folder, diff_gate(found, 0.1))
    return folder


def sections(page: Path) -> list[str]:
    return re.findall(r'<section id="([^"]+)">', page.read_text())


# --- What the page says


def test_the_figures_are_those_of_the_comparison(found: MapDiff, folder: Path) -> None:
    told = json.loads((folder / "diff.json").read_text(), parse_constant=pytest.fail)
    old, new = updated()
    both = old.merge(new, on=["route_id", "sample"], suffixes=("_old", "_new"))
    change = (both["estimate_new"] - both["estimate_old"]).dropna()
    assert told["compared"] == len(change)
    assert len(told["worse"]) == (change > found.limit).sum() > 15
    assert len(told["better"]) == (change < -found.limit).sum() > 5
    assert told["worst_growth"] == pytest.approx(change.max())
    had, has = both["estimate_old"].notna(), both["estimate_new"].notna()
    assert told["lost"] == (had & ~has).sum() > 15
    assert told["appeared"] == (~had & has).sum() == 1
    # the last place that is compared is the 99th, and the street bends: the 104th is 5.5 m off
    left = old[(old["route_id"] == "II") & (old["sample"] > 103) | (old["route_id"] == "III")]
    assert told["left"] == left["estimate"].notna().sum()
    assert [route["route_id"] for route in told["routes_left"]] == ["II", "III"]
    worst, *_ = told["stretches"]
    assert (worst["route_id"], worst["begin"], worst["end"]) == ("I", 20.0, 40.0)
    (lost,) = told["stretches_lost"]
    assert (lost["begin"], lost["end"], lost["why"]) == (200.0, 220.0, "no map around")


def test_the_page_says_it_in_order_worst_first(found: MapDiff, folder: Path) -> None:
    page = folder / "diff.html"
    there = sections(page)
    assert there == re.findall(r'<a href="#([^"]+)">', page.read_text())
    assert there == ["headline", "map", "worse", "better", "along", "lost", "notes", "facts"]
    told = words(page)
    worst = found.places.stretches.iloc[0]
    assert (
        f"1 I , 20 to 40 m 21 m {cm(worst['before'])} {cm(worst['after'])}".replace("\xa0", " ")
        in told
    )
    for said in (
        "The gate is closed",
        "1 of 13 tiles that both have changed",
        "1 tiles added",
        "1 tiles removed",
        "no map around",
        "a note",
        "old.zarr",
    ):
        assert said in told, said


def test_the_same_comparison_gives_the_same_bytes(
    found: MapDiff, folder: Path, tmp_path: Path
) -> None:
    content = write_diff(found, tmp_path, diff_gate(found, 0.1))
    for name in ("diff.html", "diff.json", "worse.geojson"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    assert content == json.loads((folder / "diff.json").read_text())
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "diff.html",
        "diff.json",
        "worse.geojson",
    ]


def test_names_from_files_stay_names(tmp_path: Path) -> None:
    old, new = (t.replace({"route_id": {"I": HOSTILE}}) for t in updated())
    new["reason"] = HOSTILE
    sides = (Side(HOSTILE, {HOSTILE: HOSTILE}), Side(HOSTILE, {HOSTILE: HOSTILE}))
    hostile = between(old, new, sides=sides, notes={HOSTILE: [HOSTILE]}, gone={HOSTILE: HOSTILE})
    write_diff(hostile, tmp_path, diff_gate(hostile, 0.01))
    page = (tmp_path / "diff.html").read_text()
    assert HOSTILE not in page
    assert "<img src=x" not in page
    outside = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r'(src|href)="https?://', outside)


# --- What is not there


def nothing_changed() -> MapDiff:
    old, _ = updated()
    return between(old, old, added=(), removed=(), changed=())


def two_stores() -> MapDiff:
    return between(None, None, without=("old.zarr", "new.zarr"))


def one_store_alone() -> MapDiff:
    return between(None, None, without=("old.zarr", "new.zarr"), added=(), removed=(), changed=())


def maps_gone() -> MapDiff:
    tiles: dict[str, Any] = {"added": (), "removed": (), "changed": (), "same": 0}
    return between(*updated(), **tiles, gone={"old": "no tile store of old"})


def all_lost() -> MapDiff:
    old, _ = updated()
    return between(old, old.assign(estimate=np.nan, low=np.nan, high=np.nan))


def one_place() -> MapDiff:
    old = places_of({"spot": 1})
    return between(old, old.assign(estimate=old["estimate"] + 0.1))


LACKING: list[tuple[Callable[[], MapDiff], list[str], tuple[str, ...]]] = [
    (
        nothing_changed,
        ["headline", "map", "notes", "facts"],
        ("What got worse: nothing grew by more than 2 cm", "0 of 12 tiles"),
    ),
    (
        two_stores,
        ["headline", "map", "notes", "facts"],
        ("Only tiles are compared", "there are no estimates in old.zarr and new.zarr"),
    ),
    (
        one_store_alone,
        ["headline", "notes", "facts"],
        ("Map: no tile differs", "Along the routes: there are no estimates"),
    ),
    (
        maps_gone,
        ["headline", "map", "worse", "better", "along", "lost", "notes", "facts"],
        ("No tiles are compared", "no tile store of old"),
    ),
    (
        all_lost,
        ["headline", "map", "along", "lost", "notes", "facts"],
        ("No place has an estimate in both", "What got better: no place has an estimate in both"),
    ),
    (
        one_place,
        ["headline", "map", "worse", "along", "notes", "facts"],
        ("+10.0 cm", "Lost and new estimates: all places that had an estimate have one"),
    ),
]


@pytest.mark.parametrize(
    ("make", "there", "said"), LACKING, ids=[m.__name__ for m, _, _ in LACKING]
)
def test_what_has_nothing_to_say_is_left_out_and_named(
    make: Callable[[], MapDiff], there: list[str], said: tuple[str, ...], tmp_path: Path
) -> None:
    write_diff(make(), tmp_path)
    assert sections(tmp_path / "diff.html") == there
    told = words(tmp_path / "diff.html")
    for line in said:
        assert line in told, line
    assert "gate" not in told
    json.loads((tmp_path / "diff.json").read_text(), parse_constant=pytest.fail)


# --- The charts


def test_the_map_has_every_place_once_and_on_the_scales_of_all_reports(
    found: MapDiff, folder: Path
) -> None:
    chart = charts(folder / "diff.html")["city-map"]
    places = found.places.places.assign(kind=found.places.kind, change=found.places.change)
    places = places.set_index(["route_id", "arc_length"])
    labels = dict(re.findall(r'"axis_label": "([xy]) \[m\] from (\d+) on"', json.dumps(chart)))
    origin = np.array([float(labels["x"]), float(labels["y"])])
    seen, last = [], len(FIXED.colours)
    for kind, _, _ in MARKERS:
        data = source(chart, kind)
        for k, key in enumerate(zip(data["route"], data["arc"].tolist(), strict=True)):
            if kind == "left":
                continue
            place = places.loc[key]
            seen.append(key)
            assert place["kind"] == kind
            at = np.array([data["x"][k], data["y"][k]]) + origin
            assert at.tolist() == pytest.approx([place["x"], place["y"]], abs=1e-6)
            for when in ("before", "after"):
                (step,) = FIXED.step(np.array([place[when]]))
                assert data[when][k] == step + 0.5
            if np.isfinite(place["change"]):
                assert data["change"][k] == last + CHANGE.step(np.array([place["change"]]))[0] + 0.5
        np.testing.assert_array_equal(data["step"], data["change"])
    assert len(seen) == len(set(seen)) == len(places)
    assert len(source(chart, "left")["route"]) == len(found.places.left)
    numbers = source(chart, "worst")
    assert numbers["number"] == [str(k + 1) for k in range(len(found.places.stretches))]
    np.testing.assert_allclose(numbers["x"] + origin[0], found.places.stretches["x"])


def test_tiles_are_outlined_where_they_are(found: MapDiff, folder: Path) -> None:
    chart = charts(folder / "diff.html")["city-map"]
    labels = dict(re.findall(r'"axis_label": "([xy]) \[m\] from (\d+) on"', json.dumps(chart)))
    for kind in ("added", "removed", "changed"):
        (key,) = getattr(found, kind)
        data = source(chart, kind)
        assert data["left"][0] + float(labels["x"]) == key.ix * TILE
        assert data["bottom"][0] + float(labels["y"]) == key.iy * TILE
        assert (data["right"] - data["left"], data["top"] - data["bottom"]) == (TILE, TILE)
    drawn = json.dumps(chart)
    for name in ("line_dash", "hatch_pattern"):  # told apart without colours
        of_kinds = re.findall(rf'"name": "Quad".*?"{name}": ({{.*?}}|\[.*?\]|".*?")', drawn)
        assert len(set(of_kinds)) >= 3, name


def test_a_profile_has_before_and_after_on_one_axis(found: MapDiff, folder: Path) -> None:
    chart = charts(folder / "diff.html")["along-0"]
    data = source(chart, "profile")
    here = found.places.places[found.places.places["route_id"] == "I"]
    for when in ("before", "after"):
        np.testing.assert_allclose(data[when], here[when] * 100.0)
    np.testing.assert_array_equal(data["arc"], here["arc_length"])


def test_a_place_between_two_without_estimates_is_a_dot(tmp_path: Path) -> None:
    old = places_of({"spot": 5}).assign(estimate=[0.1, np.nan, 0.1, np.nan, 0.1])
    write_diff(between(old, old.assign(estimate=old["estimate"] + 0.1)), tmp_path)
    chart = charts(tmp_path / "diff.html")["along-0"]
    assert source(chart, "after, alone")["arc"].tolist() == [0.0, 2.0, 4.0]


def test_a_large_city_stays_small_and_keeps_what_changed_most(tmp_path: Path) -> None:
    n = 3 * MOST // 2
    old = places_of({f"street {k}": n // 50 for k in range(50)})
    new = old.copy()
    one = int(np.flatnonzero(old["estimate"].notna())[12_345])
    new.loc[one, "estimate"] += 1.0
    write_diff(between(old, new), tmp_path)
    chart = charts(tmp_path / "diff.html")["city-map"]
    drawn = [s["data"] for s in sources(chart) if s["name"] in {kind for kind, _, _ in MARKERS}]
    assert n // 3 < sum(len(data["x"]) for data in drawn) <= MOST
    assert source(chart, "worse")["arc"].tolist() == [old["arc_length"][one]]
    assert "Each mark stands for 2 consecutive sample points" in words(tmp_path / "diff.html")
    assert (tmp_path / "diff.html").stat().st_size < 6_000_000


# --- The file for map programs


def test_stretches_that_got_worse_or_were_lost_are_lines_on_the_earth(
    found: MapDiff, folder: Path
) -> None:
    told = json.loads((folder / "worse.geojson").read_text())
    places = found.places
    back = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    stretches = [*places.stretch_rows("worse"), *places.stretch_rows("lost")]
    assert [f["properties"]["what"] for f in told["features"]].count("lost") == 1
    for feature, rows in zip(told["features"], stretches, strict=True):
        line = np.array(feature["geometry"]["coordinates"]).reshape(-1, 3)
        x, y = back.transform(line[:, 0], line[:, 1])
        np.testing.assert_allclose(x, places.places["x"].iloc[rows], atol=1e-3)
        np.testing.assert_allclose(y, places.places["y"].iloc[rows], atol=1e-3)
        assert feature["properties"]["places"] == len(rows)
    assert "WGS 84" in told["coordinates"]
    local = replace(found, crs=None)
    write_diff(local, folder.parent / "local")
    told = json.loads((folder.parent / "local" / "worse.geojson").read_text())
    assert "no CRS" in told["coordinates"]
    assert told["features"][0]["geometry"]["coordinates"][0][0] == pytest.approx(
        places.places["x"].iloc[stretches[0][0]]
    )


# --- In a browser


def test_a_browser_shows_before_after_and_change(folder: Path) -> None:
    of_map = "Bokeh.documents.flatMap((d) => d.roots()).find((r) => r.name === 'city-map')"
    named = f"[...{of_map}.references()].find((m) => m.name === 'worse' && m.data)"
    bars = f"[...{of_map}.references()].filter((m) => m.type === 'ColorBar' && m.visible)"
    with chromium_page() as browser:
        calm(opened(browser, folder / "diff.html"))
        assert browser.evaluate(f"{bars}.map((b) => b.name).join()") == "change"
        for name, scale in (("before", "error"), ("after", "error"), ("change", "change")):
            browser.evaluate(f"document.querySelector('input[value={name}]').click()")
            same = f"[...{named}.data.step].join() === [...{named}.data.{name}].join()"
            assert browser.evaluate(same), name
            assert browser.evaluate(f"{bars}.map((b) => b.name).join()") == scale
        point_at(browser, "city-map", "worse", 0)
        tip = browser.wait_for(TIPS)
        assert "before" in tip
        assert "change +" in tip
        browser.evaluate("document.querySelector('#worse a.place').click()")
        here = f"[...{of_map}.references()].find((m) => m.name === 'here')"
        browser.wait_for(f"{here}.data.x.length === 1")
        calm(browser)


def test_a_phone_shows_the_page_no_wider_than_it_is(folder: Path) -> None:
    with chromium_page() as browser:
        opened(browser, folder / "diff.html")
        browser.command(
            "Emulation.setDeviceMetricsOverride",
            width=400, height=800, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        browser.wait_for("document.documentElement.scrollWidth <= 400")
        calm(browser)
