"""The record of a run: what it did so far, kept in `run.json`."""

import json
import os
import platform
import resource
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from tilestream.errors import DamagedError
from tilestream.files import Files
from tilestream.marks import AGAIN, parsed, sealed, unsealed
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.run_names import CONFIG, RECORD
from tilestream.version import VERSION

ENDED = ("done", "failed")
"""What a run says of itself whose report is of its tables."""
WRITE_EVERY = 30.0
"""How often `run.json` is written while tasks end [s]."""


@dataclass
class Book:
    """What a run did so far; `run.json` is made from it."""

    folder: Files
    """The run directory."""
    earlier: Mapping[str, Any] = field(default_factory=dict)
    """What it said after the calls before this one."""
    began: float = field(default_factory=time.time)
    written: float = 0.0
    tasks: list[Task] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    failures: dict[str, str] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def listening(self, watch: Watch | None) -> Watch:
        """What enters outcomes as they come, and tells `watch` of them.

        It is written now and then, so that a call that is killed has told what it cost.
        """

        def hear(outcome: Outcome, ended: int, total: int) -> None:
            self.outcomes.append(outcome)
            if not outcome.ok:
                self.failures[outcome.key] = outcome.reason
            if time.time() - self.written > WRITE_EVERY:
                self.write("running")
            if watch is not None:
                watch(outcome, ended, total)

        return hear

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Where the job ends early, by an error, Ctrl-C or SIGTERM, that is written, and why."""
        try:
            yield
        except BaseException as error:
            self.facts["stopped_by"] = str(error) or type(error).__name__
            with suppress(OSError):  # on a full disk the reason itself matters more
                self.write("stopped")
            raise

    def write(self, state: str) -> dict[str, Any]:
        """Write `run.json`: whole, or as it was."""
        content = {
            "state": state,
            "tilestream": VERSION,
            **machine(),
            "began": datetime.fromtimestamp(self.began, UTC).isoformat(timespec="seconds"),
            "seconds": round(time.time() - self.began, 1),
            "calls": self.calls,
            "seconds_of_all_calls": self.seconds(),
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000,
            "stages": self.stages(),
            "failures": self.failures,
            **self.facts,
        }
        plain = json.loads(json.dumps(content, default=str))
        text = json.dumps(sealed(plain), indent=2) + "\n"
        self.folder.under(RECORD).write(text.encode())
        self.written = time.time()
        return content

    @property
    def calls(self) -> int:
        """How often the job was called on this run directory, this call included."""
        return int(self.earlier.get("calls", 0)) + 1

    def seconds(self) -> float:
        """How long all calls took [s]."""
        before = float(self.earlier.get("seconds_of_all_calls", 0.0))
        return round(before + time.time() - self.began, 1)

    def stages(self) -> dict[str, dict[str, float]]:
        """Tasks, failures and work of each stage in this call, and how much of the work was made by
        it and by those before it that did not end: the rest was done; core-seconds of all calls.
        """
        work = {task.key: task.work for task in self.tasks}
        nothing = {"tasks": 0, "failed": 0, "work": 0, "made": 0, "core_seconds": 0.0}
        before: dict[str, Any] = self.earlier.get("stages", {})
        ended = self.earlier.get("state") in ENDED
        order = dict.fromkeys([*before, *(task.stage for task in self.tasks)])
        table = {
            stage: nothing
            | {"core_seconds": before.get(stage, nothing)["core_seconds"]}
            | {"made": 0 if ended else before.get(stage, nothing).get("made", 0)}
            for stage in order
        }
        for outcome in self.outcomes:
            row = table[outcome.stage]
            row["tasks"] += 1
            row["failed"] += not outcome.ok and not outcome.refused
            row["work"] += work[outcome.key]
            row["made"] += work[outcome.key] if outcome.made else 0
            row["core_seconds"] = round(row["core_seconds"] + outcome.seconds, 3)
        return table


def told_before(record: Files) -> dict[str, Any]:
    """The record of earlier calls; empty where there is none, or it is not what was written."""
    try:
        return unsealed(parsed(record.read()))
    except (OSError, ValueError, AttributeError):
        return {}


def checksums(folder: Files) -> dict[str, str]:
    """The checksums of what a run writes besides its tables, by path in the run directory."""
    names = [CONFIG, "model.skops", "tables/evaluation.json"]
    for below in ("report", "before"):
        names += [f"{below}/{name}" for name in folder.under(below).all_files()]
    return {name: checksum_of(folder.under(name)) for name in names if folder.under(name).there()}


def checksum_of(file: Files) -> str:
    """The checksum of a file's bytes."""
    return f"{zlib.crc32(file.read()):08x}"


def content_as_written(file: Files, record: Mapping[str, Any], name: str) -> bytes:
    """The bytes of a file of a run directory, as the run wrote it.

    Args:
        file: the file.
        record: what the run says of itself (`told_before`).
        name: its path in the run directory.

    Raises:
        DamagedError: it is not what was written.
    """
    content = file.read()
    known = record.get("files", {}).get(name)
    if known is not None and known != f"{zlib.crc32(content):08x}":
        raise DamagedError(f"{file.address} is damaged, its checksum does not fit: {AGAIN}")
    return content


def machine() -> dict[str, Any]:
    """What the figures were computed with."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scikit-learn": version("scikit-learn"),
        "cores": os.cpu_count(),
    }
