"""What the main job does: one YAML file, every field with its unit; unknown keys refused."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

import yaml
from pydantic import AfterValidator, Field, ValidationError, model_validator

from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.model.registry import COMPETITORS, DEFAULT, RECIPES, UNTRAINED
from tilestream.records import TruePose
from tilestream.sensor import SENSORS, Sensor
from tilestream.settings import IngestSettings, RegistrationSettings, Settings, StartSettings

Positive = Annotated[float, Field(gt=0.0)]
Name = Annotated[str, Field(pattern=r"^[\w][\w .+-]*$")]
"""Of a drive: it becomes a folder, so nothing that could lead out of one."""
MATCHERS = {
    "default": RegistrationSettings(),
    "autoware": RegistrationSettings.autoware(),
}


def _known(recipe: str) -> str:
    if recipe not in RECIPES:
        raise ValueError(f"is {recipe!r}: choose from {', '.join(RECIPES)}")
    return recipe


Recipe = Annotated[
    str,
    AfterValidator(_known),
    Field(
        description="What estimates the error: "
        + "; ".join(f"`{name}` ({COMPETITORS[name].words})" for name in RECIPES)
        + f". All but `{UNTRAINED}` are trained on the drives."
    ),
]
"""Name of a regressor."""


class SimulateSettings(Settings):
    """A simulated city instead of real files: its survey is the map, its drives are measured."""

    city: Literal["shinjuku"] = "shinjuku"
    """The city that ships with tilestream."""
    preset: str = "physical"
    """`physical`, `paper`, or a YAML file of simulation settings."""
    size: Literal["full", "small"] = "full"
    """`small`: the first 40 m of each path, and a thin survey."""
    drives: Annotated[int, Field(ge=1, le=16)] = 1
    """Drives of each path; from the second on they show how much any estimate can know."""
    paths: tuple[str, ...] | None = None
    """Only these streets; null: all."""
    scans_per_point: Annotated[int, Field(ge=1, le=64)] = 1
    """Turns of the lidar kept at each sample point."""
    seed: int = 0
    """Seed of everything that is simulated."""
    folder: str | None = None
    """Where it is kept; null: `simulation` in the run directory."""


class MapSettings(IngestSettings):
    """The map: what it is made from, and how it is cut into tiles."""

    sources: tuple[str, ...] = ()
    """Files, globs and map directories; empty with `simulate`: its survey."""
    store: str | None = None
    """Path or URL of the tile store; null: `map.zarr` in the run directory."""
    every: Annotated[int, Field(ge=1)] = 1
    """Every n-th scan of a log becomes the map …"""
    offset: Annotated[int, Field(ge=0)] = 0
    """… from this one on."""
    points_topic: str | None = None
    """Topic of the scans in logs; null: found by type."""
    pose_topic: str | None = None
    """Topic of the poses in logs; null: found by type."""


class DriveSettings(Settings):
    """A log on which errors are measured, maybe as if through a sensor that sees less."""

    log: str
    """An MCAP log with point clouds and poses."""
    name: Name | None = None
    """What to call it; null: the name of its file. Give each drive its own."""
    every: Annotated[int, Field(ge=1)] = 1
    """Every n-th scan of the log …"""
    offset: Annotated[int, Field(ge=0)] = 0
    """… from this one on."""
    from_s: Annotated[float, Field(ge=0.0)] = 0.0
    """Scans from this time on [s after the first]."""
    until_s: Positive | None = None
    """Scans before this time [s after the first]."""
    beams: Annotated[int, Field(ge=1)] | None = None
    """As if by a lidar of so many beams."""
    range_max: Positive | None = None
    """As if by one of this range [m]."""
    blind_rear_deg: Annotated[float, Field(ge=0.0, lt=360.0)] | None = None
    """As if blind at the rear [deg]."""
    deskew: bool = False
    """Whether the distortion of motion is removed first."""
    sweep_s: Positive | None = None
    """Duration of a turn [s], for logs without the time of each point."""
    points_topic: str | None = None
    """Topic of the scans; null: found by type."""
    pose_topic: str | None = None
    """Topic of the poses; null: found by type."""

    @property
    def group(self) -> str:
        """The name of its labels."""
        return self.name or Path(self.log).stem


class LabelSettings(Settings):
    """How errors are measured: the matcher decides them (definitions, section 5)."""

    matcher: Literal["default", "autoware"] | RegistrationSettings = "autoware"
    """`autoware` (production, the paper's kind), `default` (ours), or its settings."""
    starts: StartSettings = StartSettings()
    """Where registrations start."""
    true_pose: TruePose = "log"
    """The true pose as the log has it, or refined as the paper does."""

    @property
    def registration(self) -> RegistrationSettings:
        """The matcher's settings."""
        return MATCHERS[self.matcher] if isinstance(self.matcher, str) else self.matcher


class ModelSettings(Settings):
    """How the errors of the measured places become those of all places."""

    recipe: Recipe = DEFAULT
    offset: Annotated[float, Field(ge=0.0)] = 0.0
    """With `physics`: what a real scan adds to the error of a virtual one [m]."""
    use: str | None = None
    """A model file to use instead of training; null: train on the drives."""
    seed: int = 0
    """Seed of all that is random in training."""

    @property
    def untrained(self) -> bool:
        """Whether the virtual drive as it is makes the estimates."""
        return self.recipe == UNTRAINED


class ReportSettings(Settings):
    """What the report points out."""

    threshold: Positive = 0.25
    """Estimates above this are listed as segments [m]."""
    title: str | None = None
    """Its title; null: the name of the run directory."""


class RunSettings(Settings):
    """The main job: from map and drives to the estimated error of every sample point."""

    out: str
    """The run directory."""
    simulate: SimulateSettings | None = None
    """Simulate a city; null: real files."""
    map: MapSettings = MapSettings()
    """The map."""
    drives: tuple[DriveSettings, ...] = ()
    """The logs to measure on; empty with `simulate`: its drives."""
    routes: tuple[str, ...] = ()
    """Files of routes to estimate along; empty: those of the simulation, or of the drives; without
    drives, all lanes of a map directory with `lanelet2_map.osm` among the sources."""
    project_to: str | None = None
    """CRS for routes in degrees."""
    spacing: Positive = 1.0
    """Distance between sample points [m]."""
    sensor: str | Sensor = "VLP16"
    """The vehicle's lidar: a name, or its fields."""
    sensor_height: Annotated[float, Field(ge=0.0, le=10.0)] = 2.0
    """Height of the lidar above the road [m]."""
    cell_size: Positive = 2.0
    """Edge of an NDT cell [m]."""
    observe: VirtualSettings | None = VirtualSettings()
    """How the vehicle's lidar sees in the virtual drive: usable range, blind sector, starts; null:
    no virtual drive, the paper's factors and their twins only."""
    label: LabelSettings = LabelSettings()
    """How errors are measured."""
    model: ModelSettings = ModelSettings()
    """How they are estimated."""
    report: ReportSettings = ReportSettings()
    """What is reported."""
    memory: Annotated[int, Field(gt=0)] = 1_500_000_000
    """What one task may use [bytes]."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [drive.group for drive in self.drives]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"has two drives named {', '.join(twice)}: give each its own name")
        if self.simulate is None and not self.map.sources and self.map.store is None:
            raise ValueError("has no map: give map.sources (files), map.store, or simulate")
        if isinstance(self.sensor, str) and self.sensor not in SENSORS:
            known = ", ".join(SENSORS)
            raise ValueError(f"has the sensor {self.sensor!r}: known are {known}; or its fields")
        untrained = self.model.untrained
        if not (self.simulate or self.drives or self.model.use or untrained):
            raise ValueError("has nothing to learn from: give drives, simulate, or model.use")
        if untrained and (self.observe is None or self.model.use):
            raise ValueError(f"has model.recipe {UNTRAINED}, which needs observe and no model.use")
        if not (self.simulate or self.drives or self.routes or self.map.sources):
            raise ValueError("has no routes: give files of routes, or drives")
        return self

    @property
    def looking_sensor(self) -> Sensor:
        """The sensor's data."""
        return SENSORS[self.sensor] if isinstance(self.sensor, str) else self.sensor

    @property
    def folder(self) -> Path:
        """The run directory."""
        return Path(self.out)

    @property
    def store_url(self) -> str:
        """Where the tile store is."""
        return self.map.store or str(self.folder / "map.zarr")


def read_settings(path: str | os.PathLike[str], changes: Sequence[str] = ()) -> RunSettings:
    """The settings of a job from a YAML file; relative paths in it are from where one is.

    Args:
        path: the file.
        changes: `key=value` with dots between levels and YAML values, applied on top.

    Raises:
        SourceNotFoundError: no such file.
        UsageError: no YAML, an unknown key at any level (names the nearest right one), a value that
            cannot be.
    """
    place = Path(path)
    if not place.is_file():
        raise SourceNotFoundError(f"{place}: no such config; `tilestream template` prints one")
    try:
        values = yaml.safe_load(place.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{place}: no YAML: {error}") from None
    if not isinstance(values, dict):
        raise UsageError(f"{place}: give the fields of a job, e.g. out: run")
    for change in changes:
        _apply(values, change)
    try:
        return RunSettings(**values)
    except (UsageError, ValidationError, TypeError) as error:
        told = str(error).removeprefix(f"{RunSettings.__name__}: ")
        raise UsageError(f"{place}: {told}") from None


def _apply(values: dict[str, object], change: str) -> None:
    """Set one value; levels that are not there are made, and checked with the rest."""
    key, equals, text = change.partition("=")
    if not equals or not key:
        raise UsageError(f"{change!r}: give key=value, e.g. label.matcher=default")
    *levels, last = key.split(".")
    at = values
    for level in levels:
        below = at.setdefault(level, {})
        if not isinstance(below, dict):
            raise UsageError(f"{change!r}: {level} holds a value, nothing lies below it")
        at = below
    at[last] = yaml.safe_load(text)
