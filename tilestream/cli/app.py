"""The command line: its commands, and the only place that exits.

Exit codes: 0 all good; 1 some sources, tiles or scans failed and are listed, the rest is done;
2 usage, or a job that does not fit its memory or disk; 130 Ctrl-C; 143 SIGTERM.
"""

import errno
import logging
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any

import typer
from rich.logging import RichHandler
from typer.core import TyperGroup

from tilestream.cli.printing import err, out, say
from tilestream.errors import (
    PlanError,
    SourceNotFoundError,
    StoreNotFoundError,
    TilestreamError,
    UsageError,
)
from tilestream.version import VERSION

INTERRUPTED = 130
"""Exit code of a command that was stopped with Ctrl-C."""
TERMINATED = 143
"""Exit code of a command that was stopped with SIGTERM, as a shell would give it."""
OF_DISKS = {
    errno.ENOSPC: "make room; the same command continues where it was",
    errno.EACCES: "name another place, or ask whoever owns it for the right",
    errno.EROFS: "name another place: nothing can be written there",
    errno.ENAMETOOLONG: "give a shorter name",
}
"""What to do about an error of a disk."""
MARKUP: Any = "markdown"  # the other mode takes [m] for a style
COMMANDS = {
    "estimate": (
        "jobs",
        "From a map alone to the localization error everywhere: nobody has to drive there first.",
    ),
    "ingest": ("maps", "Make a tile store from point clouds, map directories and logs of drives."),
    "status": ("maps", "Show the tiles of a store: counts, extents, status and reasons."),
    "verify": (
        "maps",
        "Read everything that is stored there; list what is damaged, half-made or lost.",
    ),
    "info": (
        "maps",
        "Show what is in anything that is read or made: extent, CRS, coverage, state, notes.",
    ),
    "localize": (
        "routes",
        "Measure the localization error along a drive: 317 registrations per sample point.",
    ),
    "factors": ("routes", "Compute the factors of the map at every sample point of a route."),
    "compare": (
        "routes",
        "Compare lidars, ranges, resolutions of map and scan along routes, from the map alone.",
    ),
    "simulate": (
        "jobs",
        "Simulate a survey of a district and drives through it; a killed run continues.",
    ),
    "explain": (
        "explain",
        "What a factor, a column, a setting or a term means: unit, formula, default.",
    ),
    "template": ("jobs", "Print a job for your city: a YAML file that explains every setting."),
    "run": (
        "jobs",
        "The main job: from map and drives to the estimated error everywhere, and its report.",
    ),
    "plan": (
        "jobs",
        "What a job would run: stages, tasks, memory, core-hours; reads headers, writes nothing.",
    ),
    "diff": (
        "maps",
        "What a map update changes: tiles, and how much road got worse, where and why.",
    ),
    "view": (
        "viewing",
        "Show a map in 3D, the route on it coloured by measured or estimated error.",
    ),
    "demo": (
        "jobs",
        "A street of Shinjuku from its map alone, and what a drive measures: minutes, no files.",
    ),
}
"""The file of each command, and what the list of commands says of it."""


class LateCommands(TyperGroup):
    """A group that imports a command's file when that command is to run, and no other."""

    def make_context(self, *line: Any, **how: Any) -> Any:
        """The options before the command."""
        with _typers_errors():
            return super().make_context(*line, **how)

    def invoke(self, ctx: Any) -> Any:
        """Run the command of a line."""
        with _typers_errors():
            return super().invoke(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """The command of a line."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command and command_of(str(name)), rest


@contextmanager
def _typers_errors() -> Iterator[None]:
    """What typer refuses of a line is told as all errors are, and not in a box of several lines."""
    try:
        yield
    except Exception as error:
        if not hasattr(error, "format_message") or type(error).__name__ == "NoArgsIsHelpError":
            raise
        context = getattr(error, "ctx", None)
        command = "tilestream" if context is None else context.command_path
        said = " ".join(error.format_message().split()).rstrip(".")
        said = said.replace("Value error, ", "")  # pydantic's
        raise UsageError(f"{said}; `{command} --help` says what there is") from error


def command_of(name: str) -> Any:
    """A command with all its options."""
    file, _ = COMMANDS[name]
    alone = typer.Typer(add_completion=False, rich_markup_mode=MARKUP)
    alone.command(name)(getattr(import_module(f"tilestream.cli.{file}"), name))
    return typer.main.get_command(alone)


app = typer.Typer(
    name="tilestream",
    cls=LateCommands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=MARKUP,
    epilog="Begin with `tilestream estimate map.pcd --route route.tum`, or with `tilestream demo`, "
    "which needs no files.",
)
for _name, (_, _told) in COMMANDS.items():
    app.command(_name, help=_told)(lambda: None)  # only listed


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[  # noqa: ARG001 - `run` takes it from anywhere on the line
        bool, typer.Option("--debug", help="With any command: show the traceback of an error.")
    ] = False,
) -> None:
    """The localization error of a LiDAR vehicle at every metre, from the map alone."""
    plain = RichHandler(console=err, show_time=False, show_level=False, show_path=False)
    logging.basicConfig(format="%(message)s", handlers=[plain])
    logging.getLogger("tilestream").setLevel(logging.INFO)
    if version:
        out.print(VERSION, highlight=False)
        raise typer.Exit


class Terminated(SystemExit):
    """SIGTERM: a batch system, a container or a shell asks for the end."""

    def __str__(self) -> str:
        return "SIGTERM"


def _terminate(*_: object) -> None:
    """End as after Ctrl-C: workers are closed, a run says that it was stopped."""
    raise Terminated(TERMINATED)


class LostRequests:
    """Asks once more for the end where the request came while Python ignores errors.

    That is so in callbacks of the garbage collector, Dask has one, and in `__del__`. What fails
    there from then on is a consequence, and is not told.
    """

    def __init__(self) -> None:
        self.any = False

    def __call__(self, ignored: Any) -> None:
        """What `sys.unraisablehook` calls."""
        if isinstance(ignored.exc_value, Terminated):
            self.any = True
            here = threading.main_thread().ident
            threading.Timer(0.05, signal.pthread_kill, (here, signal.SIGTERM)).start()
        elif not self.any:
            sys.__unraisablehook__(ignored)


def main() -> None:
    """The entry point: run a command, turn errors into one clear line and an exit code."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.unraisablehook = LostRequests()
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command line and return its exit code."""
    debug = "--debug" in arguments
    try:
        app(args=[a for a in arguments if a != "--debug"], prog_name="tilestream")
    except SystemExit as end:
        if end.code in (INTERRUPTED, TERMINATED):
            say("stopped; the same command continues where it was", to=err)
        return int(end.code or 0)
    except Exception as error:
        if _was_terminated(error):  # and something failed on the way out
            say("stopped; the same command continues where it was", to=err)
            return TERMINATED
        if isinstance(error, UsageError | SourceNotFoundError | StoreNotFoundError | PlanError):
            return _report(error, debug, 2)
        if isinstance(error, TilestreamError | OSError):
            return _report(error, debug, 1)
        raise
    return 0


def _was_terminated(error: BaseException | None) -> bool:
    """Whether an error came while a command ended since it was asked to."""
    while error is not None and not isinstance(error, Terminated):
        error = error.__context__
    return error is not None


def _report(error: Exception, debug: bool, code: int) -> int:
    if debug:
        err.print_exception()
    advice = OF_DISKS.get(error.errno or 0) if isinstance(error, OSError) else None
    say(f"error: {error}{f': {advice}' if advice else ''}", to=err)
    return code
