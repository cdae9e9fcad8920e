"""Every knob of the jobs, once: name, unit, meaning and default.

The YAML file of a job puts them together (`RunSettings` in `pipeline/jobs/run_settings.py`, with
the choice of the model); those of the matcher are in `matcher.py`. The options of the command line
are made from these fields (`cli/fields.py`), and the keywords of the Python jobs have the same
names and defaults (tests/test_settings.py). The simulated city has a file of its own
(`simulation/settings.py`).
"""

import math
import reprlib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from tilestream.config import Settings
from tilestream.errors import UsageError
from tilestream.files import local_path, place_of
from tilestream.matcher import MATCHERS, Positive, RegistrationSettings, matcher_named
from tilestream.records import LEAST_SPACING, District, RouteZ, TruePose
from tilestream.sensor import SENSORS, Carrier, Mount, Sensor, Vehicle, named

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Degrees = Annotated[float, Field(ge=0.0, lt=360.0)]
NAME = r"^[\w][\w .+-]*$"
Name = Annotated[str, Field(pattern=NAME)]
"""Of a drive: it becomes a folder, so nothing that could lead out of one."""


def _file_of(path: str) -> str:
    return place_of(local_path(path))


Place = Annotated[str, AfterValidator(place_of)]
"""A place to write to or read from: made absolute here, where it enters, or a URL."""
LocalFile = Annotated[str, AfterValidator(_file_of)]
"""A file or a glob that is read from a disk, made absolute here."""


def bytes_of(amount: object) -> object:
    """`512MB` or `2GB` as bytes (powers of ten); what is no text stays as it is.

    Raises:
        UsageError: a text that is not of that form.
    """
    if not isinstance(amount, str):
        return amount
    text = amount.strip().upper()
    for unit, factor in (("KB", 10**3), ("MB", 10**6), ("GB", 10**9), ("TB", 10**12)):
        number = text.removesuffix(unit)
        if number != text:
            try:
                count = int(float(number) * factor)
            except (ValueError, OverflowError):
                break
            if count > 0:
                return count
    raise UsageError(f"{amount!r} is no amount of memory: give a form like 512MB or 2GB")


Bytes = Annotated[int, BeforeValidator(bytes_of), Field(gt=0)]
"""An amount of memory, as a number or as `1.5GB`."""
MEMORY = "2GB"
"""What a task may use where the user promises nothing else: a tile of a dense city at 0.2 m with
those around it needs 1.6 GB."""


def _six_numbers(given: object) -> object:
    """A mount as it is written, `x,y,z,roll,pitch,yaw`, also from a list of the six numbers."""
    if given is None:
        return None
    parts = given.split(",") if isinstance(given, str) else given
    try:
        numbers = [float(part) for part in parts] if isinstance(parts, list | tuple) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise ValueError(
            f"is {reprlib.repr(given)}: give x,y,z,roll,pitch,yaw, in metres and degrees"
        )
    return ",".join(repr(number) for number in numbers)


class LogOptions(Settings):
    """How a log is read: which of its topics, and what its frames are."""

    points_topic: str | None = None
    """Topic of the scans in a log, or those of all lidars of the vehicle, with commas between them:
    their scans make one each, in the frame of the first; not given: found by what looks like the
    full turn of a lidar."""
    pose_topic: str | None = None
    """Topic of the poses in a log, also one of tf; not given: found by type."""
    map_frame: str | None = None
    """Frame of a log that is the map's; not given: `map`, or the one root of its frames that is not
    an odometry's."""
    pose_frame: str | None = None
    """Frame whose poses a log has; not given: as the log says, or as its transforms show."""
    lidar_frame: str | None = None
    """Frame of the point clouds, where a log names none or a wrong one."""
    extrinsic: Annotated[str | None, BeforeValidator(_six_numbers)] = None
    """Pose of the lidar in the frame that a log poses, as x,y,z,roll,pitch,yaw in metres and
    degrees (R = Rz Ry Rx, as a mount); not given: by the transforms of the log."""
    max_gap_s: Positive = 1.0
    """Longest time between two poses of a log that is interpolated over [s]."""
    max_speed_mps: Positive = 60.0
    """Fastest that the vehicle of a log drives [m/s]: over a faster step no pose is interpolated,
    and a route is cut."""

    @model_validator(mode="after")
    def _check_lidars(self) -> Self:
        if "," in (self.points_topic or "") and (self.extrinsic or self.lidar_frame):
            raise ValueError(
                f"has several lidars, {self.points_topic}, and extrinsic or lidar_frame, which are "
                "those of one: leave them out, so that the transforms of the log are taken"
            )
        return self

    @property
    def given(self) -> dict[str, Any]:
        """What is not the default, by name: what a log's data depend on besides its file."""
        return self.model_dump(exclude_defaults=True, include=set(LogOptions.model_fields))

    @property
    def log_options(self) -> "LogOptions":
        """These options alone, where they are part of more settings."""
        return LogOptions(**self.given)

    @property
    def mount(self) -> Mount | None:
        """The pose of the lidar in the frame that is posed, if it is given (`extrinsic`)."""
        if self.extrinsic is None:
            return None
        numbers = [float(part) for part in self.extrinsic.split(",")]
        return Mount(**dict(zip(Mount.model_fields, numbers, strict=True)))


class LogSettings(LogOptions):
    """Which scans of a log are used. Two choices with the same `every` and another `offset`, or one
    `until_s` and the other `from_s` the same time, share no scan: one maps, one localizes.
    """

    every: Annotated[int, Field(ge=1)] = 1
    """Use every n-th scan of a log …"""
    offset: Annotated[int, Field(ge=0)] = 0
    """… from this one on: another offset uses other scans."""
    from_s: Annotated[float, Field(ge=0.0)] = 0.0
    """Use the scans of a log from this time on [s after its first]."""
    until_s: Positive | None = None
    """Use the scans of a log before this time [s after its first]; not given: to the end."""

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(
                f"has from_s {self.from_s:g} and until_s {self.until_s:g}: give a later until_s"
            )
        return self


class IngestSettings(Settings):
    """How a map is cut into tiles."""

    tile_size: float = 100.0
    """Edge of a tile [m], whole millimetres, a multiple of every cell size that will be used."""
    halo: float = 10.0
    """What tasks read around a tile [m]; 10 m is the reach of the terms of 2 m cells."""
    map_leaf: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.2
    """Edge of the voxels that the map is thinned to, one centroid each [m]; 0 keeps all points."""
    crs: str | None = None
    """CRS of the map, any string that pyproj reads; not given: that of the sources."""
    keep_noise: bool = False
    """Keep the points of LAS files that are of a class of noise (7 or 18), or withheld."""


class MapSettings(IngestSettings, LogSettings):
    """The map: what it is made from, and how it is cut into tiles."""

    sources: tuple[LocalFile, ...] = ()
    """Files, globs and map directories; empty with `simulate`: its survey."""
    store: Place | None = None
    """Path or URL of the tile store; not given: `map.zarr` in the run directory."""
    partial: bool = False
    """Go on with a map that is half-made or has lost tiles; places that could see a gap say so."""


class DriveSettings(LogSettings):
    """A log on which errors are measured, maybe through a degraded sensor."""

    log: LocalFile
    """A log with point clouds and poses: a file, or the folder of a rosbag2."""
    name: Name | None = None
    """What to call it; not given: the name of its file. Give each drive its own."""
    beams: Annotated[int, Field(ge=1)] | None = None
    """As if by a lidar of so many beams; not given: as recorded."""
    range_max: Positive | None = None
    """As if by one of this range [m]; not given: as recorded."""
    blind_rear_deg: Degrees | None = None
    """As if blind in this sector to the rear [deg]; not given: as recorded."""
    deskew: bool = False
    """Remove the distortion of motion first."""
    sweep_s: Positive | None = None
    """Duration of a turn [s], for logs without the time of each point."""

    @property
    def group(self) -> str:
        """The name of its labels."""
        return self.name or Path(self.log).stem

    @property
    def degraded(self) -> str:
        """As if by which lidar it is read, e.g. `16beams-30m-rear120`; empty: as recorded."""
        parts = (
            f"{self.beams}beams" if self.beams else "",
            f"{self.range_max:.10g}m" if self.range_max else "",
            f"rear{self.blind_rear_deg:.10g}" if self.blind_rear_deg else "",
        )
        return "-".join(part for part in parts if part)


class StartSettings(Settings):
    """The starts around a true pose: the paper's initial guess particles (its section VI)."""

    radius: float = Field(default=2.0, ge=0.0)
    """Radius of the disc of starts in map x and y [m]."""
    step: float = Field(default=0.2, gt=0.0)
    """Spacing of the starts on it [m]."""
    yaw: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    """Turns about the map's z axis; every start is tried with each [rad]."""
    z: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    """Offsets in map z; every start is tried with each [m]."""


class VirtualSettings(Settings):
    """How a vehicle sees with its sensor, and how it is started in the virtual drive."""

    range_max: Positive | None = None
    """Usable range [m], no more than the sensor's; not given: the sensor's, as far as a model in
    use was trained over it."""
    range_min: Annotated[float, Field(ge=0.0)] = 0.9
    """Surfels nearer than this are ignored: the vehicle itself is there [m]."""
    blind_rear_deg: Degrees = 0.0
    """Sector to the rear that the vehicle hides [deg]."""
    fading_from: Share = 0.6
    """Share of the usable range beyond which returns are lost …"""
    fading: Share = 0.6
    """… up to this share of them at its end, linearly."""
    grazing_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 75.0
    """Angle of incidence beyond which returns are lost, more as its cosine falls to 0 [deg]."""
    without_ghosts: bool = True
    """Whether traffic that the survey recorded is left out of the scan (ghosts); some thin objects
    such as posts are left out with it."""
    draws: Annotated[int, Field(ge=1, le=100)] = 5
    """Scans of the virtual drive at a place, each with other noise and other starts …"""
    worlds: Annotated[int, Field(ge=0)] = 2
    """… of which so many are taken in streets that are not as they were mapped: other cars, people,
    motion, bias, returns lost."""
    starts: Annotated[int, Field(ge=8)] | None = 32
    """Starts of each of them, spread over the disc of starts; null: all of them."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of noise, drop-outs and streets; the place is part of it too."""

    @model_validator(mode="after")
    def _check_worlds(self) -> Self:
        if self.worlds > self.draws:
            raise ValueError(f"worlds {self.worlds}: give no more than draws, {self.draws}")
        return self


class CoarseSettings(Settings):
    """Coarse first: which places are evaluated, by a virtual drive (definitions, section 4.6)."""

    every: Annotated[int, Field(ge=2)] = 8
    """First about one place in so many is evaluated: some in groups, with all that the model reads
    of their neighbours, some alone, to see what lies between."""
    tolerance: Positive = 0.05
    """Places between two groups are interpolated where all that is known there is so near to the
    line between them [m]; a check tells how often an interpolated one is farther off …"""
    high: Positive = 0.2
    """… and where none is above this [m]."""
    checks: Annotated[int, Field(ge=0)] = 200
    """So many interpolated places are evaluated for that check, at most one in 50 of them."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the choice of these."""


class LabelSettings(Settings):
    """How errors are measured: the matcher decides them (definitions, section 5)."""

    matcher: Annotated[str | RegistrationSettings, BeforeValidator(matcher_named)] = "autoware"
    """The matcher: `autoware` (production, the paper's kind), `default` (ours), its settings, or
    Autoware's own ndt_scan_matcher.param.yaml, or a folder with it and the filters of its scans."""
    starts: StartSettings = StartSettings()
    """Where registrations start."""
    true_pose: TruePose = "log"
    """The true pose: as the log has it, or refined as the paper does."""
    scans_per_point: Annotated[int, Field(ge=1, le=64)] = 1
    """Scans that are measured at each sample point, as many as there are within 0.5 m along the
    drive; its label is the mean over all of them."""
    allow_overlap: bool = False
    """Measure also with scans that the map was made of, whose errors are too small."""

    @property
    def registration(self) -> RegistrationSettings:
        """The matcher's settings."""
        return MATCHERS[self.matcher] if isinstance(self.matcher, str) else self.matcher


class SimulateSettings(Settings):
    """A simulated city instead of real files: its survey is the map, its drives are measured."""

    city: District = "shinjuku"
    """The district: `shinjuku` has the paper's five paths, `sendagaya` three other streets."""
    preset: str = "physical"
    """`physical`, `paper`, or a YAML file of simulation settings."""
    size: Literal["full", "small"] = "full"
    """`small`: the first 40 m of each path, and a thin survey."""
    drives: Annotated[int, Field(ge=1, le=16)] = 1
    """Drives of each path; from the second on they show how much any estimate can know."""
    paths: tuple[str, ...] | None = None
    """Only these streets; not given: all."""
    scans_per_point: Annotated[int, Field(ge=1, le=64)] = 1
    """Turns of the lidar kept at each sample point."""
    every: Annotated[int, Field(ge=1)] = 1
    """Only each so-many-th sample point, of which there is one per metre, is scanned."""
    survey_of: LocalFile | None = None
    """The folder of a simulation of the same city: its survey is the map, none is simulated."""
    seed: int = 0
    """Seed of everything that is simulated."""
    folder: LocalFile | None = None
    """Where it is kept, on a disk; not given: `simulation` in the run directory."""


class ReportSettings(Settings):
    """What the report points out."""

    threshold: Positive = 0.25
    """Estimates above this are listed as segments [m]."""
    title: str | None = None
    """Its title; not given: the name of the run directory."""
    own_range: bool = False
    """Colours of the run's own range of errors, instead of steps at 5, 10, 15, 20, 25 and 50 cm as
    in every report."""


PREDICTION_ERROR = 0.3
"""How far off a filter predicts its pose where nobody says it [m]."""


class PlaceSettings(Settings):
    """Where a job looks from, and the vehicle that looks."""

    project_to: str | None = None
    """CRS to project routes to that are in degrees or in another one; not given: the map's."""
    spacing: Annotated[float, Field(ge=LEAST_SPACING)] = 1.0
    """Distance between sample points [m]."""
    sensor: Annotated[str | Sensor | Vehicle, BeforeValidator(named)] = "VLP16"
    """The vehicle's lidar: a name that ships, a YAML file, its fields, or a list of these, each
    with its mount."""
    sensor_height: Annotated[float, Field(ge=0.0, le=10.0)] = 2.0
    """Height of the lidar above the road [m]; with a mount, of the vehicle's origin."""
    route_z: RouteZ = "ground"
    """What z of a route is: `ground` takes the ground of the map that is nearest to it, `road` and
    `lidar` take it as it is."""
    cell_size: Positive = 2.0
    """Edge of an NDT cell [m]."""
    prediction_error: Annotated[float, Field(gt=0.0, le=2.0)] = PREDICTION_ERROR
    """How far off the vehicle's filter predicts its pose, from which a registration then starts:
    standard deviation in map x and in y [m]. Covariances are of such registrations."""
    memory: Bytes = Field(default=MEMORY, validate_default=True)
    """What one task may use [bytes], also as 512MB or 2GB."""

    def cells_for(self, matcher: RegistrationSettings) -> float:
        """Edge of an NDT cell: the one that the matcher wants, if it wants one [m].

        Raises:
            UsageError: another one was given.
        """
        if "cell_size" in self.model_fields_set or matcher.resolution is None:
            matcher.require_cells(self.cell_size)
            return self.cell_size
        return matcher.resolution

    @property
    def vehicle(self) -> Carrier:
        """The data of its sensor, or sensors."""
        return SENSORS[self.sensor] if isinstance(self.sensor, str) else self.sensor

    @property
    def looking_sensor(self) -> Sensor:
        """The sensor as which the paper's factors look: the first."""
        return self.vehicle.sensors[0]


DEFAULT_MEMORY = PlaceSettings().memory
"""`MEMORY` in bytes."""
