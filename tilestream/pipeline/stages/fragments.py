"""Fragments: the points of a span of a source in one file, tile by tile, and the index of it."""

import json
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.marks import parsed, sealed, unsealed
from tilestream.pipeline.engine.outputs import Facts, Made
from tilestream.records import Float64
from tilestream.store import Share

Int32 = NDArray[np.int32]
Print = tuple[int, int]
"""The fingerprint of a set of points: two sums of 64-bit hashes."""

PIECE_POINTS = 2**20
"""Points that are held until they are written, tile by tile: short pieces would be slow to read."""
BYTES_PER_PIECE_POINT = 12
"""Memory per point of those."""


@dataclass(frozen=True, eq=False)
class Grouped:
    """Points of a block, tile by tile."""

    points: Int32
    """(n, 3) millimetres from the origin of the tile that owns each."""
    tiles: Sequence[tuple[TileKey, int, Print]]
    """Each tile in their order: key, count, fingerprint."""
    dropped: int
    """Points of the file that were not finite."""
    left_out: int
    """Points that the file marks as noise or withheld."""
    outside: Float64
    """(m, 3) points that do not fit the tile grid [m]."""


def add_prints(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    """The fingerprint of two sets of points together."""
    return (a[0] + b[0]) % 2**64, (a[1] + b[1]) % 2**64


@dataclass(frozen=True)
class Fragment:
    """The index of a file of points by tile."""

    name: str
    """Its file is `fragments/<name>.bin` in the store."""
    points: int
    """Finite points that were read."""
    dropped: int
    """Points that were not finite."""
    pieces: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, start, count) of each run of points of one tile."""
    prints: tuple[tuple[int, int, int, int], ...]
    """(ix, iy, two 64-bit sums): the fingerprint of the points of each tile."""
    left_out: int = 0
    """Points that the file marks as noise or withheld."""
    outside: int = 0
    """Points that do not fit the tile grid."""
    outside_at: tuple[float, ...] = ()
    """The first of those [m]."""

    @property
    def shares(self) -> dict[TileKey, Share]:
        """What each tile has of it."""
        counts: Counter[tuple[int, int]] = Counter()
        for ix, iy, _, count in self.pieces:
            counts[ix, iy] += count
        return {TileKey(ix, iy): (counts[ix, iy], a, b) for ix, iy, a, b in self.prints}

    def only(self, tiles: Container[tuple[int, int]]) -> Self:
        """The same without what is of other tiles."""
        return replace(
            self,
            pieces=tuple(piece for piece in self.pieces if piece[:2] in tiles),
            prints=tuple(row for row in self.prints if row[:2] in tiles),
        )

    @classmethod
    def of(cls, facts: Facts) -> "Fragment":
        """From the facts of a scatter task."""
        rows = {name: tuple(tuple(row) for row in facts[name]) for name in ("pieces", "prints")}
        return cls(**{**facts, **rows, "outside_at": tuple(facts["outside_at"])})


@dataclass(frozen=True)
class FragmentFile:
    """Where a fragment goes: its points, then its index."""

    store_url: str
    name: str

    def known(self, identity: str) -> Facts | None:
        """The index, if the fragment is whole and of this identity."""
        try:
            known = unsealed(parsed(self._file("json").read()))
        except (FileNotFoundError, ValueError, AttributeError):  # absent or damaged: made anew
            return None
        return dict(known["index"]) if known["identity"] == identity else None

    def write(self, made: Made, identity: str, columns: Sequence[Any]) -> Facts:  # noqa: ARG002
        """Write the groups as they come; the index last."""
        self._file("json").remove()  # an old index must not vouch for new points
        with self._file("bin").writing() as file:
            index = asdict(_written(self.name, made.value, file))
        self._file("json").write(
            json.dumps(sealed({"identity": identity, "index": index})).encode()
        )
        return index

    def read(self) -> Any:
        """Fragments are read piece by piece."""
        raise NotImplementedError

    def _file(self, ending: str) -> Files:
        return fragments_of(self.store_url).under(f"{self.name}.{ending}")


def fragments_of(store_url: str) -> Files:
    """Where an ingest keeps its fragments while it lasts."""
    return Files.at(store_url).under("fragments")


def _written(name: str, groups: Iterable[Grouped], file: Any) -> Fragment:
    """Write groups as they come, those of a tile together; the index."""
    pieces: list[tuple[int, int, int, int]] = []
    prints: dict[TileKey, Print] = {}
    held: dict[TileKey, list[Int32]] = {}
    start = points = dropped = left_out = outside = 0
    outside_at: tuple[float, ...] = ()
    for group in groups:
        dropped += group.dropped
        left_out += group.left_out
        if len(group.outside) and not outside:
            outside_at = tuple(group.outside[0].tolist())
        outside += len(group.outside)
        first = 0
        for key, count, fingerprint in group.tiles:
            held.setdefault(key, []).append(group.points[first : first + count])
            prints[key] = add_prints(prints.get(key, (0, 0)), fingerprint)
            first += count
        points += first
        if points - start >= PIECE_POINTS:
            start = _write_pieces(held, start, pieces, file)
    _write_pieces(held, start, pieces, file)
    of_tiles = tuple((*key, *fingerprint) for key, fingerprint in prints.items())
    return Fragment(name, points, dropped, tuple(pieces), of_tiles, left_out, outside, outside_at)


def _write_pieces(
    held: dict[TileKey, list[Int32]], start: int, pieces: list[tuple[int, int, int, int]], file: Any
) -> int:
    """Write what is held, a piece for each tile, and hold nothing; the points that are written."""
    for key, parts in held.items():
        count = sum(map(len, parts))
        pieces.append((*key, start, count))
        start += count
        for part in parts:
            file.write(part.data)
    held.clear()
    return start
