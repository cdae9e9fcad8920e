"""What a vehicle sees at a place, to be looked at: the scan that the virtual drive begins with."""

import numpy as np

from tilestream.factors.beams import Beams
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import in_view, surfel_mm, surfels_in
from tilestream.factors.virtual_scan import look, rotation_of, virtual_scan, whole_places
from tilestream.factors.worlds import passed_by
from tilestream.grid import MM_PER_M, Box
from tilestream.kernels.fixed_order import turned
from tilestream.records import Float64
from tilestream.sensor import Carrier, fov_deg_of
from tilestream.settings import VirtualSettings
from tilestream.store import TileStore


def scan_at(
    store: TileStore,
    place: Float64,
    heading: float,
    vehicle: Carrier,
    seeing: VirtualSettings,
    within: float,
) -> Float64:
    """The returns of the first virtual scan at a place that lie near it.

    Args:
        store: the map, with surfels.
        place: (3,) of the vehicle's origin [m, map frame].
        heading: direction of travel [rad, from the map's x axis].
        vehicle: its lidars.
        seeing: how it sees.
        within: only so much of the map around the place is looked at [m], for less memory.

    Returns:
        (n, 3) returns [m, map frame]; none where nothing is in view.

    Raises:
        TileNotReadyError: a tile there has no surfels.
    """
    beams = Beams.of(vehicle, seeing)
    surfels = surfels_in(store, Box.around(place[None], within + beams.rim))
    real = surfels.where(~(surfels.ghost & seeing.without_ghosts))
    real = in_view(real, place[None], fov_deg_of(vehicle), within, beams.rim)
    if not len(real):
        return np.zeros((0, 3))
    place_mm = whole_places(place)
    scene = Scene.of(real, np.stack([place_mm, place_mm]), surfel_mm(store))
    scene = scene.without(passed_by(real.centre_mm, ~real.flat, seeing.seed, 0))
    found = look(scene, place_mm, heading, seeing, beams)
    points = virtual_scan(scene, found, place_mm, seeing, beams).points
    returns: Float64 = turned(rotation_of(heading), points) + place_mm / MM_PER_M
    return returns
