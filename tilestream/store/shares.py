"""What each source gave to each tile of a map: of a map that is updated, only what the update
reaches is read again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.marks import Mark, hash_of
from tilestream.records import Int64
from tilestream.store.arrays import erase, read_columns, write_columns

PREFIX = "shares_"
"""How its name begins; a hash of what it says follows, so that it is never changed."""
Share = tuple[int, int, int]
"""Of the points of a tile: how many, and their fingerprint, two sums of 64-bit hashes."""


def added(a: Share, b: Share) -> Share:
    """Two sets of points of a tile together."""
    return a[0] + b[0], (a[1] + b[1]) % 2**64, (a[2] + b[2]) % 2**64


@dataclass(frozen=True)
class Shares:
    """The shares of all sources of a map, written down when its ingest ends."""

    spans: Mapping[tuple[int, int], Mapping[TileKey, Share]]
    """What the tiles have of each span of a source, by the place of the source among those of the
    record and by the first point of the span. A span that gave nothing may be absent."""

    def by_source(self) -> dict[int, dict[int, Mapping[TileKey, Share]]]:
        """By the place of the source, then by the first point of the span."""
        found: dict[int, dict[int, Mapping[TileKey, Share]]] = {}
        for (source, start), tiles in self.spans.items():
            found.setdefault(source, {})[start] = tiles
        return found

    def write(self, files: Files) -> str:
        """Write them into a store; their name there."""
        rows = [
            (source, start, *key, *share)
            for (source, start), tiles in sorted(self.spans.items())
            for key, share in sorted(tiles.items())
        ]
        places: Int64 = np.array([row[:5] for row in rows], np.int64).reshape(-1, 5)
        prints = np.array([row[5:] for row in rows], np.uint64).reshape(-1, 2)
        name = PREFIX + hash_of(places, prints)
        erase(files, name)
        write_columns(files, name, {"places": places, "prints": prints}, Mark("done"))
        return name

    @classmethod
    def read(cls, files: Files, name: str) -> Self:
        """The shares of a store.

        Raises:
            DamagedError: they were lost, or are not what was written.
        """
        columns = read_columns(files, name)
        spans: dict[tuple[int, int], dict[TileKey, Share]] = {}
        rows = zip(columns["places"].tolist(), columns["prints"].tolist(), strict=True)
        for (source, start, ix, iy, points), (a, b) in rows:
            spans.setdefault((source, start), {})[TileKey(ix, iy)] = (points, a, b)
        return cls(spans)
