"""What the main job works on: its settings and files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.formats import require_format
from tilestream.formats.logs import ScanSelection, is_log
from tilestream.formats.routes import RoutesRead
from tilestream.notes import Notes, noticed
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.jobs.ingest import read_sources
from tilestream.pipeline.jobs.map_reading import Reading
from tilestream.pipeline.jobs.run_routes import routes_in, routes_of_map
from tilestream.pipeline.jobs.run_settings import RunSettings, one_of_each
from tilestream.pipeline.jobs.simulate import simulate
from tilestream.pipeline.jobs.sources import ingest_settings, scans_of
from tilestream.pipeline.stages.drive_scans import Reading as DriveReading
from tilestream.pipeline.stages.observe import Observing
from tilestream.records import Route
from tilestream.report.drives import DriveMeasured
from tilestream.sensor import Sensor
from tilestream.settings import (
    DriveSettings,
    SimulateSettings,
    VirtualSettings,
)
from tilestream.simulation.settings import SimulationSettings, load_preset, settings_in
from tilestream.store import open_store, require_folder

JOB = "job"
"""What notes are filed under that are about the job as a whole."""


@dataclass(frozen=True)
class Inputs:
    """What the main job works on, whether simulated or real."""

    sources: tuple[str, ...]
    """What the map is made from; empty: a store that is there."""
    drives: tuple[DriveSettings, ...]
    """The logs to measure on."""
    routes: tuple[Route, ...]
    """Where to estimate."""
    route_files: tuple[str, ...] = ()
    """The files that the routes are of."""
    notes: Notes = field(default_factory=dict)
    """What a reader of the results must know, by source."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """Which routes are left out, and why."""
    to_measure: tuple[DriveMeasured, ...] = ()
    """The scans of each drive, as soon as its log is opened."""
    mapped: tuple[str, ...] = ()
    """The drives of which scans that are measured are in the map."""
    attributions: tuple[str, ...] = ()
    """Whose data it is."""


def inputs_of(settings: RunSettings, client: Any | None, watch: Watch | None) -> Inputs:
    """The files of a job; a simulated city is simulated first, as far as it is not there.

    Raises:
        UsageError: no routes, or all shorter than the spacing.
        SourceError: a file that is not there, or none of the routes can be used.
    """
    if settings.simulate is None:
        drives, again = one_of_each(settings.drives)
        files = settings.routes or tuple(dict.fromkeys(drive.log for drive in drives))
        if not files:
            read, found, note = routes_of_map(settings)
            return _inputs(settings.map.sources, drives, read, found, {JOB: [note]})
        read = routes_in(files, settings, settings.map.sources).at_least(settings.spacing)
        told = {JOB: [*again, *_other_lidars(settings)]}
        return _inputs(settings.map.sources, drives, read, files, told)
    folder = simulated_folder(settings)
    wanted = settings.simulate
    for drive in simulations(wanted):
        simulate(drive, folder, **extent(wanted), client=client, watch=watch)
    preset = load_preset(wanted.preset)
    surveyed = Path(wanted.survey_of) if wanted.survey_of else folder
    sources = settings.map.sources or (str(surveyed / "survey" / "*.laz"),)
    files = settings.routes or (str(folder / "routes.geojson"),)
    read = routes_in(files, settings, sources)
    if wanted.paths is not None and not settings.routes:
        asked = tuple(route for route in read.routes if route.route_id in wanted.paths)
        read = replace(read, routes=asked)
    inputs = _inputs(
        sources,
        drives_of(settings),
        read.at_least(settings.spacing),
        files,
        {JOB: [f"simulated, preset {preset.preset}: {preset.note}"]},
    )
    return replace(inputs, attributions=(ATTRIBUTION,))


def _inputs(
    sources: tuple[str, ...],
    drives: tuple[DriveSettings, ...],
    read: RoutesRead,
    files: Sequence[str],
    notes: Notes,
) -> Inputs:
    """The files of a job, with what is to be told of its routes, which are of these files."""
    left_out = [f"{name} is left out: {reason}" for name, reason in read.failures.items()]
    told = noticed(notes, read.notes_of(files), {"routes": left_out})
    return Inputs(sources, drives, read.routes, tuple(files), told, failures=read.failures)


def _other_lidars(settings: RunSettings) -> list[str]:
    """A note for each drive that is labelled with another number of lidars than the vehicle has."""
    has = len(settings.vehicle.sensors)
    named = {drive.group: len((drive.points_topic or "").split(",")) for drive in settings.drives}
    return [
        f"drive {group} is labelled with the scans of {lidars} of its lidars, the vehicle is "
        f"observed with {has}: name a topic for each in points_topic"
        for group, lidars in named.items()
        if lidars != has
    ]


def simulations(wanted: SimulateSettings) -> list[SimulationSettings]:
    """The experiment of each drive."""
    preset = settings_in(wanted.city, wanted.preset).model_copy(update={"seed": wanted.seed})
    return [preset.model_copy(update={"drive": drive}) for drive in range(wanted.drives)]


def extent(wanted: SimulateSettings) -> dict[str, Any]:
    """How much of the city is simulated, as `simulate` and its plan take it."""
    return {
        "paths": wanted.paths,
        "scans_per_point": wanted.scans_per_point,
        "every": wanted.every,
        "survey_of": wanted.survey_of,
        "size": wanted.size,
    }


ATTRIBUTION = (
    "Building footprints: MLIT Project PLATEAU by way of indigo-lab/plateau-lod2-mvt, clipped, "
    "CC BY 4.0."
)


def drives_of(settings: RunSettings) -> tuple[DriveSettings, ...]:
    """The drives of a job; of a simulated city those that are there, where none are given."""
    wanted = settings.simulate
    if settings.drives or wanted is None:
        return settings.drives
    return tuple(
        DriveSettings(log=str(log), name=f"drive{drive}-{log.stem}")
        for drive in range(wanted.drives)
        for log in sorted((simulated_folder(settings) / "logs" / f"drive{drive}").glob("*.mcap"))
        if wanted.paths is None or log.stem in wanted.paths
    )


def simulated_folder(settings: RunSettings) -> Path:
    """Where a simulated city is kept.

    Raises:
        UsageError: nowhere on a disk.
    """
    assert settings.simulate is not None
    folder = settings.simulate.folder
    if folder is None and not settings.folder.local:
        raise UsageError(f"{settings.out}: a city is simulated to a disk: give simulate.folder")
    return Path(folder or f"{settings.out}/simulation")


def read_map(settings: RunSettings, inputs: Inputs) -> Reading | None:
    """The map's sources, to be read; None: the store that is there is the map.

    Raises:
        SourceError, PlanError: as `ingest`.
    """
    if not inputs.sources:
        return None
    return read_sources(
        inputs.sources,
        settings.store_url,
        ingest_settings(settings.map),
        settings.memory,
        settings.map.log_options,
        map_scans(settings, inputs),
    )


def map_scans(settings: RunSettings, inputs: Inputs) -> ScanSelection | None:
    """Which scans of logs become the map; None: there are no logs among the sources."""
    if any(map(is_log, inputs.sources)):
        return scans_of(settings.map)
    return None


def is_simulated(settings: RunSettings) -> bool:
    """Whether the simulated city is there, every drive of it."""
    assert settings.simulate is not None
    folder = simulated_folder(settings)
    drives = [folder / "logs" / f"drive{drive}" for drive in range(settings.simulate.drives)]
    return (folder / "routes.geojson").exists() and all(any(d.glob("*.mcap")) for d in drives)


def observing_of(settings: RunSettings, seeing: VirtualSettings) -> Observing:
    """What the virtual drive is made with: the vehicle's lidar and its matcher."""
    return Observing(
        settings.vehicle,
        seeing,
        settings.label.registration,
        settings.cell_size,
        settings.sensor_height,
        settings.route_z,
    )


def observing_drive(
    settings: RunSettings, seeing: VirtualSettings, drive: DriveSettings
) -> Observing:
    """What a drive is observed with: the vehicle's lidar, as far as the drive is read as a simpler
    one; that of the vehicle itself where it is not.

    Raises:
        UsageError: fewer beams of a vehicle of several sensors.
    """
    vehicle = observing_of(settings, seeing)
    changes: dict[str, float] = {}
    if drive.range_max is not None and drive.range_max < vehicle.range_max:
        changes["range_max"] = drive.range_max
    if drive.blind_rear_deg is not None and drive.blind_rear_deg > seeing.blind_rear_deg:
        changes["blind_rear_deg"] = drive.blind_rear_deg
    sensor = vehicle.sensor
    if drive.beams is not None:
        if not isinstance(sensor, Sensor):
            raise UsageError(
                f"drive {drive.group} has beams, of one lidar: the vehicle has several"
            )
        sensor = sensor.with_beams(drive.beams)
    return replace(vehicle, sensor=sensor, seeing=seeing.model_copy(update=changes))


def degraded_drives(settings: RunSettings, drives: Sequence[DriveSettings]) -> dict[str, Observing]:
    """What the drives are observed with that are read as another lidar than the vehicle's, by
    `DriveSettings.degraded`.
    """
    if settings.observe is None:
        return {}
    vehicle = observing_of(settings, settings.observe)
    found = {d.degraded: observing_drive(settings, settings.observe, d) for d in drives}
    return {name: observing for name, observing in found.items() if observing != vehicle}


def seen_otherwise(settings: RunSettings, drives: Sequence[DriveSettings]) -> list[str]:
    """The groups of the drives that are observed with another lidar than the vehicle's."""
    others = degraded_drives(settings, drives)
    return [drive.group for drive in drives if drive.degraded in others]


def check_lidars(settings: RunSettings) -> None:
    """Refuse drives to train on that are read as different lidars, before anything is made.

    Raises:
        UsageError: says which, and what to do.
    """
    model = settings.model
    if model.use is not None or model.offset is not None:
        return
    others = seen_otherwise(settings, settings.drives)
    read_as = {d.degraded: d.group for d in settings.drives if d.group not in others}
    if len(read_as) > 1:
        told = ", ".join(f"{g} ({kind or 'as recorded'})" for kind, g in sorted(read_as.items()))
        raise UsageError(
            f"drives of different lidars are to train one model: {told}: read them alike (beams, "
            "range_max, blind_rear_deg of each drive), give the others a job of their own, or "
            "model.use, e.g. shipped"
        )


def check_files(settings: RunSettings) -> None:
    """Refuse a job of real files that are not there, or of drives that cannot train one model,
    before anything is made.

    Raises:
        SourceNotFoundError: no source of the map, no log, or no file of routes of that name.
        SourceError, OSError: no source of the map is of a format that is read.
        StoreError: the map is to be there and cannot be opened.
        UsageError: the run directory is a tile store; as `check_lidars`.
    """
    require_folder(settings.out)
    check_lidars(settings)
    if settings.simulate is not None:
        return
    require_format(settings.map.sources)
    if not settings.map.sources:
        open_store(settings.store_url)
    for drive in settings.drives:
        reading_of(drive)
    for route in settings.routes:
        if not Path(route).exists():
            raise SourceNotFoundError(f"{route}: no such file; check the path")


def reading_of(drive: DriveSettings) -> DriveReading:
    """How a drive's log is read.

    Raises:
        SourceNotFoundError: there is no such log.
    """
    if not Path(drive.log).exists():
        raise SourceNotFoundError(f"{drive.log}: no such log; check the path")
    return DriveReading(
        drive.log,
        drive.log_options,
        drive.beams,
        drive.range_max,
        drive.blind_rear_deg,
        drive.deskew or drive.sweep_s is not None,
        drive.sweep_s,
    )
