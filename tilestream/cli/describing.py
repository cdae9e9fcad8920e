"""The command that shows what is in anything; it imports little, so that it answers at once."""

import math
from importlib import import_module
from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.table import Table

from tilestream.apps import info as describing
from tilestream.apps.info.record import Info
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson
from tilestream.cli.printing import out, print_json
from tilestream.counts import count_of
from tilestream.crs import named
from tilestream.errors import PartialError, TilestreamError, UsageError
from tilestream.settings import LogOptions


@with_settings
def info(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE",
            help="Points, logs, routes, map folders, stores, runs, tables, comparisons, models.",
        ),
    ],
    log: Annotated[LogOptions, fields(*LogOptions.model_fields)],
    starts_of: Annotated[
        int | None,
        typer.Option(
            help="Of a run or of the tables of `localize`: where the starts of this sample point "
            "of a drive began and ended."
        ),
    ] = None,
    of_drive: Annotated[str, typer.Option(help="Its drive, where a run has several.")] = "",
    as_json: AsJson = False,
) -> None:
    """Show what is in anything that is read or made: extent, CRS, coverage, state, notes."""
    if starts_of is not None:
        if len(files) > 1:
            raise UsageError("--starts-of is of one run: name one")
        import_module("tilestream.cli.ends").show_ends(files[0], starts_of, of_drive, as_json)
        return
    found, failures = [], {}
    for file in files:
        try:
            found.append(describing.info(file, log))
        except TilestreamError as error:
            if len(files) == 1:
                raise
            failures[file] = str(error).removeprefix(f"{file}: ")
    if as_json:
        print_json(found[0].plain() if len(files) == 1 else [one.plain() for one in found])
    else:
        for one in found:
            out.print(info_table(one))
    if failures:
        raise PartialError(f"{len(failures):,} of {len(files):,} cannot be described:", failures)


def info_table(found: Info) -> Table:
    """What is in a file, or in what we have made, a line per fact."""
    table = Table(show_header=False, title=found.path, title_justify="left", box=SIMPLE)
    table.add_row("what", f"{found.kind}: {found.format}")
    table.add_row("state", found.state)
    if found.size_bytes is not None:
        table.add_row("size", count_of(found.size_bytes, "byte"))
    if found.fields:
        table.add_row("fields", ", ".join(f"{name}: {kind}" for name, kind in found.fields))
    if found.kind not in ("model", "comparison", "scene"):
        taken = ": taken as metres" if found.kind in ("points", "map") else ""
        unnamed = f"none is named{taken}"
        table.add_row("CRS", unnamed if found.crs is None else named(found.crs))
    for name, frame in found.frames.items():
        table.add_row(f"frame of {name}", frame or "not named")
    for name, told in (*_extent(found), *_coverage(found)):
        table.add_row(name, told)
    for line in found.contents:
        table.add_row("holds", line)
    for note in found.notes:
        table.add_row("note", note)
    return table


def _extent(found: Info) -> list[tuple[str, str]]:
    """From where to where it reaches: millimetres, or what they are in degrees."""
    if found.bounds is None:
        return []
    digits = 8 if found.unit == "degrees" else 3
    lowest, highest = (
        "  ".join("no z" if math.isnan(value) else f"{value:.{digits}f}" for value in corner)
        for corner in found.bounds
    )
    told = "none" if found.heights is None else "{:.3f} to {:.3f} m".format(*found.heights)
    unit = f"[{found.unit}]"
    return [(f"lowest {unit}", lowest), (f"highest {unit}", highest), ("heights", told)]


def _coverage(found: Info) -> list[tuple[str, str]]:
    """How much of it there is."""
    rows = []
    if found.points is not None and found.kind != "run":
        rows.append(("points", f"{found.points:,}"))
    for name, value in found.coverage.items():
        shown = f"{value:.1f}" if isinstance(value, float) else str(value)
        rows.append((name.replace("_", " "), shown))
    return rows
