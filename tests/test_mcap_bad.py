"""Logs that are damaged, cut short, or lack what is needed: an error that says where, or a loss
that is reported; never a plausible result."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import logs
import lz4.frame
import numpy as np
import pytest
import zstandard
from fuzz_mutations import mcap_of
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import START, pose
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, IndexType

from tilestream.errors import (
    CorruptSourceError,
    PoseError,
    SourceError,
    TilestreamError,
)
from tilestream.formats.drive import open_drive
from tilestream.formats.logs import open_log
from tilestream.settings import LogOptions


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logs.street_log(tmp_path_factory.mktemp("street") / "street.mcap")


def chunk_offsets(path: Path) -> list[tuple[int, int]]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]


def flipped(path: Path, at: int, target: Path) -> Path:
    content = bytearray(path.read_bytes())
    content[at] ^= 0x40
    target.write_bytes(content)
    return target


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_flipped_byte_in_a_chunk_names_crc_file_and_offset(
    compression: CompressionType, street: Path, tmp_path: Path
) -> None:
    path = logs.rewrite(street, tmp_path / "made.mcap", chunk_size=4096, compression=compression)
    offset, length = chunk_offsets(path)[3]
    for share in (0.3, 0.6, 0.9):
        bad = flipped(path, offset + int(share * length), tmp_path / f"{share}.mcap")
        with pytest.raises(CorruptSourceError, match="CRC") as caught:
            open_log(bad)
        assert str(bad) in str(caught.value)
        assert f"byte {offset} " in str(caught.value)


def test_a_flipped_byte_in_the_summary_names_crc(street: Path, tmp_path: Path) -> None:
    size = street.stat().st_size
    with pytest.raises(CorruptSourceError, match=r"summary.*CRC"):
        open_log(flipped(street, size - 200, tmp_path / "bad.mcap"))


def test_a_flipped_byte_outside_of_chunks_names_crc(street: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"use_chunking": False, "enable_data_crcs": True}
    path = logs.rewrite(street, tmp_path / "made.mcap", **options)
    with pytest.raises(CorruptSourceError, match="CRC"):
        open_log(flipped(path, path.stat().st_size // 2, tmp_path / "bad.mcap"))


def test_a_byte_flipped_after_opening_is_still_found(street: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(street.read_bytes())
    log = open_log(path)
    offset, length = chunk_offsets(path)[3]
    flipped(path, offset + length // 2, path)
    with pytest.raises(CorruptSourceError, match="CRC"):
        list(log.scans())


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_no_flipped_byte_gives_other_points(street: Path, data: st.DataObject) -> None:
    content = bytearray(street.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    bad = street.with_name("flipped.mcap")
    bad.write_bytes(content)
    expected = {s.stamp_ns: s for s in open_log(street).scans()}
    try:
        scans = list(open_log(bad).scans())
    except TilestreamError:
        return
    for scan in scans:
        np.testing.assert_array_equal(scan.points, expected[scan.stamp_ns].points)
        np.testing.assert_array_equal(scan.T_map_lidar, expected[scan.stamp_ns].T_map_lidar)
    assert len(scans) == 12 or any("cut short" in note for note in open_log(bad).notes)


@settings(deadline=None, max_examples=60)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_gives_what_is_whole_and_says_so(street: Path, share: float) -> None:
    content = street.read_bytes()
    cut = street.with_name("cut.mcap")
    cut.write_bytes(content[: int(share * len(content))])
    expected = list(open_log(street).scans())
    ends = [offset + length for offset, length in chunk_offsets(street)]
    whole_chunks = sum(end <= cut.stat().st_size for end in ends)
    if whole_chunks == 0:
        with pytest.raises(SourceError, match="cut short"):
            open_log(cut)
        return
    log = open_log(cut)
    scans = list(log.scans())
    assert len(scans) >= whole_chunks
    assert any("cut short" in n and f"{len(log)} whole scans recovered" in n for n in log.notes)
    for scan, other in zip(scans, expected, strict=False):
        np.testing.assert_array_equal(scan.points, other.points)


def test_a_cut_file_counts_what_was_recovered(street: Path, tmp_path: Path) -> None:
    offset, length = chunk_offsets(street)[5]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(street.read_bytes()[: offset + length // 2])
    source = open_drive(cut)
    notes = "\n".join(source.info().notes)
    assert f"cut short: whole up to byte {offset} of {offset + length // 2}" in notes
    recovered = len(source.log)
    assert 5 <= recovered < 12
    assert source.info().points == recovered * 200


def test_a_real_drive_cut_in_half(shared_data: Path, tmp_path: Path) -> None:
    content = (shared_data / "kitti_drive" / "drive.mcap").read_bytes()
    cut = tmp_path / "half.mcap"
    cut.write_bytes(content[: len(content) // 2])
    log = open_log(cut)
    assert 20 <= len(log) <= 28
    assert len(list(log.scans(0, 3))) == 3


def test_a_cut_file_without_chunks(street: Path, tmp_path: Path) -> None:
    path = logs.rewrite(
        street, tmp_path / "made.mcap", use_chunking=False, index_types=IndexType.NONE
    )
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    log = open_log(cut)
    assert 4 <= len(log) <= 6
    assert any("cut short" in note for note in log.notes)


def test_a_tail_of_zeros_is_a_cut(street: Path, tmp_path: Path) -> None:
    offset, length = chunk_offsets(street)[5]
    path = tmp_path / "zeros.mcap"
    path.write_bytes(street.read_bytes()[: offset + length // 2] + bytes(5000))
    log = open_log(path)
    assert 5 <= len(log) < 12
    assert any(f"whole up to byte {offset}" in note for note in log.notes)


def test_a_summary_that_hides_messages_is_found(street: Path, tmp_path: Path) -> None:
    content = street.read_bytes()
    with street.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    counts = summary.statistics.channel_message_counts  # type: ignore[union-attr]
    (points,) = (c.id for c in summary.channels.values() if c.topic == "/points")
    old = points.to_bytes(2, "little") + counts[points].to_bytes(8, "little")
    new = points.to_bytes(2, "little") + (counts[points] + 3).to_bytes(8, "little")
    start = content.rindex(b"tf2_msgs") if b"tf2_msgs" in content else 0
    at = content.rindex(old)
    assert at > start
    total = sum(counts.values())
    body = content[:at] + new + content[at + len(old) :]
    before = body.rindex(total.to_bytes(8, "little"), 0, at)
    body = body[:before] + (total + 3).to_bytes(8, "little") + body[before + 8 :]
    body = body[:-12] + bytes(4) + body[-8:]  # no CRC
    path = tmp_path / "hidden.mcap"
    path.write_bytes(body)
    with pytest.raises(CorruptSourceError, match=r"counts 15 messages of /points.*hold 12"):
        open_log(path)


def test_without_clouds_the_topics_that_are_there_are_named(tmp_path: Path) -> None:
    path = logs.write(
        tmp_path / "a.mcap",
        [logs.odometry_at(START, pose()), (START, "/chat", "std_msgs/msg/String", {"data": "hi"})],
    )
    with pytest.raises(SourceError, match=r"no sensor_msgs/PointCloud2.*/chat.*/odometry"):
        open_log(path)
    with pytest.raises(SourceError, match=r"on topic /points.*/chat"):
        open_log(path, LogOptions(points_topic="/points"))


def test_without_poses(tmp_path: Path) -> None:
    static = logs.static_tf("base", "lidar", pose())
    for messages in ([], [static]):
        path = logs.write(tmp_path / f"{len(messages)}.mcap", [*messages, logs.cloud_at(1)])
        with pytest.raises(PoseError, match="no poses"):
            open_log(path)
        with pytest.raises(PoseError, match=r"no poses on topic /odom.*/points"):
            open_log(path, LogOptions(pose_topic="/odom"))


def test_poses_that_are_no_poses(tmp_path: Path) -> None:
    nan, flat = pose(x=np.nan), logs.odometry(START + 1, pose())
    flat["pose"]["pose"]["orientation"] = dict.fromkeys("xyzw", 0.0)
    bad = [
        logs.odometry_at(START, nan),
        (START + 1, "/odometry", "nav_msgs/msg/Odometry", flat),
    ]
    cloud = logs.cloud_at(START + 2)
    path = logs.write(tmp_path / "all.mcap", [*bad, cloud])
    with pytest.raises(PoseError, match="none of the 2 poses of /odometry is usable"):
        open_log(path)
    good = logs.odometry_at(START + 2, pose(x=1.0))
    log = open_log(logs.write(tmp_path / "some.mcap", [*bad, good, good, cloud]))
    assert any("3 poses of /odometry left out" in note for note in log.notes)
    assert log.T_map_lidar[0, 0, 3] == 1.0


def test_tf_that_does_not_lead_to_the_lidar(tmp_path: Path) -> None:
    tf = logs.tf_at(START, "map", "base", pose())
    path = logs.write(tmp_path / "a.mcap", [tf, logs.cloud_at(START)])
    with pytest.raises(PoseError, match=r"does not lead from 'map'.*'lidar'.*base, map"):
        open_log(path)


def test_poses_of_several_frames_on_one_topic(tmp_path: Path) -> None:
    path = logs.write(
        tmp_path / "a.mcap",
        [
            logs.odometry_at(START, pose()),
            logs.odometry_at(START + 1, pose(), child="trailer"),
            logs.cloud_at(START),
        ],
    )
    with pytest.raises(PoseError, match=r"map -> lidar, map -> trailer"):
        open_log(path)


def write_cloud(path: Path, **changes: Any) -> Path:
    points = logs.street_points(np.random.default_rng(0), 8)
    cloud = logs.cloud(START, logs.xyz_rows(points).reshape(2, 4), **changes)
    kind = "sensor_msgs/msg/PointCloud2"
    return logs.write(path, [logs.odometry_at(START, pose()), (START, "/points", kind, cloud)])


def fields(*kinds: int, names: str = "xyz") -> list[dict[str, object]]:
    return [
        {"name": name, "offset": 4 * i, "datatype": kind, "count": 1}
        for i, (name, kind) in enumerate(zip(names, kinds, strict=True))
    ]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"fields": fields(7, 7, 9)}, "field 'z' has the unknown datatype 9"),
        ({"fields": fields(7, 7, 7, names="xyw")}, "no field 'z'.*x, y, w"),
        ({"fields": fields(5, 7, 7)}, "no field 'x' of type float32 or float64"),
        ({"fields": []}, "no field 'x'.*none"),
        ({"point_step": 8}, "field 'z' lies outside of its point"),
        ({"height": 3}, "data has 96 bytes.*3 x 4 points of 12 bytes need 144"),
        ({"width": 2**31, "height": 1}, "data has 96 bytes"),
        ({"row_step": 40, "data": bytes(100)}, "row_step is 40"),
        ({"data": b""}, "data has 0 bytes"),
    ],
)
def test_a_cloud_that_contradicts_itself(
    changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    path = write_cloud(tmp_path / "a.mcap", **changes)
    with pytest.raises(CorruptSourceError, match=told) as caught:
        open_log(path)
    for named in (str(path), "/points", "byte"):
        assert named in str(caught.value)


def test_a_message_that_ends_too_early(tmp_path: Path) -> None:
    source = write_cloud(tmp_path / "a.mcap")
    path = tmp_path / "short.mcap"
    with source.open("rb") as read, path.open("wb") as stream:
        writer = logs.PlainWriter(stream)
        writer.start("ros2")
        for schema, channel, message in make_reader(read).iter_messages():
            assert schema is not None
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            where = writer.register_channel(channel.topic, "cdr", number)
            data = message.data[:60] if channel.topic == "/points" else message.data
            writer.add_message(where, message.log_time, data, message.publish_time)
        writer.finish()
    with pytest.raises(CorruptSourceError, match=r"/points.*too short"):
        open_log(path)


def test_what_is_not_encoded_as_ros_does_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = logs.PlainWriter(stream)
        writer.start("")
        schema = writer.register_schema("sensor_msgs/PointCloud2", "protobuf", b"")
        channel = writer.register_channel("/points", "protobuf", schema)
        writer.add_message(channel, START, b"12345678", START)
        writer.finish()
    with pytest.raises(SourceError, match=r"'protobuf'.*convert"):
        open_log(path)


@pytest.mark.parametrize("kind", ["zstd", "zstd of no size", "lz4"])
def test_a_chunk_is_never_unpacked_beyond_its_claim(kind: str, tmp_path: Path) -> None:
    zeros, path = bytes(10**7), tmp_path / "a.mcap"
    if kind == "lz4":
        data = lz4.frame.compress(zeros)
    else:
        named = zstandard.ZstdCompressor(write_content_size=kind == "zstd")
        data = named.compress(zeros)
    del zeros
    chunk = Chunk(kind.split(maxsplit=1)[0], data, 0, 0, 0, 1000)
    path.write_bytes(mcap_of([chunk]))
    tracemalloc.start()
    try:
        with pytest.raises(
            CorruptSourceError, match=r"a\.mcap: record at byte \d+ does not unpack"
        ):
            open_log(path)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def test_a_chunk_that_claims_more_than_any_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    data = zstandard.compress(bytes(1000))
    path.write_bytes(mcap_of([Chunk("zstd", data, 0, 0, 0, 2**40)]))
    with pytest.raises(CorruptSourceError, match=rf"claims to unpack to {2**40} bytes"):
        open_log(path)


def test_a_summary_that_leads_through_the_chunks_unpacks_none(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    whole = mcap_of([Chunk("zstd", zstandard.compress(bytes(10**7)), 0, 0, 0, 1000)])
    footer = len(whole) - 8 - 20
    path.write_bytes(whole[:footer] + struct.pack("<QQI", 8, 0, 0) + whole[-8:])
    with pytest.raises(CorruptSourceError, match=r"a\.mcap: record at byte"):
        open_log(path)
