"""Tasks that only pass the time, in a module that worker processes can import."""

import os
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tilestream.errors import TilestreamError
from tilestream.grid import TileKey
from tilestream.pipeline.engine.outputs import Facts, Made
from tilestream.pipeline.engine.stage import Stage, Task

MEMORY = 10**9
"""What a nap may use [bytes]."""


@dataclass(frozen=True)
class Nowhere:
    """Keeps nothing: what is written there is never done."""

    def known(self, _: str) -> Facts | None:
        return None

    def write(self, made: Made, *_: object) -> Facts:
        return {"result": made.value}

    def read(self) -> None:
        return None


@dataclass(frozen=True)
class There(Nowhere):
    """What is to be written there was written before."""

    def known(self, _: str) -> Facts | None:
        return {"result": "of before"}


@dataclass(frozen=True)
class After:
    """Something that is read once a task has made it."""

    makers: tuple[str, ...]
    much: Mapping[str, int] = field(default_factory=dict)
    identity: str = ""

    def read(self) -> None:
        return None

    def counts(self) -> Mapping[str, int]:
        return self.much


def napping(
    after: object,
    key: str,
    seconds: float,
    later: float,
    failures: int,
    how: str,
    notes: str,
    gate: str,
) -> str:
    """Sleep, note the try, fail the first `failures` times as told, sleep again.

    A gate is a file that is waited for first.
    """
    while gate and not Path(gate).exists():
        time.sleep(0.02)
    if seconds:
        time.sleep(seconds)
    if notes:
        note = Path(notes) / f"{key}-{time.time_ns()}"
        note.touch()
        if len(list(note.parent.glob(f"{key}-*"))) <= failures:
            fail(how)
    if later:
        time.sleep(later)
    return key.split("-", 1)[1]


ORDER: list[str] = []


def summing(after: object, number: int, error: str) -> int:
    """A number, or the failure that is asked for."""
    ORDER.append(f"sum-{number}")
    if error == "ours":
        raise TilestreamError("no such number")
    if error:
        raise ZeroDivisionError(error)
    return number


def stage_named(name: str, body: Callable[..., Any]) -> Stage:
    """A stage of a name of its own, which workers find in this module by that name."""

    def function(**how: Any) -> Any:
        return body(**how)

    function.__name__ = f"{body.__name__}_{name}"
    function.__module__ = __name__
    stage = Stage(name, function, 1, lambda counts: counts.get("bytes", 0), 0.0)
    globals()[function.__name__] = stage
    return stage


NAPS = {
    name: stage_named(name, napping)
    for name in (
        "nap",
        "after",
        "spa",
        "spb",
        "cells",
        "terms",
        "factors",
        "predict",
        "merge",
        "report",
    )
}
SUMS = {name: stage_named(name, summing) for name in ("sum", "other", *"abc")}


def Sum(
    number: int,
    needs: tuple[str, ...] = (),
    error: str = "",
    stage: str = "sum",
    work: int = 2,
    count: int = 0,
) -> Task:
    """A task that fails where it is told to."""
    return Task(
        SUMS[stage],
        str(number),
        Nowhere(),
        takes={"number": number, "error": error},
        reads={"after": After(needs)},
        work=work,
        counts={"bytes": count},
    )


def Nap(
    tile: TileKey,
    stage: str = "nap",
    seconds: float = 0.0,
    after: float = 0.0,
    needs: tuple[str, ...] = (),
    failures: int = 0,
    how: str = "",
    notes: str = "",
    work: int = 1,
    gate: str = "",
    done: bool = False,
) -> Task:
    """A task of a stage, for a tile."""
    what = {"seconds": seconds, "later": after, "failures": failures, "how": how, "notes": notes}
    what["gate"] = gate
    return Task(
        NAPS[stage],
        str(tile),
        There() if done else Nowhere(),
        takes={"key": f"{stage}-{tile}", **what},
        reads={"after": After(needs)},
        work=work,
        tile=tile,
    )


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
