"""The command that tells what names mean."""

from dataclasses import asdict
from itertools import groupby
from typing import Annotated

import typer

from tilestream import definitions
from tilestream.cli.options import AsJson
from tilestream.cli.printing import print_json, say


def explain(
    name: Annotated[
        list[str] | None,
        typer.Argument(
            help="A column, a setting (range_max or observe.range_max), a term (cell, virtual "
            "drive), or a section (4.5); none: list all."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """What a factor, a column, a setting or a term means: unit, formula, default."""
    if name:
        found = definitions.explain(" ".join(name))
        if as_json:
            print_json(asdict(found))
        else:
            say(str(found))
    elif as_json:
        print_json([asdict(entry) for entry in definitions.entries()])
    else:
        _list_all()


def _list_all() -> None:
    say("sections of the definitions")
    for section in definitions.sections().values():
        say(f"  {section.number:<4} {section.title}")
    for group, entries in groupby(definitions.entries(), _group):
        say(f"\n{group}")
        for entry in entries:
            unit = f" [{entry.unit}]" if entry.kind == "column" else ""
            default = f" ({entry.default})" if entry.default else ""
            say(f"  {entry.name}{unit}{default}" + (f": {entry.meaning}" if entry.meaning else ""))


def _group(entry: definitions.Entry) -> str:
    """A column is listed with the first of its tables only."""
    return f"{entry.kind}s of {entry.where.split(', ')[0]}"
