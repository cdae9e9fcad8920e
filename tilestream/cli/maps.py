"""The commands that compare what is stored with what was written, and with another map."""

from typing import Annotated

import typer

from tilestream.apps import diff as map_diff
from tilestream.apps import verify as verifying
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson
from tilestream.cli.printing import err, out, print_json, say, say_notes
from tilestream.cli.tables import (
    diff_table,
    stretch_table,
)
from tilestream.errors import LimitError, PartialError
from tilestream.files import Files
from tilestream.report import diff_gate, write_diff
from tilestream.report.diff.data import WORSE
from tilestream.report.diff.gate import DiffGateSettings
from tilestream.report.diff.summary import diff_content


def verify(
    place: Annotated[str, typer.Argument(help="A tile store, a run directory, or its tables.")],
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Remove what is damaged and can be made again, which the same command then does.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Read everything that is stored there; list what is damaged, half-made or lost."""
    read, left = verifying.verify(place)
    removed: list[verifying.Damage] = []
    if repair and left:
        removed, left = verifying.repair(place)
    if as_json:
        told = {"removed": removed, "damaged": left}
        lists = {name: [{"path": d.path, "reason": d.reason} for d in told[name]] for name in told}
        print_json({"read": read, **lists})
    else:
        for damage in removed:
            say(f"removed {damage.path}: {damage.reason}")
        if removed:
            say("Run the commands that made these again: they make them anew")
        say(f"{read - len(removed) - len(left):,} of {read:,} are as they were written")
    if left:
        reasons = {d.path: d.reason + _why_left(d) for d in left}
        raise PartialError(f"{place}: {len(left)} damaged, half-made or lost:", reasons)


def _why_left(damage: verifying.Damage) -> str:
    """Why something damaged cannot be removed, as far as that is not clear."""
    missing = verifying.gone(damage)
    return f"; made from {missing[0]}, which is gone" if missing else ""


@with_settings
def diff(
    old: Annotated[str, typer.Argument(help="A run directory or tile store.")],
    gate_of: Annotated[DiffGateSettings, fields("fail_worse", "measure", "over")],
    new: Annotated[
        str | None,
        typer.Argument(
            help="The newer one.", show_default="the run as it is, after its last map update"
        ),
    ] = None,
    worse: Annotated[
        float, typer.Option(help="Estimates that grew by more than this are worse [m].")
    ] = WORSE,
    report: Annotated[
        str | None, typer.Option(help="Folder of a page of it, `diff.html`, and its figures.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """What a map update changes: tiles, and how much road got worse, where and why.

    - `tilestream diff old-run new-run --report changes`: a page, before and after on one map

    - `tilestream diff run --fail-worse 0.05`: a gate, on what the last update of its map changed
    """
    found = map_diff.diff(old, new, worse=worse)
    verdict = None
    if gate_of.fail_worse is not None:
        verdict = diff_gate(found, gate_of.fail_worse, gate_of.measure, gate_of.over)
    content = diff_content(found, verdict)
    if report is not None:
        write_diff(found, report, verdict)
    if as_json:
        print_json(content)
    else:
        out.print(diff_table(found))
        if len(found.places.stretches):
            out.print(stretch_table(found))
        say_notes(found.notes)
        if report is not None:
            say(f"The page is at {Files.at(report).under('diff.html').address}")
    if verdict is not None and not verdict.closed:
        say(verdict.told, to=err)
    if found.gone:
        raise PartialError(
            "no tiles are compared, estimates only; a map is gone:", dict(found.gone)
        )
    if verdict is not None and verdict.closed:
        raise LimitError(verdict.told)
