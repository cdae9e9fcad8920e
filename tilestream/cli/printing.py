"""Where the commands print: facts on stdout, errors and what happens meanwhile on stderr."""

import json
import os
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.segment import Segment

from tilestream.notes import Notes, shared

OF_FILES = 160
"""Characters of a line where nobody knows: in a file or a pipe no table cuts its words."""
BIDIRECTIONAL = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
"""Characters that change in which order others are shown."""
SHOWN_AS = {
    **{
        code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if code not in b"\n\t"
    },
    **{0xDC00 + byte: f"\\x{byte:02x}" for byte in range(0x80, 0x100)},  # a name that is no UTF-8
    **{ord(sign): f"\\u{ord(sign):04x}" for sign in BIDIRECTIONAL},
}
"""What would steer a terminal, or could not be printed, and how it is shown instead."""


def visible(text: str) -> str:
    """A text of whatever origin as one may print it: it can move, colour and hide nothing."""
    return text.translate(SHOWN_AS)


class _Console(Console):
    """Prints names from files as they are: only our own styles reach the terminal.

    Markup and emoji codes are off: `[m]` is a unit, `[Errno 28]` a reason, `/a:car:/b` a topic.
    """

    def __init__(self, **how: Any) -> None:
        super().__init__(markup=False, emoji=False, **how)
        if not self.is_terminal and "COLUMNS" not in os.environ:
            self.width = OF_FILES

    def render(self, renderable: Any, options: Any = None) -> Iterable[Segment]:
        """All that is printed passes here: lines, tables, progress, log lines, tracebacks."""
        for segment in super().render(renderable, options):
            if segment.is_control:
                yield segment
            else:
                yield segment._replace(text=visible(segment.text))


out = _Console()
err = _Console(stderr=True)
"""What happens meanwhile: progress, notes, log lines; `--quiet` silences it."""
errors = _Console(stderr=True)
"""How a command ended that did not end well."""


def say(line: str, to: Console = out) -> None:
    """One line as it is: nothing coloured, no path broken."""
    to.print(line, highlight=False, soft_wrap=True)


def show_worth(worth: Mapping[str, Any] | None) -> None:
    """Print what estimates are worth, as a report says it; None: it does not."""
    if worth is None:
        return
    say("What these estimates are worth:")
    for sentence in worth["told"]:
        say(f"  {sentence}")


def say_notes(notes: Notes, to: Console = err) -> None:
    """What was noticed of sources: a line for each note, with all that share it."""
    for note in shared(notes):
        say(f"note: {note}", to=to)


def print_json(value: object) -> None:
    """One JSON document on stdout."""
    text = json.dumps(value, indent=2, sort_keys=True, default=str, allow_nan=False)
    sys.stdout.write(f"{text}\n")
