"""What will run: frozen tasks with their needs and their promised memory, before anything runs."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from tilestream.errors import PlanError

BASE_BYTES = 350_000_000
"""Memory of a worker process before its first task: Python, NumPy, Numba, Zarr, Dask (measured
by benchmarks/ingest.py). One that compiles kernels, in the first run after installation, holds some
300 MB more for as long as it lives, which no task promises: a local worker may take twice as much
as its task."""
DEFAULT_MEMORY = 1_500_000_000
"""What a task may use where the user promises nothing else [bytes]."""


class Task(Protocol):
    """A frozen piece of work: where it reads and writes, and what it may use."""

    @property
    def stage(self) -> str:
        """Name of the stage: the prefix of the key."""

    @property
    def key(self) -> str:
        """Unique name, `stage-…`, as the dashboard shows it."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the tasks that must be done before."""

    @property
    def work(self) -> int:
        """How much of its stage it is, in what the stage counts: tiles, scans, points."""

    @property
    def promised_bytes(self) -> int:
        """Peak memory of a process that runs it [bytes], the interpreter included."""


@dataclass(frozen=True)
class Plan:
    """Tasks in an order in which they could run one by one."""

    tasks: tuple[Task, ...]
    memory: int
    """What a task may use [bytes]."""

    @property
    def promised_bytes(self) -> int:
        """The largest promise of any task [bytes]."""
        return max((task.promised_bytes for task in self.tasks), default=0)

    def check(self) -> "Plan":
        """Itself, if every task fits the memory it may use.

        Raises:
            PlanError: one does not; names it, and says what to change.
        """
        for task in self.tasks:
            if task.promised_bytes > self.memory:
                raise PlanError(
                    f"{task.key} needs {megabytes(task.promised_bytes)} and may use "
                    f"{megabytes(self.memory)}: allow more with --memory, "
                    "or make the pieces smaller (--tile-size, or a coarser --map-leaf)"
                )
        return self

    def describe(self) -> Iterator[tuple[str, int, int]]:
        """(stage, tasks, largest promise [bytes]) of each stage, in their order."""
        for stage in dict.fromkeys(task.stage for task in self.tasks):
            promises = [task.promised_bytes for task in self.tasks if task.stage == stage]
            yield stage, len(promises), max(promises)


def megabytes(count: int) -> str:
    """`count` bytes as a person reads them."""
    return f"{count / 1e6:,.0f} MB"
