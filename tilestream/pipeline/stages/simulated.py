"""Survey, scan, log: a city is simulated stretch by stretch of its streets."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.files import Files
from tilestream.formats.logs import write_log
from tilestream.formats.points.las import write_las
from tilestream.marks import hash_of
from tilestream.pipeline.engine.outputs import Facts, Made
from tilestream.pipeline.engine.stage import Counts, stage
from tilestream.records import Column, Scan, Trajectory
from tilestream.simulation.city import City, build_city
from tilestream.simulation.drive import driven_way, motion_of, odometry, stamps_of
from tilestream.simulation.drive import scans as scans_of
from tilestream.simulation.settings import SimulationSettings
from tilestream.simulation.survey import survey as survey_of

SCENE_BYTES = 1_500_000_000
"""Peak memory of the scene of a stretch with what is measured in it [bytes]."""
BYTES_PER_RAY = 100
"""Memory of a ray of the survey, in all its copies, until its stretch is written [bytes]."""
POSE_NS = 50_000_000
"""Between two poses of the odometry [ns]."""
FIELDS = ("points", "intensity", "ring", "time_offset")
"""What a scan in a part file has."""


@dataclass(frozen=True)
class SimulatedCity:
    """A city as tasks read it: built where they run, kept for the next one."""

    settings: str
    """`SimulationSettings` as JSON."""
    makers: tuple[str, ...] = ()

    @property
    def identity(self) -> str:
        """Hash of its settings."""
        return hash_of(self.settings)

    def read(self) -> City:
        """The city."""
        return _city(self.settings)

    def counts(self) -> Counts:
        """What the plan knows too."""
        return {}


@lru_cache(maxsize=1)
def _city(settings: str) -> City:
    return build_city(SimulationSettings.model_validate_json(settings))


@dataclass(frozen=True)
class _WholeFile:
    """A file that is whole where it is there: the folder's record says of which simulation."""

    path: str

    def known(self, identity: str) -> Facts | None:  # noqa: ARG002 - see the class
        """Whether it is there."""
        return {} if Path(self.path).exists() else None


@dataclass(frozen=True)
class SurveyBlock(_WholeFile):
    """A block of the survey: LAZ."""

    crs: str | None = None
    """That its header names."""

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """Write its points."""
        write_las(self.path, made.value, crs=self.crs)
        return {"points": len(made.value)}

    def read(self) -> Any:
        """An ingest reads it."""
        raise NotImplementedError


@dataclass(frozen=True)
class ScanParts(_WholeFile):
    """The scans of a stretch, kept until their log is written."""

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """Write the scans, float32 as a log has them."""
        arrays: dict[str, Any] = {}
        count = 0
        for scan in made.value:
            for name in FIELDS:
                arrays[f"{name}_{count}"] = np.asarray(getattr(scan, name))
            arrays[f"points_{count}"] = scan.points.astype(np.float32)
            arrays[f"stamp_{count}"] = np.int64(scan.stamp_ns)
            count += 1
        with Files.at(self.path).writing() as file:
            np.savez(file, allow_pickle=False, count=np.int64(count), **arrays)
        return {"scans": count}

    def read(self) -> Iterator[Scan]:
        """The scans."""
        with np.load(self.path) as part:
            for number in range(int(part["count"])):
                values = {name: part[f"{name}_{number}"] for name in FIELDS}
                yield Scan(int(part[f"stamp_{number}"]), **values)


@dataclass(frozen=True)
class DriveLog(_WholeFile):
    """A drive: an MCAP log with scans, odometry and the true poses."""

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """Write scans, odometry and truth."""
        scans, believed, truth = made.value
        write_log(self.path, scans, believed, truth=truth)
        return made.facts

    def read(self) -> Any:
        """A job reads it."""
        raise NotImplementedError


@stage(
    "survey",
    version=3,
    memory=lambda counts: SCENE_BYTES + counts["rays"] * BYTES_PER_RAY,
    seconds=0.07,
)
def survey(city: City, street: str, stretch: tuple[int, int], passes: int) -> Any:
    """One pass of the mapping vehicle along a stretch of a street: (n, 3) points [m]."""
    found = survey_of(city, city.street(street), stretch, passes)
    return found + city.settings.city.shift


@stage("scan", version=1, memory=lambda _: SCENE_BYTES, seconds=0.03)
def scan(
    city: City, street: str, stretch: tuple[int, int], scans_per_point: int, every: int
) -> Iterable[Scan]:
    """The scans of a drive along a stretch of a street, from where it begins."""
    way = driven_way(city.street(street), city.settings)
    return scans_of(city, way, scanned(stretch, every), scans_per_point)


def scanned(stretch: tuple[int, int], every: int) -> range:
    """The sample points of a stretch that are scanned: those whose number `every` divides."""
    begin, end = stretch
    return range(-(-begin // every) * every, end, every)


@stage("log", version=2, memory=lambda _: SCENE_BYTES, seconds=0.02)
def log(
    city: City,
    parts: Sequence[Iterator[Scan]],
    street: str,
    stretch: tuple[int, int],
    scans_per_point: int,
    every: int,
) -> Made:
    """All scans of a drive along a stretch of a street, its odometry and its truth."""
    settings = city.settings
    driven = driven_way(city.street(street), settings)
    motion = motion_of(driven, settings, settings.lidar.height)
    stamps = stamps_of(motion, settings, scans_per_point)
    origin = round(stamps[0].mean())
    seen = stamps[scanned(stretch, every)].ravel()
    regular = np.arange(seen[0], seen[-1] + 2 * POSE_NS, POSE_NS)
    # The truth also has a pose at each scan and half-way: more than the odometry, so readers that
    # are told no topic take it.
    often = np.unique(np.concatenate([seen, regular, regular[:-1] + POSE_NS // 2]))
    believed, truth = (
        Trajectory(times, motion.pose(city.ground, motion.arc_at((times - origin) / 1e9)), "lidar")
        for times in (regular, often)
    )
    scans = (scan for part in parts for scan in part)
    poses = [_shifted(one, city) for one in (odometry(city, believed, driven), truth)]
    return Made((scans, *poses), {"scans": len(seen)})


def _shifted(poses: Trajectory, city: City) -> Trajectory:
    T = poses.T_map_lidar.copy()
    T[:, :3, 3] += city.settings.city.shift
    return replace(poses, T_map_lidar=T)
