"""Progress while a job runs: bars on a terminal and in a notebook, else a line now and then."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import rich.progress
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from tilestream.cli.printing import err, say
from tilestream.cli.telling import telling
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.executor import Watch

LINE_EVERY = 30.0
"""How often progress is told where there is no terminal, as in the log of a cluster job [s]."""
Show = Callable[[str, int, int], None]
"""Is called with a stage, how much of it has ended, and how much that is in all."""


class Rate(ProgressColumn):
    """How much of a stage ends per second."""

    def render(self, task: rich.progress.Task) -> Text:
        """The rate, empty before the first task has ended."""
        rate = task.finished_speed or task.speed
        return Text(f"{rate:,.1f}/s" if rate else "")


@contextmanager
def progress() -> Iterator[Watch]:
    """Progress of each stage while a job runs, on stderr or in a notebook; of failures with the
    same reason the first is printed when it happens.

    Examples:
        >>> with ts.progress() as watch:
        ...     store = ts.ingest(["street.pcd"], "small.zarr", tile_size=20.0, watch=watch)
    """
    known: set[str] = set()
    with _bars() if err.is_terminal or err.is_jupyter else _lines() as show:

        def watch(outcome: Outcome, ended: int, total: int) -> None:
            show(outcome.stage, ended, total)
            if not outcome.ok and not outcome.refused and outcome.reason not in known:
                known.add(outcome.reason)
                err.print("failed", style="red", end="")
                told = outcome.details if telling.debug else outcome.reason
                err.print(f" {outcome.key}: {told or outcome.reason}", highlight=False)

        yield watch


@contextmanager
def _bars() -> Iterator[Show]:
    """A bar per stage, and one that moves until the first task has ended."""
    columns = (
        SpinnerColumn(finished_text=" "),
        TextColumn("{task.description:>8}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err) as bar:
        waiting = bar.add_task("starting", total=None)
        rows: dict[str, TaskID] = {}

        def show(stage: str, ended: int, total: int) -> None:
            bar.update(waiting, visible=False)
            if stage not in rows:
                rows[stage] = bar.add_task(stage, total=total)
            bar.update(rows[stage], completed=ended, total=total)

        try:
            yield show
        finally:
            bar.update(waiting, visible=False)
            bar.refresh()  # a notebook would keep what it showed last


@contextmanager
def _lines() -> Iterator[Show]:
    """A line every `LINE_EVERY` seconds, of the stages that have got on since."""
    stages: dict[str, str] = {}
    told = time.monotonic()

    def show(stage: str, ended: int, total: int) -> None:
        nonlocal told
        stages[stage] = f"{stage} {ended:,}/{total:,}"
        if time.monotonic() - told >= LINE_EVERY:
            say(", ".join(stages.values()), to=err)
            stages.clear()
            told = time.monotonic()

    yield show
