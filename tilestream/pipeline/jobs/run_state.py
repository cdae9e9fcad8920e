"""What a run directory says of itself, and what has become of the run since."""

from collections.abc import Mapping
from typing import Any

from tilestream.errors import DamagedError
from tilestream.files import Files
from tilestream.lock import writer_of
from tilestream.marks import parsed, unsealed
from tilestream.pipeline.jobs.run_names import RECORD

CONTINUES = "the same command continues it"
"""What to do about a run that has not ended."""


def record_of(run_dir: Files) -> dict[str, Any]:
    """The record of a run; empty: of tables alone there is none.

    Raises:
        DamagedError: it is not what was written.
    """
    file = run_dir.under(RECORD)
    try:
        return unsealed(parsed(file.read()))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except ValueError as error:
        raise DamagedError(
            f"{file.address} is damaged ({error}): run the job again, which continues it"
        ) from error


def state_told(run_dir: Files, record: Mapping[str, Any]) -> str:
    """The state of a run in words, `whole` where it has ended well; a record that says `running` is
    of a run that lives only while its process holds the lock.

    Args:
        run_dir: the run directory.
        record: its record (`record_of`).
    """
    state = record.get("state", "done")
    if state == "running":
        writer = writer_of(run_dir)
        if writer is not None:
            return f"running: {writer}"
        return f"stopped before its end, its process is gone: {CONTINUES}"
    if state == "stopped":
        return f"stopped ({record.get('stopped_by', 'nobody said why')}): {CONTINUES}"
    if state == "failed":
        return "ended, and some of it failed: the notes list what"
    return "whole"
