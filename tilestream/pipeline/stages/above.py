"""Above: what a tile looks like from above, for the maps of reports."""

from tilestream.from_above import ABOVE_VERSION, above_table
from tilestream.grid import TileKey
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.map_part import MapPart

FIXED_BYTES = 50_000_000
"""Memory of the task besides what it reads."""
BYTES_PER_POINT = 130
"""Memory per map point of the tile: millimetres, its pixel and height, in order and out of it."""


@stage(
    "above",
    version=ABOVE_VERSION,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_POINT * counts["points"],
    seconds=0.1,
)
def above(map_part: MapPart, tile: TileKey) -> Made:
    """The pixels of a tile (`from_above.above_table`)."""
    columns = above_table().make(map_part.store, tile)
    return Made(columns, {"pixels": len(columns["height"])})
