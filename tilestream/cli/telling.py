"""How much a command tells besides its results: options that every command has."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Literal

import typer
from rich.logging import RichHandler

from tilestream.cli.printing import err, errors

Level = Literal["debug", "info", "warning", "error"]
PANEL = "With any command"
"""Heading of these options in the help of each."""
LINES = RichHandler(console=err, show_time=False, show_level=False, show_path=False)
"""Prints what is logged."""
LINES.setFormatter(logging.Formatter("%(message)s"))


@dataclass
class Telling:
    """What was asked for on the line, before the command or after it."""

    debug: bool = False
    """Tracebacks of errors."""
    quiet: bool = False
    """Nothing but results and errors."""
    level: Level | None = None
    """From which level on log lines are shown; None: `info`, where it is quiet `error`."""

    def apply(self) -> None:
        """From now on, print that much."""
        ours = logging.getLogger("tilestream")
        if LINES not in ours.handlers:  # of the root it would keep Dask from silencing its own
            ours.addHandler(LINES)
        level = self.level or ("error" if self.quiet else "info")
        ours.setLevel(level.upper())
        logging.getLogger().setLevel("ERROR" if self.quiet else "WARNING")  # all other libraries
        LINES.console = errors if self.quiet else err
        err.quiet = self.quiet

    @contextmanager
    def anew(self) -> Iterator[None]:
        """For one command line, and as if none had been after it."""
        try:
            yield
        finally:
            self.debug, self.quiet, self.level = False, False, None
            self.apply()


telling = Telling()
"""Of the command that runs."""


def _debug(asked: bool) -> None:
    telling.debug |= asked


def _quiet(asked: bool) -> None:
    telling.quiet |= asked
    telling.apply()


def _level(asked: Level | None) -> None:
    telling.level = asked or telling.level
    telling.apply()


Debug = Annotated[
    bool,
    typer.Option(
        "--debug",
        callback=_debug,
        expose_value=False,
        rich_help_panel=PANEL,
        help="Show the traceback of an error.",
    ),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        callback=_quiet,
        expose_value=False,
        rich_help_panel=PANEL,
        help="Only results and errors: no progress, no notes (they are in JSON and report).",
    ),
]
LogLevel = Annotated[
    Level | None,
    typer.Option(
        "--log-level",
        callback=_level,
        expose_value=False,
        rich_help_panel=PANEL,
        help="Log lines from this level on.",
        show_default="info, with --quiet error",
    ),
]
OF_EVERY_COMMAND = ("debug", "quiet", "log_level")
"""The arguments of `root` that are these options."""
