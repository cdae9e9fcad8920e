"""Logs of drives, whatever their format: one protocol (base.py) and the registry below."""

from functools import lru_cache
from pathlib import Path

from tilestream.files import local_path
from tilestream.formats.logs import mcap, ros_bags, rosbag2
from tilestream.formats.logs.base import Recording
from tilestream.formats.logs.mcap_scene import Cloud, Marker, write_scene
from tilestream.formats.logs.mcap_write import write_log
from tilestream.formats.logs.scan_log import ScanLog, with_poses
from tilestream.formats.logs.selection import ScanSelection
from tilestream.formats.logs.together import together
from tilestream.formats.registry import (
    Format,
    format_of,
    format_of_directory,
    format_of_ending,
    state_of,
)
from tilestream.patterns import paths_of
from tilestream.settings import LogOptions

__all__ = [
    "LOG_FORMATS",
    "Cloud",
    "Marker",
    "ScanLog",
    "ScanSelection",
    "is_log",
    "open_log",
    "write_log",
    "write_scene",
]

LOG_FORMATS: tuple[Format[Recording], ...] = (
    mcap.FORMAT,
    rosbag2.FORMAT,
    ros_bags.DB3,
    ros_bags.BAG,
)
"""What `open_log` reads. `formats.FORMATS` has each of them too, as a drive that becomes a map."""


def is_log(path: str) -> bool:
    """Whether a path, or a glob of paths, is that of a log: by its ending, or a directory's marker;
    the content is not read.
    """
    return any(
        format_of_ending(match, LOG_FORMATS) or format_of_directory(match, LOG_FORMATS)
        for match in (path, *paths_of(path))
    )


def open_log(path: str | Path, options: LogOptions | None = None) -> ScanLog:
    """Open a log of scans and poses: its scans with the pose of the lidar at each.

    The log is read through once; in one process a log that has not changed is not read again.

    Args:
        path: a file or directory of one of `LOG_FORMATS`.
        options: topics and frames; None: found, see `recording.record`. Several
            topics of scans, with commas between them, are the lidars of one vehicle, and their
            scans make one each (`together`).

    Raises:
        SourceNotFoundError: no such file.
        UsageError: a file that is not on this machine.
        UnknownFormatError: a file or directory of no known format; says what is known.
        CorruptSourceError: the log is damaged or contradicts itself; names file and place.
        SourceError: no scans, or several topics that are equally good; names what is there.
        PoseError: no poses, none at the time of any scan, or several topics that are equally good.
    """
    name, options = local_path(path), options or LogOptions()
    topics = [part.strip() or None for part in (options.points_topic or "").split(",")]
    found, state = format_of(name, LOG_FORMATS), state_of(name)
    logs = [
        _opened(name, found, state, options.model_copy(update={"points_topic": topic}))
        for topic in topics
    ]
    return logs[0] if len(logs) == 1 else together(logs)


@lru_cache(maxsize=8)
def _opened(
    path: str,
    found: Format[Recording],
    state: tuple[int, int],  # noqa: ARG001  a changed log is another
    options: LogOptions,
) -> ScanLog:
    return with_poses(found.opened(path, options), options)
