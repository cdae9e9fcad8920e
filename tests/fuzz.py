"""Damaged files for every reader, from a seed, and what becomes of each.

    python tests/fuzz.py --inputs 10000 --seed 0

Files are read in another process, which may hold `MEMORY` more than before and compute for
`SECONDS`; it is replaced when it has to be killed. What must not be is listed behind the table, and
kept with `--keep DIR`. A new reader is a line in `fuzz_readers.py`.
"""

import argparse
import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from random import Random
from types import TracebackType
from typing import Self

from fuzz_readers import READERS, Reader

from tilestream.errors import TilestreamError

MEMORY = 2**30
"""What a reader may allocate [bytes]."""
SECONDS = 20
"""How long it may compute [s]: a busy machine is no fault of a reader."""
PATIENCE = 900.0
"""How long it may take in all, so that what waits for ever is a hang too [s]."""
NAMED, SAME, OTHER = "named error", "same data", "other data"
FOREIGN, HANG, LARGE = "foreign exception", "hang", "beyond memory"
OUTCOMES = (NAMED, SAME, OTHER, FOREIGN, HANG, LARGE)
BAD = (FOREIGN, HANG, LARGE)
"""Of these there must be none."""
EVERY = 8
"""One in so many of a reader's files is a bomb, if it has any."""


@dataclass(frozen=True)
class Finding:
    """What became of a damaged file."""

    reader: str
    number: int
    outcome: str
    said: str
    """The error, or what was read in a few letters."""


class Child:
    """A process that reads files."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        command = [sys.executable, __file__, "--serve"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        ready, said = self._answer()
        assert ready == "ready", said

    def read(self, reader: Reader, path: Path) -> tuple[str, str]:
        """Outcome and what it said."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{json.dumps([reader.name, str(path)])}\n".encode())
        self._process.stdin.flush()
        outcome, said = self._answer()
        if outcome == HANG or self._process.poll() is not None:
            self._stop()
            self._start()
        return outcome, said

    def _answer(self) -> tuple[str, str]:
        out = self._process.stdout
        assert out is not None
        if not select.select([out], [], [], PATIENCE)[0]:
            return HANG, f"more than {PATIENCE:g} s"
        line = out.readline()
        if not line:
            code = self._process.wait()
            return HANG if code == -signal.SIGXCPU else FOREIGN, f"the process ended with {code}"
        outcome, said = json.loads(line)
        return outcome, said

    def _stop(self) -> None:
        self._process.kill()
        with self._process:
            pass

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._stop()


def serve() -> None:
    """Read the files that are named on standard input."""
    answers = os.fdopen(os.dup(1), "w")
    for stream in (1, 2):  # libraries say there what they think
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    known = {reader.name: reader for reader in READERS}
    print(json.dumps(["ready", ""]), file=answers, flush=True)
    for line in sys.stdin:
        name, path = json.loads(line)
        print(json.dumps(outcome_of(known[name], Path(path))), file=answers, flush=True)


def outcome_of(reader: Reader, path: Path) -> tuple[str, str]:
    """What becomes of a file in this process; data that is read has no outcome yet."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    until = int(time.process_time()) + SECONDS + 1
    resource.setrlimit(resource.RLIMIT_CPU, (until, resource.RLIM_INFINITY))
    try:
        return "", reader.digest(path)
    except BaseException as error:  # noqa: BLE001  a panic of Rust too
        said = f"{type(error).__name__}: {error}"[:2000]
        if any(isinstance(one, MemoryError) for one in chain(error)):
            return LARGE, said
        if not isinstance(error, TilestreamError):
            return FOREIGN, said
        named = path.name in said or path.parent.name in said
        return (NAMED, said) if named else (FOREIGN, f"does not name the file: {said}")
    finally:
        for kind in (resource.RLIMIT_AS, resource.RLIMIT_CPU):
            resource.setrlimit(kind, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error, its cause, the cause of that, …"""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


@lru_cache
def whole(reader: Reader) -> bytes:
    """A file that is not damaged."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / reader.file
        reader.make(path)
        return path.read_bytes()


@lru_cache
def bombs(reader: Reader) -> tuple[bytes, ...]:
    """The worst files of a reader."""
    return tuple(reader.bombs(whole(reader)))


def damaged(seed: int, number: int) -> tuple[Reader, bytes]:
    """The file with a number: which reader's, and its content."""
    turn, which = divmod(number, len(READERS))
    reader, chance = READERS[which], Random(f"{seed} {number}")
    if turn % EVERY == EVERY - 1 and bombs(reader):
        return reader, bombs(reader)[turn // EVERY % len(bombs(reader))]
    return reader, reader.mutate(whole(reader), chance)


def fuzz(inputs: int, seed: int = 0, children: int = 1, keep: Path | None = None) -> list[Finding]:
    """Read so many damaged files.

    Args:
        inputs: how many.
        seed: of the damage.
        children: processes that read.
        keep: where to keep what must not be; None: nowhere.
    """
    for reader in READERS:
        whole(reader), bombs(reader)
    parts = [range(n, inputs, children) for n in range(children)]
    with ThreadPoolExecutor(children) as pool:
        found = pool.map(lambda numbers: list(read_all(numbers, seed, keep)), parts)
        return sorted((one for part in found for one in part), key=lambda one: one.number)


def read_all(numbers: Iterable[int], seed: int, keep: Path | None) -> Iterator[Finding]:
    """The files with some numbers, in a process."""
    with tempfile.TemporaryDirectory() as folder, Child() as child:
        truth: dict[str, str] = {}
        for number in numbers:
            reader, content = damaged(seed, number)
            path = Path(folder) / reader.name / reader.file
            if reader.name not in truth:
                path.parent.mkdir()
                reader.make(path)
                outcome, truth[reader.name] = child.read(reader, path)
                assert not outcome, f"{reader.name} is not read whole: {truth[reader.name]}"
            path.write_bytes(content)
            outcome, said = child.read(reader, path)
            outcome = outcome or (SAME if said == truth[reader.name] else OTHER)
            if outcome == OTHER and reader.sealed:
                outcome, said = FOREIGN, "damaged, and read as other data"
            if outcome in BAD and keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{number}-{reader.file}").write_bytes(content)
            yield Finding(reader.name, number, outcome, said)


def table(found: Iterable[Finding]) -> str:
    """A row per reader: how many files had each outcome."""
    counts = Counter((one.reader, one.outcome) for one in found)
    names = [reader.name for reader in READERS]
    rows = [[name, *(str(counts[name, outcome]) for outcome in OUTCOMES)] for name in names]
    sums = [str(sum(counts[name, outcome] for name in names)) for outcome in OUTCOMES]
    lines = [["", *OUTCOMES], *rows, ["all", *sums]]
    return "\n".join(
        f"{name:<20}" + "".join(f"{text:>18}" for text in texts) for name, *texts in lines
    )


def bad(found: Iterable[Finding]) -> list[str]:
    """What must not be, a line each."""
    return [
        f"{one.reader}, number {one.number}: {one.outcome}: {one.said}"
        for one in found
        if one.outcome in BAD
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--children", type=int, default=2)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        with suppress(KeyboardInterrupt):
            serve()
        return
    found = fuzz(given.inputs, given.seed, given.children, given.keep)
    print(table(found), *bad(found), sep="\n")
    sys.exit(bool(bad(found)))


if __name__ == "__main__":
    main()
