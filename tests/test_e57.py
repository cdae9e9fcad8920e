"""E57: several scans, poses, spherical coordinates, points that the scanner called invalid."""

from pathlib import Path

import numpy as np
import pytest
from fuzz_bombs import of_constant_points
from points import blocks_of, points_of
from scipy.spatial.transform import Rotation

from tilestream.errors import CorruptSourceError, UnknownFormatError
from tilestream.formats import open_source
from tilestream.formats.points import e57

pye57 = pytest.importorskip("pye57", reason="E57 is an extra")
libe57 = pye57.libe57


def local_points(n: int = 200) -> np.ndarray:
    """Points near a scanner, each a float32."""
    return np.random.default_rng(n).uniform(-50, 50, (n, 3)).astype(np.float32).astype(float)


def scan_of(points: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))


def test_each_scan_has_its_pose(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    poses = [
        (Rotation.from_euler("xyz", [0.1, -0.2, 2.5]), np.array([4e6, 5e5, 30.0])),
        (Rotation.identity(), np.zeros(3)),
        (Rotation.from_euler("z", -1.0), np.array([4e6 + 7, 5e5, 30.0])),
    ]
    with pye57.E57(str(path), "w") as file:
        for rotation, place in poses:
            w = np.roll(rotation.as_quat(), 1)
            file.write_scan_raw(scan_of(local_points()), rotation=w, translation=place)
    truth = np.concatenate([rotation.apply(local_points()) + place for rotation, place in poses])
    assert np.abs(points_of(path) - truth).max() < 1e-8
    assert [(s.start, s.stop) for s in open_source(path).spans(10)] == [
        (0, 200), (200, 400), (400, 600)
    ]  # fmt: skip
    assert open_source(path).info().contents[0] == "scan 0 'Scan 0': 200 points"


def test_invalid_points_are_dropped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    state = (np.arange(200) % 3).astype(np.int8)
    with pye57.E57(str(path), "w") as file:
        file.write_scan_raw({**scan_of(local_points()), "cartesianInvalidState": state})
    blocks = blocks_of(path)
    assert sum(b.dropped for b in blocks) == np.count_nonzero(state)
    assert np.array_equal(np.concatenate([b.points for b in blocks]), local_points()[state == 0])


def write_raw(path: Path, columns: dict[str, np.ndarray], pose: dict[str, float] | None) -> None:
    """A scan of any fields in double precision, its pose's parts in any order."""
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("coordinateMetadata", libe57.StringNode(image, "EPSG:32654"))
    scans = libe57.VectorNode(image, True)
    root.set("data3D", scans)
    scan, prototype = libe57.StructureNode(image), libe57.StructureNode(image)
    for name in columns:
        prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e300, 1e300))
    if pose is not None:
        node, rotation, place = (libe57.StructureNode(image) for _ in range(3))
        for name, value in pose.items():
            target = rotation if name in "wijk" else place
            axis = dict(zip("wijkxyz", "wxyzxyz", strict=True))[name]
            target.set(axis, libe57.FloatNode(image, value))
        node.set("translation", place)
        node.set("rotation", rotation)
        scan.set("pose", node)
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    buffers, n = libe57.VectorSourceDestBuffer(), len(next(iter(columns.values())))
    for name, values in columns.items():
        buffers.append(libe57.SourceDestBuffer(image, name, values, n, True, True))
    writer = points.writer(buffers)
    writer.write(n)
    writer.close()
    image.close()


def test_spherical_coordinates_and_a_pose_in_any_order(tmp_path: Path) -> None:
    points = local_points()
    x, y, z = points.T
    horizontal = np.hypot(x, y)
    columns = {
        "sphericalElevation": np.arctan2(z, horizontal),
        "sphericalRange": np.hypot(horizontal, z),
        "sphericalAzimuth": np.arctan2(y, x),
    }
    half = np.sqrt(0.5)
    pose = {"k": half, "i": 0.0, "w": half, "j": 0.0, "z": 1.0, "x": 4e6, "y": 0.0}
    write_raw(tmp_path / "a.e57", columns, pose)
    got = points_of(tmp_path / "a.e57")
    assert np.abs(got - np.column_stack([4e6 - y, x, z + 1])).max() < 1e-8
    assert open_source(tmp_path / "a.e57").info().crs == "EPSG:32654"


def test_not_a_number_is_dropped(tmp_path: Path) -> None:
    points = local_points()
    points[5, 1] = np.nan
    columns = {name: np.ascontiguousarray(column) for name, column in scan_of(points).items()}
    write_raw(tmp_path / "a.e57", columns, None)
    blocks = blocks_of(tmp_path / "a.e57")
    assert sum(b.dropped for b in blocks) == 1
    assert np.array_equal(np.concatenate([b.points for b in blocks]), np.delete(points, 5, axis=0))


def test_scans_that_cannot_be_placed_are_refused(tmp_path: Path) -> None:
    columns = {name: np.ascontiguousarray(c) for name, c in scan_of(local_points()).items()}
    skew = dict(zip("wijkxyz", (1.0, 1.0, 0, 0, 0, 0, 0), strict=True))
    write_raw(tmp_path / "a.e57", columns, skew)
    with pytest.raises(CorruptSourceError, match="the pose of scan 0 is not rigid"):
        open_source(tmp_path / "a.e57")
    columns.pop("cartesianZ")
    write_raw(tmp_path / "b.e57", columns, None)
    with pytest.raises(CorruptSourceError, match="neither cartesian nor spherical"):
        open_source(tmp_path / "b.e57")


def test_points_that_take_no_bits_are_counted_within_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    with pye57.E57(str(path), "w") as file:
        file.write_scan_raw(scan_of(local_points()))
    whole = path.read_bytes()
    for count in (4 * 10**12, -1):
        path.write_bytes(of_constant_points(whole, count))
        with pytest.raises(CorruptSourceError, match=rf"a\.e57: .* {count} points of at least 0"):
            open_source(path)


def test_a_flipped_byte_is_found_by_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "a.e57"
    with pye57.E57(str(path), "w") as file:
        file.write_scan_raw(scan_of(local_points()))
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    path.write_bytes(content)
    with pytest.raises(CorruptSourceError, match="checksum"):
        blocks_of(path)


def test_without_the_extra_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pye57.E57(str(tmp_path / "a.e57"), "w") as file:
        file.write_scan_raw(scan_of(local_points()))
    monkeypatch.setattr(e57, "libe57", None)
    with pytest.raises(UnknownFormatError, match=r"pip install 'tilestream\[e57\]'"):
        open_source(tmp_path / "a.e57")
