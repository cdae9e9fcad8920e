"""Where the commands print: facts on stdout, what happens meanwhile on stderr."""

import json
import sys

from rich.console import Console

out = Console(markup=False)  # [m] is a unit, [Errno 28] a reason: none is a style
err = Console(stderr=True, markup=False)


def say(line: str, to: Console = out) -> None:
    """One line as it is: nothing coloured, no path broken."""
    to.print(line, highlight=False, soft_wrap=True)


def print_json(value: object) -> None:
    """One JSON document on stdout."""
    text = json.dumps(value, indent=2, sort_keys=True, default=str, allow_nan=False)
    sys.stdout.write(f"{text}\n")
