"""What might mend a poor stretch of road: other cells, ranges and lidars than a run has."""

from collections.abc import Mapping
from dataclasses import replace

from tilestream.apps.choices import Choice
from tilestream.grid import MM_PER_M, TileGrid, whole_mm
from tilestream.pipeline.stages.observe import Observing
from tilestream.sensor import SENSORS, Sensor

FIRST_GUESS = "a first guess within 1 m"
"""The remedy that needs no other virtual drive: it is the floor of the error."""


def remedies_of(now: Observing, grid: TileGrid) -> tuple[Mapping[str, Choice], Mapping[str, str]]:
    """What may be tried instead of what a run has, each alone: half the cell size, the whole range
    of the lidar, no blind sector, the other lidars that ship.

    Args:
        now: what the run is observed with.
        grid: the tiles of its map.

    Returns:
        What is tried, and why others are not, both by name.
    """
    seeing = now.seeing
    as_it_is = Choice(now.sensor, seeing.range_max, seeing.blind_rear_deg, now.cell_size)
    tried: dict[str, Choice] = {}
    left_out: dict[str, str] = {}
    half = 0.5 * now.cell_size
    name = f"cells of {half:g} m"
    if grid.tile_mm % whole_mm(half, "cell_size"):
        left_out[name] = f"they do not divide the tiles of {grid.tile_mm / MM_PER_M:g} m"
    else:
        tried[name] = replace(as_it_is, cell_size=half)
    name = f"the whole range of {now.sensor.range_max:g} m"
    if now.range_max < now.sensor.range_max:
        tried[name] = replace(as_it_is, range_max=None)
    else:
        left_out[name] = "it is in use"
    name = "no blind sector"
    if seeing.blind_rear_deg:
        tried[name] = replace(as_it_is, blind_rear_deg=0.0)
    else:
        left_out[name] = "there is none"
    if not isinstance(now.sensor, Sensor):
        return tried, left_out | {"another lidar": "the vehicle has several"}
    for other in SENSORS.values():
        if other.name != now.sensor.name:
            usable = min(now.range_max, other.range_max)
            mounted = other.model_copy(update={"mount": now.sensor.mount})
            tried[other.name] = replace(as_it_is, sensor=mounted, range_max=usable)
    return tried, left_out
