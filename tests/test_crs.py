"""The gates of coordinate reference systems: where one enters, and where two meet."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

import tilestream as ts
from tilestream.crs import enter, one_crs, same
from tilestream.errors import CrsError, PartialError
from tilestream.formats import open_source
from tilestream.formats.base import PointSource
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd

FOOT, US_FOOT = 0.3048, 1200 / 3937


def keyed(path: Path, keys: dict[int, int], doubles: tuple[float, ...] = ()) -> PointSource:
    """A LAS file of one point at (1000, 2000, 30) with keys of GeoTIFF."""
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.scales = np.full(3, 0.001)
    rows = [
        (key, 34736, 1, value) if key == 3077 else (key, 0, 1, value) for key, value in keys.items()
    ]
    content = struct.pack("<4H", 1, 1, 0, len(rows)) + b"".join(
        struct.pack("<4H", *r) for r in rows
    )
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", content))
    if doubles:
        content = struct.pack(f"<{len(doubles)}d", *doubles)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34736, "", content))
    las = laspy.LasData(header)
    las.x, las.y, las.z = [1000.0], [2000.0], [30.0]
    las.write(path)
    return open_source(path)


def point_of(source: PointSource) -> np.ndarray:
    (span,) = source.spans(10)
    return next(iter(source.blocks(span, 10))).points[0]


@pytest.mark.parametrize(
    ("keys", "doubles", "crs", "xy", "z"),
    [
        ({1024: 1, 3072: 32654}, (), "EPSG:32654", 1.0, 1.0),
        ({1024: 1, 3072: 2263}, (), "EPSG:32118", US_FOOT, US_FOOT),
        ({1024: 1, 3072: 2263, 4099: 9001}, (), "EPSG:32118", US_FOOT, 1.0),
        ({1024: 1, 3072: 2263, 4096: 5703}, (), "EPSG:32118", US_FOOT, 1.0),
        ({1024: 1, 3072: 32654, 4096: 8228}, (), "EPSG:32654", 1.0, FOOT),
        ({1024: 1, 3072: 32654, 3076: 9002}, (), "EPSG:32654", FOOT, FOOT),
        ({1024: 1, 3072: 32767, 3076: 9003}, (), None, US_FOOT, US_FOOT),
        ({1024: 1, 2048: 4269, 3072: 32767, 3076: 32767, 3077: 0}, (0.5,), None, 0.5, 0.5),
        ({3072: 32654}, (), "EPSG:32654", 1.0, 1.0),
    ],
)
def test_keys_of_geotiff(
    keys: dict[int, int],
    doubles: tuple[float, ...],
    crs: str | None,
    xy: float,
    z: float,
    tmp_path: Path,
) -> None:
    source = keyed(tmp_path / "a.las", keys, doubles)
    found = source.info()
    assert (found.crs is None) == (crs is None)
    assert found.crs is None or crs is None or same(found.crs, crs)
    np.testing.assert_allclose(point_of(source), [1000 * xy, 2000 * xy, 30 * z], rtol=1e-9)
    assert any("brought to metres" in note for note in found.notes) == (xy != 1.0 or z != 1.0)
    assert found.bounds is not None
    np.testing.assert_allclose(found.bounds[0], point_of(source))


@pytest.mark.parametrize(
    "keys", [{1024: 2, 2048: 4326}, {1024: 2, 2048: 32767}, {1024: 3, 2048: 4978}, {2048: 4269}]
)
def test_keys_of_what_is_no_plane_are_refused(keys: dict[int, int], tmp_path: Path) -> None:
    with pytest.raises(CrsError, match=r"a\.las.*project it"):
        keyed(tmp_path / "a.las", keys)


def test_a_code_that_no_one_knows_is_a_note(tmp_path: Path) -> None:
    found = keyed(tmp_path / "a.las", {1024: 1, 3072: 1111}).info()
    assert found.crs is None
    assert "cannot be read" in found.notes[0]


@pytest.mark.parametrize(
    ("crs", "kept", "xy", "z"),
    [
        ("EPSG:6677", "EPSG:6677", 1.0, 1.0),
        ("EPSG:32654+3855", "EPSG:32654", 1.0, 1.0),
        ("EPSG:2263+5703", "EPSG:32118", US_FOOT, 1.0),
        ("EPSG:2263+6360", "EPSG:32118", US_FOOT, US_FOOT),
        ("EPSG:2225", "EPSG:26941", US_FOOT, US_FOOT),
        ("+proj=utm +zone=54 +datum=WGS84 +units=us-ft +type=crs", "EPSG:32654", US_FOOT, US_FOOT),
    ],
)
def test_a_crs_enters_in_metres(crs: str, kept: str, xy: float, z: float) -> None:
    found = enter(crs, "map")
    assert found.crs is not None
    assert same(found.crs, kept)
    assert {axis.unit_name for axis in pyproj.CRS(found.crs).axis_info} == {"metre"}
    assert found.xy.metres == pytest.approx(xy, rel=1e-9)
    assert found.z.metres == pytest.approx(z, rel=1e-9)


def test_a_projection_in_metres_is_the_same_place() -> None:
    metric = enter("EPSG:2263", "map").crs
    assert metric is not None
    x, y = pyproj.Transformer.from_crs("EPSG:2263", metric, always_xy=True).transform(9.9e5, 1.9e5)
    np.testing.assert_allclose([x, y], [9.9e5 * US_FOOT, 1.9e5 * US_FOOT], atol=1e-6)


@pytest.mark.parametrize(
    "crs", ["EPSG:4326", "EPSG:4979", "EPSG:4978", "EPSG:4326+3855", "nowhere"]
)
def test_what_no_map_can_be_in_is_refused(crs: str) -> None:
    with pytest.raises(CrsError, match="map: "):
        enter(crs, "map")


def test_a_local_frame_names_no_place() -> None:
    found = enter('LOCAL_CS["site",UNIT["foot",0.3048]]', "map")
    assert found.crs is None
    assert found.xy.metres == 0.3048
    assert "site" in found.notes[0]


@pytest.mark.parametrize("crs", ["EPSG:6677", "EPSG:32654", "EPSG:25832", "EPSG:2056"])
@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019"])
def test_a_crs_is_the_same_however_it_is_written(crs: str, version: str) -> None:
    text = pyproj.CRS(crs).to_wkt(version)
    assert same(crs, text)
    assert one_crs(None, [("a", crs), ("b", text)]) == crs
    assert not same(text, "EPSG:6676")


def test_other_datums_and_zones_are_others() -> None:
    assert not same("EPSG:6677", "EPSG:2451")
    assert not same("EPSG:32654", "EPSG:32653")


def test_feet_that_only_the_user_names_are_refused(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", np.zeros((1, 3)))
    with pytest.raises(CrsError, match=r"US survey foot and .*a\.pcd names none"):
        ts.ingest(tmp_path / "a.pcd", tmp_path / "map.zarr", crs="EPSG:2263")
    write_las(tmp_path / "a.las", np.ones((1, 3)), crs="EPSG:2263")
    store = ts.ingest(tmp_path / "a.las", tmp_path / "map.zarr", crs="EPSG:2263")
    assert same(str(store.settings.crs), "EPSG:32118")
    again = ts.ingest(tmp_path / "a.las", tmp_path / "map.zarr", crs="EPSG:32118")
    assert again.settings.crs == store.settings.crs


@pytest.mark.parametrize("crs", ["EPSG:3857", "ESRI:102100"])
def test_a_map_in_the_crs_of_web_maps_is_refused(crs: str, tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", np.zeros((1, 3)), crs=crs)
    with pytest.raises(CrsError, match=r"a\.laz.*1 / cos"):
        ts.ingest([tmp_path / "a.laz"], tmp_path / "map.zarr")
    with pytest.raises(CrsError, match="asked for"):
        one_crs(crs, [("a", None)])


def test_a_map_in_degrees_is_named_not_the_route_on_it(tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", [[139.7, 35.6, 0.0], [139.8, 35.7, 1.0]], crs="EPSG:4326")
    (tmp_path / "r.csv").write_text("lon,lat\n139.7,35.6\n139.7,35.6001\n")
    with pytest.raises(PartialError, match=r"(?s)no source of the map.*: its CRS.*in degrees"):
        ts.estimate(tmp_path / "a.laz", tmp_path / "r.csv", out=tmp_path / "run")
