"""Vicinities of sample points: terms of cells as whole numbers, and their sums.

The vicinity is that of definitions, section 2. Every sum is a sum of integers (definitions,
section 1.2), so it has the same bits for any tiling, any order of tiles and sample points, and any
number of workers.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.grid import MM_PER_M
from tilestream.kernels import depth_image
from tilestream.kernels import vicinity as kernels
from tilestream.records import Float64, Int64
from tilestream.sensor import Sensor

Terms = dict[str, NDArray[Any]]
Sums = dict[str, NDArray[Any]]

FRACTION = 2.0**20
"""A term that is no whole number is summed in steps of 2^-20 of its unit."""
FIELD_STEPS = 2.0**20
"""The finest steps of a cell's 441 score sums: 2^-20; coarser where the largest needs 31 bits."""
HISTOGRAMS = {"normal_8": 8 * 8, "normal_16": 16 * 16, "normal_90": 90 * 90, "wall": 36}
"""Terms that are counted, not summed: the number of a bin, -1 for none; how many bins there are."""
STANDING = "standing"
"""The term that says whether a cell's normal is not vertical: its azimuth is counted apart."""
CELL_BLOCK = 16.0
"""Edge of the blocks in which cells are tested together [m]; only speed depends on it."""
POINT_BLOCK, POINT_GROUP = 2.5, 4
"""Edge of the blocks of points of the depth image [m], and of groups of them in blocks."""


def ratio(sums: NDArray[Any], counts: NDArray[Any]) -> Float64:
    """The quotient, NaN where there is nothing to divide by."""
    with np.errstate(invalid="ignore", divide="ignore"):
        quotient: Float64 = np.asarray(sums, np.float64) / counts
    return np.where(np.asarray(counts) == 0, np.nan, quotient)


def fixed(term: NDArray[Any], name: str) -> Int64:
    """A term as a whole number: as it is, or in steps of 1 / `FRACTION`.

    Raises:
        UsageError: a value that is not finite, or too large to be summed.
    """
    if term.dtype.kind in "biu":
        return term.astype(np.int64)
    steps = np.rint(term * FRACTION)
    if not (np.abs(steps) < 2.0**62 / max(len(term), 1)).all():
        row = int(np.flatnonzero(~(np.abs(steps) < 2.0**62 / len(term)))[0])
        raise UsageError(f"term {name} of a cell is {term[row]!r}: it cannot be summed")
    whole: Int64 = steps.astype(np.int64)
    return whole


@dataclass(frozen=True, eq=False)
class TileTerms:
    """The terms of a tile's cells, and its points for the depth image; block by block."""

    names: tuple[str, ...]
    """Names of the columns of `sums`."""
    whole: NDArray[np.bool_]
    """(m,) whether a column is of whole numbers, not of steps of 1 / `FRACTION`."""
    mean: Float64
    """(n, 3) means of the cells [m, map frame]."""
    sums: Int64
    """(n, m) terms that are summed."""
    bins: NDArray[np.int16]
    """(n, 4) bins in the `HISTOGRAMS`."""
    standing: NDArray[np.bool_]
    """(n,) whether the cell's normal is not vertical."""
    field: NDArray[np.int32]
    """(n, 441) score sums in steps of 2^exponent / `FIELD_STEPS`, i slowest."""
    exponent: NDArray[np.uint8]
    """(n,) exponents of `field`."""
    depth_mm: Int64
    """(d, 3) map points thinned to 0.5 m [mm, map frame]."""
    loose_mean: Float64
    """(s, 3) means of the voxels with too few points for a cell [m, map frame]."""
    loose_count: Int64
    """(s,) their points."""

    @classmethod
    def of(
        cls,
        mean: Float64,
        terms: Terms,
        field: str,
        depth_mm: Int64,
        loose_mean: Float64,
        loose_count: Int64,
    ) -> Self:
        """Terms as the criteria give them, made into whole numbers.

        Args:
            mean: (n, 3) means of the cells [m, map frame].
            terms: a row per cell, by name; those named in `HISTOGRAMS` are bins.
            field: name of the one that has 441 columns.
            depth_mm: (d, 3) points of the depth image [mm].
            loose_mean: (s, 3) means of voxels that are no cells [m].
            loose_count: (s,) their points.
        """
        own = {*HISTOGRAMS, STANDING, field}
        summed = {name: term for name, term in terms.items() if name not in own}
        order = _by_block(mean, CELL_BLOCK)
        loose_order = _by_block(loose_mean, CELL_BLOCK)
        values = np.asarray(terms[field], np.float64)[order]
        largest = values.max(axis=1, initial=0.0) * FIELD_STEPS
        exponent = np.maximum(np.ceil(np.log2(np.maximum(largest, 1.0) / 2.0**31)), 0.0)
        columns = [fixed(term, name)[order] for name, term in summed.items()]
        return cls(
            names=tuple(summed),
            whole=np.array([term.dtype.kind in "biu" for term in summed.values()], np.bool_),
            mean=mean[order],
            sums=np.column_stack([*columns, np.zeros((len(mean), 0), np.int64)]),
            bins=np.column_stack([terms[name][order] for name in HISTOGRAMS]).astype(np.int16),
            standing=terms[STANDING][order].astype(np.bool_),
            field=np.minimum(
                np.rint(values * (FIELD_STEPS / 2.0**exponent)[:, None]), 2**31 - 1
            ).astype(np.int32),
            exponent=exponent.astype(np.uint8),
            depth_mm=depth_mm[_by_group(depth_mm / MM_PER_M)],
            loose_mean=loose_mean[loose_order],
            loose_count=loose_count[loose_order],
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The fields as arrays, as the store keeps them."""
        kept = {f.name: getattr(self, f.name) for f in fields(self)}
        return {**kept, "names": np.frombuffer("\n".join(self.names).encode(), np.uint8)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The terms from the arrays that `arrays` gave."""
        names = arrays["names"].astype(np.uint8).tobytes().decode().split("\n")
        return cls(**{**arrays, "names": tuple(names)})  # type: ignore[arg-type]

    @property
    def nbytes(self) -> int:
        """Memory of the arrays, with those that are derived from them [bytes]."""
        kept = sum(array.nbytes for array in self.arrays().values())
        return kept + self.mean.nbytes + self.depth_mm.nbytes + self.bins.nbytes * 2

    @cached_property
    def cell_blocks(self) -> tuple[Float64, Int64, Float64]:
        """(3, n) means, and starts and boxes of their blocks."""
        return _blocks(self.mean, CELL_BLOCK)

    @cached_property
    def loose_blocks(self) -> tuple[Float64, Int64, Float64]:
        """(3, s) means of loose voxels, and starts and boxes of their blocks."""
        return _blocks(self.loose_mean, CELL_BLOCK)

    @cached_property
    def depth_blocks(self) -> tuple[Float64, Int64, Float64, Int64, Float64]:
        """(3, d) points, starts and (6, b) boxes of blocks, starts and boxes of groups of them."""
        points = self.depth_mm / MM_PER_M
        xyz, start, box = _blocks(points, POINT_BLOCK)
        _, group_start, group_box = _blocks(points, POINT_BLOCK * POINT_GROUP)
        groups = np.searchsorted(start, group_start), np.ascontiguousarray(group_box.T)
        return xyz, start, np.ascontiguousarray(box.T), *groups

    @cached_property
    def counted(self) -> NDArray[np.int16]:
        """(n, 4) bins in all histograms side by side; those of no bin are in the last of all."""
        sizes = np.array(list(HISTOGRAMS.values()))
        offset = np.cumsum(sizes) - sizes
        placed: NDArray[np.int64] = np.where(self.bins < 0, sizes.sum(), self.bins + offset)
        return placed.astype(np.int16)


def _voxels(points: Float64, edge: float) -> Int64:
    voxels: Int64 = np.floor(points / edge).astype(np.int64)
    return voxels


def _by_block(points: Float64, edge: float) -> Int64:
    """The order that makes blocks of points contiguous; within a block it stays."""
    return np.lexsort(_voxels(points, edge).T[::-1])


def _by_group(points: Float64) -> Int64:
    """The order that makes groups of blocks contiguous, and blocks in them."""
    block = _voxels(points, POINT_BLOCK)
    return np.lexsort((*block.T[::-1], *(block // POINT_GROUP).T[::-1]))


def _blocks(points: Float64, edge: float) -> tuple[Float64, Int64, Float64]:
    """(3, n) points, (b + 1,) starts of blocks and (b, 6) boxes; the points are in block order."""
    block = _voxels(points, edge)
    changes = (block[1:] != block[:-1]).any(axis=1)
    run = np.concatenate([np.zeros(min(len(points), 1), np.int64), np.cumsum(changes)])
    xyz = np.ascontiguousarray(points.T)
    start, box = kernels.blocks_of(run, *xyz)
    return xyz, start, box


def row_edges(sensor: Sensor) -> Float64:
    """Elevations of the edges of the depth image's rows [rad], rising; a row per beam.

    Halfway between beams, the outer ones mirrored at the outer beams (definitions, section 3,
    `occupancy_ratio`).
    """
    beams = np.radians(sensor.elevations_deg)
    between = (beams[:-1] + beams[1:]) / 2.0
    outer = 2.0 * beams[0] - between[0], 2.0 * beams[-1] - between[-1]
    return np.concatenate([outer[:1], between, outer[1:]])


def _row_sines(sensor: Sensor) -> Float64:
    """Sines of the rows' edges, each moved by 1e-9 of its row (definitions, section 1.1)."""
    edges = row_edges(sensor)
    height = np.diff(edges)
    moved = np.append(edges[:-1] - 1e-9 * height, edges[-1] + 1e-9 * height[-1])
    sines: Float64 = np.sin(np.clip(moved, -np.pi / 2, np.pi / 2))
    return sines


def vicinity_sums(places: Float64, sensor: Sensor, tiles: Iterable[TileTerms]) -> Sums:
    """Sums over the vicinity of each sample point: 0 < |mu - P| <= R, elevation in view.

    Args:
        places: (k, 3) sample points [m, map frame], best in the order of a route.
        sensor: range, field of view and beams.
        tiles: the terms of all tiles within range, in any order; the nearest first is fastest.

    Returns:
        A row per sample point. Every summed term by its name, (k,) or for the field (k, 441); the
        histograms, (k, bins); and what depends on the place: `cells` (N), `range` (sum of r [m]),
        `range_squared` [m^2], `sight_xx` ... `sight_zz` (sums of u u^T, u = (mu - P) / r),
        `azimuth` and `azimuth_standing` (k, 90) cells per azimuth of mu - P, `occupied` and
        `pixels` of the depth image, `loose_points` (map points in voxels that are no cells).

    Raises:
        UsageError: tiles have terms of two kinds.
    """
    places = np.ascontiguousarray(places, np.float64)
    k, reach = len(places), float(sensor.range_max)
    low, high = np.sin(np.radians(sensor.fov_deg))
    names: tuple[str, ...] = ()
    whole = np.zeros(0, np.bool_)
    view, sums = np.zeros((k, 8), np.int64), np.zeros((k, 0), np.int64)
    azimuth = np.zeros((k, 2, kernels.AZIMUTHS), np.int64)
    field = np.zeros((k, 441), np.int64)
    counts = np.zeros((k, sum(HISTOGRAMS.values()) + 1), np.int32)
    loose = np.zeros(k, np.int64)
    sines = _row_sines(sensor)
    guess = depth_image.row_guesses(sines)
    pixels = depth_image.COLUMNS * len(sensor.elevations_deg)
    images = np.zeros((k, pixels), np.bool_)
    for tile in tiles:
        if not names:
            names, whole, sums = tile.names, tile.whole, np.zeros((k, len(tile.names)), np.int64)
        if tile.names != names:
            raise UsageError(f"terms of two kinds: {tile.names} and {names}")
        xyz, start, box = tile.cell_blocks
        terms = tile.standing, tile.sums, tile.field, tile.exponent, tile.counted
        kernels.add_cells(
            places, reach, low, high, xyz, start, box, *terms, view, azimuth, sums, field, counts
        )
        kernels.add_weights(places, reach, low, high, *tile.loose_blocks, tile.loose_count, loose)
        depth_image.add_points(places, reach, sines, guess, *tile.depth_blocks, images)
    for changes in (sums, field, counts):
        np.cumsum(changes, axis=0, out=changes)
    return {
        **_named(names, whole, sums),
        **_histograms(counts),
        **_of_the_place(view, azimuth, reach),
        "score": field / FIELD_STEPS,
        "occupied": images.sum(axis=1).astype(np.float64),
        "pixels": np.full(k, float(pixels)),
        "loose_points": loose.astype(np.float64),
    }


def _named(names: Sequence[str], whole: NDArray[np.bool_], sums: Int64) -> Sums:
    steps = np.where(whole, 1.0, FRACTION)
    return {name: sums[:, i] / steps[i] for i, name in enumerate(names)}


def _histograms(counts: NDArray[np.int32]) -> Sums:
    ends = np.cumsum(list(HISTOGRAMS.values()))
    parts = np.split(counts, ends, axis=1)
    return {
        name: np.ascontiguousarray(part) for name, part in zip(HISTOGRAMS, parts[:-1], strict=True)
    }


def _of_the_place(view: Int64, azimuth: Int64, reach: float) -> Sums:
    cells = view[:, kernels.N_CELLS].astype(np.float64)
    share = view / kernels.ONE
    xx, yy = share[:, kernels.UXX], share[:, kernels.UYY]
    return {
        "cells": cells,
        "range": share[:, kernels.RANGE] * reach,
        "range_squared": share[:, kernels.RANGE_SQUARED] * reach**2,
        "sight_xx": xx,
        "sight_xy": share[:, kernels.UXY],
        "sight_xz": share[:, kernels.UXZ],
        "sight_yy": yy,
        "sight_yz": share[:, kernels.UYZ],
        "sight_zz": cells - xx - yy,
        "azimuth": azimuth[:, 0].astype(np.int32),
        "azimuth_standing": azimuth[:, 1].astype(np.int32),
    }
