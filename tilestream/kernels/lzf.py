"""LZF, the compression of binary_compressed PCD files (Marc Lehmann's liblzf stream format).

A stream is a row of instructions. A first byte c < 32 is a literal: copy the c + 1 bytes behind it.
Any other is a back reference: length (c >> 5) + 2, where 7 in the three bits means that a further
byte is added to the length; distance ((c & 31) << 8 | last byte) + 1 back from the end of the
output, which it may overlap.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

WHOLE = -1
"""What `decompress` returns for an undamaged stream."""

_LITERAL_MAX = 32
_LENGTH_MAX = 264
_DISTANCE_MAX = 8192
_HASH_BITS = 14


@njit(cache=True, nogil=True, error_model="numpy")
def decompress(packed: NDArray[np.uint8], unpacked: NDArray[np.uint8]) -> int:
    """Decode `packed` into `unpacked`; neither is read nor written out of bounds.

    Args:
        packed: (m,) the stream, contiguous.
        unpacked: (n,) overwritten, contiguous; n is what the stream claims to hold.

    Returns:
        `WHOLE` if the stream decodes to exactly n bytes, else the offset in `packed` of the
        instruction that does not fit.
    """
    m, n = packed.shape[0], unpacked.shape[0]
    i = 0
    o = 0
    while i < m:
        at = i
        c = np.int64(packed[i])
        i += 1
        if c < 32:
            length = c + 1
            if i + length > m or o + length > n:
                return at
            for _ in range(length):
                unpacked[o] = packed[i]
                i += 1
                o += 1
        else:
            length = c >> 5
            if length == 7:
                if i >= m:
                    return at
                length += np.int64(packed[i])
                i += 1
            length += 2
            if i >= m:
                return at
            source = o - ((c & 31) << 8) - np.int64(packed[i]) - 1
            i += 1
            if source < 0 or o + length > n:
                return at
            for _ in range(length):
                unpacked[o] = unpacked[source]
                o += 1
                source += 1
    return WHOLE if o == n else m


@njit(cache=True, nogil=True, error_model="numpy")
def compress(raw: NDArray[np.uint8], packed: NDArray[np.uint8]) -> int:
    """Encode `raw` into `packed` by a hash of the last place of every three bytes.

    Args:
        raw: (n,) contiguous.
        packed: overwritten; n + n // 32 + 1 bytes are always enough.

    Returns:
        The bytes written.
    """
    n = raw.shape[0]
    last = np.full(1 << _HASH_BITS, -1, np.int64)
    o = 0
    i = 0
    literal = 0  # raw[literal:i] waits to be written
    while i < n:
        length = 0
        distance = 0
        if i + 2 < n:
            key = np.int64(raw[i]) << 16 | np.int64(raw[i + 1]) << 8 | np.int64(raw[i + 2])
            slot = ((key * 2654435761) >> 10) & ((1 << _HASH_BITS) - 1)
            before = last[slot]
            last[slot] = i
            distance = i - before
            if before >= 0 and distance <= _DISTANCE_MAX:
                longest = min(n - i, _LENGTH_MAX)
                while length < longest and raw[before + length] == raw[i + length]:
                    length += 1
        if length >= 3:
            o = _literals(raw, literal, i, packed, o)
            back = distance - 1
            if length - 2 < 7:
                packed[o] = ((length - 2) << 5) | (back >> 8)
                o += 1
            else:
                packed[o] = (7 << 5) | (back >> 8)
                packed[o + 1] = length - 9
                o += 2
            packed[o] = back & 255
            o += 1
            i += length
            literal = i
        else:
            i += 1
    return _literals(raw, literal, i, packed, o)


@njit(cache=True, nogil=True, error_model="numpy")
def _literals(
    raw: NDArray[np.uint8], start: int, stop: int, packed: NDArray[np.uint8], o: int
) -> int:
    while start < stop:
        length = min(stop - start, _LITERAL_MAX)
        packed[o] = length - 1
        o += 1
        for _ in range(length):
            packed[o] = raw[start]
            o += 1
            start += 1
    return o
