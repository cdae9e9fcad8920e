"""Logs of drives, whatever their format: one protocol (base.py) and the registry below."""

from functools import lru_cache
from pathlib import Path

from tilestream.files import local_path
from tilestream.formats.logs import mcap
from tilestream.formats.logs.base import MAX_GAP_S, LogOptions, Recording
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

__all__ = ["LOG_FORMATS", "ScanLog", "ScanSelection", "is_log", "open_log", "write_log"]

LOG_FORMATS: tuple[Format[Recording], ...] = (mcap.FORMAT,)
"""What `open_log` reads. `formats.FORMATS` has each of them too, as a drive that becomes a map."""


def is_log(path: str) -> bool:
    """Whether a path, or a glob of paths, is that of a log: by its ending, or a directory's marker;
    the content is not read.
    """
    named = format_of_ending(path, LOG_FORMATS) or format_of_directory(path, LOG_FORMATS)
    return named is not None


def open_log(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    map_frame: str | None = None,
    pose_frame: str | None = None,
    max_gap_s: float = MAX_GAP_S,
) -> ScanLog:
    """Open a log of scans and poses: its scans with the pose of the lidar at each.

    The log is read through once; in one process a log that has not changed is not read again.

    Args:
        path: a file or directory of one of `LOG_FORMATS`.
        points_topic: topic of the scans; default: the one with the most messages. Several, with
            commas between them, are the lidars of one vehicle, and their scans make one each
            (`together`).
        pose_topic: topic of the poses; default: see the format, e.g. `mcap.open_mcap`.
        map_frame: frame that counts as the map; default `map`; with tf, where there is no such
            frame, the root of the tree above the lidar.
        pose_frame: frame whose poses these are, where the log does not name it.
        max_gap_s: longest time between two poses that is interpolated over [s].

    Raises:
        SourceNotFoundError: no such file.
        UsageError: a file that is not on this machine.
        UnknownFormatError: a file or directory of no known format; says what is known.
        CorruptSourceError: the log is damaged or contradicts itself; names file and place.
        SourceError: no scans, or several topics that are equally good; names what is there.
        PoseError: no poses, none at the time of any scan, or several topics that are equally good.
    """
    name = local_path(path)
    topics = [None] if points_topic is None else [part.strip() for part in points_topic.split(",")]
    found, state = format_of(name, LOG_FORMATS), state_of(name)
    logs = [
        _opened(name, found, state, LogOptions(t, pose_topic, map_frame, pose_frame, max_gap_s))
        for t in topics
    ]
    return logs[0] if len(logs) == 1 else together(logs)


@lru_cache(maxsize=8)
def _opened(
    path: str,
    found: Format[Recording],
    state: tuple[int, int],  # noqa: ARG001  a changed log is another
    options: LogOptions,
) -> ScanLog:
    return with_poses(found.opened(path, options), options.max_gap_s)
