"""Whether a client can be used: it answers at once, its workers see what they write and hold it."""

import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from tilestream.errors import UsageError
from tilestream.files import Files, without_secrets
from tilestream.notes import some_of
from tilestream.pipeline.engine.plan import megabytes

ANSWER_WITHIN = 120.0
"""How long workers may take to look before the run goes on without their answer [s]: a new one
imports this package first, from the disk of a busy machine maybe."""
NAMED = 3
"""Workers that are named of those that have one trouble; of the others the number."""


def require_blocking(client: Any) -> None:
    """Refuse a client that answers with coroutines.

    Raises:
        UsageError: it was made with `asynchronous=True`, and is used in its own event loop.
    """
    if client.asynchronous:
        raise UsageError(
            "the Dask client is asynchronous: give one made without asynchronous=True, or None"
        )


def require_seen(
    client: Any,
    places: Sequence[str],
    inputs: Sequence[str] = (),
    workers: Sequence[str] | None = None,
    memory: int = 0,
) -> None:
    """Refuse workers that do not see the places in which they are to work, or are too small.

    A small file is written to each and read by every worker; of a place where none can be written,
    and of an input, it is looked whether it is there.

    Args:
        client: a Dask client.
        places: folders and stores, made by now: local paths or fsspec URLs.
        inputs: files and stores that are there, and only read; of those of one kind in one folder
            one is looked at.
        workers: addresses of those that are asked; None: all that are there now.
        memory: what a task may use [bytes]: a worker that is ended before would take one task
            after the other with it.

    Raises:
        UsageError: some do not find it, may use less memory, or have no tilestream; says which,
            what, and what to do.
    """
    probe = f".seen.{uuid.uuid4().hex}.part"  # which the next run clears up after a killed one
    files = [Files.at(place).under(probe) for place in dict.fromkeys(places)]
    try:
        told = {file.parent.address: _written(file, probe) for file in files}
        told |= {place: "" for place in _some_of(inputs) if place not in told}
        answers = _answers(client, told, workers, memory)
    finally:
        for file in files:
            with suppress(OSError):
                file.remove()
    blind: dict[str, list[str]] = {}
    for worker, answer in sorted(answers.items()):
        if answer and not isinstance(answer, OSError):  # which says that this worker is gone
            blind.setdefault(_told(answer), []).append(worker)
    for reason, those in blind.items():
        many = "workers" if len(those) > 1 else "worker"
        raise UsageError(f"{many} {some_of(those, NAMED)} {reason}")


def _some_of(inputs: Sequence[str]) -> list[str]:
    """One of each kind in each folder: of a city's blocks there are thousands."""
    folder_and_ending = {(p.rpartition("/")[0], p.rpartition(".")[2]): p for p in inputs}
    return list(folder_and_ending.values())


def _told(answer: tuple[str, str] | Exception) -> str:
    """What keeps a worker from its work, and what to do about it."""
    if isinstance(answer, Exception):
        return f"cannot work ({answer}): all workers need tilestream, of the client's version"
    place, why = answer
    if not place:
        return why
    shown = without_secrets(place)
    do = (
        "start them with the credentials and settings of this store that the client has"
        if "://" in place
        else "mount it there under the same name"
    )
    return (
        f"cannot read {shown} ({why.replace(place, shown)}): {do}; inputs, stores and run "
        "directories must lie where all workers see them"
    )


def _written(file: Files, probe: str) -> str:
    """Write a probe; what it says, nothing where it cannot be written: a map may be read only."""
    try:
        file.write(probe.encode())
    except OSError:
        return ""
    return probe


def _answers(
    client: Any, probes: Mapping[str, str], workers: Sequence[str] | None, memory: int
) -> dict[str, Any]:
    """What `_look` says, by worker; of one that cannot run it the exception; nothing where the
    workers are busy, or the scheduler is lost, which the run finds out itself.
    """
    how = {"on_error": "return", "callback_timeout": ANSWER_WITHIN}
    try:
        return dict(client.run(_look, probes, memory, workers=workers, **how))
    except (TimeoutError, OSError):
        return {}


def _look(probes: Mapping[str, str], memory: int, dask_worker: Any) -> tuple[str, str] | None:
    """The first place that a worker does not see, and why, or why it is too small, and no place;
    None: it can do all.
    """
    limit = dask_worker.memory_manager.memory_limit
    if limit and limit < memory:
        return "", (
            f"may use {megabytes(limit)}, and a task {megabytes(memory)}: start it with more "
            "(--memory-limit), or allow tasks less (--memory)"
        )
    for place, probe in probes.items():
        try:
            where = Files.at(place)
            seen = where.under(probe).read() == probe.encode() if probe else where.there()
        except Exception as error:  # noqa: BLE001 - whatever keeps it from seeing
            return place, f"{type(error).__name__}: {error}"
        if not seen:
            return place, "another one is there" if probe else "nothing is there"
    return None
