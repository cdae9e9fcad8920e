"""A file of messages, whatever it is stored as: topics, each message once, any message again."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

Place = tuple[int, int, int]
"""Where a message is in a file: three numbers that the file gives and takes again."""


@dataclass(frozen=True)
class Topic:
    """A topic of a log."""

    name: str
    """As recorded, e.g. `/points`."""
    type: str
    """Message type without the `msg` part, e.g. `sensor_msgs/PointCloud2`."""
    encoding: str
    """Encoding of its messages, e.g. `cdr`."""
    messages: int
    """Messages that the file holds."""


@dataclass(frozen=True, eq=False)
class Message:
    """A message as it lies in the file."""

    topic: str
    """Name of its topic."""
    place: Place
    """Where it is."""
    held: int
    """What reading it holds at once besides its content [bytes]."""
    data: memoryview
    """Its content."""


class MessageFile(AbstractContextManager["MessageFile"], Protocol):
    """A file of messages that is open for reading."""

    path: str
    """The file, as it was named."""
    size: int
    """Its size [bytes]."""
    topics: tuple[Topic, ...]
    """Its topics; none where they were not asked for."""
    lost: str | None
    """Once messages were read: what a cut file lacks; None: nothing."""
    unchecked: bool
    """Once messages were read: whether some lay where others have a CRC and they have none."""

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """The messages of some topics, in the file's order.

        Raises:
            CorruptSourceError: the file is damaged; names it and the place.
        """

    def content(self, topic: str, place: Sequence[int]) -> memoryview:
        """The message of a topic at a place; errors as for `messages`."""

    def where(self, place: Sequence[int]) -> str:
        """A place in words, for those who look for damage."""


class OpenFile(Protocol):
    """Opens a file by its path; a function or class of a module, so that it can be pickled."""

    def __call__(self, path: str, *, topics: bool = True) -> MessageFile:
        """The file; without its topics where only messages are read whose places are known."""
