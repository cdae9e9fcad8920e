"""The command that writes what a run knows for a vehicle's software."""

from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Table

from tilestream.apps.export import covariance as exported
from tilestream.apps.export.covariance_files import Format
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson, or_elsewhere
from tilestream.cli.printing import out, print_json, say
from tilestream.report.formatting import cm, distance, percent
from tilestream.settings import ReportSettings


@with_settings
def export(
    what: Annotated[exported.What, typer.Argument(help="What: the covariances of registrations.")],
    run: Annotated[str, typer.Argument(help="A run directory: `estimate`, `run`.")],
    report: Annotated[ReportSettings, fields("threshold")],
    as_what: Annotated[
        Format,
        typer.Option(
            "--format", help="A table, all of it with meanings, or Autoware's parameters."
        ),
    ] = "csv",
    file: Annotated[
        str | None,
        typer.Option("--out", help="The file.", show_default="RUN/export/covariance.<format>"),
    ] = None,
    updates: Annotated[
        float, typer.Option("--every", help="The filter takes an update every so many metres [m].")
    ] = exported.EVERY,
    inflate: Annotated[
        bool,
        typer.Option(
            "--inflate",
            help="Multiply covariances by what a filter needs that takes their errors as "
            "independent.",
        ),
    ] = False,
    route: Annotated[str | None, typer.Option(help="Only this route; default: all.")] = None,
    lost: Annotated[
        float, typer.Option(help="A stretch is poor, too, where more registrations are lost.")
    ] = exported.LOST,
    as_json: AsJson = False,
) -> None:
    """Write the covariance of a registration at every place, and the poor stretches.

    - `tilestream export covariance run --format csv`: a row per place, 36 numbers in ROS's order,
      map frame

    - `--format json`: with meanings, the frame of the route, the correlation of neighbouring
      places, and poor stretches as areas

    - `--format autoware`: parameters that `ndt_scan_matcher` loads after its own. A node that has
      the lookup takes, for the lidar at p, the place k with the `position[3k..3k+2]` nearest to p,
      and its `output_pose_covariance[36k..36k+35]` where that is nearer than `spacing`, else the
      constant `covariance.output_pose_covariance`
    """
    with or_elsewhere(f"{run}/export", file):
        told = exported.export(
            what,
            run,
            file,
            format=as_what,
            every=updates,
            inflate=inflate,
            route=route,
            threshold=report.threshold,
            lost=lost,
        )
    if as_json:
        print_json(told)
    else:
        out.print(_table(told))
        say(f"Written to {told['file']}")


def _table(told: dict[str, Any]) -> Table:
    """A summary, figure and meaning."""
    table = Table(title="covariance", title_justify="left", box=SIMPLE, show_header=False)
    table.add_column(justify="right", no_wrap=True)
    table.add_column()
    spread = " x ".join(cm(told[name], 1) for name in ("along_m", "across_m"))
    times = told["inflation"]
    done = "and are multiplied by it" if told["inflated"] else "--inflate does it"
    interpolated = told["interpolated"]
    unsaid = f", of which {interpolated:,} were interpolated and have none" if interpolated else ""
    between = ""
    if told["inflation_low"] is not None:
        between = f" ({told['inflation_low']:.1f} to {told['inflation_high']:.1f})"
    rows = (
        (
            f"{told['places']:,}",
            f"places, {told['without']:,} more without{unsaid}; routes: {told['routes']:,}",
        ),
        ("", told["rest_on"]),
        (spread, "along x across, median standard deviation of a filter's registration"),
        (f"{told['yaw_deg']:.2f} deg", "heading, likewise"),
        (percent(told["p_lost"]), "lost in the median: they end over 50 cm away"),
        (told["correlation_length"], "correlation length of what neighbouring places share"),
        (
            "not known" if times is None else f"{times:.2f} times",
            f"these covariances are needed by independent updates every {told['every_m']:g} m"
            + ("" if times is None else f"{between}, {done}"),
        ),
        (distance(told["poor_length_m"]), f"of road poor; stretches: {told['poor_stretches']:,}"),
    )
    for figure, meaning in rows:
        table.add_row(*(" ".join(text.split()) for text in (figure, meaning)))
    return table
