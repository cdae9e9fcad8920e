"""Rows whose length is in them: those of PLY that have lists."""

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

CUT_SHORT = -1
"""What `find_rows` returns where the rows end behind the data."""


@njit(nogil=True, error_model="numpy")
def find_rows(
    data: NDArray[np.uint8],
    start: int,
    count: int,
    properties: NDArray[np.int64],
    big_endian: bool,
    wanted: NDArray[np.int64],
    places: NDArray[np.int64],
) -> int:
    """Where some properties of each row lie; nothing is read out of bounds.

    Args:
        data: (m,) the file.
        start: where the first row begins.
        count: number of rows.
        properties: (k, 2) bytes of the length that stands before a list (0: no list), and of the
            property or of each item of the list.
        big_endian: whether a length has its highest byte first.
        wanted: (j,) which properties.
        places: (count, j) overwritten: where they begin; (0, j) where no one wants to know.

    Returns:
        Where the last row ends, or `CUT_SHORT`.
    """
    at = start
    for row in range(count):
        for p in range(properties.shape[0]):
            for j in range(wanted.shape[0]):
                if wanted[j] == p and row < places.shape[0]:
                    places[row, j] = at
            before, size = properties[p]
            items = 1
            if before > 0:
                if at + before > data.shape[0]:
                    return CUT_SHORT
                items = 0
                for k in range(before):
                    items = items * 256 + int(data[at + (k if big_endian else before - 1 - k)])
            at += before + items * size
            if at > data.shape[0]:
                return CUT_SHORT
    return at
