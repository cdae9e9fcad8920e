"""The messages of a log in other containers of ROS, written by the libraries."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer


class Raw(NamedTuple):
    """A message as it lies in a log."""

    topic: str
    type: str
    time: int
    data: bytes


def messages_of(path: Path) -> list[Raw]:
    with path.open("rb") as stream:
        read = make_reader(stream).iter_messages(log_time_order=False)
        return [
            Raw(channel.topic, schema.name, message.log_time, message.data)
            for schema, channel, message in read
            if schema is not None
        ]


def write_mcap(path: Path, messages: Iterable[Raw], encoding: str = "cdr") -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4096)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for topic, kind, time, data in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def write_db3(path: Path, messages: Iterable[Raw]) -> Path:
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra ros")
    folder = path.with_name(f"{path.name}-folder")
    shutil.rmtree(folder, ignore_errors=True)
    with rosbag2.Writer(folder, version=9) as writer:
        connections: dict[str, object] = {}
        for topic, kind, time, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, msgdef=" ", rihs01="x")
            writer.write(connections[topic], time, data)
    (made,) = folder.glob("*.db3")
    made.replace(path)
    shutil.rmtree(folder)
    return path


def types(name: str) -> Any:
    """The types of a version of ROS as rosbags has them, and tf."""
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra ros")
    store = typesys.get_typestore(typesys.Stores[name])
    tf = "tf2_msgs/msg/TFMessage"
    if tf not in store.types:
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(typesys.get_types_from_msg(text, tf))
    return store


def as_ros1(messages: Iterable[Raw]) -> list[Raw]:
    """The same, as ROS 1 writes them."""
    store = types("ROS2_HUMBLE")
    return [m._replace(data=bytes(store.cdr_to_ros1(m.data, m.type))) for m in messages]


def write_bag(path: Path, messages: Iterable[Raw], compression: str = "") -> Path:
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="needs the extra ros")
    store = types("ROS1_NOETIC")
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, object] = {}
        for topic, kind, time, data in as_ros1(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, data)
    return path


def split_in(folder: Path, messages: Sequence[Raw], files: int, storage: str = "mcap") -> Path:
    """A rosbag2 folder of so many files, one after the other in time."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return fill(folder, messages, files, storage)


def fill(folder: Path, messages: Sequence[Raw], files: int, storage: str = "mcap") -> Path:
    """A folder that is there made a rosbag2."""
    write, ending = {"mcap": (write_mcap, "mcap"), "sqlite3": (write_db3, "db3")}[storage]
    size = -(-len(messages) // files)
    names = [f"bag_{i}.{ending}" for i in range(files)]
    for i, name in enumerate(names):
        write(folder / name, messages[i * size : (i + 1) * size])
    write_metadata(folder, names, storage)
    return folder


def write_metadata(folder: Path, names: list[str], storage: str, **more: object) -> None:
    known = {"version": 8, "storage_identifier": storage, "relative_file_paths": names, **more}
    text = yaml.safe_dump({"rosbag2_bagfile_information": known})
    (folder / "metadata.yaml").write_text(text)
