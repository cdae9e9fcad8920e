"""The manifest of a map: which tiles it must have, so that a lost one is missed."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.marks import Mark, hash_of
from tilestream.store.arrays import erase, read_columns, write_columns

PREFIX = "manifest_"
"""How its name begins; a hash of what it says follows, so that it is never changed."""


@dataclass(frozen=True)
class Manifest:
    """The tiles of a map, written down as soon as they are known."""

    identities: Mapping[TileKey, str]
    """Of each tile, sorted: the identity that its points have, or will have."""
    points: Mapping[TileKey, int]
    """Of each tile: the points that were read for it, before thinning."""

    def __contains__(self, key: TileKey) -> bool:
        return key in self.identities

    @classmethod
    def of(cls, tiles: Mapping[TileKey, tuple[str, int]]) -> Self:
        """From the identity and the points of each tile."""
        keys = sorted(tiles)
        return cls({key: tiles[key][0] for key in keys}, {key: tiles[key][1] for key in keys})

    def write(self, files: Files) -> str:
        """Write it into a store; its name there."""
        name = PREFIX + hash_of(
            [(str(key), self.identities[key], self.points[key]) for key in self.identities]
        )
        erase(files, name)
        identities = np.array(list(self.identities.values()), "S32")
        columns: dict[str, NDArray[Any]] = {
            "tile": np.array(list(self.identities), np.int64).reshape(-1, 2),
            "identity": identities.view(np.uint8).reshape(-1, 32),
            "points": np.array(list(self.points.values()), np.int64),
        }
        write_columns(files, name, columns, Mark("done", facts={"tiles": len(self.identities)}))
        return name


@lru_cache(maxsize=8)
def read_manifest(files: Files, name: str) -> Manifest:
    """A manifest of a store; a process keeps the last ones, which never change.

    Raises:
        DamagedError: it was lost, or is not what was written.
    """
    columns = read_columns(files, name)
    keys = [TileKey(ix, iy) for ix, iy in columns["tile"].tolist()]
    identities = [bytes(row).rstrip(b"\0").decode() for row in columns["identity"]]
    points = columns["points"].tolist()
    return Manifest(dict(zip(keys, identities, strict=True)), dict(zip(keys, points, strict=True)))
