"""Progress on stderr while a job runs: a bar per stage, and failures as they happen."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import rich.progress
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from tilestream.cli.printing import err
from tilestream.dataflow.run import Watch
from tilestream.dataflow.tasks import Outcome


class Rate(ProgressColumn):
    """How much of a stage ends per second."""

    def render(self, task: rich.progress.Task) -> Text:
        """The rate, empty before the first task has ended."""
        rate = task.finished_speed or task.speed
        return Text(f"{rate:,.1f}/s" if rate else "")


@contextmanager
def progress() -> Iterator[Watch]:
    """A progress bar per stage on stderr; failures are printed as they happen."""
    columns = (
        TextColumn("{task.description:>8}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, transient=not err.is_terminal) as bar:
        rows: dict[str, TaskID] = {}

        def watch(outcome: Outcome, ended: int, total: int) -> None:
            if outcome.stage not in rows:
                rows[outcome.stage] = bar.add_task(outcome.stage, total=total)
            bar.update(rows[outcome.stage], completed=ended, total=total)
            if not outcome.ok:
                bar.console.print("failed", style="red", end="")
                told = outcome.details if "--debug" in sys.argv else outcome.reason
                bar.console.print(f" {outcome.key}: {told or outcome.reason}", highlight=False)

        yield watch
