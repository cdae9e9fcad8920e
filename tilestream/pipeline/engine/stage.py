"""One kind of work: a stage is a function with a version and a cost, a task applies it once."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from tilestream.grid import TileKey
from tilestream.marks import identity_of
from tilestream.pipeline.engine.outputs import Output
from tilestream.records import Column

BASE_BYTES = 350_000_000
"""Memory of a worker process before its first task: Python, NumPy, Numba, Zarr, Dask (measured
by benchmarks/ingest.py). One that compiles kernels, in the first run after installation, holds some
300 MB more for as long as it lives, which no task promises: a local worker may take twice as much
as its task."""

Counts = Mapping[str, int]
"""How much a task reads: `points` of the map, `places` (sample points), `scans`, `rows`, …"""


@dataclass(frozen=True)
class Stage:
    """What a kind of task does, and what that costs."""

    name: str
    """The prefix of its tasks' keys."""
    function: Callable[..., Any]
    """What is read and set in, what is written out (a value, or `Made`); no side effects."""
    version: int
    """Part of the identity of all that it makes; raise it when what it makes changes."""
    memory: Callable[[Counts], int]
    """Peak memory beyond the interpreter of a task that reads so much [bytes]."""
    seconds: float
    """How long a unit of its work takes before a run has measured it here [s]."""
    columns: tuple[Column, ...] = ()
    """What the columns mean, of a stage that writes a table."""
    tells_failures: bool = False
    """Whether a tile that is not ready becomes a mark that says so, instead of a failure: those
    that read it say so in their rows."""

    def __post_init__(self) -> None:
        # A task is sent to workers with the name of its stage, which they import.
        object.__setattr__(self, "__module__", self.function.__module__)

    def __reduce__(self) -> str:
        return self.function.__name__


def stage(
    name: str,
    *,
    version: int,
    memory: Callable[[Counts], int],
    seconds: float,
    columns: tuple[Column, ...] = (),
    tells_failures: bool = False,
) -> Callable[[Callable[..., Any]], Stage]:
    """Makes a stage of a function; arguments as the fields of `Stage`."""

    def decorated(function: Callable[..., Any]) -> Stage:
        return Stage(name, function, version, memory, seconds, columns, tells_failures)

    return decorated


class Readable(Protocol):
    """Something that a task reads."""

    @property
    def identity(self) -> str:
        """Hash of what it holds, by what that was made from."""

    @property
    def makers(self) -> tuple[str, ...]:
        """Keys of the tasks that make it; none: it is there."""

    def read(self) -> Any:
        """What the stage's function is given."""

    def counts(self) -> Counts:
        """How much it is, once it is there."""


@dataclass(frozen=True)
class Product:
    """What a task makes, as something to read."""

    output: Output
    identity: str
    makers: tuple[str, ...]

    def read(self) -> Any:
        """As the output gives it."""
        return self.output.read()

    def counts(self) -> Counts:
        """Nothing that memory depends on."""
        return {}


Reads = Mapping[str, Readable | tuple[Readable, ...]]
"""What a function reads, by argument."""


@dataclass(frozen=True, eq=False, slots=True)
class Task:
    """A stage applied to something: a frozen piece of work. A plan holds millions of them."""

    applies: Stage
    """What it does."""
    name: str
    """To what: a tile, a drive and its scans; the end of the key."""
    writes: Output
    """Where the result goes."""
    takes: Mapping[str, Any] = field(default_factory=dict)
    """The settings that the function takes, by argument."""
    reads: Reads = field(default_factory=dict)
    """What the function reads, by argument."""
    work: int = 1
    """How much of its stage it is, in what the stage counts: tiles, scans, points."""
    counts: Counts = field(default_factory=dict)
    """How much it is expected to read."""
    tile: TileKey | None = None
    """The tile that it belongs to, as the dashboard shows it."""
    key: str = field(init=False)
    """Unique name, `stage-…`, as the dashboard shows it."""
    _identity: str = field(init=False, repr=False, default="")

    def __post_init__(self) -> None:
        object.__setattr__(self, "key", f"{self.applies.name}-{self.name}")

    @property
    def stage(self) -> str:
        """Name of the stage."""
        return self.applies.name

    @property
    def identity(self) -> str:
        """Hash of all that its result depends on."""
        if not self._identity:
            object.__setattr__(self, "_identity", self._hashed())
        return self._identity

    def _hashed(self) -> str:
        inputs = {name: [one.identity for one in _all(read)] for name, read in self.reads.items()}
        return identity_of(self.stage, self.applies.version, self.takes, inputs)

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the tasks that must be done before."""
        makers = [key for read in self.reads.values() for one in _all(read) for key in one.makers]
        return tuple(dict.fromkeys(makers))

    @property
    def promised_bytes(self) -> int:
        """Peak memory of a process that runs it [bytes], the interpreter included."""
        return BASE_BYTES + self.applies.memory(self.counts)

    @property
    def product(self) -> Product:
        """What it makes, for tasks that read it."""
        return Product(self.writes, self.identity, (self.key,))

    def arguments(self) -> dict[str, Any]:
        """What its function is called with: what it reads, read now, and its settings."""
        read = {
            name: tuple(one.read() for one in what) if isinstance(what, tuple) else what.read()
            for name, what in self.reads.items()
        }
        return {**read, **self.takes}


def _all(read: Readable | tuple[Readable, ...]) -> tuple[Readable, ...]:
    return read if isinstance(read, tuple) else (read,)
