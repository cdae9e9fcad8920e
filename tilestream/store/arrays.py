"""Arrays and marks of a tile store, as Zarr keeps them: two objects a table, each with a checksum.

A table is one array: its columns' values one after the other, of the columns' own type where all
have the same, else as bytes. The array's `zarr.json` holds the mark, which says where each column
is, and comes last: without it there is no table.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec
from zarr.core.buffer import cpu
from zarr.storage import MemoryStore

from tilestream.errors import DamagedError
from tilestream.files import Files
from tilestream.marks import AGAIN, MISSING, SEAL, Mark, parsed, sealed, unsealed

_OURS = "tilestream"
"""The attribute of a Zarr node that is ours."""
FORMAT: Literal[3] = 3
"""Zarr's format; named wherever Zarr is asked, whose own settings name another one maybe."""
NODE, CHUNK = "zarr.json", "c/0"
"""The two objects of a table."""


def write_group(files: Files, attributes: Mapping[str, Any]) -> None:
    """Write a Zarr group of ours: whole, or as it was."""
    kept: dict[str, Any] = {}
    zarr.open_group(MemoryStore(kept), mode="w", zarr_format=FORMAT)
    _write_node(files, kept, attributes)


def read_group(files: Files) -> dict[str, Any]:
    """What a group of ours says.

    Raises:
        DamagedError: it is not what was written.
        OSError: it cannot be read.
    """
    return checked(files.under(NODE).read(), f"{files.root}/{NODE}")


def said_by(text: bytes) -> dict[str, Any]:
    """What the text of a node says of ours, its checksum not looked at.

    Raises:
        ValueError: it is no node of ours.
    """
    try:
        return dict(parsed(text)["attributes"][_OURS])
    except (KeyError, TypeError) as error:
        raise ValueError("no node of tilestream") from error


def checked(text: bytes, where: str) -> dict[str, Any]:
    """What the text of a node says of ours.

    Raises:
        DamagedError: it is not what was written.
    """
    try:
        ours = said_by(text)
        node = {**parsed(text), "attributes": {}, _OURS: ours}
        return dict(unsealed({**node, SEAL: ours.pop(SEAL, None)})[_OURS])
    except ValueError as error:
        raise DamagedError(f"{where} is damaged ({error}): {AGAIN}") from error


def read_marks(files: Files, tables: Sequence[str]) -> list[Mark]:
    """The marks of tables, `TILE/TABLE` each, in one request; `missing` where there is none, and
    `damaged` where it is not what was written.

    Raises:
        OSError: one cannot be read.
    """
    texts = files.read_all([f"{table}/{NODE}" for table in tables])
    return [_mark(text, f"{files.root}/{t}/{NODE}") for text, t in zip(texts, tables, strict=True)]


def _mark(text: bytes | None, where: str) -> Mark:
    try:
        return MISSING if text is None else Mark(**checked(text, where))
    except DamagedError as error:
        return Mark("damaged", str(error))


def read_columns(files: Files, table: str) -> dict[str, NDArray[Any]]:
    """The columns of a table, `TILE/TABLE`, by name.

    Raises:
        DamagedError: it was lost in part, or is not what was written.
        OSError: it cannot be read.
    """
    where = f"{files.root}/{table}"
    node, chunk = files.read_all([f"{table}/{NODE}", f"{table}/{CHUNK}"])
    mark = _mark(node, f"{where}/{NODE}")
    if mark.status != "done":
        raise DamagedError(f"{where} is {mark.status}: {mark.reason}")
    columns: Mapping[str, tuple[str, list[int]]] = mark.facts["columns"]
    if chunk is None and any(0 not in shape for _, shape in columns.values()):
        raise DamagedError(f"{where}/{CHUNK} is lost: {AGAIN}")
    kept: dict[str, Any] = {
        name: cpu.Buffer.from_bytes(b) for name, b in ((NODE, node), (CHUNK, chunk)) if b
    }
    try:
        packed = np.asarray(zarr.open_array(MemoryStore(kept), mode="r", zarr_format=FORMAT)[...])
        return _unpacked(packed, columns)
    except (ValueError, RuntimeError, TypeError) as error:
        raise DamagedError(f"{where}/{CHUNK} is damaged ({error}): {AGAIN}") from error


def write_columns(
    files: Files, table: str, columns: Mapping[str, NDArray[Any]], mark: Mark
) -> None:
    """Write a table, `TILE/TABLE`, where none is: its values, last the mark."""
    packed = _packed(columns)
    kept: dict[str, Any] = {}
    array = zarr.create_array(
        MemoryStore(kept),
        shape=packed.shape,
        chunks=(max(1, packed.size),),
        dtype=packed.dtype,
        filters=None,
        serializer=BytesCodec(endian="little"),
        compressors=[_codec(columns), Crc32cCodec()],
        zarr_format=FORMAT,
        config={"write_empty_chunks": True},
    )
    array[...] = packed
    shapes = {name: [column.dtype.str, list(column.shape)] for name, column in columns.items()}
    facts = {**mark.facts, "columns": shapes}
    if CHUNK in kept:
        files.under(f"{table}/{CHUNK}").write(kept[CHUNK].to_bytes())
    _write_node(files.under(table), kept, asdict(mark) | {"facts": facts})


def erase(files: Files, table: str) -> None:
    """Remove a table, `TILE/TABLE`, if it is there: its mark first."""
    files.under(f"{table}/{NODE}").remove()
    files.under(table).remove()


def _write_node(files: Files, kept: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    """Write a node's `zarr.json`; the checksum in it is of all of it."""
    node = {**parsed(kept[NODE].to_bytes()), "attributes": {}}
    seal = sealed({**node, _OURS: ours})[SEAL]
    node["attributes"] = {_OURS: {**ours, SEAL: seal}}
    files.under(NODE).write(json.dumps(node, indent=1).encode())


def _codec(columns: Mapping[str, NDArray[Any]]) -> BloscCodec:
    """Bits of values are shuffled by the widest type, whatever the array calls them."""
    width = max((column.dtype.itemsize for column in columns.values()), default=1)
    return BloscCodec(typesize=width, cname="zstd", clevel=3, shuffle="bitshuffle")


def _packed(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Values one after the other, the widest first, so that each lies where its type may lie."""
    types = {column.dtype for column in columns.values()}
    kind = types.pop() if len(types) == 1 else np.dtype(np.uint8)
    ordered = sorted(columns.values(), key=lambda column: -column.dtype.itemsize)
    flat = [np.ascontiguousarray(column).reshape(-1).view(kind) for column in ordered]
    return np.concatenate([np.zeros(0, kind), *flat])


def _unpacked(
    packed: NDArray[Any], columns: Mapping[str, tuple[str, list[int]]]
) -> dict[str, NDArray[Any]]:
    found, start = dict.fromkeys(columns, packed), 0
    for name, (kind, shape) in sorted(columns.items(), key=lambda c: -np.dtype(c[1][0]).itemsize):
        size = int(np.prod(shape)) * np.dtype(kind).itemsize // packed.dtype.itemsize
        found[name] = packed[start : start + size].view(kind).reshape(shape)
        start += size
    return found
