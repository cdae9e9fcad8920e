"""Routes from every format, at equal arc length; what is no route is refused."""

import csv
import json
import tracemalloc
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import SECOND, START, pose
from pyproj import Transformer

from tilestream.errors import (
    CorruptSourceError,
    CrsError,
    PoseError,
    SourceError,
    SourceNotFoundError,
    UnknownFormatError,
    UsageError,
)
from tilestream.formats.motion import along
from tilestream.formats.routes import (
    read_all_routes,
    read_route,
    read_routes,
    resample,
    route_of,
    together,
    write_geojson_route,
    write_tum,
)
from tilestream.formats.routes.routes_read import distinct
from tilestream.records import Trajectory

XYZ = np.array([[0.0, 0, 1], [30, 0, 1.5], [30, 40, 2], [-20, 40, 2]])


def geojson(path: Path, *geometries: Any, **top: Any) -> Path:
    features = [{"type": "Feature", "properties": None, "geometry": g} for g in geometries]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **top}))
    return path


def line(points: Any) -> dict[str, Any]:
    return {"type": "LineString", "coordinates": np.asarray(points).tolist()}


def as_tum(path: Path) -> Path:
    rows = [f"{i}.5 {x} {y} {z} 0 0 0 1" for i, (x, y, z) in enumerate(XYZ)]
    path.write_text("# stamp x y z\n\n" + "\n".join(rows))
    return path


def as_kitti(path: Path) -> Path:
    path.write_text("\n".join(f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}" for x, y, z in XYZ))
    return path


def as_csv(path: Path) -> Path:
    rows = [f"{i},{z},{y},{x}" for i, (x, y, z) in enumerate(XYZ)]
    path.write_text("\ufeffid, Z_m ,north_m (local),East\n" + "\n".join(rows))
    return path


FORMATS: dict[str, Any] = {
    "a.tum": as_tum,
    "b.txt": as_tum,
    "c.txt": as_kitti,
    "d.csv": as_csv,
    "e.geojson": lambda path: geojson(path, line(XYZ)),
    "f.json": lambda path: path.write_text(json.dumps(line(XYZ))),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_route(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    FORMATS[name](path)
    route = read_route(path)
    assert route.route_id == path.stem
    np.testing.assert_array_equal(route.positions, XYZ)
    steps = np.linalg.norm(np.diff(XYZ, axis=0), axis=1)
    np.testing.assert_allclose(route.arc_length, [0, *np.cumsum(steps)])
    assert route.heading[[0, 3]].tolist() == pytest.approx([0, np.pi])
    assert route.heading[1] == pytest.approx(np.pi / 4, abs=1e-3)
    assert (route.crs, route.dropped) == (None, 0)


AS_WRITTEN: dict[str, str] = {
    "empty rows at the end": "x,y,z\n1.5,0,7\n20,-3.25,7\n\n,,\n  \n",
    "semicolons": "x;y;z\n1.5;0;7\n20;-3.25;7\n",
    "decimal commas": "x;y;z\r\n1,5;0;7,000\r\n20;-3,25;7,000\r\n",
    "tabs": "x\ty\tz\n1.5\t0\t7\n20\t-3.25\t7\n",
    "quotes and blanks": '"x", "y", "z"\n"1.5", 0 , 7\n"20", -3.25 , 7\n',
}


@pytest.mark.parametrize("kind", AS_WRITTEN)
def test_csv_as_people_write_it(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(AS_WRITTEN[kind])
    assert read_route(path).positions.tolist() == [[1.5, 0, 7], [20, -3.25, 7]]


@pytest.mark.parametrize("empty", ["", " ", "nan", "NaN"])
def test_a_column_of_no_heights_is_no_height(empty: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"x,y,z\n0,0,{empty}\n30,40,{empty}\n")
    route = read_route(path)
    assert np.isnan(route.positions[:, 2]).all()
    assert route.arc_length[-1] == 50


# --- real files


def test_the_real_lane_centre_route(shared_data: Path) -> None:
    path = shared_data / "shinjuku" / "route_nishishinjuku_local_m.csv"
    route = read_route(path)
    rows = list(csv.reader(path.read_text().splitlines()))[1:]
    assert len(route.positions) == len(rows)
    assert route.positions[0, :2].tolist() == [-938.87, -505.51]
    assert np.isnan(route.positions[:, 2]).all()
    np.testing.assert_allclose(route.arc_length, [float(r[0]) for r in rows], atol=0.05)
    every_metre = resample(route)
    assert len(every_metre.positions) == 2873
    assert np.isnan(every_metre.positions[:, 2]).all()


def test_a_real_log_is_the_way_of_its_lidar(shared_data: Path) -> None:
    path = shared_data / "kitti_drive" / "drive.mcap"
    route = read_route(path)
    assert len(route.positions) == 52
    assert route.positions[0].tolist() == [0.0, 0.0, 0.0]
    assert route.arc_length[-1] == pytest.approx(71.45, abs=0.1)
    lowered = read_route(path, z_offset=-1.73)
    assert lowered.positions[0, 2] == -1.73


# --- equal arc length


def test_a_metre_apart_along_the_route() -> None:
    route = route_of("r", np.array([[0.0, 0, np.nan], [10, 0, np.nan], [10, 5.5, np.nan]]))
    every = resample(route)
    assert every.arc_length.tolist() == list(range(16))
    np.testing.assert_allclose(every.positions[:11, 0], np.arange(11))
    np.testing.assert_allclose(every.positions[11:, 1], np.arange(1, 6))
    np.testing.assert_allclose(every.heading[:10], 0.0, atol=1e-12)
    assert every.heading[10] == pytest.approx(np.pi / 4)
    np.testing.assert_allclose(every.heading[11:], np.pi / 2)


@given(
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=12),
    st.sampled_from([5.0, 13.0]),
)
@settings(deadline=None)
def test_points_lie_on_the_route_at_their_arc_length(
    points: list[tuple[float, float]], spacing: float
) -> None:
    xyz = np.array([(x + 3.7e5, y + 3.95e6, np.nan) for x, y in points])
    try:
        route = route_of("r", xyz, max_jump=1e5)
    except CorruptSourceError:
        assert np.ptp(xyz[:, :2], axis=0).max() <= 0.01 * len(xyz)
        return
    if route.arc_length[-1] < spacing:
        with pytest.raises(UsageError, match="spacing"):
            resample(route, spacing)
        return
    every = resample(route, spacing)
    np.testing.assert_allclose(np.diff(every.arc_length), spacing)
    assert route.arc_length[-1] - every.arc_length[-1] < spacing * (1 + 1e-9)
    segment = np.clip(np.searchsorted(route.arc_length, every.arc_length), 1, None)
    segment = np.minimum(segment, len(route.arc_length) - 1)
    a, b = route.positions[segment - 1, :2], route.positions[segment, :2]
    begin, end = route.arc_length[segment - 1], route.arc_length[segment]
    share = np.minimum((every.arc_length - begin) / (end - begin), 1.0)[:, None]
    np.testing.assert_allclose(every.positions[:, :2], a + share * (b - a), atol=1e-6)
    assert (np.abs(every.heading) <= np.pi).all()


def test_height_is_part_of_the_length_where_there_is_one() -> None:
    route = route_of("r", np.array([[0.0, 0, 0], [30, 0, 4], [60, 0, 8]]))
    assert route.arc_length[-1] == pytest.approx(2 * np.hypot(30, 4))
    np.testing.assert_allclose(resample(route).positions[10, 2], 10 * 4 / np.hypot(30, 4))


# --- what a path may do, and may not


def test_repeated_points_are_dropped_and_counted() -> None:
    xyz = np.array([[0.0, 0, 0], [0, 0, 0], [5, 0, 0], [5.002, 0, 0], [5, 0.003, 0], [9, 0, 0]])
    route = route_of("r", xyz)
    assert route.positions[:, 0].tolist() == [0, 5, 9]
    assert route.dropped == 3


def test_slow_motion_is_no_repetition() -> None:
    xyz = np.column_stack([np.arange(0, 5, 0.004), np.zeros(1250), np.zeros(1250)])
    assert route_of("r", xyz).arc_length[-1] == pytest.approx(5.0, abs=0.02)


def test_a_way_there_and_back_is_kept_and_the_heading_turns() -> None:
    route = route_of("r", np.array([[0.0, 0, 0], [10, 0, 0], [0, 0, 0]]))
    every = resample(route)
    assert every.arc_length[-1] == 20
    np.testing.assert_allclose(every.heading[:10], 0, atol=1e-12)
    np.testing.assert_allclose(np.abs(every.heading[11:]), np.pi)
    assert np.isfinite(every.heading).all()


def test_a_jump_is_an_error_that_names_point_and_distance() -> None:
    xyz = np.array([[0.0, 0, 0], [5, 0, 0], [5, 0, 0], [5, 4000, 0], [9, 4000, 0]])
    with pytest.raises(PoseError, match=r"jumps 4000\.0 m from point 1 to point 3.*max_jump"):
        route_of("r", xyz)
    assert route_of("r", xyz, max_jump=5000.0).arc_length[-1] == 4009


@pytest.mark.parametrize(
    "degrees",
    [
        [[139.69, 35.69], [139.695, 35.695], [139.70, 35.70]],
        [[8.4242, 49.0034], [8.4243, 49.0035]],
        [[139.0 + 1e-4 * i, 35.0 + 2e-4 * i] for i in range(12_000)],
        [[-0.1276, 51.507], [-0.1280, 51.508]],
    ],
)
def test_degrees_are_refused_and_can_be_projected(degrees: Any, tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", line(degrees))
    with pytest.raises(CrsError, match="degrees, not metres"):
        read_routes(path)
    with pytest.raises(CrsError, match="project_to = 'EPSG:4326' is in degrees"):
        read_routes(path, project_to="EPSG:4326")
    with pytest.raises(CrsError, match="no CRS"):
        read_routes(path, project_to="nowhere")
    zone = f"EPSG:{32600 + int((degrees[0][0] + 180) // 6) + 1}"
    route = read_route(path, project_to=zone)
    x, y = Transformer.from_crs("EPSG:4326", zone, always_xy=True).transform(*degrees[0])
    np.testing.assert_allclose(route.positions[0, :2], [x, y])
    assert route.crs == zone


@pytest.mark.parametrize(
    "metres",
    [
        [[0, 0], [3, 1], [8, 2]],
        [[80.0 + 0.05 * i, -20.0] for i in range(60)],
        [[458000, 5427900], [458000.5, 5427900.2]],
    ],
)
def test_short_routes_in_metres_are_no_degrees(metres: Any, tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", line(metres))
    assert read_route(path).arc_length[-1] > 0.5
    with pytest.raises(CrsError, match="not in degrees"):
        read_routes(path, project_to="EPSG:32654")


def test_a_vehicle_that_stands_most_of_the_time_is_not_in_degrees(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    waits = rng.normal(0, 1e-4, 500)
    drives = np.arange(0, 20, 0.1)
    x = np.concatenate([waits, drives])
    path = tmp_path / "a.tum"
    path.write_text("\n".join(f"{i} {v} 3 0 0 0 0 1" for i, v in enumerate(x)))
    assert read_route(path).arc_length[-1] == pytest.approx(19.9, abs=0.01)


def test_what_the_file_says_of_its_crs_counts(tmp_path: Path) -> None:
    def named(crs: str) -> dict[str, Any]:
        return {"crs": {"type": "name", "properties": {"name": crs}}}

    metric = geojson(tmp_path / "m.geojson", line(XYZ), **named("urn:ogc:def:crs:EPSG::6677"))
    assert read_route(metric).crs == "urn:ogc:def:crs:EPSG::6677"
    degrees = geojson(tmp_path / "d.geojson", line(XYZ / 2), **named("EPSG:4326"))
    with pytest.raises(CrsError, match="degrees"):
        read_route(degrees)
    broken = geojson(tmp_path / "b.geojson", line(XYZ), crs="here")
    with pytest.raises(CorruptSourceError, match="crs"):
        read_route(broken)


def test_the_names_of_columns_tell_degrees(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("lat,lon\n35.0,139.0\n36.5,139.0\n")
    with pytest.raises(CrsError, match="degrees"):
        read_route(path)


def test_degrees_that_are_none_are_refused_with_what_they_look_like(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("lat,lon\n139.1,35.0\n139.1,36.5\n")
    with pytest.raises(CrsError, match=r"longitude 35, latitude 139\.1 .*look swapped"):
        read_route(path, project_to="EPSG:6677")
    path.write_text("lat,lon\n-12000,35\n-12000,360\n")
    with pytest.raises(CrsError, match="look like metres"):
        read_route(path)
    path.write_text("lat,lon\n0,48\n0,49.8\n")
    with pytest.raises(CrsError, match="is nowhere in EPSG:6677"):
        read_route(path, project_to="EPSG:6677")


def test_poses_of_a_camera_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "00.txt"
    path.write_text("\n".join(f"1 0 0 {0.1 * i} 0 1 0 0.01 0 0 1 {2 * i}" for i in range(50)))
    with pytest.raises(CorruptSourceError, match=r"climbs 98\.0 m.*z up"):
        read_route(path)


BAD: dict[str, tuple[str, str]] = {
    "empty.tum": ("", "is empty"),
    "comment.tum": ("# nothing\n", "is empty"),
    "one.tum": ("1 0 0 0 0 0 0 1", "1 different points of 1"),
    "still.tum": ("1 5 5 5 0 0 0 1\n2 5 5 5 0 0 0 1", "1 different points of 2"),
    "seven.tum": ("1 0 0 0 0 0 0", "line 1 has 7 numbers"),
    "ragged.txt": ("1 0 0 0 0 0 0 1\n\n2 0 0 0 0 0 0", "line 3 has 7 numbers"),
    "word.tum": ("1 0 zero 0 0 0 0 1", "line 1 is no number: 'zero'"),
    "nan.tum": ("1 0 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1", "line 2 is not finite"),
    "empty.csv": ("", "is empty"),
    "noheader.csv": ("0,0\n10,0\n", "names no columns x and y"),
    "nopoints.csv": ("x,y\n", "0 different points"),
    "word.csv": ("x,y\n0,0\n1,far\n", "line 3, column y is no number: 'far'"),
    "short.csv": ("x,y\n0,0\n1\n", "line 3, column y is no number: ''"),
    "inf.csv": ("x,y\n0,0\n1,inf\n", "line 3, column y is not finite"),
    "blank.csv": ("x,y\n0,0\n\n1,1\n", "line 3 is empty"),
    "somez.csv": ("x,y,z\n0,0,1\n5,0,\n", "point 1 has no z, others have"),
    "grouped.csv": ("x;y\n1,000;2,000\n1,200;2,100\n", "'1,000' may have a decimal comma, or one"),
    "mixed.csv": ("x;y\n1.234,5;0\n8.234,5;0\n", "'1.234,5' may have a decimal comma"),
    "broken.geojson": ('{"type": ', "no GeoJSON"),
    "list.geojson": ("[1, 2]", "no GeoJSON"),
    "point.geojson": ('{"type": "Point", "coordinates": [1, 2]}', "no LineString but Point"),
    "none.geojson": ('{"type": "FeatureCollection", "features": []}', "no geometry"),
    "noline.geojson": ('{"type": "LineString", "coordinates": []}', "no coordinates"),
    "null.geojson": ('{"type": "LineString", "coordinates": [[0, null]]}', "point 0 is no number"),
    "flat.geojson": ('{"type": "LineString", "coordinates": [0, 1]}', "point 0 is no position"),
    "nan.geojson": ('{"type": "LineString", "coordinates": [[0, NaN]]}', "point 0 is not finite"),
    "deep.geojson": ("[" * 100_000, "RecursionError"),
    "large.geojson": (f'{{"type": "LineString", "coordinates": [[0, {"9" * 400}]]}}', "too large"),
    "shape.geojson": ('{"type": "Feature", "properties": [1]}', "AttributeError"),
    "features.geojson": ('{"type": "FeatureCollection", "features": 7}', "TypeError"),
    "field.csv": ("x,y\n0,0\n1," + "9" * 200_000, "field larger than field limit"),
    "broken.osm": ("<osm>", "no OSM XML"),
    "encoding.osm": ('<?xml version="1.0" encoding="foo"?><osm/>', "unknown encoding"),
    "none.osm": ("<osm/>", "no lanelets"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_route_is_refused_with_the_place(name: str, tmp_path: Path) -> None:
    content, told = BAD[name]
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(CorruptSourceError, match=told) as caught:
        read_routes(path)
    assert str(path) in str(caught.value)


def test_a_route_around_the_earth_is_looked_at_within_bounds(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + "\n".join(f"{900_000 * i},0,0" for i in range(50)))
    tracemalloc.start()
    try:
        (route,) = read_routes(path, max_jump=1e6)
        assert tracemalloc.get_traced_memory()[1] < 200_000_000
    finally:
        tracemalloc.stop()
    assert route.arc_length[-1] == 900_000 * 49


def test_points_with_and_without_height_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"type": "LineString", "coordinates": [[0, 0, 1], [5, 0]]}')
    with pytest.raises(CorruptSourceError, match="point 1 has no z, others have"):
        read_route(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match="no such file"):
        read_routes(tmp_path / "none.csv")
    other = tmp_path / "route.gpx"
    other.write_text("<gpx/>")
    with pytest.raises(UnknownFormatError, match=r"\.gpx.*\.tum"):
        read_routes(other)
    binary = tmp_path / "route.csv"
    binary.write_bytes(b"\xff\xfe\x00\x01\x80")
    with pytest.raises(CorruptSourceError, match="not a text file"):
        read_routes(binary)


# --- poses that stand, and poses with gaps


def as_poses(path: Path, xyz: Any, stamps: Any) -> Path:
    rows = zip(np.asarray(stamps).tolist(), np.asarray(xyz, dtype=float).tolist(), strict=True)
    lines = [f"{t!r} {x!r} {y!r} {z!r} 0 0 0 1" for t, (x, y, z) in rows]
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize("waits", [(0.0,), (15.0,), (30.0,), (0.0, 10.0, 11.0, 30.0)])
def test_waiting_adds_no_length(waits: tuple[float, ...], noise: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    x = np.sort(np.concatenate([np.arange(301) / 10, *(np.full(900, at) for at in waits)]))
    xyz = np.column_stack([x, 0 * x, 0 * x]) + rng.normal(0, noise, (len(x), 3))
    route = read_route(as_poses(tmp_path / "a.tum", xyz, np.arange(len(x)) / 10))
    assert route.arc_length[-1] == pytest.approx(30.0, abs=0.3 + 3 * noise)
    arc = along(xyz)
    assert (np.diff(arc) >= 0).all()
    assert np.abs(arc - x).max() < 0.3 + 5 * noise


def test_along_a_path_that_never_stands_is_its_length() -> None:
    xyz = np.cumsum(np.random.default_rng(0).uniform(0.5, 2, (50, 3)), axis=0)
    lengths = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    np.testing.assert_allclose(along(xyz), [0, *np.cumsum(lengths)])
    assert along(xyz[:1]).tolist() == [0.0]
    fine = np.column_stack([np.arange(100) / 30, np.zeros(100)])
    np.testing.assert_allclose(along(fine), fine[:, 0])


DRIVE = [*range(20)]
GAPS: dict[str, tuple[list[int], Any, list[tuple[float, float]]]] = {
    "faster than a vehicle": ([*DRIVE, *range(50, 70)], np.arange(40) / 10, [(0, 19), (50, 69)]),
    "longer than steps are": ([*DRIVE, *range(60, 80)], np.r_[:20, 90:110], [(0, 19), (60, 79)]),
    "as a vehicle drives": ([*DRIVE, *range(30, 50)], np.arange(40), [(0, 49)]),
    "a place far off": ([*DRIVE, 900, *range(20, 40)], np.arange(41) / 10, [(0, 19), (20, 39)]),
    "stands at first": ([0] * 9 + [*range(900, 920)], np.arange(29) / 10, [(900, 919)]),
    "slow for long, then fast": (
        [*range(99), *range(99, 900, 30)],
        np.arange(126),
        [(0, 879)],
    ),
    "no time": ([*DRIVE, *range(30, 50)], np.zeros(40), [(0, 49)]),
    "few poses far apart": ([0, 30, 70, 20], np.arange(4), [(0, 20)]),
}


@pytest.mark.parametrize("kind", GAPS)
def test_poses_are_cut_where_nobody_drove(kind: str, tmp_path: Path) -> None:
    x, stamps, ends = GAPS[kind]
    xyz = np.pad(np.array(x)[:, None], [(0, 0), (0, 2)])
    read = read_all_routes(as_poses(tmp_path / "a.tum", xyz, stamps))
    assert [(r.positions[0, 0], r.positions[-1, 0]) for r in read.routes] == ends
    assert [r.route_id for r in read.routes] == ["a", "a-2"][: len(ends)]
    cut = len(ends) > 1 or ends[0][0] > 0
    assert any("cut where nobody drove" in note for note in read.notes) == cut
    stands = kind in ("a place far off", "stands at first")
    assert any("left out, the vehicle stands" in note for note in read.notes) == stands


def test_a_kitti_file_without_stamps_is_cut_too(tmp_path: Path) -> None:
    path = tmp_path / "a.kitti"
    x = [*range(20), *range(60, 80)]
    path.write_text("\n".join(f"1 0 0 {v} 0 1 0 0 0 0 1 0" for v in x))
    assert [r.arc_length[-1] for r in read_routes(path)] == [19.0, 19.0]


def test_a_log_is_cut_at_a_jump(tmp_path: Path) -> None:
    messages: list[logs.Message] = []
    for i in range(20):
        stamp = START + i * SECOND // 10
        T = pose(x=i if i < 9 else i + 400.0)
        messages += [logs.odometry_at(stamp, T), logs.cloud_at(stamp)]
    read = read_all_routes(logs.write(tmp_path / "a.mcap", messages))
    assert [r.arc_length[-1] for r in read.routes] == [8.0, 10.0]
    assert "a gap of 401.0 m after (8.0, 0.0)" in read.notes[0]


def test_a_drawn_line_has_no_gaps(tmp_path: Path) -> None:
    drawn = [[x, 0, 0] for x in (*DRIVE, *range(500, 520))]
    assert read_route(geojson(tmp_path / "a.geojson", line(drawn))).arc_length[-1] == 519.0


# --- several routes


def test_several_routes_in_one_file(tmp_path: Path) -> None:
    path = geojson(
        tmp_path / "a.geojson",
        line(XYZ),
        {"type": "Point", "coordinates": [0, 0]},
        {"type": "MultiLineString", "coordinates": [XYZ.tolist(), (XYZ + 5).tolist()]},
    )
    routes = read_routes(path)
    assert [r.route_id for r in routes] == ["a", "a/2/0", "a/2/1"]
    np.testing.assert_array_equal(routes[2].positions, XYZ + 5)
    with pytest.raises(SourceError, match=r"more than one route.*a, a/2/0, a/2/1"):
        read_route(path)
    with pytest.raises(SourceError, match="no route 'b'"):
        read_route(path, route_id="b")
    assert read_route(path, route_id="a/2/1").route_id == "a/2/1"


def test_names_that_are_taken_are_not_given_again(tmp_path: Path) -> None:
    assert distinct(["a", "a-2", "a", "b", "a"]) == ["a", "a-2", "a-3", "b", "a-4"]
    path = geojson(tmp_path / "a.geojson", line(XYZ))
    read = together([read_all_routes(path), read_all_routes(path)])
    assert [r.route_id for r in read.routes] == ["a", "a-2"]
    assert read.notes == ("2 routes are named a: here they are a, a-2",)


def test_bad_routes_are_left_out_by_name(tmp_path: Path) -> None:
    path = geojson(
        tmp_path / "a.geojson",
        line(XYZ),
        line([[5, 5, 5], [5, 5, 5]]),
        {"type": "LineString", "coordinates": [[0, None]]},
        line([[0, 0, 0], [0.4, 0, 0]]),
        {"type": "MultiLineString", "coordinates": [XYZ.tolist(), []]},
    )
    broken = tmp_path / "broken.csv"
    broken.write_text("x,y\n0,far\n")
    read = together([read_all_routes(path), read_all_routes(broken)]).at_least(1.0)
    assert [r.route_id for r in read.routes] == ["a", "a/4/0"]
    failures = {
        "route a/2": "point 0 is no number",
        "route a/4/1": "has no coordinates",
        "route a/1": "1 different points of 2",
        "route broken": "column y is no number: 'far'",
        "route a/3": "at most the length of route a/3, 0.40 m",
    }
    assert list(read.failures) == list(failures)
    for name, why in failures.items():
        assert why in read.failures[name]
    assert read_route(path, route_id="a").route_id == "a"
    for unclear in (None, "a/1"):
        with pytest.raises(CorruptSourceError, match="point 0 is no number"):
            read_route(path, route_id=unclear)


def test_where_no_route_is_good_the_first_says_why(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", line([[5, 5, 5], [5, 5, 5]]))
    with pytest.raises(CorruptSourceError, match="1 different points of 2"):
        together([read_all_routes(path)])
    short = geojson(tmp_path / "b.geojson", line([[0, 0, 0], [1.5, 0, 0]]))
    with pytest.raises(UsageError, match=r"at most the length of route b, 1\.50 m"):
        together([read_all_routes(short)]).at_least(2.0)


# --- out


def test_geojson_reads_back_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    steps = rng.uniform(0.1, 2, (50, 3)) * np.array([1, 1, 0.1])
    walk = np.cumsum(steps, axis=0) + np.array([3.7e5, 3.95e6, 40])
    flat = walk.copy()
    flat[:, 2] = np.nan
    routes = [route_of(name, xyz, crs="EPSG:6677") for name, xyz in (("a", walk), ("b", flat))]
    path = tmp_path / "a.geojson"
    write_geojson_route(path, routes)
    for route, found in zip(routes, read_routes(path), strict=True):
        assert (found.route_id, found.crs) == (route.route_id, "EPSG:6677")
        assert found.positions.tobytes() == route.positions.tobytes()
    with pytest.raises(UsageError, match="different CRS"):
        write_geojson_route(path, [routes[0], route_of("c", walk)])


def test_tum_reads_back_to_the_bit(tmp_path: Path) -> None:
    stamps = START + np.arange(5) * SECOND // 3
    T = np.array([pose(x=3.7e5 + 2 * i / 3, y=3.95e6, z=0.1, yaw=0.2 * i) for i in range(5)])
    path = tmp_path / "a.tum"
    write_tum(path, Trajectory(stamps, T))
    assert read_route(path).positions.tobytes() == T[:, :3, 3].tobytes()
    rows = [r.split() for r in path.read_text().splitlines()[1:]]
    found = [int(r[0].replace(".", "")) for r in rows]
    assert found == stamps.tolist()
    assert float(rows[2][7]) == pytest.approx(np.cos(0.2))
