"""The kernels below the formats, against their plain twins, byte for byte."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tilestream.kernels import lzf
from tilestream.kernels.rows import finite_points


def plain_decompress(packed: bytes, size: int) -> bytes | None:
    """The LZF stream read literally; None where it does not fit."""
    out, i = bytearray(), 0
    try:
        while i < len(packed):
            control, i = packed[i], i + 1
            if control < 32:
                if i + control + 1 > len(packed):
                    return None
                out += packed[i : i + control + 1]
                i += control + 1
            else:
                length = control >> 5
                if length == 7:
                    length, i = length + packed[i], i + 1
                source = len(out) - ((control & 31) << 8) - packed[i] - 1
                i += 1
                if source < 0:
                    return None
                for _ in range(length + 2):
                    out.append(out[source])
                    source += 1
            if len(out) > size:
                return None
    except IndexError:
        return None
    return bytes(out) if len(out) == size else None


def as_array(raw: bytes) -> np.ndarray:
    return np.frombuffer(bytearray(raw), np.uint8)


def decompress(packed: bytes, size: int) -> bytes | None:
    unpacked = np.zeros(size + 64, np.uint8)  # a margin that nothing may touch
    status = lzf.decompress(as_array(packed), unpacked[:size])
    assert not unpacked[size:].any()
    assert status == lzf.WHOLE or 0 <= status <= len(packed)
    return unpacked[:size].tobytes() if status == lzf.WHOLE else None


def compress(raw: bytes) -> bytes:
    packed = np.zeros(len(raw) + len(raw) // 32 + 1, np.uint8)
    return packed[: lzf.compress(as_array(raw), packed)].tobytes()


repetitive = st.lists(st.tuples(st.binary(max_size=12), st.integers(1, 400)), max_size=8).map(
    lambda parts: b"".join(part * times for part, times in parts)
)


@settings(max_examples=200, deadline=None)
@given(raw=st.one_of(st.binary(max_size=2000), repetitive))
def test_what_is_compressed_comes_back(raw: bytes) -> None:
    packed = compress(raw)
    assert decompress(packed, len(raw)) == raw
    assert plain_decompress(packed, len(raw)) == raw


@pytest.mark.interpreted
def test_repetition_is_compressed_and_comes_back() -> None:
    assert decompress(compress(b"abc" * 99), 297) == b"abc" * 99
    assert len(compress(bytes(100_000))) < 1300
    far = bytes(range(256)) * 32  # repeats 8192 bytes back, the largest distance
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, 8192, np.uint8).tobytes()
    assert len(compress(noise + noise)) < 8192 * 1.1
    assert len(compress(far)) < 700


@settings(max_examples=300, deadline=None)
@given(packed=st.binary(max_size=300), size=st.integers(0, 3000))
def test_any_bytes_decode_as_the_plain_reading_says(packed: bytes, size: int) -> None:
    assert decompress(packed, size) == plain_decompress(packed, size)


@pytest.mark.interpreted
def test_a_damaged_stream_is_named_by_its_offset() -> None:
    out = np.zeros(10, np.uint8)
    assert lzf.decompress(as_array(b"\x01ab\x20\x07"), out) == 3  # 8 back, 2 are there
    assert lzf.decompress(as_array(b"\x01ab\x09x"), out) == 3  # 10 literals, 1 is there
    assert lzf.decompress(as_array(b"\x01ab\xe0"), out) == 3  # the length is missing
    assert lzf.decompress(as_array(b"\x01ab"), out) == 3  # 2 of 10 bytes
    assert lzf.decompress(as_array(b"\x01ab\xe0\x09\x01"), out) == 3  # 18 bytes into 8


def plain_finite_points(x, y, z, scale, offset):  # type: ignore[no-untyped-def]
    points = np.column_stack([x, y, z]).astype(float) * scale + offset
    return points[np.isfinite(points).all(axis=1)]


@pytest.mark.interpreted
def test_finite_points_are_the_plain_ones_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    for dtype in (np.float32, np.float64, np.int32):
        table = rng.uniform(-1e6, 1e6, (300, 5)).astype(dtype)
        if dtype is not np.int32:
            table[rng.integers(0, 300, 40), rng.integers(0, 5, 40)] = np.nan
            table[rng.integers(0, 300, 40), rng.integers(0, 5, 40)] = -np.inf
        scale, offset = np.array([0.001, 0.01, 1.0]), np.array([4e6, -5e5, 0.0])
        points = np.empty((300, 3))
        x, y, z = table[:, 4], table[:, 0], table[:, 2]
        kept = finite_points(x, y, z, scale, offset, points)
        assert np.array_equal(points[:kept], plain_finite_points(x, y, z, scale, offset))
