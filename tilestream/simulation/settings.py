"""Settings of a simulated city and its drives; presets are YAML files that users can copy."""

import zlib
from contextlib import nullcontext
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BeforeValidator, Field

from tilestream.bounded_yaml import read_yaml
from tilestream.config import Settings
from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.files import local_path
from tilestream.records import District, Float64
from tilestream.sensor import SENSORS, Sensor, Vehicle, named

OF_PRESETS: District = "shinjuku"
"""The district whose files presets name; a preset of one's own may name others."""

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Length = Annotated[float, Field(ge=0.0)]


def _alone(given: Any) -> Any:
    """A sensor as `named` reads it.

    Raises:
        UsageError: it is a list of sensors.
    """
    found = named(given)
    if isinstance(found, Vehicle):
        raise UsageError("the simulated vehicle has one lidar: give one sensor")
    return found


class CitySettings(Settings):
    """What stands in the streets."""

    footprints: str = "shinjuku_buildings.geojson.gz"
    """GeoJSON of buildings in metres: a path, or a file that ships with tilestream."""
    routes: str = "shinjuku_routes.geojson"
    """GeoJSON of routes in metres, likewise."""
    relief: Length = 0.35
    """Deepest recess between pilasters [m]; 0: flat walls."""
    furniture: Share = 1.0
    """Share of the lamp posts, bollards, guard rails and signs that are there."""
    vegetation: Share = 1.0
    """Share of the trees and hedges that are there."""
    parked: Share = 0.4
    """Share of the parking places along the curb that are taken."""
    slope: Length = 0.01
    """Steepest slope of the ground, m per m."""

    crs: str | None = None
    """CRS in which map, poses and routes are written; null: the local metres of the files."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Where the zero of the files is in it [m]."""

    @property
    def shift(self) -> Float64:
        """(3,) from the metres of the files to those that are written [m]."""
        return np.array([*self.origin, 0.0])

    def of_district(self, name: str) -> Self:
        """The same in another district that ships with tilestream."""
        files = {"footprints": f"{name}_buildings.geojson.gz", "routes": f"{name}_routes.geojson"}
        return self.model_copy(update=files)


class LidarSettings(Settings):
    """How the lidar of the drives measures."""

    sensor: Annotated[str | Sensor, BeforeValidator(_alone)] = "VLP16"
    """The sensor: a name that ships, a YAML file, or its fields."""
    height: Annotated[float, Field(gt=0.0)] = 2.0
    """Height above the ground [m]."""
    range_max: Length | None = None
    """Largest range of a return [m]; None: the sensor's."""
    beam_bias: Length = 0.01
    """Standard deviation of the constant range error of each beam [m]."""
    quantum: Length = 0.002
    """Step of the ranges [m]; 0: none."""
    glass_loss: Share = 0.035
    """Share of the rays on glass that do not come back."""
    blind_deg: Annotated[float, Field(ge=0.0, lt=360.0)] = 60.0
    """Sector to the rear that the vehicle hides [deg]."""
    speed: Annotated[float, Field(gt=0.0, le=20.0)] = 1.8
    """Largest speed of the vehicle [m/s]."""
    distortion: bool = True
    """Whether points keep the place from where they were seen during the turn."""

    @property
    def model(self) -> Sensor:
        """The sensor's data, with the range that is used."""
        sensor = self.sensor if isinstance(self.sensor, Sensor) else SENSORS[self.sensor]
        return (
            sensor
            if self.range_max is None
            else sensor.model_copy(update={"range_max": min(self.range_max, sensor.range_max)})
        )


class SurveySettings(Settings):
    """How the mapping vehicle measures."""

    rays_per_m: Annotated[int, Field(gt=0)] = 30_000
    """Rays of the scanner per metre and pass."""
    range_max: Annotated[float, Field(gt=0.0)] = 80.0
    """Largest range of a return [m]."""
    height: Annotated[float, Field(gt=0.0)] = 2.4
    """Height of the scanner above the ground [m]."""
    noise: Length = 0.015
    """Standard deviation of a range [m]."""
    passes: Annotated[int, Field(gt=0, le=4)] = 2
    """How many times each street is driven: 1 is one way only; every second pass drives back."""
    drift: Length = 0.02
    """Root mean square of the position error of a pass, smooth over 50 to 200 m [m]."""
    traffic: Share = 0.3
    """Share of the traffic of the drives that the survey bakes into the map as ghosts."""


class TrafficSettings(Settings):
    """What moves, and what is not as it was."""

    cars_per_100m: Length = 3.0
    """Moving cars per 100 m of street."""
    people_per_100m: Length = 8.0
    """Pedestrians per 100 m of street."""
    reparked: Share = 0.6
    """Share of the parking places that are filled anew between survey and drive."""
    regrown: bool = True
    """Whether leaves hang elsewhere than in the survey."""


class SimulationSettings(Settings):
    """A whole experiment: a city, its survey and its drives."""

    preset: str = "physical"
    """What the settings are called; written into everything made with them."""
    note: str = ""
    """What a reader of the results must know of them."""
    city: CitySettings = CitySettings()
    """What stands in the streets."""
    lidar: LidarSettings = LidarSettings()
    """How the lidar of the drives measures."""
    survey: SurveySettings = SurveySettings()
    """How the mapping vehicle measures."""
    traffic: TrafficSettings = TrafficSettings()
    """What moves, and what is not as it was."""
    odometry_error: Length = 0.05
    """Root mean square of the smooth error of the logged odometry [m]."""
    seed: int = 0
    """Seed of everything."""
    reverse: bool = False
    """Whether the drive goes along the streets the other way, from their ends."""
    side: Annotated[float, Field(ge=0.0, le=2.0)] = 0.0
    """How far right of the route the drive keeps [m]."""
    drive: Annotated[int, Field(ge=0)] = 0
    """Which drive: another number is another day, with other traffic, noise, leaves and cars."""


def stream(seed: int, phenomenon: str, *which: int) -> np.random.Generator:
    """The random stream of one phenomenon, independent of all others.

    Args:
        seed: of the experiment.
        phenomenon: its name.
        which: numbers that tell one draw of it from another: drive, path, scan.
    """
    name = zlib.crc32(phenomenon.encode())
    return np.random.default_rng(np.random.SeedSequence((seed, name, *which)))


def load_preset(name: str) -> SimulationSettings:
    """A preset that ships with tilestream, or a YAML file.

    Raises:
        SourceNotFoundError: no such preset or file.
        UsageError: an unknown key or a value that cannot be; names the file.
    """
    shipped = resources.files("tilestream") / "simulation" / "presets" / f"{name}.yaml"
    own = Path(local_path(name))
    if not shipped.is_file() and not own.is_file():
        raise SourceNotFoundError(f"{name}: no preset and no file; presets are paper and physical")
    with resources.as_file(shipped) if shipped.is_file() else nullcontext(own) as path:
        values = read_yaml(path, UsageError) or {}
    if not isinstance(values, dict):
        raise UsageError(f"{name}: give settings of a simulation, e.g. preset: mine")
    try:
        return SimulationSettings(**values)
    except (TypeError, UsageError) as error:
        raise UsageError(f"{name}: {error}") from None


def settings_in(city: District, preset: str) -> SimulationSettings:
    """A preset (`load_preset`, which says what it raises) in a district that ships."""
    known = load_preset(preset)
    if city == OF_PRESETS:
        return known
    return known.model_copy(update={"city": known.city.of_district(city)})
