"""The command line: its commands, and the only place that exits.

Exit codes: 0 all good; 1 some sources, tiles or scans failed and are listed, the rest is done;
2 usage, or a job that does not fit its memory or disk; 130 Ctrl-C; 143 SIGTERM.
"""

import errno
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from tilestream.cli.completion import completable
from tilestream.cli.printing import errors, out, say
from tilestream.cli.telling import OF_EVERY_COMMAND, Debug, LogLevel, Quiet, telling
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
    "ingest": (
        "ingesting",
        "Make a tile store from point clouds, map directories and logs of drives.",
    ),
    "status": ("state", "Show the tiles of a store: counts, extents, status and reasons."),
    "verify": (
        "maps",
        "Read everything that is stored there; list what is damaged, half-made or lost.",
    ),
    "info": (
        "describing",
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
    "advise": (
        "advising",
        "What would mend the poor stretches of a run: cells, range, lidar, first guess.",
    ),
    "export": (
        "exporting",
        "Write the covariance of a registration at every place, and the poor stretches.",
    ),
    "view": (
        "viewing",
        "Show a map in 3D, the route on it coloured by measured or estimated error.",
    ),
    "warm": (
        "jobs",
        "Compile the kernels that jobs need: once per installation, for an image or a first job.",
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
        """The command of a line; where the line is completed, what can be completed of it."""
        name, command, rest = super().resolve_command(ctx, args)
        if command is None:
            return name, None, rest
        if ctx.resilient_parsing:
            return name, _made(str(name), completable(str(name), function_of)), rest
        return name, command_of(str(name)), rest


def function_of(name: str) -> Any:
    """The function of a command, from its file."""
    file, _ = COMMANDS[name]
    return getattr(import_module(f"tilestream.cli.{file}"), name)


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
    return _made(name, function_of(name))


def _made(name: str, function: Any) -> Any:
    alone = typer.Typer(add_completion=False, rich_markup_mode=MARKUP)
    alone.command(name)(function)
    command = typer.main.get_command(alone)
    everywhere = [p for p in typer.main.get_command(app).params if p.name in OF_EVERY_COMMAND]
    command.params += everywhere
    return command


app = typer.Typer(
    name="tilestream",
    cls=LateCommands,
    no_args_is_help=True,
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
    debug: Debug = False,  # noqa: ARG001 - these three are told to `telling`
    quiet: Quiet = False,  # noqa: ARG001
    log_level: LogLevel = None,  # noqa: ARG001
) -> None:
    """The localization error of a LiDAR vehicle at every metre, from the map alone."""
    telling.apply()
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
    with telling.anew():
        return _run(arguments)


def _run(arguments: list[str]) -> int:
    try:
        app(args=arguments, prog_name="tilestream")
    except SystemExit as end:
        if end.code in (INTERRUPTED, TERMINATED):
            say("stopped; the same command continues where it was", to=errors)
        return int(end.code or 0)
    except Exception as error:
        if _was_terminated(error):  # and something failed on the way out
            say("stopped; the same command continues where it was", to=errors)
            return TERMINATED
        if isinstance(error, UsageError | SourceNotFoundError | StoreNotFoundError | PlanError):
            return _report(error, 2)
        if isinstance(error, TilestreamError | OSError):
            return _report(error, 1)
        raise
    return 0


def _was_terminated(error: BaseException | None) -> bool:
    """Whether an error came while a command ended since it was asked to."""
    while error is not None and not isinstance(error, Terminated):
        error = error.__context__
    return error is not None


def _report(error: Exception, code: int) -> int:
    if telling.debug:
        errors.print_exception()
    advice = OF_DISKS.get(error.errno or 0) if isinstance(error, OSError) else None
    say(f"error: {error}{f': {advice}' if advice else ''}", to=errors)
    return code
