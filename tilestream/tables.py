"""Tables as Parquet files: every column documented inside, whole or not there, marked as done.

Each page has its checksum, and the whole file one: what is read is what was written.
"""

import io
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tilestream.errors import DamagedError, SourceNotFoundError
from tilestream.files import Files
from tilestream.marks import AGAIN, MISSING, Mark, sealed, unsealed
from tilestream.records import Column

_MARK = b"tilestream"
_CHECKSUM = b"tilestream.checksum"
"""The entry of a file's footer that holds the checksum of all other bytes."""
_UNKNOWN = b"00000000"
"""That checksum while it is not known yet."""


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
    text = json.dumps(sealed(asdict(mark)), sort_keys=True)
    table = table.cast(pa.schema(fields, {_MARK: text}))
    buffer = io.BytesIO()
    with pq.ParquetWriter(
        buffer, table.schema, compression="zstd", write_page_checksum=True
    ) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({_CHECKSUM: _UNKNOWN})
    content = buffer.getvalue()
    at = _checksum_at(content)
    Files.at(path).write(b"%s%08x%s" % (content[:at], zlib.crc32(content), content[at + 8 :]))


def _checksum_at(content: bytes) -> int:
    """Where the eight hex digits of a file's checksum are; -1: nowhere."""
    name = content.rfind(_CHECKSUM)
    # Thrift writes the value behind the name: a byte for the field, one for its length.
    return name + len(_CHECKSUM) + 2 if name >= 0 else -1


def read_mark(path: str) -> Mark:
    """The mark of a table; `missing` where no table is at `path`, or one of version 0.1, and
    `damaged` where it is not what was written.

    Raises:
        OSError: it cannot be read.
    """
    place = Files.at(path)
    try:
        with place.fs.open(place.root, "rb") as file:
            metadata = pq.read_schema(file).metadata or {}
        known = json.loads(metadata.get(_MARK, b"{}"))
        return Mark(**unsealed(known)) if "status" in known else MISSING
    except FileNotFoundError:
        return MISSING
    except (pa.ArrowException, ValueError, TypeError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # Arrow's own has none
            raise
        return Mark("damaged", f"{path} is damaged ({error}): {AGAIN}")


def read_tables(paths: Sequence[str]) -> pd.DataFrame:
    """The rows of tables of the same columns, one after the other.

    Raises:
        SourceNotFoundError: a file is not there, or `paths` is empty.
        DamagedError: a file is not what was written.
        OSError: a file cannot be read.
    """
    if not paths:
        raise SourceNotFoundError("no tables: the job that writes them has not run here")
    rows: pd.DataFrame = pd.concat([_read(path) for path in paths], ignore_index=True)
    return rows


def _read(path: str) -> pd.DataFrame:
    try:
        content = Files.at(path).read()
    except FileNotFoundError:
        raise SourceNotFoundError(f"{path}: no such table") from None
    at = _checksum_at(content)
    bare = content[:at] + _UNKNOWN + content[at + 8 :]
    if at < 0 or content[at : at + 8] != b"%08x" % zlib.crc32(bare):
        raise DamagedError(f"{path} is damaged, its checksum does not fit: {AGAIN}")
    read = pq.read_table(io.BytesIO(content), page_checksum_verification=True)
    frame: pd.DataFrame = read.to_pandas()
    return frame
