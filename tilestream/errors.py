"""Every error that tilestream raises on purpose: one small tree.

A message says what is wrong, where, and what to do about it. Each class is also the built-in
exception that a caller would expect, so `except FileNotFoundError` works as usual.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

NOT_RUN = "not run, since "
"""How the reason of what was not even tried begins, since something that it needs had failed."""


class TilestreamError(Exception):
    """Base of all errors raised on purpose."""


class UsageError(TilestreamError, ValueError):
    """An argument or a setting that cannot be used as given."""


class SettingsError(UsageError):
    """Settings with values that cannot be; knows which, so that each can be named as it was given.

    Args:
        settings: what these settings are called.
        problems: the keys, with dots between levels (empty: several together), and how the sentence
            about each goes on, its separator included.
    """

    def __init__(self, settings: str, problems: tuple[tuple[str, str], ...]) -> None:
        told = "; ".join(f"{key}{wrong}".strip() for key, wrong in problems)
        super().__init__(f"{settings}: {told}")
        self.problems = problems


class SourceError(TilestreamError):
    """An input file or log that cannot be read as what it claims to be."""


class SourceNotFoundError(SourceError, FileNotFoundError):
    """No file at a path, or a glob that matches nothing."""


class UnknownFormatError(SourceError, ValueError):
    """A file whose ending or content is of no supported format."""


class CorruptSourceError(SourceError, ValueError):
    """A file cut short, damaged, or with a header that contradicts its content."""


class CrsError(SourceError, ValueError):
    """Sources in different coordinate reference systems, or a CRS that pyproj cannot read."""


class PoseError(SourceError, ValueError):
    """A log without poses, or a time outside of the poses it has."""


class StoreError(TilestreamError):
    """A tile store that cannot be used as asked."""


class StoreNotFoundError(StoreError, FileNotFoundError):
    """No tile store at a path."""


class StoreVersionError(StoreError):
    """A store whose layout is that of another version of tilestream."""


class TileNotReadyError(StoreError, LookupError):
    """A tile (or one of its tables) that is missing, failed or skipped; the message says why."""


class DamagedError(StoreError, ValueError):
    """A stored file that is not what was written; the message names it."""


class IncompleteError(StoreError, LookupError):
    """A map or run that is half-made, or has lost something that must exist."""


class LockedError(StoreError):
    """A folder or store that another process writes to."""


class RegistrationError(TilestreamError, ValueError):
    """A scan that cannot be registered: nothing near it, too few points, start poses not rigid."""


class ModelError(TilestreamError, ValueError):
    """A model that cannot be trained, read or applied as asked; the message says why."""


class TaskError(TilestreamError):
    """A task of the dataflow that failed; the message carries its reason."""


class PlanError(TilestreamError):
    """A job that does not fit what it was promised (memory, disk); says what to change."""


class DisplayError(TilestreamError, RuntimeError):
    """A view that cannot be shown here: no display, or a library is missing; says which."""


class LimitError(TilestreamError):
    """The job is done, and an estimate is above the limit that was given."""


class PartialError(TaskError):
    """A job that ended with some of its work failed; everything else is done and usable."""

    def __init__(self, what: str, failures: dict[str, str]) -> None:
        """What it says: a line for each reason (`alike`).

        Args:
            what: of which job some failed.
            failures: every failure: reasons by name.
        """
        super().__init__(what + "".join(f"\n  {line}" for line in alike(failures)))
        self.what = what
        self.failures = failures

    def with_more(self, failures: dict[str, str]) -> "PartialError":
        """The same, with what failed besides."""
        return PartialError(self.what, {**failures, **self.failures})


NAMED = 3
"""Names that are told of those with the same reason."""
OF_A_KIND = re.compile(r"(tile|scan|route|drive|sample point)( )(.+)|([a-z_]+)(-)([^./]+)")
"""The name of one of a kind, or of a task of a stage."""
OF_ANOTHER = re.compile(rf"{NOT_RUN}\S+ failed: ")
"""How the reason of a task begins that was not run."""


def alike(failures: Mapping[str, str]) -> list[str]:
    """What failed, a line for each reason, in the order of the names; last, what was not run.

    Where several have a reason, that says how many and names the first of them:
    `12 tiles: no space left (3_4, 3_5, 3_6, …)`. What was not run is told by the reason for which
    what it needs had failed.

    Args:
        failures: reasons by name: of a task, a file, `tile 3_4`, `scan 7`, …
    """
    names_of: dict[str, list[str]] = {}
    for name in sorted(failures, key=lambda n: (failures[n].startswith(NOT_RUN), _by_number(n))):
        reason = OF_ANOTHER.sub(f"{NOT_RUN}what they need failed: ", failures[name])
        names_of.setdefault(reason, []).append(name)
    return [
        f"{names[0]}: {failures[names[0]]}" if len(names) == 1 else _together(names, reason)
        for reason, names in names_of.items()
    ]


def counted(failures: Mapping[str, str]) -> str:
    """How many failed, and how many were not run because of that: `3 failed, 2 not run`."""
    not_run = sum(reason.startswith(NOT_RUN) for reason in failures.values())
    told = f"{len(failures) - not_run:,} failed"
    return told + (f", {not_run:,} not run" if not_run else "")


def require_all_done(job: object, failures: dict[str, str]) -> None:
    """Refuse a job that has ended with failures.

    Args:
        job: what it is called, or where it wrote.
        failures: reasons by name.

    Raises:
        PartialError: there are some; says how many, and that the rest is done.
    """
    if failures:
        raise PartialError(f"{job}: {counted(failures)}, the rest is done:", failures)


def _together(names: list[str], reason: str) -> str:
    """Several names with one reason, on a line."""
    parts = [OF_A_KIND.fullmatch(name) for name in names]
    kinds = {(part[1] or part[4], part[2] or part[5]) for part in parts if part}
    told, shown = f"{len(names):,} alike", names[:NAMED]
    if len(kinds) == 1 and all(parts):
        ((kind, between),) = kinds
        told = f"{len(names):,} {kind}s" if between == " " else f"{len(names):,} of {kind}"
        shown = [part[3] or part[6] for part in parts[:NAMED] if part]
    more = ", …" if len(names) > NAMED else ""
    return f"{told}: {reason} ({', '.join(shown)}{more})"


def _by_number(name: str) -> list[tuple[bool, int, str]]:
    """Sorts names as people do: scan 9 is before scan 10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(not part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]


COPY_AGAIN = "copy it again from where it came from"
"""What to do about a damaged file."""


@contextmanager
def foreign_errors(
    kind: type[TilestreamError], what: str, advice: str = COPY_AGAIN
) -> Iterator[None]:
    """The gate where a file is read: what a library raises on damaged bytes becomes one of ours.

    Our own errors pass, and so does what the machine failed (`OSError`, `MemoryError`). The message
    holds type and text of the original, which stays its cause: a bug of ours is seen as one.

    Args:
        kind: what it becomes.
        what: which file, and what is wrong with it where this happens.
        advice: what to do about it.
    """
    try:
        yield
    except (TilestreamError, OSError, MemoryError):
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:300]
        raise kind(f"{what} ({type(error).__name__}: {said}); {advice}") from error
