"""Tables as Parquet files: every column documented inside, whole or not there, marked as done."""

import io
import json
import uuid
from collections.abc import Sequence
from dataclasses import asdict

import fsspec
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tilestream.errors import CorruptSourceError, SourceNotFoundError, UsageError
from tilestream.marks import MISSING, Mark
from tilestream.records import Column

_MARK = b"tilestream"


def write_table(path: str, frame: pd.DataFrame, columns: Sequence[Column], mark: Mark) -> None:
    """Write a table in one piece: a file that is there is whole.

    Args:
        path: where to, a local path or any fsspec URL; a file there is replaced.
        frame: the rows.
        columns: what the columns mean; each of the frame's columns must be among them.
        mark: what is kept in the file of how it was made; `read_mark` gives it back.
    """
    known = {column.name: column for column in columns}
    table = pa.Table.from_pandas(frame, preserve_index=False)
    fields = [
        field.with_metadata(
            {
                "unit": known[field.name].unit,
                "meaning": known[field.name].meaning,
                "source": known[field.name].source,
            }
        )
        for field in table.schema
    ]
    table = table.cast(pa.schema(fields, {_MARK: json.dumps(asdict(mark), sort_keys=True)}))
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    fs, place = fsspec.core.url_to_fs(path)
    fs.makedirs(place.rsplit("/", 1)[0], exist_ok=True)
    part = f"{place}.{uuid.uuid4().hex}.part"
    try:
        fs.pipe_file(part, buffer.getvalue())
        fs.mv(part, place)
    except OSError:
        if fs.exists(part):
            fs.rm(part)
        raise


def read_mark(path: str) -> Mark:
    """The mark of a table; `missing` where no whole table is at `path`, or one of version 0.1."""
    fs, place = fsspec.core.url_to_fs(path)
    try:
        with fs.open(place, "rb") as file:
            metadata = pq.read_schema(file).metadata or {}
    except (FileNotFoundError, pa.ArrowInvalid):
        return MISSING
    known = json.loads(metadata.get(_MARK, b"{}"))
    return Mark(**known) if "status" in known else MISSING


def remove_others(keep: Sequence[str]) -> None:
    """Make the folder of these tables hold no others: of other settings, or half-written.

    It is made where it is missing, so that one that cannot be is told before any work.

    Raises:
        UsageError: the folder is a file, or below one.
    """
    fs, place = fsspec.core.url_to_fs(keep[0])
    folder = place.rsplit("/", 1)[0]
    try:
        fs.makedirs(folder, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{folder} is a file, or below one: name another folder") from None
    names = {path.rsplit("/", 1)[-1] for path in keep}
    for path in [*fs.glob(f"{folder}/*.parquet"), *fs.glob(f"{folder}/*.part")]:
        if str(path).rsplit("/", 1)[-1] not in names:
            fs.rm_file(path)


def read_tables(paths: Sequence[str]) -> pd.DataFrame:
    """The rows of tables of the same columns, one after the other.

    Raises:
        SourceNotFoundError: a file is not there, or `paths` is empty.
        CorruptSourceError: a file is no Parquet table.
    """
    if not paths:
        raise SourceNotFoundError("no tables: the job that writes them has not run here")
    frames = []
    for path in paths:
        fs, place = fsspec.core.url_to_fs(path)
        try:
            with fs.open(place, "rb") as file:
                frames.append(pq.read_table(file).to_pandas())
        except FileNotFoundError:
            raise SourceNotFoundError(f"{path}: no such table") from None
        except pa.ArrowInvalid as error:
            raise CorruptSourceError(f"{path}: no Parquet table: {error}") from error
    rows: pd.DataFrame = pd.concat(frames, ignore_index=True)
    return rows
