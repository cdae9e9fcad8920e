"""A rosbag2 folder: `metadata.yaml` and the files of one recording, which are one log together."""

from pathlib import Path
from typing import Any

from tilestream.bounded_yaml import read_yaml
from tilestream.errors import CorruptSourceError, SourceError, UnknownFormatError
from tilestream.formats.logs.base import METADATA, Recording
from tilestream.formats.logs.mcap_file import McapFile
from tilestream.formats.logs.messages import OpenFile
from tilestream.formats.logs.recording import record
from tilestream.formats.logs.ros_bags import Db3File
from tilestream.formats.registry import Format
from tilestream.settings import LogOptions

STORAGE: dict[str, OpenFile] = {"mcap": McapFile, "sqlite3": Db3File}
"""What opens a file, by the name that the metadata have for how it is stored."""


def open_bag(path: str, options: LogOptions) -> Recording:
    """The scans and poses of all files that the metadata list, see `recording.record`.

    Raises:
        CorruptSourceError: the metadata are none, or a file that they list is missing.
        UnknownFormatError: it is stored or compressed in a way that is not known.
    """
    place = Path(path) / METADATA
    bag = _bag_of(place)
    storage = str(bag.get("storage_identifier", ""))
    if storage not in STORAGE:
        raise UnknownFormatError(
            f"{place}: stored as {storage!r}, known are {' and '.join(STORAGE)}; "
            "`ros2 bag convert` makes one of them"
        )
    names = bag.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise CorruptSourceError(f"{place}: lists no files; `ros2 bag reindex` writes it anew")
    # older versions name the folder too
    files = [Path(path) / name for name in dict.fromkeys(Path(name).name for name in names)]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise CorruptSourceError(
            f"{path}: {len(missing)} of the {len(files)} files that {METADATA} lists are missing: "
            f"{', '.join(missing[:5])}; copy them too, or let `ros2 bag reindex` list what is there"
        )
    compressed = str(bag.get("compression_mode") or "").lower() not in ("", "none")
    if compressed or any(file.suffix == ".zstd" for file in files):
        raise UnknownFormatError(
            f"{path}: its messages or files are compressed: unpack them (`ros2 bag convert` "
            "without compression_mode, or `zstd -d` and `ros2 bag reindex`)"
        )
    return record(path, f"rosbag2 {storage}", list(map(str, files)), STORAGE[storage], options)


def _bag_of(place: Path) -> dict[str, Any]:
    """What the metadata say."""
    try:
        found = read_yaml(place, CorruptSourceError)
    except OSError as error:
        raise SourceError(f"{place}: cannot be read ({error})") from error
    bag = found.get("rosbag2_bagfile_information") if isinstance(found, dict) else None
    if not isinstance(bag, dict):
        raise CorruptSourceError(
            f"{place}: is no list of a rosbag2 (rosbag2_bagfile_information); `ros2 bag reindex` "
            "writes it anew"
        )
    return bag


FORMAT = Format(
    name="rosbag2",
    what="all files of a recording, MCAP or sqlite3",
    open=open_bag,
    marker=METADATA,
)
