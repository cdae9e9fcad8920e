"""The inventory of a folder of tables: which there must be, so that a lost one is missed.

It is written when a job knows what it will make, before any of it is made.
"""

import json
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from tilestream.errors import DamagedError, IncompleteError, UsageError
from tilestream.files import Files, place_of
from tilestream.lock import only_writer
from tilestream.marks import parsed, sealed, unsealed
from tilestream.notes import some_of
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.engine.outputs import Parquet, TileArrays, way_to
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.run_names import INVENTORY
from tilestream.pipeline.stages.drive_scans import DriveScans, Sample
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.store import require_folder
from tilestream.tables import read_mark


@dataclass(frozen=True)
class Entry:
    """A table that must be there."""

    stage: str
    """Who makes it."""
    identity: str
    """The identity that it has, or will have."""
    sources: tuple[str, ...] = ()
    """What it is made from besides other tables, seen from its folder: logs, the map."""
    stamps_ns: tuple[int, ...] = ()
    """Of a table of a drive: the scans in it [ns since the epoch]."""
    failed: str = ""
    """Why it could not be made; empty: it can, or that is not known yet."""


Inventory = Mapping[str, Entry]
"""By the name of the file."""


def announce(tasks: Iterable[Task], *, begun: bool = False) -> None:
    """Write down the tables that tasks will make; others of their folders are removed.

    Only what an earlier inventory names is removed. The folders are made, so that one that cannot
    be is told before any work.

    Args:
        tasks: all that will write to these folders.
        begun: some of them are running; the half-written files there may be theirs.

    Raises:
        UsageError: a folder is a file, or below one.
        DamagedError: an earlier inventory is not what was written.
    """
    for place, entries in _by_folder(tasks).items():
        folder = Files.at(place)
        try:
            folder.make()
        except (FileExistsError, NotADirectoryError):
            raise UsageError(f"{place} is a file, or below one: name another folder") from None
        if not begun:
            folder.remove_parts()
        for name in inventory_of(place):
            if name not in entries:
                folder.under(name).remove()
        write_inventory(folder, entries)


def withdraw(folder: str) -> None:
    """Remove the tables that a folder's inventory names, the inventory, and the folder if it is
    empty then.
    """
    place = Files.at(folder)
    for name in inventory_of(folder):
        place.under(name).remove()
    place.under(INVENTORY).remove()
    place.remove_parts()
    place.remove_empty()


def settle(tasks: Iterable[Task], failures: Mapping[str, str]) -> None:
    """Write down which of the announced tables could not be made, and clear up.

    Args:
        tasks: as announced.
        failures: reasons by the key of the task.
    """
    for place, entries in _by_folder(tasks, failures).items():
        if any(entry.failed for entry in entries.values()):
            write_inventory(Files.at(place), {**inventory_of(place), **entries})
        Files.at(place).remove_parts()


def make_tables(
    plan: Plan, out: str | os.PathLike[str], client: Any | None, watch: Watch | None
) -> dict[str, str]:
    """Run a plan that writes tables below a folder, alone there; the reasons of what failed.

    Raises:
        UsageError: the folder is a tile store, and as `announce`.
        DamagedError: as `announce`.
        LockedError: another process writes to the folder.
    """
    require_folder(out)
    with only_writer(out):
        announce(plan.tasks)
        stores = [t.writes.store_url for t in plan.tasks if isinstance(t.writes, TileArrays)]
        inputs = [source for task in plan.tasks for source in _sources_of(task)]
        shared = [place_of(out), *dict.fromkeys(stores)]
        outcomes = execute(plan, client, watch, shared=shared, inputs=inputs)
        failures = {outcome.key: outcome.reason for outcome in outcomes if not outcome.ok}
        settle(plan.tasks, failures)
    return failures


def inventory_of(folder: str) -> Inventory:
    """The inventory of a folder; empty where it has none.

    Raises:
        DamagedError: it is not what was written.
    """
    file = Files.at(folder).under(INVENTORY)
    try:
        known = unsealed(parsed(file.read()))["tables"]
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedError(
            f"{file.root} is damaged ({error}): remove it and run the same command again"
        ) from error
    return {name: _entry(**entry) for name, entry in known.items()}


def _entry(sources: Sequence[str], stamps_ns: Sequence[int], **others: str) -> Entry:
    return Entry(sources=tuple(sources), stamps_ns=tuple(stamps_ns), **others)


def tables_in(folder: str) -> list[str]:
    """The tables of a folder and of those below it, sorted, without those that failed.

    Raises:
        IncompleteError: one that must be there is not: its job has not ended, or it was lost.
        DamagedError: a table or an inventory is not what was written.
    """
    found, missing = [], []
    for name, entry in inventory_of(folder).items():
        path = f"{folder}/{name}"
        mark = read_mark(path)
        if mark.is_of(entry.identity):
            found.append(path)
        elif not entry.failed:
            missing.append(path)
    if missing:
        names = some_of([path.rsplit("/", 1)[1] for path in missing], 1)
        raise IncompleteError(
            f"{folder} is half-made or has lost tables: {names}; run the job that makes them "
            "again, which continues where it was"
        )
    for name in Files.at(folder).names():
        if "." not in name:
            found += tables_in(f"{folder}/{name}")
    return sorted(found)


def _by_folder(
    tasks: Iterable[Task], failures: Mapping[str, str] | None = None
) -> dict[str, dict[str, Entry]]:
    """What tasks make, by folder and name."""
    found: dict[str, dict[str, Entry]] = defaultdict(dict)
    for task in tasks:
        if isinstance(task.writes, Parquet):
            reason = (failures or {}).get(task.key, "")
            sources = tuple(way_to(source, task.writes.path) for source in _sources_of(task))
            for path, identity in task.writes.files(task.identity).items():
                folder, name = path.rsplit("/", 1)
                found[folder][name] = Entry(task.stage, identity, sources, _stamps_of(task), reason)
    return found


def _sources_of(task: Task) -> tuple[str, ...]:
    """The log and the map that a task reads."""
    scans, part = (task.reads.get(name) for name in ("scans", "map_part"))
    found = [scans.reading.path] if isinstance(scans, DriveScans) else []
    return (*found, *([place_of(part.store_url)] if isinstance(part, MapPart) else ()))


def _stamps_of(task: Task) -> tuple[int, ...]:
    """The scans that a table of a drive is about."""
    scans = task.reads.get("scans")
    samples = scans.samples if isinstance(scans, DriveScans) else task.takes.get("samples")
    if not isinstance(samples, tuple):
        return ()
    return tuple(sample.stamp_ns for sample in samples if isinstance(sample, Sample))


def write_inventory(folder: Files, entries: Inventory) -> None:
    """Write which tables a folder must have, in place of what it said before."""
    known = {name: asdict(entry) for name, entry in sorted(entries.items())}
    folder.under(INVENTORY).write(json.dumps(sealed({"tables": known}), indent=1).encode())
