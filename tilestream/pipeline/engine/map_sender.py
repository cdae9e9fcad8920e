"""Reads what a run has made and sends what of it the dashboard's map draws, beside the run.

A task's output says itself what it is: a tile from above, or a table of estimates.
"""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from tilestream.from_above import FromAbove, above_table, seen_from_above
from tilestream.grid import MM_PER_M, Box
from tilestream.model.training import ESTIMATES, MAIN, PREDICTION_COLUMNS
from tilestream.pipeline.engine.map_view import FINEST, Patch, thinned
from tilestream.pipeline.engine.outputs import Parquet, TileArrays
from tilestream.pipeline.engine.stage import Task
from tilestream.report.relief import relief
from tilestream.store import open_store

logger = logging.getLogger(__name__)

PIXELS = 400_000
"""Pixels of the relief of all tiles together, about: as many as the map on the page has."""
PIXELS_OF_TILE = 160_000
"""Pixels of the relief of one tile."""
MARKS_OF_TILE = 500
"""Places of a tile that are sent; of more, the worst of squares."""
BYTES_OF_RUN = 16_000_000
"""What is sent in a run; the rest of it is not drawn. The scheduler keeps all messages: 100,000
places and 10,000 tiles take 3 MB."""
CLOSE_WITHIN = 5.0
"""How long the end of a run waits for what is left to be drawn [s]."""
ABOVE = above_table().name


class MapSender:
    """A thread that reads tables and sends what is to be drawn, while the run goes on."""

    def __init__(self, send: Callable[[dict[str, Any]], None]) -> None:
        """Nothing is read yet.

        Args:
            send: sends a message; may be called from any thread.
        """
        self._send = send
        self._tasks: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._stopped = False
        self._told = False
        self._tiles: set[Any] = set()
        self._sent = 0

    def plan(self, task: Task) -> None:
        """Learn of a task: the more tiles there are, the coarser is what is drawn of each."""
        if _is_above(task):
            self._tiles.add(task.tile)

    def learn(self, task: Task) -> None:
        """Learn that a task is done, which returns at once."""
        if not (_is_above(task) or _is_estimates(task)):
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="map sender", daemon=True)
            self._thread.start()
        self._tasks.put(task)

    def close(self) -> None:
        """Send the rest, as far as that is done within a few seconds."""
        if self._thread is not None:
            self._tasks.put(None)
            self._thread.join(CLOSE_WITHIN)
            self._stopped = True
            if self._thread.is_alive():
                left = self._tasks.qsize()
                logger.info("the map of the dashboard lacks %d of the last tiles", left)

    def _work(self) -> None:
        while not self._stopped and (task := self._tasks.get()) is not None:
            try:
                self._draw(task)
            except Exception as error:  # noqa: BLE001 - a view disturbs no run
                if not self._told:
                    logger.warning("not drawn on the dashboard's map: %s", error or repr(error))
                self._told = True

    def _draw(self, task: Task) -> None:
        message = self._patch(task) if _is_above(task) else _marks(task)
        if message is None:
            return
        self._sent += len(message["patch"][-1] if "patch" in message else message["marks"])
        if self._sent > BYTES_OF_RUN:
            self._stopped = True
            logger.info("the map of the dashboard is full: the rest of the run is not drawn on it")
        else:
            self._send(message)

    def _patch(self, task: Task) -> dict[str, Any] | None:
        assert isinstance(task.writes, TileArrays)
        store, tile = open_store(task.writes.store_url), task.writes.tile
        most = min(PIXELS_OF_TILE, PIXELS // max(1, len(self._tiles)))
        core = store.grid.core(tile)
        found = seen_from_above(store, [tile], core, most)
        patch = None if found is None else patch_of(found, core)
        return None if patch is None else {"patch": patch.message()}


def patch_of(found: FromAbove, core: Box) -> Patch | None:
    """The relief of a tile, of the pixels whose centres lie in its core: so patches do not overlap;
    None: it is less than a pixel, and there is no such centre.

    Args:
        found: the tile from above.
        core: its box [mm].
    """
    rows, columns = (
        corner + (np.arange(count) + 0.5) * found.pixel
        for corner, count in zip(found.corner[::-1], found.height.shape, strict=True)
    )
    low, left, high, right = (
        end / MM_PER_M for end in (core.y_lo, core.x_lo, core.y_hi, core.x_hi)
    )
    in_rows = np.flatnonzero((low <= rows) & (rows < high))
    in_columns = np.flatnonzero((left <= columns) & (columns < right))
    if not (in_rows.size and in_columns.size):
        return None
    shades = relief(found)[::-1, :, 3][np.ix_(in_rows, in_columns)]
    x, y = columns[in_columns[0]], rows[in_rows[0]]
    half = found.pixel / 2.0
    return Patch(float(x - half), float(y - half), found.pixel, np.ascontiguousarray(shades))


def _marks(task: Task) -> dict[str, Any] | None:
    rows = task.writes.read().rows
    places = rows[["x", "y", ESTIMATES[MAIN]]].to_numpy(np.float64)
    places = places[np.isfinite(places[:, :2]).all(axis=1)]
    if not len(places):
        return None
    kept, _ = thinned(places, MARKS_OF_TILE, FINEST)
    return {"marks": kept.tobytes(), "places": len(rows)}


def _is_above(task: Task) -> bool:
    return isinstance(task.writes, TileArrays) and task.writes.table == ABOVE


def _is_estimates(task: Task) -> bool:
    """Whether it writes a table of estimates of places."""
    return isinstance(task.writes, Parquet) and set(PREDICTION_COLUMNS) <= set(task.applies.columns)
