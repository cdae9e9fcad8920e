"""Damage, from a seed: bits, cuts, lies of headers; inside of what is packed or has checksums."""

import copy
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import google_crc32c
import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer, Header
from mcap.stream_reader import MAGIC_SIZE, StreamReader

Mutate = Callable[[bytes, Random], bytes]
"""Other bytes from some."""

INTEGERS = (0, 1, 2, 3, 255, 2**15, 2**16 - 1, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1)
WORDS = (
    *("", "-1", "0", "nan", "-inf", "1e400", "9" * 20, "9" * 5000, "0x" + "f" * 9000, "1e-320"),
    *(
        "2001-99-99",
        "!!timestamp x",
        "!!bool y",
        "null",
        "{}",
        "[]",
        '""',
        "*a",
        "&a [*a]",
        "<<: 1",
    ),
    *("[" * 3000, '{"a":' * 3000, "\t", "\x00", "\ufeff", "é", "'", '"', "=", "~", "true", "1:2:3"),
)
SHAPES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1e300, 10**30, "", "x", "9" * 5000, [], {}, [0], [[0, 1]], {"a": 1}),
    *(
        [1, 2, 3, 4],
        {"type": "LineString"},
        {"type": "Feature", "geometry": []},
        [[[0, 0], [1, 1]]],
    ),
)
TOKEN = re.compile(rb"[-+.\w]+")


def mutated(data: bytes, chance: Random) -> bytes:
    """One to three damages of any kind, most of them where headers and indices are."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        ways = TEXT if chance.random() < 0.7 and is_text(data) else BINARY
        data = chance.choice(ways)(data, chance)
    return data


def is_text(data: bytes) -> bool:
    return b"\x00" not in data[:512] and data[:512].isascii()


def place(data: bytes, chance: Random) -> int:
    """An offset; of four, one each near the beginning and the end."""
    where = chance.randrange(4)
    last = max(len(data) - 1, 0)
    if where == 0:
        return chance.randint(0, min(400, last))
    return chance.randint(max(0, last - 400), last) if where == 1 else chance.randint(0, last)


def flip_bits(data: bytes, chance: Random) -> bytes:
    changed = bytearray(data or b"\x00")
    for _ in range(chance.choice((1, 1, 2, 8))):
        changed[place(changed, chance)] ^= 1 << chance.randrange(8)
    return bytes(changed)


def cut_short(data: bytes, chance: Random) -> bytes:
    return data[: place(data, chance)]


def lie(data: bytes, chance: Random) -> bytes:
    """Another whole number where there may be one, or another float."""
    at = place(data, chance)
    if chance.random() < 0.2:
        value = chance.choice((0.0, -1.0, 1e300, float("nan"), float("inf"), 5e-324))
        number = struct.pack(chance.choice(("<d", "<f" if abs(value) < 1e38 else "<d")), value)
    else:
        size = chance.choice((1, 2, 4, 8))
        value = chance.choice(INTEGERS) + chance.choice((0, 0, -1, 1))
        number = (value % 256**size).to_bytes(size, chance.choice(("little", "little", "big")))
    return data[:at] + number + data[at + len(number) :]


def fill(data: bytes, chance: Random) -> bytes:
    at, length = place(data, chance), chance.choice((1, 4, 16, 100, 1000))
    filling = chance.choice((b"\x00", b"\xff", b" ", b"9")) * length
    return data[:at] + filling + data[at + length :]


def take_out(data: bytes, chance: Random) -> bytes:
    at = place(data, chance)
    return data[:at] + data[at + chance.choice((1, 2, 4, 8, 100)) :]


def put_in(data: bytes, chance: Random) -> bytes:
    at = place(data, chance)
    return data[:at] + chance.randbytes(chance.choice((1, 2, 4, 8, 100))) + data[at:]


def repeat(data: bytes, chance: Random) -> bytes:
    at, length = place(data, chance), chance.choice((1, 8, 50, 500))
    return data[: at + length] + data[at : at + length] * chance.choice((1, 3, 100)) + data[at:]


def other_token(data: bytes, chance: Random) -> bytes:
    """A word or number of a text as something else."""
    found = list(TOKEN.finditer(data))
    if not found:
        return flip_bits(data, chance)
    token = chance.choice(found[:60] if chance.random() < 0.5 else found)
    word = chance.choice(found).group() if chance.random() < 0.4 else chance.choice(WORDS).encode()
    return data[: token.start()] + word + data[token.end() :]


def other_lines(data: bytes, chance: Random) -> bytes:
    """A line gone, twice, somewhere else, or deeper."""
    lines = data.split(b"\n")
    line, at = chance.choice(lines), chance.randrange(len(lines))
    match chance.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, line)
        case 2:
            lines[at] = line
        case _:
            lines[at] = b"  " + lines[at]
    return b"\n".join(lines)


BINARY: tuple[Mutate, ...] = (
    *(flip_bits, flip_bits, cut_short, lie, lie, lie, lie, fill, take_out, put_in, repeat),
)
TEXT: tuple[Mutate, ...] = (
    *(other_token, other_token, other_token, other_token, other_lines, other_lines, flip_bits),
    *(cut_short, put_in, repeat),
)


def in_json(data: bytes, chance: Random) -> bytes:
    """Something else in a place of a JSON text, or twice, or not there; else any damage."""
    if chance.random() < 0.3:
        return mutated(data, chance)
    root = [json.loads(data)]
    holders = [node for node in nodes(root) if node]
    for _ in range(chance.choice((1, 1, 2))):
        holder: Any = chance.choice(holders)
        key = chance.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        donor = chance.choice(holders)
        value = chance.choice(SHAPES) if chance.random() < 0.7 else copy.deepcopy(donor)
        match chance.randrange(4):
            case 0 if isinstance(holder, dict) and len(holder) > 1:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(key, value)
            case _:
                holder[key] = value
    return json.dumps(root[0]).encode()


def nodes(node: Any) -> Iterator[Any]:
    """Every list and mapping."""
    if isinstance(node, dict | list):
        yield node
        for value in node.values() if isinstance(node, dict) else node:
            yield from nodes(value)


def in_pages(data: bytes, chance: Random) -> bytes:
    """Damage of an E57 file below the checksums of its pages, which are right again."""
    if chance.random() < 0.25:
        return mutated(data, chance)
    content = b"".join(data[at : at + 1020] for at in range(0, len(data), 1024))
    return paged(mutated(content, chance))


def paged(content: bytes) -> bytes:
    """The content of an E57 file in pages of 1 KB, each with its checksum."""
    content += bytes(-len(content) % 1020)
    pages = (content[at : at + 1020] for at in range(0, len(content), 1020))
    return b"".join(page + google_crc32c.value(page).to_bytes(4, "big") for page in pages)


def in_zip(data: bytes, chance: Random) -> bytes:
    """Damage of a member of an archive, which is written anew."""
    if chance.random() < 0.25:
        return mutated(data, chance)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = "schema.json" if chance.random() < 0.6 else chance.choice(list(members))
    members[name] = (in_json if name == "schema.json" else mutated)(members[name], chance)
    return zipped(members)


def zipped(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def in_chunks(data: bytes, chance: Random) -> bytes:
    """Damage inside of a chunk of an MCAP file, which is packed again as if it were right."""
    if chance.random() < 0.25:
        return mutated(data, chance)
    stream = StreamReader(io.BytesIO(data[MAGIC_SIZE:]), skip_magic=True, emit_chunks=True)
    chunks = [record for record in stream.records if isinstance(record, Chunk)]
    victim = chance.randrange(len(chunks))
    contents = [unpacked(chunk) for chunk in chunks]
    contents[victim] = mutated(contents[victim], chance)
    kinds = [chunk.compression for chunk in chunks]
    return mcap_of([packed(*pair) for pair in zip(kinds, contents, strict=True)])


def unpacked(chunk: Chunk) -> bytes:
    match chunk.compression:
        case "zstd":
            return zstandard.decompress(chunk.data)
        case "lz4":
            return bytes(lz4.frame.decompress(chunk.data))
    return chunk.data


def packed(kind: str, content: bytes) -> Chunk:
    """A chunk whose size and checksum are those of its content."""
    match kind:
        case "zstd":
            data = zstandard.compress(content)
        case "lz4":
            data = lz4.frame.compress(content)
        case _:
            data = content
    return Chunk(kind, data, 0, 0, zlib.crc32(content), len(content))


def mcap_of(chunks: list[Chunk]) -> bytes:
    """An MCAP file without a summary."""
    magic, builder = b"\x89MCAP0\r\n", RecordBuilder()
    builder.write(magic)
    for record in (Header("ros2", "fuzz"), *chunks, DataEnd(0), Footer(0, 0, 0)):
        record.write(builder)
    builder.write(magic)
    return builder.end()
