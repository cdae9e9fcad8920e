"""What will run: tasks in an order in which they could run one by one, within a promised memory."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Self

from tilestream.errors import PlanError
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.stage import Task


@dataclass(frozen=True)
class Plan:
    """Tasks, each after those that it needs."""

    tasks: tuple[Task, ...]
    memory: int
    """What a task may use [bytes]."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """What was to be worked on and cannot be read, and why."""

    @classmethod
    def of(cls, tasks: Iterable[Task], memory: int) -> Self:
        """A plan in which every task is once, and fits the memory.

        Raises:
            PlanError: one does not; names it, and says what to change.
        """
        plan = cls(tuple({task.key: task for task in tasks}.values()), memory)
        for task in plan.tasks:
            require_fit(task, task.promised_bytes, memory)
        return plan

    def outputs(self, stage: str) -> tuple[Task, ...]:
        """The tasks of a stage, whose products are to be read."""
        return tuple(task for task in self.tasks if task.stage == stage)

    @property
    def promised_bytes(self) -> int:
        """The largest promise of any task [bytes]."""
        return max((task.promised_bytes for task in self.tasks), default=0)

    def describe(self) -> Iterator[tuple[str, int, int]]:
        """(stage, tasks, largest promise [bytes]) of each stage, in their order."""
        for stage in dict.fromkeys(task.stage for task in self.tasks):
            promises = [task.promised_bytes for task in self.outputs(stage)]
            yield stage, len(promises), max(promises)


def require_fit(task: Task, needed: int, memory: int) -> None:
    """Refuse a task that needs more memory than it may use.

    Raises:
        PlanError: it does; says what to change.
    """
    if needed > memory:
        raise PlanError(
            f"{task.key} needs {megabytes(needed)} and may use {megabytes(memory)}: "
            "allow more memory (--memory), or make the pieces smaller: a smaller tile_size "
            "(--tile-size) or a coarser map_leaf (--map-leaf)"
        )


def paths_of(tasks: Iterable[Task]) -> list[str]:
    """The files of tasks that write tables."""
    return [task.writes.path for task in tasks if isinstance(task.writes, Parquet)]


def megabytes(count: int) -> str:
    """`count` bytes as a person reads them."""
    return f"{count / 1e6:,.0f} MB"
