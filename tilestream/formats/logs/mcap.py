"""MCAP logs of ROS messages."""

from tilestream.formats.logs.base import Recording
from tilestream.formats.logs.mcap_file import MAGIC, McapFile
from tilestream.formats.logs.recording import record
from tilestream.formats.registry import Format
from tilestream.settings import LogOptions


def open_mcap(path: str, options: LogOptions) -> Recording:
    """A log of scans and poses, see `recording.record`. Every chunk that holds one is unpacked and
    its CRC tested; after that scans are read by seeking to their chunks, whether the file has an
    index or not.
    """
    return record(path, "mcap", [path], McapFile, options)


FORMAT = Format(
    name="MCAP",
    what="logs with point clouds and poses",
    open=open_mcap,
    endings=(".mcap",),
    magic=MAGIC,
)
