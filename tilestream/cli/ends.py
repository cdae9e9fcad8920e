"""Where the starts of a place began and ended, for `tilestream info --starts-of`."""

import pandas as pd
from rich.box import SIMPLE
from rich.table import Table

from tilestream.cli.printing import out, print_json
from tilestream.counts import count_of
from tilestream.label import FAILED
from tilestream.pipeline.jobs.starts_of import starts_of

ENDS = ("from_along", "from_across", "along", "across", "up", "error")
"""What is told of each start [m]."""


def show_ends(place: str, sample: int, of_drive: str, as_json: bool) -> None:
    """Print them, of a sample point of a run or of the tables of `localize`."""
    rows = starts_of(place, sample, of_drive)
    if as_json:
        print_json(rows.to_dict("records"))
    else:
        out.print(ends_table(rows))


def ends_table(rows: pd.DataFrame) -> Table:
    """Where the starts of a place began and ended, a line per start."""
    failed = int((rows["error"] > FAILED).sum())
    title = (
        f"{count_of(len(rows), 'start')} of sample point {rows['sample'].iloc[0]}, {failed} failed"
    )
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for name in ("scan", "start", *(f"{name} [m]" for name in ENDS), "converged"):
        table.add_column(name, justify="right")
    for row in rows.to_dict("records"):
        lengths = (f"{row[name]:.3f}" for name in ENDS)
        converged = "yes" if row["converged"] else "no"
        table.add_row(str(row["scan"]), str(row["start"]), *lengths, converged)
    return table
