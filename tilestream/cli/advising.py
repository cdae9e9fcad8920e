"""The command that says what would mend the poor stretches of a run."""

from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Table

from tilestream.apps import advise as advising
from tilestream.apps.runs import settings_of
from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson, or_elsewhere
from tilestream.cli.printing import out, print_json, say, show_worth
from tilestream.cli.progress import progress
from tilestream.report.formatting import cm_about, cm_limit, distance
from tilestream.report.summary import plain
from tilestream.settings import DEFAULT_MEMORY, ReportSettings

DIGITS = 2
"""Significant digits of an estimate with a remedy."""


@on_cluster
@with_settings
def advise(
    run: Annotated[str, typer.Argument(help="A run directory: `estimate`, `run`.")],
    report: Annotated[ReportSettings, fields("threshold")],
    folder: Annotated[
        str | None,
        typer.Option("--out", help="Folder of the tables.", show_default="RUN/advise"),
    ] = None,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """What would mend the poor stretches of a run: cells, range, lidar, first guess.

    From the map alone: the virtual drive of some places of each stretch, once per remedy. Smaller
    cells are kept in the tile store of the map.
    """
    settings = settings_of(run)
    memory = DEFAULT_MEMORY if settings is None else settings.memory
    with (
        or_elsewhere(f"{run}/advise", folder),
        cluster.client(memory) as client,
        progress() as watch,
    ):
        found = advising.advise(run, folder, threshold=report.threshold, client=client, watch=watch)
    if as_json:
        print_json(content_of(found))
        return
    if found.stretches.empty:
        say(f"No estimate is above {cm_limit(found.threshold)}: there is nothing to mend")
        return
    show_worth({"told": found.worth})
    out.print(advice_table(found))
    for row in found.stretches.to_dict("records"):
        begin, end = (f"{row[name]:.0f}" for name in ("begin_m", "end_m"))
        where = f"at {begin}" if begin == end else f"{begin} to {end}"
        say(f"{row['route']}, {where} m: {verdict(found, row)}")
    for name, why in found.left_out.items():
        say(f"Not tried: {name}, {why}")


def content_of(found: advising.Advice) -> dict[str, Any]:
    """Advice for machines."""
    stretches = [
        row
        | {"verdict": verdict(found, row)}
        | {"remedies": of.drop(columns="stretch").to_dict("records")}
        for number, row in enumerate(found.stretches.to_dict("records"))
        for of in [found.remedies[found.remedies["stretch"] == number]]
    ]
    content = {"threshold_m": found.threshold, "stretches": stretches, "not_tried": found.left_out}
    content |= {"worth": list(found.worth)}
    return dict(plain(content))


def verdict(found: advising.Advice, row: Any) -> str:
    """What to do about a stretch, in words."""
    if not row["best"]:
        return (
            "none of these helps clearly: the lidar does not tell the position here, other sensors "
            "have to"
        )
    change = f"{row['best']}: {cm_about(row['now_m'], DIGITS)} to {cm_about(row['best_m'], DIGITS)}"
    limit = cm_limit(found.threshold)
    told = f"{change}, {'within' if row['mends'] else 'still over'} {limit}"
    return " ".join(told.split())  # plain spaces


def advice_table(found: advising.Advice) -> Table:
    """The stretches, and below each a line per remedy."""
    table = Table(
        title="estimates as it is, and with each remedy", title_justify="left", box=SIMPLE
    )
    table.add_column("route")
    for column in ("from", "length"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("remedy", no_wrap=True)
    table.add_column("estimate", justify="right", no_wrap=True)
    table.add_column("")
    for number, row in enumerate(found.stretches.to_dict("records")):
        where = (str(row["route"]), f"{row['begin_m']:.0f} m", distance(row["length_m"]))
        table.add_row(*where, "as it is", cm_about(row["now_m"], DIGITS), "")
        for one in found.remedies[found.remedies["stretch"] == number].to_dict("records"):
            clear = "" if one["helps"] else "unclear"
            table.add_row("", "", "", str(one["remedy"]), cm_about(one["after_m"], DIGITS), clear)
    return table
