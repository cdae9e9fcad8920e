"""Every error that tilestream raises on purpose: one small tree.

A message says what is wrong, where, and what to do about it. Each class is also the built-in
exception that a caller would expect, so `except FileNotFoundError` works as usual.
"""

from collections.abc import Iterator
from contextlib import contextmanager


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
    """A store written by a newer version of tilestream."""


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
        lines = "".join(f"\n  {name}: {reason}" for name, reason in sorted(failures.items()))
        super().__init__(what + lines)
        self.what = what
        self.failures = failures

    def with_more(self, failures: dict[str, str]) -> "PartialError":
        """The same, with what failed besides."""
        return PartialError(self.what, {**failures, **self.failures})


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
