"""The report's files and figures: what is written is what was found, in every program."""

import csv
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from report_findings import (
    LIMIT,
    hostile,
    nothing_estimated,
    one_place,
    places_of,
    whole,
    without_labels,
    written,
)
from report_json import sources

from tilestream.errors import CrsError, TileNotReadyError, UsageError
from tilestream.factors import catalogue, observability
from tilestream.files import Files
from tilestream.formats import open_source
from tilestream.model.features import SPREAD_ACROSS, SPREAD_ALONG, WEAK_ALONG
from tilestream.records import Float64
from tilestream.report import Findings, gate, write_report
from tilestream.report.city_map import MOST, city_map
from tilestream.report.colours import FIXED, MISSING, THRESHOLDS, scale_of
from tilestream.report.exports.tables import write_csv, write_geoparquet
from tilestream.report.lines import with_gaps
from tilestream.report.segments import BRIDGE, reaches, segments, worst_places
from tilestream.report.summary import plain

FILES = (
    "index.html",
    "places.parquet",
    "places.gpkg",
    "places.csv",
    "over_threshold.geojson",
    "over_threshold.qml",
    "map.pcd",
    "foxglove.mcap",
    "report.json",
)


@pytest.fixture(scope="module")
def found() -> Findings:
    return whole()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(whole, tmp_path_factory)


def strict_json(path: Path) -> Any:
    def refuse(name: str) -> None:
        raise AssertionError(f"{path} has {name}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.mark.parametrize("make", [whole, without_labels, one_place, nothing_estimated, hostile])
def test_all_files_are_there_and_whole(make: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = written(make, tmp_path_factory)
    assert {p.name for p in folder.iterdir()} == {*FILES, "figures"}
    drawn = sorted(p.name for p in (folder / "figures").iterdir())
    assert drawn == strict_json(folder / "report.json")["figures"]
    for name in drawn:
        picture = matplotlib.image.imread(folder / "figures" / name)
        assert picture.shape[0] > 100
        assert np.ptp(picture[..., :3]) > 0.1
    assert pq.read_table(folder / "places.parquet").num_rows == len(make().places)


def test_the_headline_is_what_the_places_say(found: Findings, folder: Path) -> None:
    head = strict_json(folder / "report.json")["headline"]
    estimate = found.places["estimate"].dropna()
    missing = found.places["estimate"].isna()
    assert head["places"] == 460
    assert head["length"] == pytest.approx(299.0 + 159.0)
    assert head["median"] == estimate.median()
    assert head["p95"] == pytest.approx(estimate.quantile(0.95))
    assert head["max"] == estimate.max()
    assert head["over"] == (estimate > LIMIT).sum() > 20
    assert head["over_share"] == pytest.approx((estimate > LIMIT).mean())
    outside = ~found.places["in_domain"] & ~missing
    assert head["outside_share"] == pytest.approx(outside.sum() / len(estimate))
    assert head["missing"] == missing.sum() > 5
    assert head["missing_by_reason"] == {"no estimate: FDOP is not a number": missing.sum()}
    assert head["labelled"] == len(found.labels)


def test_each_path_is_judged_by_what_was_held_out(found: Findings, folder: Path) -> None:
    one, two = strict_json(folder / "report.json")["paths"]
    here = found.labels[found.labels["path"] == "I"]
    assert one["mae"] == pytest.approx((here["held_out"] - here["error_mean"]).abs().mean())
    assert one["spearman"] == pytest.approx(
        here["held_out"].rank().corr(here["error_mean"].rank()), abs=1e-9
    )
    assert one["groups"] == ["morning", "noon"]
    assert (one["interval"], two["interval"]) == (True, False)


def test_geoparquet_is_read_by_its_own_rules(found: Findings, folder: Path) -> None:
    table = pq.read_table(folder / "places.parquet")
    geo = json.loads(table.schema.metadata[b"geo"])
    assert geo["version"] == "1.1.0"
    column = geo["columns"][geo["primary_column"]]
    assert column["encoding"] == "WKB"
    assert column["geometry_types"] == ["Point Z"]
    assert CRS.from_json_dict(column["crs"]) == CRS.from_epsg(32654)
    at = found.places[["x", "y", "z"]].to_numpy()
    assert column["bbox"] == [*at.min(axis=0), *at.max(axis=0)]
    points = [struct.unpack("<BIddd", wkb.as_py()) for wkb in table["geometry"]]
    assert {point[:2] for point in points} == {(1, 1001)}
    np.testing.assert_array_equal(np.array([point[2:] for point in points]), at)
    read = table.drop_columns("geometry").to_pandas()
    pd.testing.assert_frame_equal(read, found.places, check_dtype=False)
    assert table["estimate"].null_count == found.places["estimate"].isna().sum()
    assert table.schema.field("feature_count").metadata[b"unit"] == b"1"


def test_every_column_of_the_places_says_what_it_means(tmp_path: Path) -> None:
    columns = [*catalogue.COLUMNS, *observability.COLUMNS, WEAK_ALONG, SPREAD_ALONG, SPREAD_ACROSS]
    places = places_of({"a": 3})
    for column in columns:
        if column.name not in places:
            places[column.name] = 1.0
    write_geoparquet(Files.at(tmp_path / "places.parquet"), Findings("t", places))
    schema = pq.read_schema(tmp_path / "places.parquet")
    assert {"ob_info_along", "vd_mean", "heading", "route_id"} <= set(schema.names)
    for field in schema:
        if field.name != "geometry":
            assert field.metadata[b"meaning"], field.name
            assert b"unit" in field.metadata, field.name
    units = {name: schema.field(name).metadata[b"unit"] for name in ("vd_mean", "heading", "x")}
    assert units == {"vd_mean": b"m", "heading": b"rad", "x": b"m"}


def test_geoparquet_of_a_local_frame_says_that_its_crs_is_unknown(tmp_path: Path) -> None:
    lost = without_labels()
    places = lost.places.copy()
    places.loc[3, "z"] = np.nan
    write_report(replace(lost, places=places), tmp_path)
    table = pq.read_table(tmp_path / "places.parquet")
    column = json.loads(table.schema.metadata[b"geo"])["columns"]["geometry"]
    assert "crs" in column
    assert column["crs"] is None
    assert table["geometry"][3].as_py() is None
    assert np.isfinite(column["bbox"]).all()
    assert strict_json(tmp_path / "report.json")["not_in_cloud"] == 1


def test_csv_is_read_back_to_the_bit(found: Findings, folder: Path) -> None:
    read = pd.read_csv(folder / "places.csv", float_precision="round_trip")
    pd.testing.assert_frame_equal(read, found.places, check_dtype=False, check_exact=True)


def test_no_text_of_a_csv_is_a_formula_and_numbers_stay(tmp_path: Path) -> None:
    texts = ["=1+1", "+1", "-2", "@sum", "\t=1", "\r=1", "a\r=1", "", None, "'a"]
    numbers = np.linspace(-1.0, 1.0, len(texts))
    write_csv(Files.at(tmp_path / "a.csv"), pd.DataFrame({"route_id": texts, "x": numbers}))
    with (tmp_path / "a.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["route_id", "x"]
    assert [text for text, _ in rows] == [
        *("'=1+1", "'+1", "'-2", "'@sum", "'\t=1", "'\n=1"),
        *("a\n=1", "", "", "'a"),
    ]
    assert [float(x) for _, x in rows] == numbers.tolist()


def test_geojson_has_the_segments_in_degrees(found: Findings, folder: Path) -> None:
    collection = strict_json(folder / "over_threshold.geojson")
    back = Transformer.from_crs(4326, 32654, always_xy=True)
    runs = segments(found.places, LIMIT)
    assert len(collection["features"]) == len(runs) > 3
    for feature, rows in zip(collection["features"], runs, strict=True):
        part = found.places.iloc[rows]
        flat = feature["geometry"]["coordinates"]
        assert feature["geometry"]["type"] == ("Point" if len(rows) == 1 else "LineString")
        lon_lat = np.atleast_2d(flat)
        x, y = back.transform(lon_lat[:, 0], lon_lat[:, 1])
        np.testing.assert_allclose(np.column_stack([x, y]), part[["x", "y"]], atol=1e-3)
        said = feature["properties"]
        assert said["worst"] == part["estimate"].max()
        worst = part.loc[part["estimate"].idxmax()]
        for name in ("along", "across", "up", "floor", "tail"):
            assert said[name] == worst[name]
        assert said["mean"] == pytest.approx(part["estimate"].mean())
        assert said["p_fail"] == part["p_fail"].max()
        assert said["reason"] == "few features in view"
        assert (said["begin"], said["end"]) == (
            part["arc_length"].iloc[0],
            part["arc_length"].iloc[-1],
        )


def test_geojson_of_a_local_frame_says_so(tmp_path: Path) -> None:
    write_report(without_labels(), tmp_path, threshold=LIMIT)
    collection = strict_json(tmp_path / "over_threshold.geojson")
    assert "no CRS" in collection["coordinates"]
    x, _, z = collection["features"][0]["geometry"]["coordinates"][0]
    assert x >= 368_000.0
    assert z == 40.0


def test_the_cloud_is_read_by_us(found: Findings, folder: Path) -> None:
    ours = np.concatenate(
        [
            block.points
            for span in open_source(folder / "map.pcd").spans(10_000)
            for block in open_source(folder / "map.pcd").blocks(span, 10_000)
        ]
    )
    np.testing.assert_allclose(ours, found.places[["x", "y", "z"]], atol=1e-4)


def test_the_cloud_and_its_colours_are_read_by_open3d(found: Findings, folder: Path) -> None:
    open3d = pytest.importorskip(
        "open3d", reason="Open3D, the other reader, cannot be loaded", exc_type=ImportError
    )
    cloud = open3d.t.io.read_point_cloud(str(folder / "map.pcd"))
    estimate = found.places["estimate"].to_numpy()
    np.testing.assert_allclose(
        cloud.point["estimate"].numpy()[:, 0], estimate.astype(np.float32), rtol=1e-6
    )
    colours = np.asarray(cloud.point["colors"].numpy())
    np.testing.assert_array_equal(colours, FIXED.rgb(estimate))
    grey = [int(MISSING[k : k + 2], 16) for k in (1, 3, 5)]
    assert (colours[np.isnan(estimate)] == grey).all()
    assert tuple(colours[np.nanargmax(estimate)]) == tuple(
        int(FIXED.shades(estimate)[np.nanargmax(estimate)][k : k + 2], 16) for k in (1, 3, 5)
    )


def test_colours_rise_in_lightness() -> None:
    rgb = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in FIXED.colours])
    lightness = (rgb / 255.0) ** 2.2 @ np.array([0.2126, 0.7152, 0.0722])
    assert (lightness[1:] > 1.1 * lightness[:-1]).all()
    assert lightness[-1] > 4.0 * lightness[0]


def test_colours_change_at_the_thresholds_that_people_ask_for() -> None:
    at = np.array(THRESHOLDS)
    assert FIXED.step(at).tolist() == [0, 1, 2, 3, 4, 5]  # an error of a threshold keeps it
    assert FIXED.step(np.nextafter(at, 1.0)).tolist() == [1, 2, 3, 4, 5, 6]
    assert FIXED.step(np.array([0.0, 9.0, np.nan])).tolist() == [0, 6, -1]
    assert FIXED.shades(np.array([9.0, np.nan])) == [FIXED.colours[-1], MISSING]


@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=30), st.floats(0.0, 5.0))
def test_a_range_of_its_own_ends_within_the_errors(errors: list[float], more: float) -> None:
    known = np.array([*errors, max(errors) + more])
    scale = scale_of(known)
    assert list(scale.edges) == sorted(set(scale.edges))
    assert 2 <= len(scale.edges) < 12
    spread = np.quantile(known, 0.98) - known.min()
    if spread > 1e-6:
        assert known.min() <= scale.edges[0] < scale.edges[-1] <= known.min() + spread
        assert scale.step(known[:1] * 0.0 + known.min())[0] == 0


@st.composite
def routes_with_gaps(draw: st.DrawFn) -> pd.DataFrame:
    """Some routes, sample points left out, estimates low, high or missing."""
    parts = []
    for route in draw(st.lists(st.sampled_from("abc"), min_size=1, max_size=3, unique=True)):
        samples = draw(st.lists(st.integers(0, 30), min_size=1, max_size=20, unique=True))
        values = st.sampled_from([0.1, 0.2, 0.3, float("nan")])
        kept = sorted(samples)
        part = places_of({route: 31}).iloc[kept]
        parts.append(part.assign(estimate=[draw(values) for _ in kept]))
    return pd.concat(parts, ignore_index=True)


def literal_segments(places: pd.DataFrame, threshold: float) -> list[list[tuple[str, int]]]:
    """Row by row: what is over begins or prolongs a run, what is not waits to be bridged."""
    runs: list[list[tuple[str, int]]] = []
    waiting: list[tuple[str, int]] = []
    last: tuple[str, int, float] | None = None
    for row in places.itertuples():
        name = (row.route_id, row.sample)
        if not row.estimate > threshold:
            waiting.append(name)
            continue
        near = (
            last is not None
            and last[0] == row.route_id
            and (row.arc_length - last[2] <= BRIDGE or row.sample == last[1] + 1)
        )
        if near:
            runs[-1] += [*waiting, name]
        else:
            runs.append([name])
        waiting, last = [], (row.route_id, row.sample, row.arc_length)
    return runs


@settings(max_examples=60, deadline=None)
@given(routes_with_gaps(), st.sampled_from([1.0, 3.0, 8.0]))
def test_segments_are_the_stretches_over_the_threshold(
    places: pd.DataFrame, spacing: float
) -> None:
    places = Findings("t", places.assign(arc_length=spacing * places["arc_length"])).places
    runs = segments(places, 0.25)
    names = list(zip(places["route_id"], places["sample"], strict=True))
    assert [[names[row] for row in run] for run in runs] == literal_segments(places, 0.25)
    union = np.concatenate(runs) if runs else np.zeros(0, np.int64)
    over = (places["estimate"] > 0.25).to_numpy()
    assert len(np.unique(union)) == len(union)
    assert set(np.flatnonzero(over)) <= set(union)
    for run in runs:
        assert over[[run[0], run[-1]]].all()
        assert len(set(places["route_id"].iloc[run])) == 1


def test_a_dip_of_a_few_metres_does_not_split_a_stretch(tmp_path: Path) -> None:
    estimate = np.full(40, 0.1)
    estimate[[5, 6, 10, 20, 26]] = 0.3  # 4 m apart, 10 m apart, 6 m apart
    estimate[8] = np.nan
    places = places_of({"a": 40}).assign(estimate=estimate)
    assert [run.tolist() for run in segments(places, 0.25)] == [list(range(5, 11)), [20], [26]]
    content = write_report(Findings("t", places), tmp_path)
    assert content["segments"][0]["worst"] == 0.3
    assert content["segments"][0]["mean"] == pytest.approx((3 * 0.3 + 2 * 0.1) / 5)


@settings(max_examples=30, deadline=None)
@given(routes_with_gaps())
def test_reaches_add_up_to_the_road_between_neighbours(places: pd.DataFrame) -> None:
    places = Findings("t", places).places
    walked = sum(
        float((np.diff(part["arc_length"]) * (np.diff(part["sample"]) == 1)).sum())
        for _, part in places.groupby("route_id")
    )
    assert reaches(places).sum() == pytest.approx(walked)
    assert (reaches(places) >= 0.0).all()


def test_the_worst_places_are_different_places(found: Findings) -> None:
    rows = worst_places(found.places)
    at = found.places[["x", "y", "z"]].to_numpy()
    estimate = found.places["estimate"].to_numpy()
    assert len(rows) == 10
    assert (np.diff(estimate[rows]) <= 0.0).all()
    between = np.linalg.norm(at[rows][:, None] - at[rows][None], axis=2)
    assert between[~np.eye(10, dtype=bool)].min() >= 30.0
    for row in np.flatnonzero(estimate > estimate[rows[-1]]):
        assert np.linalg.norm(at[rows] - at[row], axis=1).min() < 30.0 or row in rows


def test_a_gate_closes_above_the_limit(found: Findings) -> None:
    places = found.places[found.places["estimate"].notna()]
    highest = float(places["estimate"].max())
    assert gate(places, highest) == []
    (closed,) = gate(places, highest - 1e-6)
    worst = places.loc[places["estimate"].idxmax()]
    assert f"mean: 1 of {len(places)} sample points are above" in closed
    assert closed.endswith("estimated")
    assert f"on {worst['route_id']} at {worst['arc_length']:.0f} m" in closed
    for limit in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="threshold"):
            gate(places, limit)


def test_a_gate_closes_where_too_little_is_known() -> None:
    places = places_of({"a": 60, "b": 40}).assign(estimate=0.1)
    few = places.assign(estimate=places["estimate"].where(places["sample"] > 4))
    assert few["estimate"].isna().sum() == 10
    assert gate(places, 0.25) == []
    (many,) = gate(few, 0.25)
    assert "10 of 100 sample points without an estimate, more than 5%" in many
    allowed = places.assign(estimate=places["estimate"].where(places.index > 4))
    assert allowed["estimate"].isna().sum() == 5
    assert gate(allowed, 0.25) == []
    blind = pd.concat([places, places_of({"c": 2}).assign(estimate=np.nan)], ignore_index=True)
    assert gate(blind, 0.25) == ["no estimate at all on c"]
    assert len(gate(nothing_estimated().places, 0.25)) == 2


def test_neither_order_nor_repetition_changes_a_byte(
    found: Findings, folder: Path, tmp_path: Path
) -> None:
    shuffled = replace(
        found,
        places=found.places.sample(frac=1.0, random_state=3),
        labels=found.labels.sample(frac=1.0, random_state=3),
    )
    content = write_report(shuffled, tmp_path, threshold=LIMIT)
    assert strict_json(tmp_path / "report.json") == content
    names = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file()]
    assert len(names) == len(FILES) + 21
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_a_figure_of_an_earlier_report_does_not_stay(tmp_path: Path) -> None:
    write_report(one_place(), tmp_path)
    assert (tmp_path / "figures" / "worst_01.png").is_file()
    content = write_report(replace(one_place(), around=None), tmp_path)
    assert content["figures"] == ["distribution.png", "map.png"]
    assert not (tmp_path / "figures" / "worst_01.png").exists()


def test_a_tile_that_is_missing_costs_its_picture_only(tmp_path: Path) -> None:
    def failed(*_: float) -> Float64:
        raise TileNotReadyError("tile (3, 4) failed: <disk full>")

    def bare(*_: float) -> Float64:
        return np.zeros((0, 3))

    write_report(replace(one_place(), around=failed), tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert "no picture: tile (3, 4) failed: &lt;disk full&gt;" in page
    write_report(replace(one_place(), around=bare), tmp_path)
    assert "no map points around it" in (tmp_path / "index.html").read_text()


def test_bad_findings_are_refused(tmp_path: Path) -> None:
    places = places_of({"a": 5})
    with pytest.raises(UsageError, match="places: no column estimate, p_fail"):
        Findings("t", places.drop(columns=["estimate", "p_fail"]))
    with pytest.raises(UsageError, match="at least one sample point"):
        Findings("t", places.iloc[:0])
    with pytest.raises(UsageError, match="route 'a' has sample 0 twice"):
        Findings("t", pd.concat([places, places.iloc[:1]]))
    with pytest.raises(UsageError, match="labels: no column group, block, held_out"):
        Findings(
            "t", places, labels=pd.DataFrame({"path": ["a"], "arc_length": 0, "error_mean": 1})
        )
    labels = whole().labels
    assert len(Findings("t", places, pd.concat([labels, labels])).labels) == len(labels)
    with pytest.raises(UsageError, match="group 'morning' has path 'I' at 0 m twice"):
        Findings("t", places, pd.concat([labels, labels.iloc[:1].assign(held_out=0.3)]))
    with pytest.raises(UsageError, match="threshold 0"):
        write_report(Findings("t", places), tmp_path, threshold=0.0)
    with pytest.raises(CrsError, match="'nowhere' is no CRS"):
        write_report(Findings("t", places, crs="nowhere"), tmp_path)


def test_json_has_plain_values_only() -> None:
    value = {
        1: np.float32(0.5), "n": float("nan"), "i": -np.inf, "a": np.arange(2), "s": {"b", "a"},
        "t": (np.int64(3), None, np.bool_(True)), "p": Path("x"), "m": pd.NA,
    }  # fmt: skip
    assert plain(value) == {
        "1": 0.5, "n": None, "i": None, "a": [0, 1], "s": ["a", "b"], "t": [3, None, True],
        "p": "x", "m": None,
    }  # fmt: skip


def test_lines_break_where_labels_are_far_apart() -> None:
    arc = np.array([0.0, 1.0, 2.0, 50.0, 51.0, 53.0])
    np.testing.assert_array_equal(with_gaps(arc), [3])
    assert with_gaps(np.array([4.0])).size == 0


def test_a_page_of_many_places_stays_small(tmp_path: Path) -> None:
    many = without_labels()
    long_reason = "parallel walls, surfaces face few directions (normal_H_90 5.21, typically 6.48)"
    places = places_of({"a": 2500, "b": 2500}).assign(reason=long_reason)
    write_report(replace(many, places=places), tmp_path)
    assert (tmp_path / "index.html").stat().st_size < 8_000_000


def test_of_too_many_places_the_map_shows_the_worst_of_every_few() -> None:
    places = places_of({"a": MOST + 1000, "b": 50})
    chart = city_map(Findings("t", places), "@route")
    from_chart = json.dumps(chart)
    assert len(from_chart) < 8_000_000
    drawn = [s for s in sources(chart) if s["name"] in ("in_domain", "outside", "missing")]
    shown = np.concatenate([s["data"]["estimate"] for s in drawn]) / 100.0
    assert len(shown) == np.ceil((MOST + 1000) / 2) + 25
    assert np.nanmax(shown) == pytest.approx(places["estimate"].max())
