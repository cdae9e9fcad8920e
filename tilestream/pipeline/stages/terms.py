"""Terms: all of a tile's cells that does not depend on the sample point."""

from tilestream.factors.terms import TERMS_VERSION, terms_table
from tilestream.grid import TileKey
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.map_part import MapPart

FIXED_BYTES = 150_000_000
"""Memory of the task besides what it reads: the neighbours of some cells, their pairs."""
BYTES_PER_POINT = 150
"""Memory per map point of the tile and of those around it: millimetres, its cell, distances."""


@stage(
    "terms",
    version=TERMS_VERSION,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_POINT * counts["points"],
    seconds=1.6,
    tells_failures=True,
)
def terms(map_part: MapPart, tile: TileKey, cell_mm: int) -> Made:
    """The terms of a tile's cells (`factors.terms.terms_table`)."""
    columns = terms_table(cell_mm).make(map_part.store, tile)
    return Made(columns, {"cells": len(columns["mean"])})
