"""Places that a coarse run interpolates are told apart: pictures, clouds, lists, map updates."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from map_diffs import between, updated, words
from matplotlib.figure import Figure
from mcap_ros2.reader import read_ros2_messages
from report_findings import LENGTHS, places_of
from report_json import charts, source
from rich.console import Console

from tilestream.apps.run_plot import DOT, SMALL, plot_places
from tilestream.cli.tables import diff_table, report_table, stretch_table
from tilestream.factors.stations import INTERPOLATED
from tilestream.report import Findings, diff_gate, write_diff, write_report
from tilestream.report.colours import FIXED
from tilestream.report.diff.data import MapDiff
from tilestream.report.exports.labels import worst_labels
from tilestream.report.summary import cards


@pytest.fixture(scope="module")
def found() -> Findings:
    """Two streets; of the first a half is interpolated."""
    found = Findings(title="Coarse", places=places_of(LENGTHS))
    places = found.places.astype({"in_domain": "boolean"})
    first = (places["route_id"] == "I") & places["sample"].between(100, 250)
    places.loc[first & places["estimate"].notna(), "status"] = INTERPOLATED
    places.loc[first, ["low", "high"]] = np.nan
    places.loc[first, "in_domain"] = pd.NA
    return replace(found, places=places)


@pytest.fixture(scope="module")
def folder(found: Findings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(found, folder, threshold=0.15)
    return folder


def between_of(found: Findings) -> np.ndarray[Any, Any]:
    of: np.ndarray[Any, Any] = (found.places["status"] == INTERPOLATED).to_numpy()
    return of


def printed(*tables: Any) -> str:
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(*tables)
    return " ".join(console.export_text().split())


# --- One run


def test_a_picture_has_dots_where_nothing_was_evaluated(found: Findings) -> None:
    places = found.places
    ax = plot_places(places, None, Figure().add_subplot())
    at, sizes = (ax.collections[0].get_offsets(), ax.collections[0].get_sizes())
    order = np.argsort(places["estimate"].to_numpy(), kind="stable")[: len(at)]
    assert at[:, 0].tolist() == places["x"].to_numpy()[order].tolist()
    assert (sizes == DOT).tolist() == between_of(found)[order].tolist()
    assert sizes.max() == SMALL > DOT
    colours = [mpl.colors.to_hex(one) for one in ax.collections[0].get_facecolors()]
    assert colours == FIXED.shades(places["estimate"].to_numpy()[order])
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert told == ["evaluated", "interpolated, not evaluated"]
    of_the_map = plot_places(places, "feature_count", Figure().add_subplot())
    assert (of_the_map.collections[0].get_sizes() == SMALL).all()
    assert of_the_map.get_legend() is None


def test_a_cloud_has_a_field_that_says_so(found: Findings, folder: Path) -> None:
    header, _, data = (folder / "map.pcd").read_bytes().partition(b"DATA binary\n")
    assert b"FIELDS x y z rgb estimate interpolated\n" in header
    row = np.dtype([(name, "<f8") for name in "xyz"] + [("rgb", "<f4"), ("estimate", "<f4")])
    row = np.dtype([*row.descr, ("interpolated", "u1")])
    rows = np.frombuffer(data, row)
    assert rows["interpolated"].astype(bool).tolist() == between_of(found).tolist()


def test_a_scene_has_a_field_and_a_thin_line(found: Findings, folder: Path) -> None:
    scene = {m.channel.topic: m.ros_msg for m in read_ros2_messages(folder / "foxglove.mcap")}
    cloud = scene["/tilestream/places"]
    rows = np.frombuffer(bytes(cloud.data), [(field.name, "<f4") for field in cloud.fields])
    assert rows["interpolated"].astype(bool).tolist() == between_of(found).tolist()
    lines = scene["/tilestream/route"].markers
    steps: dict[bool, list[float]] = {True: [], False: []}
    for line in lines:
        x = [point.x for point in line.points]
        thin = line.ns.endswith(", interpolated")
        assert line.scale.x == (0.2 if thin else 0.6)
        steps[thin] += x[1:]
    of_route = (found.places["route_id"] == found.places["route_id"].shift()).to_numpy()
    either = between_of(found) | np.roll(between_of(found), 1)
    assert len(steps[True]) == (either & of_route).sum() > 0
    assert len(steps[False]) == (~either & of_route).sum()


def test_lists_of_worst_places_have_the_word(found: Findings, folder: Path) -> None:
    labels = worst_labels(found)
    between = between_of(found)
    assert {label.endswith(" interpolated") for label in labels.values()} == {True, False}
    for row, label in labels.items():
        assert label.endswith(" interpolated") == between[row]
    report = json.loads((folder / "report.json").read_text())
    shown = printed(report_table(report, cards(report)))
    first = [between[row] for row in list(labels)[:3]]
    assert shown.count("of the worst places, interpolated") == sum(first) > 0
    assert shown.count("of the worst places") == 3


# --- A map update


@pytest.fixture(scope="module")
def update() -> MapDiff:
    """What got worse at 20 to 40 m is interpolated afterwards from 30 m on, and what got better
    before; the rest is evaluated.
    """
    old, new = updated()
    first = new["route_id"] == "I"
    new.loc[first & new["sample"].between(30, 45) & new["estimate"].notna(), "status"] = (
        INTERPOLATED
    )
    was = (old["route_id"] == "I") & old["sample"].between(125, 135) & old["estimate"].notna()
    old.loc[was, "status"] = INTERPOLATED
    return between(old, new)


def test_pairs_with_an_interpolated_side_are_counted_apart(update: MapDiff, tmp_path: Path) -> None:
    places = update.places
    at = places.places["sample"].between(30, 45) | places.places["sample"].between(125, 135)
    at &= (places.places["route_id"] == "I") & np.isfinite(places.change)
    assert places.compared_interpolated == at.sum()
    content = write_diff(update, tmp_path)
    assert content["compared_interpolated"] == at.sum()
    assert {r["route_id"]: r["compared_interpolated"] for r in content["routes"]}["I"] == at.sum()
    (worse,), (better,) = content["stretches"], content["stretches_better"]
    for stretch, low, high in ((worse, 30, 40), (better, 125, 130)):
        inside = at & places.places["sample"].between(low, high)
        assert 0 < stretch["interpolated"] == inside.sum() < stretch["places"]
    for row in (*content["worse"], *content["better"]):
        far = 30 <= row["arc_length"] <= 45 or 125 <= row["arc_length"] <= 135
        assert row["interpolated"] == far
    lines = json.loads((tmp_path / "worse.geojson").read_text())["features"]
    said = {line["properties"]["what"]: line["properties"]["interpolated"] for line in lines}
    assert said["worse"] == worse["interpolated"]
    told = words(tmp_path / "diff.html")
    assert f"{at.sum()} of them interpolated before or after" in told
    assert f"{worse['interpolated']} of {worse['places']} places interpolated" in told
    data = source(charts(tmp_path / "diff.html")["city-map"], "worse")
    hollow = [arc for arc, filled in zip(data["arc"], data["filled"], strict=True) if not filled]
    assert set(hollow) == {arc for arc in data["arc"] if 30 <= arc <= 45} != set()
    assert all(
        ("interpolated" in now) == (arc in hollow)
        for now, arc in zip(data["is"], data["arc"], strict=True)
    )
    shown = printed(diff_table(update)), printed(stretch_table(update))
    assert f"interpolated, not evaluated {at.sum()} of these" in shown[0]
    assert f"{worse['interpolated']} of {worse['places']} places interpolated" in shown[1]


def test_no_gate_opens_or_closes_by_them_unsaid(update: MapDiff) -> None:
    closed = diff_gate(update, 0.1)
    above = (update.places.change > 0.1) & update.places.interpolated
    assert f"({above.sum()} of them interpolated)" in closed.closed[0]
    count = f"{update.places.compared_interpolated:,} of {update.places.compared:,}"
    opened = diff_gate(update, 10.0)
    for verdict in (closed, opened):
        assert any(count in said and "interpolated" in said for said in verdict.besides)
    assert "interpolated" not in diff_gate(between(*updated()), 0.1).told
