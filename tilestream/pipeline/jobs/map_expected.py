"""Which tiles the sources of a map may give points to, by their headers alone."""

import numpy as np

from tilestream.formats import describe
from tilestream.grid import MM_PER_M, Box, TileKey
from tilestream.pipeline.jobs.map_reading import Reading
from tilestream.pipeline.stages.scatter import SourceSpan


def tiles_to_read(reading: Reading) -> tuple[set[TileKey], list[str]]:
    """The tiles within the bounds of the sources that are read first, and the sources whose headers
    have none.
    """
    spans = [task.reads["blocks"] for task in reading.scatters.tasks]
    opened_with = {span.path: span.options for span in spans if isinstance(span, SourceSpan)}
    tiles: set[TileKey] = set()
    unknown: list[str] = []
    for path, options in sorted(opened_with.items()):
        bounds = describe(path, **dict(options)).bounds
        if bounds is None:
            unknown.append(path)
        else:
            low, high = (np.round(np.array(corner) * MM_PER_M).astype(int) for corner in bounds)
            box = Box(int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1)
            tiles.update(reading.store.grid.keys_over(box))
    return tiles, unknown
