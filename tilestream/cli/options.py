"""Options that several commands have, and what their words mean."""

import errno
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from tilestream.errors import UsageError
from tilestream.files import Files

StoreUrl = Annotated[str, typer.Argument(help="A tile store, or a run directory: its map.")]
Routes = Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or a log.")]
Config = Annotated[str, typer.Argument(help="A YAML file, begun with `tilestream template`.")]
Changes = Annotated[
    list[str], typer.Option("--set", help="key=value over the file, e.g. model.seed=1.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]


@contextmanager
def or_elsewhere(folder: str, asked: str | None) -> Iterator[None]:
    """Where what a command writes goes below a run directory, since nobody named another place: a
    refusal of the disk is answered with the option that names one.

    Args:
        folder: where it goes.
        asked: what `--out` says; None: it is not on the line.
    """
    try:
        yield
    except OSError as error:
        below = str(error.filename).startswith(Files.at(folder).address)
        if asked is None and below and error.errno in (errno.EACCES, errno.EROFS):
            told = f"{folder} cannot be written ({error.strerror}): --out names another place"
            raise UsageError(told) from error
        raise


def numbers(lists: list[str], option: str) -> list[float]:
    """The numbers of an option that takes several, also with commas between them.

    Raises:
        UsageError: one is no number.
    """
    parts = [part.strip() for text in lists for part in text.split(",")]
    try:
        found = [float(part) for part in parts]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        told = ", ".join(lists)
        raise UsageError(f"{option} {told}: give numbers, with commas between them")
    return found
