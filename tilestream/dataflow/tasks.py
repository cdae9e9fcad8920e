"""How a task is performed, whatever its stage, and what became of it.

The body of each stage registers itself beside its task's type, in the file of its job.
"""

import time
import traceback
from dataclasses import dataclass
from functools import singledispatch

from tilestream.dataflow.plan import Task
from tilestream.errors import TaskError, TilestreamError

NOT_RUN = "not run, since "
"""How the reason of a task begins that was refused because of another one."""
STANDING = (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)
"""What the disk refuses in the same way however often it is asked."""


@dataclass(frozen=True)
class Outcome:
    """What became of a task."""

    key: str
    """The task's key."""
    stage: str
    """The task's stage."""
    result: object
    """Its small summary; None where it failed."""
    reason: str = ""
    """Why it failed; empty where it did not."""
    seconds: float = 0.0
    """How long it ran [s]."""
    details: str = ""
    """The traceback of a failure, for --debug."""
    passing: bool = False
    """Whether another try may succeed: the machine failed, not the data."""

    @property
    def ok(self) -> bool:
        """Whether the task is done."""
        return not self.reason

    @property
    def refused(self) -> bool:
        """Whether it was not run, since a task that it needs had failed."""
        return self.reason.startswith(NOT_RUN)


@singledispatch
def perform(task: Task) -> object:
    """Do the work of a task; what it raises is its failure."""
    raise TaskError(f"{task.key}: no body for tasks of type {type(task).__name__}")


def attempt(task: Task) -> Outcome:
    """Do the work of a task and say what became of it; never raises.

    A verdict of our own on the data (`TilestreamError`), a path that cannot be used and a bug
    stand; where the disk, the network or the memory failed, another try may succeed.
    """
    began, passing = time.perf_counter(), False
    try:
        result = perform(task)
    except TilestreamError as error:
        reason, details = str(error), traceback.format_exc()
    except MemoryError:
        reason, details = "out of memory: allow less work at a time (--memory)", ""
        passing = True
    except OSError as error:
        reason, details = f"{error} ({type(error).__name__})", traceback.format_exc()
        passing = not isinstance(error, STANDING)
    except Exception as error:  # noqa: BLE001 - whatever fails is listed, and the others go on
        reason, details = f"{type(error).__name__}: {error}", traceback.format_exc()
    else:
        return Outcome(task.key, task.stage, result, seconds=time.perf_counter() - began)
    seconds = time.perf_counter() - began
    return Outcome(task.key, task.stage, None, reason, seconds, details, passing)
