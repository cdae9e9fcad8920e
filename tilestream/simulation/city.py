"""The city: real footprints as walls with relief, ground, furniture, tunnels and bridges.

Nothing is built before it is looked at: `City.scene` builds what is seen from a stretch of street.
What stands where is drawn once for the whole city, each phenomenon from a random stream of its
own, so that any stretch shows the same city and switching one phenomenon off leaves the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from tilestream.records import Float64
from tilestream.simulation import buildings, furniture, structures
from tilestream.simulation.footprints import Footprints, read_footprints
from tilestream.simulation.free_space import free_space
from tilestream.simulation.ground import Ground
from tilestream.simulation.mesh import Mesh, joined
from tilestream.simulation.settings import SimulationSettings
from tilestream.simulation.streets import Street, read_streets, street_called

REACH = 115.0
"""How far around a stretch the city is built [m]: a lidar's range and some more."""
MARGIN = 130.0
"""How far from all routes buildings are kept [m]."""


@dataclass(frozen=True, eq=False)
class City:
    """A city that streets run through."""

    settings: SimulationSettings
    footprints: Footprints
    streets: tuple[Street, ...]
    ground: Ground
    furnished: furniture.Furniture
    """Every piece of furniture, tree and parking place along the streets."""

    def street(self, name: str) -> Street:
        """The street of that name.

        Raises:
            UsageError: there is none; names those that are.
        """
        return street_called(self.streets, name)

    def scene(self, along: Float64, epoch: int) -> Mesh:
        """All that stands still around a stretch of street.

        Args:
            along: (k, 2) places of the stretch [m].
            epoch: 0 the survey, d + 1 drive d: parked cars and leaves differ.
        """
        low, high = along.min(axis=0) - REACH, along.max(axis=0) + REACH
        seen = self.footprints.within(tuple(low), tuple(high))
        return joined(
            [
                self.ground.mesh(low, high),
                buildings.facades(seen, self.ground, self.settings),
                structures.tunnels_and_bridges(self.streets, self.ground, low, high),
                furniture.fixed(self.furnished, self.ground, low, high),
                furniture.vegetation(self.furnished, self.ground, low, high, self.settings, epoch),
                furniture.parked_cars(self.furnished, self.ground, low, high, self.settings, epoch),
            ]
        )


def build_city(settings: SimulationSettings) -> City:
    """Read footprints and routes and furnish the streets.

    Args:
        settings: of the experiment; whether a route is clear of buildings is not looked at
            (`check_clear`).

    Raises:
        SourceError: footprints or routes that cannot be read.
    """
    streets = read_streets(data_file(settings.city.routes))
    everything = np.concatenate([street.xy for street in streets])
    low, high = everything.min(axis=0) - MARGIN, everything.max(axis=0) + MARGIN
    footprints = read_footprints(data_file(settings.city.footprints)).within(
        tuple(low), tuple(high)
    )
    ground = Ground.of(free_space(footprints), streets, settings)
    return City(settings, footprints, streets, ground, furniture.placed(streets, ground, settings))


def stretches(street: Street, length: int = 50) -> Sequence[tuple[int, int]]:
    """Sample points `begin` to `end` (exclusive) of each piece of a street of about that length."""
    return [(i, min(i + length, len(street.xy))) for i in range(0, len(street.xy), length)]


def data_file(name: str) -> Path:
    """A file of the user's, or one that ships with tilestream."""
    shipped = Path(str(resources.files("tilestream") / "data" / name))
    return Path(name) if Path(name).exists() or not shipped.is_file() else shipped
