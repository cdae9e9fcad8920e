"""A rosbag2 folder is one log, however many files it has, wherever a log can be given."""

import sys
from pathlib import Path
from unittest.mock import patch

import bags
import logs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import SECOND, START, pose
from points import far_points

import tilestream as ts
from tilestream.cli import run
from tilestream.crs import same
from tilestream.errors import CorruptSourceError, SourceError, UnknownFormatError
from tilestream.formats import expand_sources
from tilestream.formats.logs import is_log, open_log
from tilestream.formats.points.las import write_las
from tilestream.formats.registry import state_of
from tilestream.formats.routes import read_route
from tilestream.pipeline.jobs.sources import crs_of_map
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.settings import LogOptions

SCANS = 12
MOUNT = pose(x=1.0, z=1.8, yaw=0.3)


def drive(path: Path) -> Path:
    """A vehicle whose mount is said once, at the beginning."""
    messages = [logs.static_tf("base", "lidar", MOUNT)]
    rng = np.random.default_rng(2)
    for i in range(SCANS):
        stamp = START + i * SECOND // 10
        T = pose(x=20.0 + 0.7 * i, y=5.0, yaw=0.02 * i)
        messages.append(logs.odometry_at(stamp, T, child="base"))
        messages.append(logs.cloud_at(stamp, logs.street_points(rng)))
    return logs.write(path, messages)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("whole") / "drive.mcap")


@pytest.fixture(params=["mcap", "sqlite3"])
def bag(request: pytest.FixtureRequest, whole: Path, tmp_path: Path) -> Path:
    return bags.split_in(tmp_path / "bag", bags.messages_of(whole), 3, request.param)


@settings(max_examples=25)
@given(files=st.integers(1, 25), seed=st.integers(0, 10**6))
def test_a_log_in_any_number_of_files_is_the_log(
    tmp_path_factory: pytest.TempPathFactory, whole: Path, files: int, seed: int
) -> None:
    """Also where messages were recorded in any order, and files are empty."""
    messages = bags.messages_of(whole)
    np.random.default_rng(seed).shuffle(messages)  # type: ignore[arg-type]
    messages = [bags.Raw(*message) for message in messages]
    bag = bags.split_in(tmp_path_factory.mktemp("log") / "bag", messages, files)
    one, many = open_log(whole), open_log(bag)
    assert many.stamps_ns.tolist() == one.stamps_ns.tolist()
    assert many.T_map_lidar.tobytes() == one.T_map_lidar.tobytes()
    assert many.contents == one.contents
    assert many.notes == one.notes
    wanted = np.random.default_rng(seed).integers(SCANS, size=7).tolist()
    for a, b in zip(one.scans_at(wanted), many.scans_at(wanted), strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.points, b.points)


def test_the_state_of_a_bag_is_that_of_all_its_files(bag: Path) -> None:
    before, reading = state_of(bag), Reading(str(bag))
    state = reading.state
    *_, last = sorted(bag.glob("bag_*"))
    last.write_bytes(last.read_bytes() + b"x")
    assert state_of(bag) != before
    assert reading.state != state


def test_a_bag_is_a_source_of_a_map_a_drive_and_a_route(bag: Path, tmp_path: Path) -> None:
    assert is_log(str(bag))
    assert is_log(str(tmp_path / "*"))
    assert expand_sources(str(tmp_path / "b*")) == [str(bag)]
    store = ts.ingest(tmp_path / "b*", tmp_path / "map.zarr", scans=ts.ScanSelection(every=2))
    (source,) = store.sources()
    assert (source["path"], source["reason"], source["points"]) == (str(bag), "", 6 * 200)
    others = ts.ScanSelection(every=2, offset=1)
    errors = ts.localize(store, bag, tmp_path / "out", spacing=3.0, scans=others)
    assert errors["scan"].tolist() == [1, 5, 9]
    route = read_route(bag)
    assert route.route_id == "bag"
    np.testing.assert_allclose(route.positions[0, :2], (pose(x=20.0, y=5.0) @ MOUNT)[:2, 3])


def test_the_crs_of_a_map_is_that_of_the_files_beside_a_bag(bag: Path, tmp_path: Path) -> None:
    write_las(tmp_path / "block.las", far_points(50), crs="EPSG:6677")
    found = crs_of_map([str(tmp_path / "b*")], str(tmp_path / "map.zarr"), None)
    assert found is not None
    assert same(found, "EPSG:6677")
    assert crs_of_map([str(bag)], str(tmp_path / "map.zarr"), None) is None


def test_ingest_takes_folders_by_a_glob(bag: Path, tmp_path: Path) -> None:
    made = [str(tmp_path / "b*"), "--store", str(tmp_path / "map.zarr"), "--every", "2"]
    assert run(["ingest", *made, "--offset", "1"]) == 0
    assert ts.open_store(tmp_path / "map.zarr").sources()[0]["points"] == 6 * 200


def test_files_that_are_missing_are_named(bag: Path) -> None:
    first, *_ = sorted(bag.glob("bag_*"))
    first.unlink()
    with pytest.raises(CorruptSourceError, match=rf"1 of the 3 files that.*missing: {first.name}"):
        open_log(bag)


def test_folders_that_older_versions_name_before_each_file(whole: Path, tmp_path: Path) -> None:
    bag = bags.split_in(tmp_path / "bag", bags.messages_of(whole), 2)
    bags.write_metadata(bag, ["bag/bag_0.mcap", "bag/bag_1.mcap"], "mcap", version=2)
    assert len(open_log(bag)) == SCANS


@pytest.mark.parametrize(
    ("storage", "more", "error", "told"),
    [
        ("rrd", {}, UnknownFormatError, "stored as 'rrd', known are mcap and sqlite3"),
        ("mcap", {"compression_mode": "MESSAGE"}, UnknownFormatError, "compressed: unpack them"),
        ("mcap", {"compression_mode": "FILE"}, UnknownFormatError, "compressed: unpack them"),
        ("mcap", {"relative_file_paths": []}, CorruptSourceError, "lists no files"),
        ("mcap", {"relative_file_paths": [1]}, CorruptSourceError, "lists no files"),
        ("mcap", {"relative_file_paths": None}, CorruptSourceError, "lists no files"),
    ],
)
def test_bags_that_cannot_be_read_say_why(
    whole: Path,
    tmp_path: Path,
    storage: str,
    more: dict[str, object],
    error: type[SourceError],
    told: str,
) -> None:
    bag = bags.split_in(tmp_path / "bag", bags.messages_of(whole), 1)
    bags.write_metadata(bag, ["bag_0.mcap"], storage, **more)
    with pytest.raises(error, match=told):
        open_log(bag)


@pytest.mark.parametrize("text", ["", "[1, 2]", "a: 1", "rosbag2_bagfile_information: 1"])
def test_metadata_that_are_none(text: str, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(CorruptSourceError, match="is no list of a rosbag2"):
        open_log(tmp_path)


def test_a_cut_file_of_a_bag_is_named(whole: Path, tmp_path: Path) -> None:
    bag = bags.split_in(tmp_path / "bag", bags.messages_of(whole), 3)
    last = bag / "bag_2.mcap"
    last.write_bytes(last.read_bytes()[:-2500])
    log = open_log(bag)
    assert 8 <= len(log) < SCANS
    assert any(note.startswith(f"{last}: cut short") for note in log.notes)


def test_messages_of_one_time_are_told_apart(whole: Path, tmp_path: Path) -> None:
    """Recorded at one time: only which of them it is tells where a scan lies."""
    messages = [message._replace(time=START) for message in bags.messages_of(whole)]
    expected = list(open_log(whole).scans())
    for path in (
        bags.write_db3(tmp_path / "a.db3", messages),
        bags.write_bag(tmp_path / "a.bag", messages),
    ):
        for a, b in zip(expected, open_log(path).scans(), strict=True):
            np.testing.assert_array_equal(a.points, b.points)


@pytest.mark.parametrize("name", ["a.mcap.zstd", "a.db3.zstd", "a.bag.bz2"])
def test_a_compressed_file_says_what_unpacks_it(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"1234")
    with pytest.raises(UnknownFormatError, match=r"unpack it first \((zstd -d|bunzip2)\)"):
        open_log(tmp_path / name)


@pytest.mark.parametrize("name", ["a.db3", "a.bag"])
def test_without_the_extra_it_says_which(name: str, whole: Path, tmp_path: Path) -> None:
    write = {"a.db3": bags.write_db3, "a.bag": bags.write_bag}[name]
    path = write(tmp_path / name, bags.messages_of(whole))
    module = sys.modules["tilestream.formats.logs.ros_bags"]
    with (
        patch.multiple(module, rosbag1=None, rosbag2=None),
        pytest.raises(UnknownFormatError, match=r"pip install 'tilestream\[ros\]'"),
    ):
        open_log(path, LogOptions(max_gap_s=1.5))
