"""Surfels: what a virtual scan sees of a tile instead of points."""

from tilestream.factors.surfels import SURFELS_VERSION, surfels_table
from tilestream.grid import TileKey
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.map_part import MapPart

FIXED_BYTES = 100_000_000
"""Memory of the task besides what it reads: the planes of some voxels."""
BYTES_PER_POINT = 200
"""Memory per map point of the tile and of its rim: millimetres, voxels, centroids, discs."""


@stage(
    "surfels",
    version=SURFELS_VERSION,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_POINT * counts["points"],
    seconds=0.7,
    tells_failures=True,
)
def surfels(map_part: MapPart, tile: TileKey, edge_mm: int) -> Made:
    """The surfels of a tile (`factors.surfels.surfels_table`)."""
    columns = surfels_table(edge_mm).make(map_part.store, tile)
    return Made(columns, {"surfels": len(columns["radius"])})
