"""What is in a `foxglove.mcap` of a report: its topics, and what it says of itself."""

from pathlib import Path

from mcap.reader import make_reader

from tilestream.apps.info.record import Info
from tilestream.counts import count_of
from tilestream.errors import CorruptSourceError, foreign_errors
from tilestream.settings import LogOptions

_HEADER = b"\x04\0\0\0ros2\x0a\0\0\0tilestream"
"""Profile and library in the header of such a file; a log, also a simulated one, has another."""


def is_scene(path: str) -> bool:
    """Whether a path is a picture that a report has made for Foxglove, and no log of a drive."""
    if Path(path).suffix.lower() != ".mcap" or not Path(path).is_file():
        return False
    with Path(path).open("rb") as file:
        return _HEADER in file.read(64)


def described(path: str, _: LogOptions) -> Info:
    """A picture of a report for Foxglove: its topics, and what it says of itself."""
    advice = "make the report again"
    with (
        foreign_errors(CorruptSourceError, f"{path} is damaged", advice),
        Path(path).open("rb") as file,
    ):
        reader = make_reader(file)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise CorruptSourceError(f"{path}: has no summary, it is cut short; {advice}")
        counts = summary.statistics.channel_message_counts
        topics = [
            f"{one.topic}: {summary.schemas[one.schema_id].name}, "
            f"{count_of(counts.get(one.id, 0), 'message')}"
            for one in summary.channels.values()
        ]
        about = {k: v for one in reader.iter_metadata() for k, v in one.metadata.items()}
    return Info(
        path=path,
        kind="scene",
        format="MCAP for Foxglove",
        size_bytes=Path(path).stat().st_size,
        coverage={"topics": len(topics)},
        contents=[*sorted(topics), *(f"{name}: {told}" for name, told in about.items())],
        notes=["made by a report to be looked at: it is no log of a drive"],
    )
