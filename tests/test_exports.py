"""Files for other programs: GDAL, QGIS and readers of MCAP find in them what was found."""

import json
import shutil
import sqlite3
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from pyproj import CRS
from report_findings import (
    LIMIT,
    ORIGIN,
    cloud_around,
    nothing_estimated,
    one_place,
    whole,
    without_labels,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tilestream.errors import TileNotReadyError
from tilestream.files import Files
from tilestream.formats.logs import ros
from tilestream.formats.logs.drivers import recorded_scan
from tilestream.formats.logs.mcap_file import McapFile
from tilestream.records import Float64
from tilestream.report import Findings, write_report
from tilestream.report.colours import FIXED, MISSING, scale_of
from tilestream.report.data import LaneletMap
from tilestream.report.exports.foxglove import MOST_POINTS
from tilestream.report.exports.geometry import wkb_line, wkb_points
from tilestream.report.exports.geopackage import write_geopackage
from tilestream.report.exports.labels import worst_labels
from tilestream.report.exports.qgis_styles import style_of_places, style_over_threshold
from tilestream.report.exports.tables import write_json
from tilestream.report.exports.write import write_for_others
from tilestream.report.segments import worst_places
from tilestream.report.summary import summary
from tilestream.report.worth import NOWHERE, Worth


def some_of_the_map(most: int) -> Float64:
    assert most == MOST_POINTS
    return cloud_around(*ORIGIN)


def measured() -> Findings:
    """Two streets with a measured stretch each, and the map."""
    found = whole()
    here = found.places["sample"].between(20, 50)
    places = found.places.assign(measured=(1.3 * found.places["estimate"]).where(here))
    return replace(found, places=places, map_points=some_of_the_map)


def told_of(found: Findings) -> list[dict[str, Any]]:
    told: list[dict[str, Any]] = summary(found, LIMIT)["segments"]
    return told


def for_others(found: Findings, folder: Path) -> Path:
    """The folder with the files alone, and what `report.json` says of them."""
    place = Files.at(folder)
    write_json(place.under("report.json"), write_for_others(place, found, LIMIT, told_of(found)))
    return folder


@pytest.fixture(scope="module")
def found() -> Findings:
    return measured()


@pytest.fixture(scope="module")
def folder(found: Findings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return for_others(found, tmp_path_factory.mktemp("report"))


def layer(path: Path, name: str) -> pd.DataFrame:
    _, table = pyogrio.read_arrow(path, layer=name)
    read: pd.DataFrame = table.to_pandas()
    return read


# --- GeoPackage


def test_a_geopackage_has_what_was_found(found: Findings, folder: Path) -> None:
    path = folder / "places.gpkg"
    assert pyogrio.list_layers(path)[:3].tolist() == [
        ["places", "Point Z"],
        ["over_threshold", "Unknown"],
        ["measured", "Point Z"],
    ]
    assert CRS(pyogrio.read_info(path, layer="places")["crs"]) == CRS.from_epsg(32654)
    read = layer(path, "places")
    for name in ("route_id", "sample", "estimate", "low", "high", "p_fail", "reason", "measured"):
        pd.testing.assert_series_equal(read[name], found.places[name], check_dtype=False)
    at = found.places[["x", "y", "z"]].to_numpy()
    assert [bytes(wkb)[5:] for wkb in read["geom"]] == [bytes(w)[5:] for w in wkb_points(at) if w]
    ranked = read.dropna(subset="worst").sort_values("worst")
    assert ranked.index.tolist() == worst_places(found.places)
    assert ranked["worst"].tolist() == list(range(1, 11))
    largest = np.fmax(found.places["estimate"], found.places["measured"])
    np.testing.assert_array_equal(read["error"], largest)


def test_stretches_and_measured_places_are_layers_of_their_own(
    found: Findings, folder: Path
) -> None:
    told = json.loads((folder / "over_threshold.geojson").read_text())["features"]
    read = layer(folder / "places.gpkg", "over_threshold")
    assert len(read) == len(told) > 3
    for row, feature in zip(read.to_dict("records"), told, strict=True):
        assert {name: row[name] for name in feature["properties"]} == feature["properties"]
    kinds = {"Point": 1001, "LineString": 1002}
    assert [int.from_bytes(wkb[1:5], "little") % 1000 for wkb in read["geom"]] == [
        kinds[feature["geometry"]["type"]] % 1000 for feature in told
    ]
    driven = layer(folder / "places.gpkg", "measured")
    assert len(driven) == found.places["measured"].notna().sum() > 50
    assert driven["measured"].tolist() == found.places["measured"].dropna().tolist()


def test_a_line_is_its_points_and_of_one_point_a_point() -> None:
    at = np.arange(12.0).reshape(4, 3)
    at[1, 2] = np.nan
    line = wkb_line(at)
    assert line is not None
    assert (int.from_bytes(line[1:5], "little"), int.from_bytes(line[5:9], "little")) == (1002, 3)
    np.testing.assert_array_equal(np.frombuffer(line[9:]).reshape(3, 3), at[[0, 2, 3]])
    assert wkb_line(at[:2]) == wkb_points(at[:1])[0]
    assert wkb_line(at[1:2]) is None


def test_every_field_says_its_unit_and_meaning(folder: Path) -> None:
    with sqlite3.connect(folder / "places.gpkg") as base:
        told = base.execute(
            "SELECT table_name, column_name, name, description FROM gpkg_data_columns"
        )
        rows = told.fetchall()
    base.close()
    names = {(table, column): name for table, column, name, _ in rows}
    assert names["places", "estimate"] == "estimate [m]"
    assert names["places", "heading"] == "heading [rad]"
    assert names["over_threshold", "length"] == "length [m]"
    assert names["measured", "p_fail"] == "p_fail"
    assert all(meaning for *_, meaning in rows)
    for table in ("places", "over_threshold", "measured"):
        fields = set(pyogrio.read_info(folder / "places.gpkg", layer=table)["fields"])
        assert fields == {column for of, column in names if of == table}


def test_a_geopackage_of_a_local_frame_says_so(tmp_path: Path) -> None:
    lost = replace(without_labels(), worth=Worth("a model", NOWHERE))
    places = lost.places.copy()
    places.loc[3, "z"] = np.nan
    for_others(replace(lost, places=places), tmp_path)
    with sqlite3.connect(tmp_path / "places.gpkg") as base:
        rows = base.execute(
            "SELECT srs_id, description FROM gpkg_contents WHERE data_type = 'features'"
        ).fetchall()
    base.close()
    assert {number for number, _ in rows} == {-1}  # undefined cartesian
    assert all("names no CRS" in told for _, told in rows)
    assert all(told.startswith("The estimates are of a model. Checked nowhere") for _, told in rows)
    read = layer(tmp_path / "places.gpkg", "places")
    assert read["geom"].isna().to_numpy().nonzero()[0].tolist() == [3]
    assert pyogrio.list_layers(tmp_path / "places.gpkg")[:, 0].tolist() == [
        "places",
        "over_threshold",
        "layer_styles",
    ]


def test_gdal_reads_all_layers(folder: Path) -> None:
    program = shutil.which("ogrinfo")
    if program is None:
        pytest.skip("no ogrinfo here: apt install gdal-bin")
    for name in ("places.gpkg", "over_threshold.geojson"):
        done = subprocess.run(
            [program, "-al", "-so", folder / name], capture_output=True, text=True, check=True
        )
        assert "Layer name: over_threshold" in done.stdout
        assert not done.stderr
        assert "Feature Count: 0" not in done.stdout


@pytest.mark.parametrize("make", [one_place, nothing_estimated])
def test_what_has_nothing_to_show_is_empty_and_whole(make: Any, tmp_path: Path) -> None:
    folder = for_others(make(), tmp_path)
    assert len(layer(folder / "places.gpkg", "places")) == len(make().places)
    assert len(layer(folder / "places.gpkg", "over_threshold")) == 0
    found = {message.channel.topic for message in read_ros2_messages(folder / "foxglove.mcap")}
    assert ("/tilestream/worst" in found) == (make is one_place)


def test_an_estimate_is_told_with_the_digits_that_it_deserves(found: Findings) -> None:
    rough = Worth("a model", NOWHERE, mae=0.2, median=0.1)
    labels = worst_labels(replace(found, worth=rough))
    assert list(labels) == worst_places(found.places)
    driven = found.places["measured"] > found.places["estimate"]
    assert {bool(driven[row]) for row in labels} == {True, False}
    for number, (row, label) in enumerate(labels.items(), start=1):
        if driven[row]:
            assert label == f"{number}: {100 * found.places['measured'][row]:.1f} cm measured"
        else:
            one_digit = float(f"{100 * found.places['estimate'][row]:.0e}")
            assert label == f"{number}: {one_digit:.0f} cm"


# --- Styles


def rules_of(style: str) -> list[tuple[str, str, str]]:
    """Label, filter and colour of each rule."""
    root = ET.fromstring(style)
    colours = {}
    for symbol in root.iter("symbol"):
        options = {o.get("name"): str(o.get("value")) for o in symbol.iter("Option")}
        rgba = (options.get("color") or options["line_color"]).split(",")
        colours[symbol.get("name")] = "#" + "".join(f"{int(part):02x}" for part in rgba[:3])
    return [
        (str(rule.get("label")), str(rule.get("filter")), colours[rule.get("symbol")])
        for rule in root.iter("rule")
    ]


def test_styles_have_the_colours_of_the_report_in_centimetres() -> None:
    rules = rules_of(style_of_places(FIXED))
    assert [label for label, _, _ in rules] == [
        "up to 5 cm", "5 to 10 cm", "10 to 15 cm", "15 to 20 cm", "20 to 25 cm", "25 to 50 cm",
        "over 50 cm", "no estimate",
    ]  # fmt: skip
    assert [colour for _, _, colour in rules] == [*FIXED.colours, MISSING]
    own = scale_of(np.linspace(0.021, 0.043, 50))
    assert [colour for _, _, colour in rules_of(style_of_places(own))][:-1] == own.colours


def test_each_error_has_one_rule_and_its_colour() -> None:
    """SQLite reads the filters as QGIS does."""
    errors = [0.0, 0.05, np.nextafter(0.05, 1), 0.2, 0.25, 0.26, 0.5, 0.51, 9.0]
    with sqlite3.connect(":memory:") as base:
        for error in (*errors, None):
            kept = [
                colour
                for _, where, colour in rules_of(style_of_places(FIXED))
                if base.execute(
                    f'SELECT {where} FROM (SELECT ? AS "estimate")', [error]
                ).fetchone()[0]
            ]
            assert kept == FIXED.shades(np.array([np.nan if error is None else error]))
    base.close()


def test_the_style_of_stretches_begins_at_the_threshold() -> None:
    rules = rules_of(style_over_threshold(FIXED, 0.25))
    assert [label for label, _, _ in rules] == ["25 to 50 cm"] * 2 + ["over 50 cm"] * 2
    assert {colour for _, _, colour in rules} == set(FIXED.colours[-2:])
    first = rules_of(style_over_threshold(FIXED, 0.12))[0]
    assert first[0] == "10 to 15 cm"


@cache
def qgis_python() -> str:
    """A Python that has QGIS, else the test is skipped."""
    for program in ("/usr/bin/python3", shutil.which("python3")):
        if (
            program
            and subprocess.run([program, "-c", "import qgis.core"], capture_output=True).returncode
            == 0
        ):
            return program
    pytest.skip("no QGIS here: apt install python3-qgis")


IN_QGIS = """
import json, sys
import qgis.core as q
app = q.QgsApplication([], False)
app.initQgis()
found = {}
for source in sys.argv[1:]:
    layer = q.QgsVectorLayer(source, "layer", "ogr")
    renderer, context = layer.renderer().clone(), q.QgsRenderContext()
    context.expressionContext().appendScopes(q.QgsExpressionContextUtils.globalProjectLayerScopes(layer))
    renderer.startRender(context, layer.fields())
    colours = []
    for feature in layer.getFeatures():
        context.expressionContext().setFeature(feature)
        symbols = renderer.originalSymbolsForFeature(feature, context)
        colours += [symbol.color().name() for symbol in symbols]
    renderer.stopRender(context)
    labels = layer.labeling().settings() if layer.labelsEnabled() else None
    texts = []
    if labels:
        expression = q.QgsExpression(labels.fieldName)
        for feature in layer.getFeatures():
            context.expressionContext().setFeature(feature)
            texts.append(expression.evaluate(context.expressionContext()) or None)
    found[source] = {
        "crs": layer.crs().authid(), "renderer": renderer.type(), "colours": colours,
        "labels": [text for text in texts if isinstance(text, str)],
        "legend": [item.label() for item in layer.renderer().legendSymbolItems()],
    }
print(json.dumps(found))
"""


def in_qgis(*sources: str) -> list[dict[str, Any]]:
    """What QGIS's own library makes of layers."""
    environment = {"QT_QPA_PLATFORM": "offscreen", "HOME": "/tmp", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [qgis_python(), "-c", IN_QGIS, *sources],
        capture_output=True, text=True, check=False, env=environment, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    return [told[source] for source in sources]


def test_qgis_shows_each_place_in_its_colour_and_labels_the_worst(
    found: Findings, folder: Path
) -> None:
    base, kinds = folder / "places.gpkg", ("LineString", "Point")
    places, driven, *others = in_qgis(
        *(f"{base}|layername={name}" for name in ("places", "measured")),
        *(f"{folder}/over_threshold.geojson|geometrytype={kind}" for kind in kinds),
        *(f"{base}|layername=over_threshold|geometrytype={kind}25D" for kind in kinds),
    )
    assert places["crs"] == "EPSG:32654"
    assert places["colours"] == FIXED.shades(found.places["estimate"].to_numpy())
    assert places["legend"][1:3] == ["5 to 10 cm", "10 to 15 cm"]
    assert sorted(places["labels"]) == sorted(worst_labels(found).values())
    assert driven["colours"] == FIXED.shades(found.places["measured"].dropna().to_numpy())
    told = json.loads((folder / "over_threshold.geojson").read_text())["features"]
    worst = [
        FIXED.shades(
            np.array([f["properties"]["worst"] for f in told if f["geometry"]["type"] == kind])
        )
        for kind in kinds
    ]
    assert all(worst)
    assert [other["colours"] for other in others] == [*worst, *worst]


# --- MCAP


def messages(path: Path) -> dict[str, Any]:
    """The one message of each topic."""
    found = list(read_ros2_messages(path))
    topics = [message.channel.topic for message in found]
    assert len(set(topics)) == len(topics)
    assert len({message.log_time_ns for message in found}) == 1
    return {message.channel.topic: message.ros_msg for message in found}


def rows_of(cloud: Any) -> np.ndarray[Any, Any]:
    kinds = [(field.name, "<f4") for field in cloud.fields]
    rows: np.ndarray[Any, Any] = np.frombuffer(bytes(cloud.data), kinds)
    assert (len(rows), cloud.point_step) == (cloud.width, rows.itemsize)
    return rows


def test_the_scene_has_every_place_to_the_millimetre(found: Findings, folder: Path) -> None:
    scene = messages(folder / "foxglove.mcap")
    (moved,) = scene["/tf_static"].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("world", "map")
    step = moved.transform.translation
    origin = np.array([step.x, step.y, step.z])
    assert (origin % 10.0 == 0.0).all()
    at = found.places[["x", "y", "z"]].to_numpy()
    assert np.abs(at[worst_places(found.places)[0]] - origin).max() <= 5.0
    places = rows_of(scene["/tilestream/places"])
    assert scene["/tilestream/places"].header.frame_id == "map"
    xyz = np.column_stack([places[name] for name in "xyz"]).astype(np.float64)
    np.testing.assert_allclose(xyz + origin, at, atol=1e-3)
    estimate = found.places["estimate"].to_numpy()
    np.testing.assert_array_equal(places["estimate"], estimate.astype(np.float32))
    packed = places["rgb"].view(np.uint32)
    rgb = np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255])
    np.testing.assert_array_equal(rgb, FIXED.rgb(estimate))


def test_the_route_is_coloured_and_the_worst_places_are_labelled(
    found: Findings, folder: Path
) -> None:
    scene = messages(folder / "foxglove.mcap")
    lines = scene["/tilestream/route"].markers
    assert [(line.type, line.ns, len(line.points)) for line in lines] == [
        (4, "I", 300),
        (4, "II", 160),
    ]
    shown = np.array([(c.r, c.g, c.b) for line in lines for c in line.colors])
    estimate = found.places["estimate"].to_numpy()
    np.testing.assert_allclose(255.0 * shown, FIXED.rgb(estimate), atol=1e-3)
    balls, *texts = scene["/tilestream/worst"].markers
    rows = worst_places(found.places)
    assert (balls.type, len(balls.points)) == (7, len(rows))
    error = np.fmax(estimate, found.places["measured"])
    driven = error == found.places["measured"]
    for number, (row, text) in enumerate(zip(rows, texts, strict=True), start=1):
        first, second, *reasons = text.text.splitlines()
        assert first == f"{number}: {100 * error[row]:.1f} cm{' measured' if driven[row] else ''}"
        assert second == f"{found.places['route_id'][row]}, {found.places['arc_length'][row]:.0f} m"
        assert reasons == ["few features in view"]
        assert text.pose.position.x == pytest.approx(balls.points[number - 1].x)
    (cubes,) = scene["/tilestream/measured"].markers
    assert (cubes.type, len(cubes.points)) == (6, found.places["measured"].notna().sum())
    ids = [(marker.ns, marker.id) for marker in (*lines, balls, *texts)]
    assert len(set(ids)) == len(ids)


def test_the_map_of_the_scene_is_read_by_our_own_reader(folder: Path) -> None:
    with McapFile(str(folder / "foxglove.mcap")) as file:
        (topic,) = (topic for topic in file.topics if topic.name == "/tilestream/map")
        (message,) = file.messages({topic.name})
        cloud = ros.read_cloud(message.data, topic.encoding)
        points = recorded_scan(cloud.stamp_ns, cloud.rows()).points
    origin = json.loads((folder / "report.json").read_text())["foxglove"]["origin"]
    np.testing.assert_allclose(points + origin, some_of_the_map(MOST_POINTS), atol=1e-4)


def test_the_messages_are_those_of_ros(folder: Path) -> None:
    """An independent reader has the definitions of ROS 2 Humble."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    with (folder / "foxglove.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            ours = get_types_from_msg(schema.data.decode(), schema.name)
            for name, (_, fields) in ours.items():  # constants are not in the bytes
                assert types.fielddefs[name][1] == fields
            read = types.deserialize_cdr(message.data, schema.name)
            if channel.topic == "/tilestream/worst":
                assert read.markers[1].text.startswith("1: ")


def test_whoever_comes_late_gets_the_scene_too_and_the_file_says_what_it_is(
    found: Findings, folder: Path
) -> None:
    with (folder / "foxglove.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        (told,) = reader.iter_metadata()
    assert summary is not None
    for channel in summary.channels.values():
        (offered,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert (offered["durability"], offered["reliability"]) == (
            1,
            1,
        )  # transient local, reliable
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    origin = json.loads((folder / "report.json").read_text())["foxglove"]["origin"]
    assert all(f"{value:.0f}" in told.metadata["origin"] for value in origin)
    assert told.metadata["crs"] == found.crs


def test_a_scene_without_the_map_says_why(tmp_path: Path) -> None:
    def failed(most: int) -> Float64:
        raise TileNotReadyError("tile (3, 4) failed: disk full")

    content = write_report(replace(one_place(), map_points=failed), tmp_path)
    assert content["foxglove"]["map_points"] == 0
    assert content["foxglove"]["without_map"] == "tile (3, 4) failed: disk full"
    assert "has no map: tile (3, 4) failed" in (tmp_path / "index.html").read_text()
    assert "/tilestream/map" not in messages(tmp_path / "foxglove.mcap")


# --- All of them


def test_a_file_that_cannot_be_made_costs_only_itself_and_says_why(tmp_path: Path) -> None:
    (tmp_path / "there.osm").write_text("<osm/>")
    maps = [LaneletMap(str(tmp_path / f"{name}.osm"), list) for name in ("gone", "there")]
    (tmp_path / "report").mkdir()
    for name in ("lanelets.osm", "lanelets-3.osm"):
        (tmp_path / "report" / name).write_text("of an earlier report")
    content = write_report(replace(one_place(), lanelet_maps=tuple(maps)), tmp_path / "report")
    assert list(content["lanelet_maps"]) == ["lanelets-2.osm"]
    assert (tmp_path / "report" / "lanelets-2.osm").read_text() == "<osm/>"
    assert list(content["not_written"]) == ["lanelets.osm"]
    assert "no longer there" in content["not_written"]["lanelets.osm"]
    there = {path.name for path in (tmp_path / "report").iterdir()}
    assert there == {*content["files"], "index.html", "report.json", "figures"}
    page = (tmp_path / "report" / "index.html").read_text()
    assert "could not be written" in page
    assert all(f'<a href="{name}"' in page for name in content["files"])


def test_the_files_are_written_to_any_place(found: Findings, folder: Path) -> None:
    there = Files.at("memory://exports/report")
    write_for_others(there, found, LIMIT, told_of(found))
    for name in ("places.gpkg", "foxglove.mcap", "over_threshold.qml"):
        assert there.under(name).read() == (folder / name).read_bytes(), name


def test_the_bytes_do_not_depend_on_how_a_column_is_held(
    found: Findings, folder: Path, tmp_path: Path
) -> None:
    half = len(found.places) // 2
    parts = [pa.Table.from_pandas(part) for part in (found.places[:half], found.places[half:])]
    again = pa.concat_tables(parts).to_pandas(
        types_mapper={pa.string(): pd.ArrowDtype(pa.string())}.get
    )
    file = Files.at(tmp_path / "places.gpkg")
    write_geopackage(file, replace(found, places=again), LIMIT, told_of(found))
    assert file.read() == (folder / "places.gpkg").read_bytes()
