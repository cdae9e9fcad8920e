"""Simulate a city: survey blocks and drive logs, in tasks per stretch of street."""

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from tilestream.dataflow.plan import BASE_BYTES, Plan
from tilestream.dataflow.run import Watch, execute
from tilestream.dataflow.tasks import perform
from tilestream.errors import PartialError, PlanError, UsageError
from tilestream.formats.las import write_las
from tilestream.formats.mcap_write import write_log
from tilestream.formats.rows import writing_whole
from tilestream.records import Scan, Trajectory
from tilestream.simulation.city import City, build_city, data_file, stretches
from tilestream.simulation.drive import motion_of, odometry, scans, stamps_of
from tilestream.simulation.settings import SimulationSettings
from tilestream.simulation.streets import Street, check_clear, read_streets, street_called
from tilestream.simulation.survey import survey
from tilestream.version import VERSION

SCENE_BYTES = 1_500_000_000
"""Peak memory of the scene of a stretch with what is measured in it [bytes]."""
STRETCH = 50
"""Sample points of a stretch: a task's worth."""
SMALL_POINTS, SMALL_RAYS = 40, 4_000
"""Of `size="small"`: sample points of each path, rays per metre of the survey."""
MEMORY_PER_RAY = 100
"""Of a ray of the survey, in all its copies, until its stretch is written [bytes]."""
BYTES_PER_RAY, BYTES_PER_SCAN = 4, 400_000
"""On disk, generously: of a survey, and of a scan while it waits for its log [bytes]."""
POSE_NS = 50_000_000
"""Between two poses of the odometry [ns]."""
FIELDS = ("points", "intensity", "ring", "time_offset")
"""What a scan in a part file has."""
RECORD, ROUTES = "simulation.yaml", "routes.geojson"
"""Files that say what was simulated, and where its streets run."""
SIMULATION_VERSION = 1
"""Raised when the code of the simulation changes what it writes."""

Size = Literal["full", "small"]
"""How much of each path."""


@dataclass(frozen=True)
class Stretch:
    """A piece of a street that something is simulated along."""

    settings: str
    """The simulation's settings as JSON."""
    street: str
    begin: int
    """First sample point."""
    end: int
    """The one after the last."""
    path: str
    """The file to write; one that is there is finished."""
    needs: tuple[str, ...] = ()
    promised_bytes: int = BASE_BYTES + SCENE_BYTES

    @property
    def work(self) -> int:
        """Sample points."""
        return self.end - self.begin


@dataclass(frozen=True)
class SurveyTask(Stretch):
    """One pass of the mapping vehicle along a stretch: a block of LAZ."""

    passes: int = 0
    stage: str = "survey"

    @property
    def key(self) -> str:
        """`survey-<street>-<pass>-<first point>`."""
        return f"survey-{self.street}-{self.passes}-{self.begin}"


@dataclass(frozen=True)
class ScanTask(Stretch):
    """The scans of a drive along a stretch, kept until the log is written."""

    scans_per_point: int = 1
    stage: str = "scan"

    @property
    def key(self) -> str:
        """`scan-<street>-<first point>`."""
        return f"scan-{self.street}-{self.begin}"


@dataclass(frozen=True)
class LogTask(Stretch):
    """All scans of a drive along a street as one MCAP log."""

    parts: tuple[str, ...] = ()
    scans_per_point: int = 1
    stage: str = "log"

    @property
    def key(self) -> str:
        """`log-<street>`."""
        return f"log-{self.street}"


def simulate(
    settings: SimulationSettings,
    out: str | Path,
    *,
    paths: Sequence[str] | None = None,
    scans_per_point: int = 1,
    size: Size = "full",
    client: Any | None = None,
    watch: Watch | None = None,
) -> Path:
    """Simulate a survey of a city and drives through it.

    Writes `survey/*.laz` (the map, in blocks), `logs/drive<k>/<path>.mcap` (PointCloud2, Odometry,
    the true poses on `/ground_truth`), `routes.geojson` and `simulation.yaml` (the settings). The
    same settings give the same bytes, in this process or on any number of workers. What is there
    already is kept; another `drive` of the same city adds its logs.

    Args:
        settings: the experiment.
        out: the directory to write to.
        paths: the streets to simulate, by name; None: all, of which the driven ones are scanned.
        scans_per_point: turns of the lidar kept at each sample point.
        size: `small`: the first 40 m of each path and a thin survey, for demonstrations and tests.
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The directory.

    Raises:
        UsageError: an unknown path, a route through a building, or a directory that holds another
            simulation.
        PlanError: not enough space on the disk.
        PartialError: some tasks failed; the message lists them, the rest is there.
    """
    folder = Path(out)
    plan = plan_simulation(
        settings, folder, paths=paths, scans_per_point=scans_per_point, size=size
    )
    settings = _sized(settings, size)
    identity = _identity(settings, scans_per_point, size)
    _require_same(folder, identity)
    require_space(folder, _bytes_needed(plan, settings))
    city = _city(settings.model_dump_json())
    for street in city.streets:
        check_clear(street, city.footprints)
    _begin(folder, city, plan, identity)
    outcomes = execute(plan.tasks, client, watch)
    failures = {outcome.key: outcome.reason for outcome in outcomes if not outcome.ok}
    if failures:
        raise PartialError(f"{folder}: {len(failures)} tasks failed, the rest is done:", failures)
    shutil.rmtree(folder / "parts", ignore_errors=True)
    return folder


def plan_simulation(
    settings: SimulationSettings,
    out: str | Path,
    *,
    paths: Sequence[str] | None = None,
    scans_per_point: int = 1,
    size: Size = "full",
) -> Plan:
    """What `simulate` will run: surveys and scans of every stretch, then a log per driven street.

    Only the routes are read; no city is built and nothing is written. Arguments and errors as
    there.
    """
    if scans_per_point < 1 or scans_per_point > 64:
        raise UsageError(f"scans_per_point is {scans_per_point}: give 1 to 64")
    folder, settings = Path(out), _sized(settings, size)
    text = settings.model_dump_json()
    streets = read_streets(data_file(settings.city.routes))
    if paths is not None:
        streets = tuple(street_called(streets, name) for name in paths)
    tasks: list[SurveyTask | ScanTask | LogTask] = []
    logs: list[LogTask] = []
    for street in streets:
        end = len(street.xy) if size == "full" else min(len(street.xy), SMALL_POINTS)
        pieces = [(b, min(e, end)) for b, e in stretches(street, STRETCH) if b < end]
        for passes in range(settings.survey.passes):
            for begin, stop in pieces:
                path = folder / "survey" / f"{street.name}_{passes}_{begin:05d}.laz"
                tasks.append(
                    SurveyTask(
                        text,
                        street.name,
                        begin,
                        stop,
                        str(path),
                        promised_bytes=BASE_BYTES
                        + SCENE_BYTES
                        + (stop - begin) * settings.survey.rays_per_m * MEMORY_PER_RAY,
                        passes=passes,
                    )
                )
        log = folder / "logs" / f"drive{settings.drive}" / f"{street.name}.mcap"
        if not street.driven or log.exists():
            continue
        scan_tasks = [
            ScanTask(
                text,
                street.name,
                begin,
                stop,
                str(folder / "parts" / f"drive{settings.drive}_{street.name}_{begin:05d}.npz"),
                scans_per_point=scans_per_point,
            )
            for begin, stop in pieces
        ]
        tasks += scan_tasks
        logs.append(
            LogTask(
                text,
                street.name,
                0,
                end,
                str(log),
                needs=tuple(task.key for task in scan_tasks),
                parts=tuple(task.path for task in scan_tasks),
                scans_per_point=scans_per_point,
            )
        )
    largest = max((task.promised_bytes for task in (*tasks, *logs)), default=0)
    return Plan((*tasks, *logs), largest)


def _bytes_needed(plan: Plan, settings: SimulationSettings) -> int:
    """What the files that are not there yet may take, generously [bytes]."""
    needed = 0
    for task in plan.tasks:
        if isinstance(task, SurveyTask) and not Path(task.path).exists():
            needed += task.work * settings.survey.rays_per_m * BYTES_PER_RAY
        elif isinstance(task, ScanTask) and not Path(task.path).exists():
            needed += 2 * task.work * task.scans_per_point * BYTES_PER_SCAN
    return needed


def require_space(folder: Path, needed: int) -> None:
    """Refuse what would fill the disk half-way.

    Raises:
        PlanError: fewer than `needed` bytes are free where the folder is.
    """
    place = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    free = shutil.disk_usage(place).free
    if needed > free:
        raise PlanError(
            f"{folder}: the simulation may need {needed / 1e9:.1f} GB and {free / 1e9:.1f} GB are "
            "free: give another directory, fewer --paths or --size small"
        )


def _sized(settings: SimulationSettings, size: Size) -> SimulationSettings:
    """The settings that a size means."""
    if size == "full":
        return settings
    thin = settings.survey.model_copy(update={"rays_per_m": SMALL_RAYS})
    return settings.model_copy(update={"survey": thin})


def _identity(settings: SimulationSettings, scans_per_point: int, size: Size) -> dict[str, Any]:
    """All that decides what the files of a simulation hold, whatever their drive."""
    inputs = {
        name: hashlib.sha256(data_file(name).read_bytes()).hexdigest()
        for name in (settings.city.footprints, settings.city.routes)
    }
    return {
        "settings": settings.model_dump(mode="json", exclude={"drive", "note"}),
        "scans_per_point": scans_per_point,
        "size": size,
        "inputs_sha256": inputs,
        "tilestream": VERSION,
        "simulation_version": SIMULATION_VERSION,
    }


def _require_same(folder: Path, identity: dict[str, Any]) -> None:
    """Refuse to mix two simulations.

    Raises:
        UsageError: the folder holds one with another identity; names what differs.
    """
    record = folder / RECORD
    if not record.exists():
        return
    try:
        known = yaml.safe_load(record.read_text())
        there = {name: known.get(name) for name in identity}
    except (yaml.YAMLError, AttributeError):
        raise UsageError(f"{record} is no record of a simulation: give another directory") from None
    other = [f"{name} {there[name]}" for name in identity if there[name] != identity[name]]
    if other:
        raise UsageError(
            f"{folder} holds another simulation, with {'; '.join(other)} ({record}): give another "
            "directory"
        )


def _begin(folder: Path, city: City, plan: Plan, identity: dict[str, Any]) -> None:
    """Make the folders; write what is simulated, and the routes."""
    for part in {Path(task.path).parent for task in plan.tasks if isinstance(task, Stretch)}:
        part.mkdir(parents=True, exist_ok=True)
    facts = identity | {
        "note": city.settings.note,
        "buildings": len(city.footprints.height),
        "buildings_left_out": dict(city.footprints.refused),
        "attribution": city.footprints.attribution,
    }
    end = SMALL_POINTS if identity["size"] == "small" else None
    features = [_feature(street, city, end) for street in city.streets]
    routes = {"type": "FeatureCollection", "features": features}
    _keep(folder / ROUTES, f"{json.dumps(routes)}\n")
    _keep(folder / RECORD, yaml.safe_dump(facts, sort_keys=True, allow_unicode=True))


def _keep(path: Path, text: str) -> None:
    """Write a file whole, unless it says so already: its time tells readers of a change."""
    if not path.exists() or path.read_bytes() != text.encode():
        with writing_whole(path) as file:
            file.write(text.encode())


def _feature(street: Street, city: City, end: int | None) -> dict[str, Any]:
    """A street as GeoJSON, as far as it is simulated, with the height of its road."""
    motion = motion_of(street, city.settings, 0.0)
    line = motion.pose(city.ground, street.arc[:end])[:, :3, 3]
    properties = {
        "name": street.name,
        "kind": street.kind,
        "driven": street.driven,
        "spots": [vars(spot) for spot in street.spots],
    }
    geometry = {"type": "LineString", "coordinates": np.round(line, 3).tolist()}
    return {
        "type": "Feature",
        "id": street.name,
        "properties": properties,
        "geometry": geometry,
    }


@lru_cache(maxsize=1)
def _city(settings: str) -> City:
    return build_city(SimulationSettings.model_validate_json(settings), check=False)


@perform.register
def _survey(task: SurveyTask) -> int:
    if Path(task.path).exists():
        return 0
    city = _city(task.settings)
    points = survey(city, city.street(task.street), (task.begin, task.end), task.passes)
    write_las(task.path, points)
    return len(points)


@perform.register
def _scan(task: ScanTask) -> int:
    if Path(task.path).exists():
        return 0
    city = _city(task.settings)
    street, count = city.street(task.street), 0
    arrays: dict[str, Any] = {}
    for scan in scans(city, street, (task.begin, task.end), task.scans_per_point):
        for name in FIELDS:
            arrays[f"{name}_{count}"] = np.asarray(getattr(scan, name))
        arrays[f"points_{count}"] = scan.points.astype(np.float32)
        arrays[f"stamp_{count}"] = np.int64(scan.stamp_ns)
        count += 1
    with writing_whole(task.path) as file:
        np.savez(file, allow_pickle=False, count=np.int64(count), **arrays)
    return count


@perform.register
def _log(task: LogTask) -> int:
    if Path(task.path).exists():
        return 0
    city = _city(task.settings)
    street, settings = city.street(task.street), city.settings
    motion = motion_of(street, settings, settings.lidar.height)
    stamps = stamps_of(motion, settings, task.scans_per_point)
    origin = round(stamps[0].mean())
    seen = stamps[: task.end].ravel()
    every = np.arange(seen[0], seen[-1] + 2 * POSE_NS, POSE_NS)
    # The truth also has a pose at each scan and half-way: more than the odometry, so readers that
    # are told no topic take it.
    often = np.unique(np.concatenate([seen, every, every[:-1] + POSE_NS // 2]))
    believed, truth = (
        Trajectory(times, motion.pose(city.ground, motion.arc_at((times - origin) / 1e9)), "lidar")
        for times in (every, often)
    )
    part = Path(task.path).with_suffix(".part")
    write_log(part, _parts(task), odometry(city, believed, street), truth=truth)
    part.replace(task.path)
    return len(seen)


def _parts(task: LogTask) -> Any:
    for path in task.parts:
        with np.load(path) as part:
            for number in range(int(part["count"])):
                values = {name: part[f"{name}_{number}"] for name in FIELDS}
                yield Scan(int(part[f"stamp_{number}"]), **values)
