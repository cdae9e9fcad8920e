"""Cells: the NDT map of a tile."""

from tilestream.grid import TileKey
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.store import CELLS_VERSION, cells_table

FIXED_BYTES = 50_000_000
"""Memory of the task besides what it reads."""
BYTES_PER_POINT = 100
"""Memory per map point of the tile: as stored, in millimetres, its voxel, sums of the voxels."""


@stage(
    "cells",
    version=CELLS_VERSION,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_POINT * counts["points"],
    seconds=0.12,
)
def cells(map_part: MapPart, tile: TileKey, cell_mm: int) -> Made:
    """The cells of one size of a tile (`store.cells_table`)."""
    columns = cells_table(cell_mm).make(map_part.store, tile)
    return Made(columns, {"cells": len(columns["count"])})
