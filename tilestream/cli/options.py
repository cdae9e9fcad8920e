"""Options that several commands have, and what their words mean."""

import math
from typing import Annotated

import typer

from tilestream.errors import UsageError

StoreUrl = Annotated[str, typer.Argument(help="The tile store.")]
Routes = Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or a log.")]
Config = Annotated[str, typer.Argument(help="A YAML file, begun with `tilestream template`.")]
Changes = Annotated[
    list[str], typer.Option("--set", help="key=value over the file, e.g. model.seed=1.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]


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
