"""A part of the map as a task reads it: some tables of some tiles, by place."""

from dataclasses import dataclass

from tilestream.grid import TileKey
from tilestream.pipeline.engine.stage import Counts
from tilestream.store import POINTS, TileStore, open_store


@dataclass(frozen=True, slots=True)
class MapPart:
    """Some tiles of a map, as a task reads them: through the store, by place."""

    store_url: str
    tiles: tuple[TileKey, ...]
    identity: str
    """Hash of what is read of these tiles."""
    makers: tuple[str, ...]
    state: str
    """Hash of the points of the whole map: what a process keeps of a map is of this state only."""
    core: TileKey | None = None
    """The tile that a table is made for; None: the part is read alike."""

    def read(self) -> "MapPart":
        """Itself: `store` reads by place."""
        return self

    def counts(self) -> Counts:
        """The points of its tiles, as their marks say: in all, of the largest, of the core."""
        marks = self.store.marks(POINTS, self.tiles)
        points = {key: mark.facts.get("points", 0) for key, mark in marks.items()}
        largest = max(points.values(), default=0)
        core = 0 if self.core is None else points[self.core]
        return {"points": sum(points.values()), "largest": largest, "core": core}

    @property
    def store(self) -> TileStore:
        """The map."""
        return open_store(self.store_url)
