"""Tasks that only pass the time, in a module that worker processes can import."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tilestream.dataflow.tasks import perform
from tilestream.errors import TilestreamError
from tilestream.tiling import TileKey


@dataclass(frozen=True)
class Nap:
    """Sleep, note the try, fail the first `failures` times as told, sleep again."""

    tile: TileKey
    stage: str = "nap"
    seconds: float = 0.0
    after: float = 0.0
    needs: tuple[str, ...] = ()
    failures: int = 0
    how: str = ""
    notes: str = ""
    work: int = 1
    promised_bytes: int = 10**8

    @property
    def key(self) -> str:
        return f"{self.stage}-{self.tile}"


@perform.register
def _nap(task: Nap) -> str:
    if task.seconds:
        time.sleep(task.seconds)
    if task.notes:
        note = Path(task.notes) / f"{task.key}-{time.time_ns()}"
        note.touch()
        if len(list(note.parent.glob(f"{task.key}-*"))) <= task.failures:
            fail(task.how)
    if task.after:
        time.sleep(task.after)
    return str(task.tile)


def fail(how: str) -> None:
    if how == "disk":
        raise OSError(28, "No space left on device")
    if how == "path":
        raise NotADirectoryError(20, "Not a directory")
    if how == "memory":
        raise MemoryError
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "bug":
        raise ZeroDivisionError(how)
    raise TilestreamError(how)
