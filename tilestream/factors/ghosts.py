"""Ghosts: surfels of traffic that moved while the map was surveyed (definitions, section 4.2).

A parked car hides the ground beneath it in every pass of the survey. A moving car does not: the map
has the ground there too. So what stands above mapped ground, with mapped ground around it, is a
ghost; unless it is upright and slim, as lamp posts and signs are.
"""

import numpy as np
from numpy.typing import NDArray

LOW_MM, HIGH_MM = 300, 3_400
"""Heights above the ground between which traffic stands [mm]."""
BLOCK = 5
"""Edge of the blocks [columns] whose lowest surfel is the ground: 1 m."""
AROUND = 2
"""Columns on each side that are checked for ground too: 5 x 5 in all."""
OPEN = 0.7
"""Least share of these columns that must show ground."""
UPRIGHT = 6
"""Least surfels of a column that is upright: 1.2 m."""
SLIM = 4
"""Most columns of the 5 x 5 around that have something above the ground where it is slim."""
LEVEL = (AROUND + 1) ** 2
"""Least columns of the 5 x 5 around a column of ground, itself included, that begin at its height:
as many as at the corner of a level piece of ground."""
REACH_EDGES = 2 * BLOCK + 3 * AROUND
"""How far around a surfel the map is needed to decide whether it is a ghost [edges]: 3.2 m."""
NONE_MM = 2**30
"""Height of a column without surfels: above all ground [mm]."""

Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


def ghosts_among(centre_mm: Int64, edge_mm: int) -> NDArray[np.bool_]:
    """Which surfels are ghosts.

    A ghost stands 0.3 to 3.4 m above the ground, the lowest surfel of the blocks of 1 m around that
    lies level with others: mirrored and stray returns lie below the road. Its own column, of one
    voxel, and 70 % of the 5 x 5 around it show ground and nothing above 3.4 m. Of these columns,
    those that are upright and slim are none: 6 surfels or more above the ground, in at most 4
    columns of the 5 x 5.

    Args:
        centre_mm: (n, 3) centres of the surfels of a part of the map [mm, map frame]; within
            `REACH_EDGES` of its rim the result may be wrong, since surfels around are missing.
        edge_mm: edge of their voxels [mm].

    Returns:
        (n,) True for a ghost.
    """
    if not len(centre_mm):
        return np.zeros(0, np.bool_)
    block_mm = BLOCK * edge_mm
    corner = centre_mm[:, :2].min(axis=0) // block_mm * block_mm
    column = (centre_mm[:, :2] - corner) // edge_mm
    shape = tuple((column.max(axis=0) // BLOCK + 1) * BLOCK)
    at = column[:, 0] * shape[1] + column[:, 1]
    z = (centre_mm[:, 2] - centre_mm[:, 2].min()).astype(np.int32)
    lowest, highest = (np.full(shape, none, np.int32) for none in (NONE_MM, -NONE_MM))
    np.minimum.at(lowest.reshape(-1), at, z)
    np.maximum.at(highest.reshape(-1), at, z)
    ground = _ground(np.where(_is_level(lowest), lowest, np.int32(NONE_MM)))
    there = (lowest < NONE_MM) & (ground < NONE_MM)
    shows = there & (lowest <= ground + LOW_MM) & (highest <= ground + HIGH_MM)
    is_open = shows & (_sum_around(shows) >= OPEN * (2 * AROUND + 1) ** 2)
    height = z - ground.reshape(-1)[at]
    stands = (height > LOW_MM) & (height <= HIGH_MM) & is_open.reshape(-1)[at]
    count = np.bincount(at[stands], minlength=is_open.size).reshape(shape)
    slim = (count >= UPRIGHT) & (_sum_around(count > 0) <= SLIM)
    found: NDArray[np.bool_] = stands & ~slim.reshape(-1)[at]
    return found


def _is_level(lowest: Int32) -> NDArray[np.bool_]:
    """Which columns begin within 0.3 m of as high as enough of the 5 x 5 around them do."""
    padded = np.pad(lowest, AROUND, constant_values=NONE_MM)
    rows, columns = lowest.shape
    count = np.zeros(lowest.shape, np.uint8)
    for i in range(2 * AROUND + 1):
        for j in range(2 * AROUND + 1):
            count += np.abs(padded[i : i + rows, j : j + columns] - lowest) <= LOW_MM
    return count >= LEVEL


def _ground(lowest: Int32) -> Int32:
    """Per column the lowest surfel of its block and the eight around it [mm]."""
    rows, columns = lowest.shape[0] // BLOCK, lowest.shape[1] // BLOCK
    blocks = lowest.reshape(rows, BLOCK, columns, BLOCK).min(axis=(1, 3))
    padded = np.pad(blocks, 1, mode="edge")
    near = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    ground: Int32 = np.min(near, axis=0).repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
    return ground


def _sum_around(shows: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Number of columns that show ground in the 5 x 5 around each column, itself included."""
    padded = np.pad(shows.astype(np.uint8), AROUND)
    steps = range(2 * AROUND + 1)
    rows, columns = shows.shape
    in_rows = np.zeros((rows, columns + 2 * AROUND), np.uint8)
    around = np.zeros_like(shows, np.uint8)
    for i in steps:
        in_rows += padded[i : i + rows]
    for j in steps:
        around += in_rows[:, j : j + columns]
    return around
