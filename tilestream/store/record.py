"""What a store says of itself, at its root: settings, state, manifest, what it was made from."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from tilestream.errors import (
    DamagedError,
    StoreError,
    StoreNotFoundError,
    StoreVersionError,
    UsageError,
)
from tilestream.files import Files
from tilestream.store.arrays import NODE, checked, said_by, write_group
from tilestream.version import VERSION

SCHEMA = 3
"""Version of the store's layout; a store with another one is refused."""
State = Literal["being written", "whole"]
"""`whole` once the ingest that makes the map has ended."""


@dataclass(frozen=True)
class StoreSettings:
    """What a store is, written once when it is created."""

    tile_size: float
    """Edge of a tile [m], whole millimetres."""
    halo: float
    """Width of the halo around a tile [m], whole millimetres."""
    map_leaf: float
    """Edge of the voxels that points were thinned to [m]; 0: all points were kept."""
    crs: str | None
    """Coordinate reference system of the map, any string that pyproj reads; None: local."""


@dataclass(frozen=True)
class Record:
    """The record of a store."""

    settings: StoreSettings
    state: State = "being written"
    manifest: str | None = None
    """Name of the manifest in the store; None: which tiles it must have is not known yet."""
    sources: Sequence[Mapping[str, Any]] = ()
    """What the map was made from."""
    made_by: Mapping[str, int] | None = None
    """The stages that made it, with their versions; None: no ingest has ended."""
    shares: str | None = None
    """Name in the store of what each source gave to each tile; None: that is not known."""


def way_of(files: Files, path: str) -> str | None:
    """A source seen from the store that lies there: a way that moves with both; None: they are not
    on one disk.
    """
    try:
        store = os.path.realpath(files.root)
        return os.path.relpath(os.path.realpath(path), store) if files.local else None
    except ValueError:  # two disks of Windows
        return None


def source_of(store: str | None, known: Mapping[str, Any]) -> dict[str, Any]:
    """A source as the record of the store that lies there, on a disk or not (None), has it, `path`
    being where it is now: where it is seen from the store, as long as it is there, else where it
    was.
    """
    source = dict(known)
    way = source.pop("way", None)  # which a record of before does not have
    if way is not None and store is not None:
        now = os.path.normpath(os.path.join(store, way))  # noqa: PTH118
        if os.path.realpath(source["path"]) != now and Path(now).exists():
            source["path"] = now
    return source


def write_record(files: Files, record: Record) -> None:
    """Write the record of the store that lies there: whole, or as it was."""
    write_group(files, {"schema": SCHEMA, "lattice_origin": [0.0, 0.0, 0.0], **asdict(record)})


def require_folder(url: str | os.PathLike[str]) -> None:
    """Refuse a place where no folder of results can be, before any work is done for them.

    Raises:
        UsageError: it is a file or below one, or a tile store.
    """
    place = Files.at(url)
    path = Path(place.root)
    if place.local and any(way.is_file() for way in (path, *path.parents)):
        raise UsageError(f"{os.fspath(url)} is a file, or below one: name another folder")
    if place.under(NODE).there():
        raise UsageError(f"{os.fspath(url)} is a tile store: name another folder for the results")


def read_record(url: str) -> Record:
    """The record of a store.

    Raises:
        StoreNotFoundError: nothing there.
        StoreVersionError: written by another version of tilestream.
        DamagedError: it is not what was written.
        StoreError: something else lies there.
        UsageError: a file lies there, or where a folder above it would be.
    """
    root = Files.at(url).under(NODE)
    try:
        return _record(root.read(), os.fspath(url), root.root)
    except FileNotFoundError:
        store = "FOLDER" if root.parent.there() else url
        other = f"; `tilestream info {url}` says what is there" * (store != url)
        raise StoreNotFoundError(
            f"no tile store at {url}: make one with `tilestream ingest SOURCES --store {store}`"
            f"{other}"
        ) from None
    except NotADirectoryError:
        raise UsageError(
            f"{url} is a file, or below one, and a tile store is a folder, which `tilestream "
            "ingest SOURCES --store FOLDER` makes: name another path"
        ) from None


@lru_cache(maxsize=8)
def _record(text: bytes, url: str, where: str) -> Record:
    """What the text of a record says; a process keeps the last ones, since each task opens its map,
    and that of a city names thousands of sources.
    """
    try:
        schema = int(said_by(text)["schema"])
    except (KeyError, ValueError, TypeError) as error:
        raise StoreError(f"{where} is damaged, or of no tile store: {error}") from error
    if schema != SCHEMA:
        what = "install the newer tilestream" if schema > SCHEMA else "give another path"
        raise StoreVersionError(
            f"{url} has schema {schema}, this is tilestream {VERSION} with schema {SCHEMA}: "
            f"{what}, or remove it and ingest the sources again"
        )
    try:
        said = checked(text, where)
    except DamagedError as error:
        raise DamagedError(
            f"{where} is damaged, without which the map cannot be read: remove the folder "
            f"{url} and ingest its sources again"
        ) from error
    del said["schema"], said["lattice_origin"]
    return Record(**{**said, "settings": StoreSettings(**said["settings"])})
