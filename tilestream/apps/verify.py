"""Verify a map or a run directory: read everything, name what is not as it was written."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tilestream.errors import DamagedError, TilestreamError, UsageError
from tilestream.files import Files, place_of
from tilestream.lock import only_writer
from tilestream.marks import parsed, unsealed
from tilestream.pipeline.jobs.inventory import Entry, inventory_of
from tilestream.pipeline.jobs.run_book import ENDED, checksum_of
from tilestream.pipeline.jobs.run_names import INVENTORY, RECORD
from tilestream.pipeline.jobs.run_state import state_told
from tilestream.pipeline.stages.label import label
from tilestream.store import NODE, POINTS, Tile, open_store
from tilestream.tables import read_mark, read_tables


@dataclass(frozen=True)
class Damage:
    """Something that is not as it was written, half-made, or lost."""

    path: str
    """The file, table or tile."""
    reason: str
    """What is wrong, without the path."""
    sources: tuple[str, ...] = ()
    """What it is made from, as far as that is known."""
    remove: Callable[[], None] | None = None
    """Removes it, so that the same command makes it again; None: there is nothing to remove."""


Findings = Iterator[Damage | None]
"""An item for each thing that was read; None: it is as it was written."""


def verify(place: str | os.PathLike[str]) -> tuple[int, list[Damage]]:
    """Read everything below a run directory, a folder of tables, or a tile store.

    Args:
        place: a local path or an fsspec URL.

    Returns:
        How many files and tables there are, and those that are not as they were written.

    Raises:
        UsageError: nothing of ours lies there.

    Examples:
        >>> read, damaged = ts.verify("map.zarr")
        >>> damaged
        []
    """
    found = list(_below(place_of(place)))
    if not found:
        raise UsageError(f"{place} is no tile store and no run directory: nothing to verify there")
    return len(found), [damage for damage in found if damage is not None]


def repair(place: str | os.PathLike[str]) -> tuple[list[Damage], list[Damage]]:
    """Remove what is damaged, where all that it is made from is there: the same command then makes
    it again.

    Returns:
        What was removed, and what was not.

    Raises:
        UsageError: nothing of ours lies there.
        LockedError: another process writes there.
    """
    with only_writer(place):
        _, damages = verify(place)
        can = [d for d in damages if d.remove is not None and not gone(d)]
        for damage in can:
            assert damage.remove is not None
            damage.remove()
    return can, [damage for damage in damages if damage not in can]


def gone(damage: Damage) -> list[str]:
    """What it is made from and that is not there any more."""
    return [source for source in damage.sources if not Files.at(source).there()]


def _below(root: str) -> Findings:
    names = Files.at(root).names()
    if NODE in names:
        yield from _store(root)
        return
    if RECORD in names:
        yield from _record(root)
    if INVENTORY in names:
        yield from _tables(root)
    for name in names:
        if name.endswith(".zarr") or "." not in name:
            yield from _below(f"{root}/{name}")


def _wrong(path: str, read: Callable[[], object], *made_of: Any) -> Damage | None:
    """What is wrong with something that can be read."""
    try:
        read()
    except (TilestreamError, OSError) as error:
        return Damage(path, str(error).removeprefix(path).lstrip("/: "), *made_of)
    return None


def _store(url: str) -> Findings:
    """The record of a store, its manifest, its shares, and every table of every tile."""
    try:
        store = open_store(url)
    except TilestreamError as error:
        yield Damage(url, str(error))
        return
    sources = tuple(source["path"] for source in store.sources())
    bad = _wrong(url, lambda: store.manifest, sources, store.forget)
    yield bad
    if bad is not None or store.manifest is None:
        return
    yield _wrong(f"{url}, what each source gave", store.shares, sources, store.forget_shares)
    if store.state() != "whole":
        yield Damage(url, str(store.condition()))
    for key in store.manifest.identities:
        names = store.files.under(str(key)).names()
        if names:
            remove = partial(store.remove, key)
            yield _wrong(f"{url}/{key}/{NODE}", Tile(store, key).check_group, sources, remove)
        for table in dict.fromkeys([POINTS, *(name for name in names if name != NODE)]):
            yield _tile_table(Tile(store, key), table, sources if table == POINTS else ())


def _tile_table(tile: Tile, table: str, sources: tuple[str, ...]) -> Damage | None:
    def read() -> None:
        mark = tile.mark(table)
        if mark.status in ("done", "damaged"):
            tile.read_table(table)
        elif mark.status == "missing":
            raise DamagedError(mark.reason)

    where = f"{tile.store.url}/{tile.key}/{table}"
    return _wrong(where, read, sources, lambda: tile.erase(table))


def _tables(folder: str) -> Findings:
    """The tables that an inventory names."""
    try:
        entries = inventory_of(folder)
    except TilestreamError as error:
        yield Damage(
            f"{folder}/{INVENTORY}", str(error), (), Files.at(folder).under(INVENTORY).remove
        )
        return
    yield None
    for name, entry in entries.items():
        file = Files.at(folder).under(name)
        if not (entry.failed and not file.there()):
            path = f"{folder}/{name}"
            sources = tuple(_seen_from(folder, source) for source in entry.sources)
            yield _wrong(path, partial(_read, path, entry), sources, file.remove)


def _seen_from(folder: str, source: str) -> str:
    """A source of a table as anybody names it."""
    return source if "://" in source else os.path.normpath(Path(folder).absolute() / source)


def _read(path: str, entry: Entry) -> None:
    """Read a table that must be there.

    Raises:
        SourceNotFoundError: it is not.
        DamagedError: it is another one, lacks a scan, or is not what was written.
    """
    rows, mark = read_tables([path]), read_mark(path)
    if not mark.is_of(entry.identity):
        raise DamagedError(f"{path} is {mark.reason or 'of other settings'}")
    if entry.stage == label.name and set(rows["stamp_ns"]) != set(entry.stamps_ns):
        raise DamagedError(f"{path} is not of the scans that it must be of")


def _record(folder: str) -> Findings:
    """The record of a run, whether the run has ended, and the files whose checksums it keeps."""
    run_dir = Files.at(folder)
    record = run_dir.under(RECORD)
    try:
        found = unsealed(parsed(record.read()))
        files: dict[str, str] = found.get("files", {})
    except (ValueError, AttributeError, OSError) as error:
        yield Damage(record.root, f"the record of the run is damaged ({error})", (), record.remove)
        return
    ended = found.get("state", "done") in ENDED
    yield None if ended else Damage(folder, f"the run is {state_told(run_dir, found)}")
    for name, checksum in files.items():
        file = Files.at(folder).under(name)
        yield _wrong(file.root, partial(_compare, file, checksum), (), file.remove)


def _compare(file: Files, checksum: str) -> None:
    if checksum_of(file) != checksum:
        raise DamagedError("its checksum does not fit")
