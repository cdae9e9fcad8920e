"""Autoware's divided map: its metadata, files that are missing or outside, where on earth it is."""

import os
from pathlib import Path

import numpy as np
import pyproj
import pytest

from tilestream.errors import CorruptSourceError, SourceNotFoundError, UnknownFormatError
from tilestream.formats import describe, expand_sources, open_source
from tilestream.formats.points.autoware import open_map_directory
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.projector import read_projector

METADATA = "x_resolution: 20.0\ny_resolution: 20.0\nb.pcd: [20, 0]\na.pcd: [0.0, 0.0]\n"


def make_map(folder: Path, metadata: str = METADATA, sub: str = "pointcloud_map.pcd") -> Path:
    (folder / sub).mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(("a.pcd", "b.pcd")):
        write_pcd(folder / sub / name, np.full((3 + i, 3), 20.0 * i + 1))
    (folder / "pointcloud_map_metadata.yaml").write_text(metadata)
    return folder


@pytest.mark.parametrize("sub", ["pointcloud_map.pcd", "."])
def test_files_beside_the_metadata_or_in_autowares_sub_directory(sub: str, tmp_path: Path) -> None:
    folder = make_map(tmp_path, sub=sub)
    found = open_map_directory(str(folder))
    assert [Path(f).name for f in found.files] == ["a.pcd", "b.pcd"]
    assert expand_sources(folder) == list(found.files)
    assert describe(folder).points == 7
    assert describe(folder).bounds == ((1.0, 1.0, 1.0), (21.0, 21.0, 21.0))
    assert describe(folder).notes == ("2 parts of 20 x 20 m",)


def test_files_that_are_not_listed_are_noted(tmp_path: Path) -> None:
    folder = make_map(tmp_path)
    write_pcd(folder / "pointcloud_map.pcd" / "spare.pcd", np.zeros((1, 3)))
    notes = open_source(folder).info().notes
    assert "1 PCD files are not listed and not read: spare.pcd" in notes
    assert open_source(folder).info().points == 7


def test_files_that_are_missing_are_named(tmp_path: Path) -> None:
    folder = make_map(tmp_path, METADATA + "c.pcd: [40, 0]\n")
    for read in (open_source, expand_sources):
        with pytest.raises(SourceNotFoundError, match=r"lists 1 of 3 files .* missing: c\.pcd"):
            read(folder)


@pytest.mark.parametrize("name", ["../out.pcd", "sub/../../out.pcd", "{absolute}", "link.pcd"])
def test_a_file_outside_of_the_directory_is_refused_by_name(name: str, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "map")
    outside = tmp_path / "out.pcd"
    write_pcd(outside, np.zeros((1, 3)))
    (folder / "link.pcd").symlink_to(outside)
    name = name.format(absolute=outside)
    make_map(folder, METADATA + f"{name}: [40, 0]\n")
    for read in (open_source, expand_sources):
        with pytest.raises(CorruptSourceError, match="points outside of") as caught:
            read(folder)
        assert name in str(caught.value)


def test_a_link_inside_of_the_directory_is_followed(tmp_path: Path) -> None:
    folder = make_map(tmp_path / "map", METADATA + "c.pcd: [40, 0]\n")
    inside = folder / "pointcloud_map.pcd"
    (inside / "c.pcd").symlink_to(inside / "a.pcd")
    (tmp_path / "link").symlink_to(folder)
    assert open_source(tmp_path / "link").info().points == 10


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (METADATA, "", "holds NoneType"),
        (METADATA, "- a.pcd\n", "holds list"),
        (METADATA, "{: [", "no readable YAML"),
        (METADATA, "a: &x [*x", "no readable YAML"),
        ("x_resolution: 20.0\n", "", "x_resolution is None"),
        ("y_resolution: 20.0", "y_resolution: -1", "y_resolution is -1"),
        ("y_resolution: 20.0", "y_resolution: .inf", "y_resolution is inf"),
        ("[20, 0]", "[20]", r"entry 'b.pcd' has \[20\]"),
        ("[20, 0]", "[20, .nan]", r"entry 'b.pcd' has \[20, nan\]"),
        ("[20, 0]", "[20, north]", r"entry 'b.pcd' has"),
        ("b.pcd:", "b.laz:", r"entry 'b.laz' is no name of a PCD file"),
        ("b.pcd:", "7:", r"entry 7 is no name of a PCD file"),
    ],
)
def test_damaged_metadata_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in METADATA
    folder = make_map(tmp_path, METADATA.replace(old, new))
    with pytest.raises(CorruptSourceError, match=rf"pointcloud_map_metadata\.yaml.*{message}"):
        open_source(folder)


def test_metadata_that_is_no_text_is_named(tmp_path: Path) -> None:
    folder = make_map(tmp_path)
    (folder / "pointcloud_map_metadata.yaml").write_bytes(os.urandom(4) + b"\xff\xfe\x00" * 9)
    with pytest.raises(CorruptSourceError, match="is no text"):
        open_source(folder)


def test_another_directory_says_what_to_give(tmp_path: Path) -> None:
    for read in (open_source, expand_sources):
        with pytest.raises(UnknownFormatError, match=r"give its files, e\.g\. '.*/\*\.pcd'"):
            read(tmp_path)


def coordinates(crs: str, longitude: float, latitude: float) -> np.ndarray:
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return np.array(to_map.transform(longitude, latitude))


def projector(folder: Path, text: str) -> Path:
    (folder / "map_projector_info.yaml").write_text(text)
    return folder / "map_projector_info.yaml"


@pytest.mark.parametrize(
    ("grid", "longitude", "latitude", "utm", "corner"),
    [
        ("54SUE", 139.69, 35.69, "EPSG:32654", (300_000, 3_900_000)),
        ("18SUJ", -77.03528, 38.88947, "EPSG:32618", (300_000, 4_300_000)),
        ("31UDQ", 2.29448, 48.85837, "EPSG:32631", (400_000, 5_400_000)),
        ("56HLH", 151.2153, -33.8568, "EPSG:32756", (300_000, 6_200_000)),
        ("21NYA", -55.0, 0.3, "EPSG:32621", (700_000, 0)),
        ("33XWG", 15.6, 78.22, "EPSG:32633", (500_000, 8_600_000)),
    ],
)
def test_mgrs_is_utm_from_the_corner_of_its_square(
    grid: str, longitude: float, latitude: float, utm: str, corner: tuple[int, int], tmp_path: Path
) -> None:
    info = f"projector_type: MGRS\nvertical_datum: WGS84\nmgrs_grid: {grid}\n"
    crs, notes = read_projector(projector(tmp_path, info))
    assert crs is not None
    local = coordinates(crs, longitude, latitude)
    assert np.abs(local + corner - coordinates(utm, longitude, latitude)).max() < 1e-4
    assert (local >= 0).all()
    assert (local < 100_000).all()
    assert f"mgrs_grid: {grid}" in notes[0]


def test_the_washington_monument_is_where_the_national_grid_says(tmp_path: Path) -> None:
    """18S UJ 23480 06470: the usual example of the United States National Grid."""
    crs, _ = read_projector(projector(tmp_path, "projector_type: MGRS\nmgrs_grid: 18SUJ\n"))
    assert crs is not None
    assert np.hypot(*(coordinates(crs, -77.03524, 38.88948) - [23480, 6470])) < 30


def test_origins_of_utm_and_transverse_mercator(tmp_path: Path) -> None:
    origin = "map_origin: {latitude: -33.8568, longitude: 151.2153, altitude: 3.0}\n"
    crs, _ = read_projector(projector(tmp_path, "projector_type: LocalCartesianUTM\n" + origin))
    assert crs is not None
    shift = coordinates("EPSG:32756", 151.22, -33.85) - coordinates(
        "EPSG:32756", 151.2153, -33.8568
    )
    assert np.abs(coordinates(crs, 151.22, -33.85) - shift).max() < 1e-4

    for scale in (0.9996, 1.0):
        named = "" if scale == 0.9996 else "scale_factor: 1.0\n"
        text = "projector_type: TransverseMercator\n" + named + origin
        crs, _ = read_projector(projector(tmp_path, text))
        assert crs is not None
        assert np.abs(coordinates(crs, 151.2153, -33.8568)).max() < 1e-6
        degree = coordinates(crs, 151.2153, -32.8568)[1]
        assert degree == pytest.approx(110_912.0 * scale, abs=15.0)


def test_what_is_no_crs_is_a_note(tmp_path: Path) -> None:
    arctic = "map_origin: {latitude: 60.4, longitude: 5.3}\n"
    for text in (
        "projector_type: local\n",
        "projector_type: LocalCartesian\nmap_origin: {latitude: 1, longitude: 2}\n",
        "projector_type: LocalCartesianUTM\n" + arctic,
    ):
        crs, notes = read_projector(projector(tmp_path, text))
        assert crs is None
        assert notes[0].startswith("map_projector_info.yaml: projector_type: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mgrs_grid: 54SUE\n", "has no projector_type"),
        ("projector_type: MGRS\n", "mgrs_grid 'None'"),
        ("projector_type: MGRS\nmgrs_grid: 54SAE\n", "mgrs_grid '54SAE'"),
        ("projector_type: MGRS\nmgrs_grid: 61SUE\n", "mgrs_grid '61SUE'"),
        ("projector_type: MGRS\nmgrs_grid: 54SUP\n", "its row is not in its band"),
        ("projector_type: TransverseMercator\n", "has no map_origin"),
        ("projector_type: TransverseMercator\nmap_origin: {latitude: 99, longitude: 1}\n", "earth"),
        ("projector_type: TransverseMercator\nmap_origin: {latitude: no}\n", "latitude is False"),
    ],
)
def test_a_damaged_projector_is_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(CorruptSourceError, match=rf"map_projector_info\.yaml.*{message}"):
        read_projector(projector(tmp_path, text))


def test_the_parts_of_a_map_know_its_crs(tmp_path: Path) -> None:
    folder = make_map(tmp_path)
    projector(folder, "projector_type: MGRS\nmgrs_grid: 54SUE\n")
    truth = open_source(folder).info().crs
    assert truth is not None
    assert [open_source(part).info().crs for part in expand_sources(folder)] == [truth, truth]
    write_pcd(tmp_path / "single.pcd", np.zeros((1, 3)))
    assert open_source(tmp_path / "single.pcd").info().crs == truth
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    write_pcd(tmp_path / "elsewhere" / "deep" / "a.pcd", np.zeros((1, 3)))
    assert open_source(tmp_path / "elsewhere" / "deep" / "a.pcd").info().crs is None
