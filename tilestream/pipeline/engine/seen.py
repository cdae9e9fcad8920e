"""Whether a client can be used: it answers at once, and its workers see what they are to write."""

import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from tilestream.errors import UsageError
from tilestream.files import Files

ANSWER_WITHIN = 30.0
"""How long workers may take to look before the run goes on without their answer [s]."""


def require_blocking(client: Any) -> None:
    """Refuse a client that answers with coroutines.

    Raises:
        UsageError: it was made with `asynchronous=True`, and is used in its own event loop.
    """
    if client.asynchronous:
        raise UsageError(
            "the Dask client is asynchronous: give one made without asynchronous=True, or None"
        )


def require_seen(client: Any, places: Sequence[str]) -> None:
    """Refuse workers that do not see the places in which they are to work.

    A small file is written to each and read by every worker that is there now; of a place where
    none can be written, it is looked whether it is there.

    Args:
        client: a Dask client.
        places: folders and stores, made by now: local paths or fsspec URLs.

    Raises:
        UsageError: a worker does not find it, or has no tilestream; says which and where.
    """
    probe = f".seen-{uuid.uuid4().hex}"
    files = [Files.at(place).under(probe) for place in dict.fromkeys(places)]
    try:
        told = {file.parent.address: _written(file, probe) for file in files}
        answers = _answers(client, told)
    finally:
        for file in files:
            with suppress(OSError):
                file.remove()
    for worker, answer in sorted(answers.items()):
        if answer and not isinstance(answer, OSError):  # which says that this worker is gone
            raise UsageError(
                f"worker {worker}: {answer}: inputs, stores and run directories must lie where all "
                "workers see them under the same name, and all workers need tilestream"
            )


def _written(file: Files, probe: str) -> str:
    """Write a probe; what it says, nothing where it cannot be written: a map may be read only."""
    try:
        file.write(probe.encode())
    except OSError:
        return ""
    return probe


def _answers(client: Any, probes: Mapping[str, str]) -> dict[str, Any]:
    """What `_look` says, by worker; of one that cannot run it the exception; nothing where the
    workers are busy, or the scheduler is lost, which the run finds out itself.
    """
    try:
        found = client.run(_look, probes, on_error="return", callback_timeout=ANSWER_WITHIN)
        return dict(found)
    except (TimeoutError, OSError):
        return {}


def _look(probes: Mapping[str, str]) -> str:
    """Why a worker does not see a place; empty: it sees them all."""
    for place, probe in probes.items():
        try:
            where = Files.at(place)
            seen = where.under(probe).read() == probe.encode() if probe else where.there()
        except Exception as error:  # noqa: BLE001 - whatever keeps it from seeing
            return f"does not see {place} ({type(error).__name__}: {error})"
        if not seen:
            return f"sees another {place}" if probe else f"does not see {place}"
    return ""
