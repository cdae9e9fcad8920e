"""The command line: its commands, and the only place that exits.

Exit codes: 0 all good; 1 some sources, tiles or scans failed and are listed, the rest is done;
2 usage, or a job that does not fit its memory or disk.
"""

import logging
import sys
from typing import Annotated

import typer
from rich.logging import RichHandler

from tilestream.cli import jobs, maps, routes
from tilestream.cli.printing import err, out, say
from tilestream.errors import (
    PlanError,
    SourceNotFoundError,
    StoreNotFoundError,
    TilestreamError,
    UsageError,
)
from tilestream.version import VERSION

app = typer.Typer(
    name="tilestream",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # the other mode takes [m] for a style
)
for command in (
    maps.ingest,
    maps.status,
    maps.info,
    routes.localize,
    routes.factors,
    routes.compare,
    jobs.simulate,
    jobs.run,
    jobs.plan,
    maps.diff,
    jobs.demo,
):
    app.command()(command)


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


def main() -> None:
    """The entry point: run a command, turn errors into one clear line and an exit code."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command line and return its exit code."""
    debug = "--debug" in arguments
    try:
        app(args=[a for a in arguments if a != "--debug"], prog_name="tilestream")
    except SystemExit as end:
        return int(end.code or 0)
    except (UsageError, SourceNotFoundError, StoreNotFoundError, PlanError) as error:
        return _report(error, debug, 2)
    except (TilestreamError, OSError) as error:
        return _report(error, debug, 1)
    return 0


def _report(error: Exception, debug: bool, code: int) -> int:
    if debug:
        err.print_exception()
    say(f"error: {error}", to=err)
    return code
