"""Which topic of clouds is the lidar: the one whose scans look like full turns."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from tilestream.errors import CorruptSourceError, SourceError
from tilestream.formats.logs import ros
from tilestream.formats.logs.drivers import FULL_TURN_DEG, recorded_scan, returned, span_deg
from tilestream.formats.logs.messages import MessageFile, Topic
from tilestream.records import Float64

LOOKED_AT = 3
"""So many clouds of each topic tell what it is."""
ALIKE = 0.8
"""Topics of two lidars with nearly as many returns are equally good, from this share on."""


@dataclass(frozen=True)
class Look:
    """What the first clouds of a topic look like."""

    topic: Topic
    """The topic."""
    frame: str
    """Frame of its clouds."""
    span_deg: float
    """What a cloud spans of the azimuth, in the middle [deg]."""
    returns: float
    """Returns of all its clouds, by those of the middle one."""

    @property
    def full_turn(self) -> bool:
        """Whether its clouds are turns of a lidar."""
        return self.span_deg >= FULL_TURN_DEG

    def __str__(self) -> str:
        return f"{self.topic.name} ({self.topic.messages}, {self.span_deg:.0f} deg)"


def choose_clouds(
    path: str,
    files: Sequence[MessageFile],
    topics: Sequence[Topic],
    named: str | None,
    notes: list[str],
) -> Topic:
    """The topic of the scans: the named one; else of those whose clouds span a full turn (if there
    are any) the one with the most returns; notes what was chosen from.

    Two topics of different frames with nearly as many returns are equally good; so are two of one
    frame with exactly as many.

    Raises:
        SourceError: no clouds, several topics that are equally good, or an encoding that is not
            ROS's; names what is there.
    """
    there = ", ".join(f"{t.name} ({t.type or 'no type'}, {t.messages})" for t in topics)
    clouds = [t for t in topics if t.type == ros.POINT_CLOUD and t.messages]
    if named is not None:
        clouds = [t for t in clouds if t.name == named]
    if not clouds:
        what = f"no {ros.POINT_CLOUD} messages" + (f" on topic {named}" if named else "")
        lost = next((file.lost for file in files if file.lost), None)
        cut = f" (the file is {lost})" if lost else ""
        raise SourceError(f"{path}: {what}{cut}; topics: {there or 'none'}")
    for topic in clouds:
        if topic.encoding not in ros.ENCODINGS:
            raise SourceError(
                f"{path}: {topic.name} is encoded as {topic.encoding!r}, not as ROS does "
                f"({', '.join(ros.ENCODINGS)}); convert the log to ROS 2"
            )
    if len(clouds) == 1:
        return clouds[0]
    looks = [_look(files, topic) for topic in clouds]
    candidates = [look for look in looks if look.full_turn] or looks
    first, *others = sorted(candidates, key=lambda look: -look.returns)
    equal = [
        o for o in others if o.returns >= first.returns * (1.0 if o.frame == first.frame else ALIKE)
    ]
    if equal:
        names = sorted(look.topic.name for look in (first, *equal))
        raise SourceError(
            f"{path}: several topics have about {first.returns:.0f} returns each: "
            f"{', '.join(names)}; name one as points_topic, or with commas all that are lidars of "
            "one vehicle"
        )
    left = ", ".join(str(look) for look in looks if look is not first)
    notes.append(f"of several topics of clouds took {first}, not {left}")
    return first.topic


def _look(files: Sequence[MessageFile], topic: Topic) -> Look:
    """What the first clouds of a topic look like; a damaged one is not looked at."""
    spans, counts, frame = [], [], ""
    messages = (message for file in files for message in file.messages({topic.name}))
    for message in islice(messages, LOOKED_AT):
        try:
            cloud = ros.read_cloud(message.data, topic.encoding)
            points: Float64 = recorded_scan(cloud.stamp_ns, cloud.rows()).points
        except CorruptSourceError:
            continue
        seen = points[returned(points)]
        spans.append(span_deg(seen))
        counts.append(len(seen))
        frame = cloud.frame
    if not spans:
        return Look(topic, frame, 0.0, 0.0)
    return Look(topic, frame, float(np.median(spans)), float(np.median(counts)) * topic.messages)
