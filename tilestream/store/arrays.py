"""Arrays, marks and the root of a tile store, as Zarr keeps them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Self

import fsspec
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from tilestream.errors import StoreError, StoreNotFoundError, UsageError
from tilestream.marks import MISSING, Mark

_CODEC = BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")
_OURS = "tilestream"
"""The attribute of a group that is ours."""


@dataclass(frozen=True)
class Files:
    """Where a store lies."""

    url: str
    """As it was given: a path, or any fsspec URL."""
    fs: Any
    """The fsspec filesystem."""
    root: str
    """The store's path on it."""

    @classmethod
    def at(cls, url: str) -> Self:
        """The place that a URL names."""
        fs, root = fsspec.core.url_to_fs(url)
        fs.use_listings_cache = False
        return cls(url, fs, str(root).rstrip("/"))

    @cached_property
    def zarr(self) -> Any:
        """The place as Zarr opens it."""
        return zarr.open_group(self.url, mode="r+").store


def create_root(url: str, attributes: Mapping[str, Any]) -> None:
    """Make an empty store."""
    zarr.open_group(url, mode="w", attributes={_OURS: dict(attributes)})


def write_root(files: Files, attributes: Mapping[str, Any]) -> None:
    """Replace what a store says of itself."""
    zarr.open_group(files.zarr, mode="r+").attrs[_OURS] = dict(attributes)


def read_root(files: Files) -> dict[str, Any]:
    """What a store says of itself: `schema`, `settings`, `sources`, `made_by`.

    Raises:
        StoreNotFoundError: nothing there.
        StoreError: something else lies there.
        UsageError: a file lies there, or where a folder above it would be.
    """
    try:
        text = files.fs.cat_file(f"{files.root}/zarr.json")
    except FileNotFoundError:
        url = files.url
        raise StoreNotFoundError(
            f"no tile store at {url}: make one with `tilestream ingest SOURCES --store {url}`"
        ) from None
    except NotADirectoryError:
        raise UsageError(
            f"{files.url} is a file, or below one, and a tile store is a folder: name another path"
        ) from None
    try:
        attributes: dict[str, Any] = json.loads(text)["attributes"][_OURS]
        int(attributes["schema"])
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{files.url} is a Zarr group but no tile store of tilestream") from error
    return attributes


def read_marks(files: Files, tables: Sequence[str]) -> list[Mark]:
    """The marks of tables, `TILE/TABLE` each, in one request; `missing` where there is none."""
    if not tables:
        return []
    paths = [f"{files.root}/{table}/zarr.json" for table in tables]
    texts = files.fs.cat(paths, on_error="omit")
    by_end = {"/".join(str(path).split("/")[-3:-1]): text for path, text in texts.items()}
    return [_parse_mark(by_end.get(table)) for table in tables]


def _parse_mark(text: bytes | None) -> Mark:
    if text is None:
        return MISSING
    known = json.loads(text).get("attributes", {}).get(_OURS)
    return Mark(**known) if known else MISSING


def read_columns(files: Files, table: str, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Some columns of a table, `TILE/TABLE`, by name.

    Raises:
        StoreError: one was lost or damaged.
    """
    found = {}
    for name in columns:
        path = f"{table}/{name}"
        try:
            column = np.asarray(zarr.open_array(files.zarr, path=path, mode="r")[...])
        except (FileNotFoundError, KeyError, ValueError, RuntimeError) as error:
            raise StoreError(
                f"{files.url}/{path} cannot be read ({error}): "
                f"delete the folder {table} and run the same command again"
            ) from error
        chunk = "/".join(["c", *("0" for _ in column.shape)])  # of a lost one, zeros are read
        if column.size and not files.fs.exists(f"{files.root}/{path}/{chunk}"):
            raise StoreError(
                f"{files.url}/{path} has lost a chunk: "
                f"delete the folder {table} and run the same command again"
            )
        found[name] = column
    return found


def write_columns(
    files: Files, table: str, columns: Mapping[str, NDArray[Any]], mark: Mark
) -> None:
    """Write a table, `TILE/TABLE`, where none is: each column as one chunk, last the mark."""
    for name, column in columns.items():
        array = zarr.create_array(
            files.zarr,
            name=f"{table}/{name}",
            shape=column.shape,
            chunks=tuple(max(1, n) for n in column.shape),
            dtype=column.dtype,
            compressors=_CODEC,
            config={"write_empty_chunks": True},
        )
        array[...] = column
    known = asdict(mark)
    known["facts"] = {**mark.facts, "columns": list(columns)}
    zarr.open_group(files.zarr, path=table, mode="a").attrs[_OURS] = known


def erase(files: Files, table: str) -> None:
    """Remove a table, `TILE/TABLE`, if it is there: its mark first."""
    folder = f"{files.root}/{table}"
    if files.fs.exists(folder):
        if files.fs.exists(f"{folder}/zarr.json"):
            files.fs.rm(f"{folder}/zarr.json")
        files.fs.rm(folder, recursive=True)
