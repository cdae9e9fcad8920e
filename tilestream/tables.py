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
from tilestream.marks import AGAIN, MISSING, Mark, parsed, sealed, unsealed
from tilestream.records import Column

_MARK = b"tilestream"
_CHECKSUM = b"tilestream.checksum"
"""The entry of a file's footer that holds the checksum of all other bytes."""
_UNKNOWN = b"00000000"
"""That checksum while it is not known yet."""
TAIL_BYTES = 64 * 1024
"""What is read of a file to find its mark; the footer of most is shorter."""


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
    try:
        text = _entry(_footer(Files.at(path)), _MARK)
        known = {} if text is None else parsed(text)
        return Mark(**unsealed(known)) if "status" in known else MISSING
    except FileNotFoundError:
        return MISSING
    except (ValueError, TypeError) as error:
        return Mark("damaged", f"{path} is damaged ({error}): {AGAIN}")


def _footer(file: Files) -> bytes:
    """The footer of a Parquet file, with its length and magic number behind it.

    Raises:
        ValueError: it has none.
    """
    tail = file.read_end(TAIL_BYTES)
    if tail[-4:] != b"PAR1" or len(tail) < 8:
        raise ValueError("it does not end as a Parquet file does")
    length = int.from_bytes(tail[-8:-4], "little") + 8
    return tail[-length:] if length <= len(tail) else file.read_end(length)


def _entry(footer: bytes, key: bytes) -> bytes | None:
    """The value of an entry of a footer's metadata; None: there is no such entry.

    Found by its bytes: whether a city is done is read of a hundred thousands of tables, and to
    parse what each column means takes fifty times as long. What is found has its own checksum.
    """
    _, found, rest = footer.rpartition(b"\x18%c%s\x18" % (len(key), key))
    if not found:
        return None
    length = shift = place = 0
    while place < len(rest):  # as Thrift writes a number: seven bits a byte, the lowest first
        byte = rest[place]
        length |= (byte & 127) << shift
        shift, place = shift + 7, place + 1
        if byte < 128:
            break
    return rest[place : place + length]


def read_tables(paths: Sequence[str]) -> pd.DataFrame:
    """The rows of tables of the same columns, one after the other.

    Raises:
        SourceNotFoundError: a file is not there, or `paths` is empty.
        DamagedError: a file is not what was written.
        OSError: a file cannot be read.
    """
    if not paths:
        raise SourceNotFoundError("no tables: the job that writes them has not run here")
    table = pa.concat_tables([_read(path) for path in paths], promote_options="permissive")
    rows: pd.DataFrame = table.to_pandas()
    return rows


def _read(path: str) -> pa.Table:
    try:
        content = Files.at(path).read()
    except FileNotFoundError:
        raise SourceNotFoundError(f"{path}: no such table") from None
    at = _checksum_at(content)
    bare = content[:at] + _UNKNOWN + content[at + 8 :]
    if at < 0 or content[at : at + 8] != b"%08x" % zlib.crc32(bare):
        raise DamagedError(f"{path} is damaged, its checksum does not fit: {AGAIN}")
    # `read_table` would look for a whole data set, which takes half as long again
    return pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read()
