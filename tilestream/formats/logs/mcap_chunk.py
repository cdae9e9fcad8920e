"""What is inside an MCAP chunk, unpacked to the size that the chunk claims and never to more."""

import struct
import zlib

import lz4.frame
import zstandard

LARGEST_RECORD = 1 << 28
"""Bytes that a chunk may claim to unpack to, or a record to hold that is read at once; more is
taken for damage. A chunk holds some messages, by default up to 1 MB of them, and one at least."""
_HEAD = struct.Struct("<QQQII")
"""First and last time, size and CRC of the unpacked chunk, length of the compression's name."""
_LENGTH = struct.Struct("<Q")


def unpack_chunk(content: memoryview) -> tuple[bytes, int, int]:
    """The records inside a chunk.

    Args:
        content: the chunk's record, without its head.

    Returns:
        The records, the CRC that is recorded of them (0: none), and theirs.

    Raises:
        ValueError: it claims too much, or does not hold what it claims.
        Exception: whatever its compression raises on damaged bytes.
    """
    _, _, size, recorded, length = _HEAD.unpack_from(content)
    if size > LARGEST_RECORD:
        raise ValueError(f"claims to unpack to {size} bytes, more than {LARGEST_RECORD}")
    at = _HEAD.size + length
    compression = bytes(content[_HEAD.size : at]).decode()
    (packed_bytes,) = _LENGTH.unpack_from(content, at)
    packed = content[at + _LENGTH.size :][:packed_bytes]
    if len(packed) < packed_bytes:
        raise ValueError(f"claims {packed_bytes} packed bytes, has {len(packed)}")
    data = _decoded(compression, packed, size)
    if len(data) != size:
        raise ValueError(f"unpacks to {len(data)} bytes or more, not {size}")
    return data, recorded, zlib.crc32(data)


def _decoded(compression: str, packed: memoryview, size: int) -> bytes:
    """A chunk as far as it was claimed to go, or a byte more."""
    match compression:
        case "":
            return bytes(packed)
        case "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        case "zstd":
            # zstandard trusts this number more than any limit that it is given
            within = zstandard.get_frame_parameters(packed).content_size
            if within not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise ValueError(f"unpacks to {within} bytes, not {size}")
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    raise ValueError(f"its compression {compression[:20]!r} is neither zstd nor lz4")
