"""Simulate a city: survey blocks and drive logs, in tasks per stretch of street."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tilestream.errors import PlanError, UsageError, require_all_done
from tilestream.files import Files, local_path, place_of
from tilestream.lock import only_writer
from tilestream.pipeline.engine.executor import Watch, execute
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.simulation_record import (
    SMALL_POINTS,
    Size,
    begin_folder,
    identity_of,
    require_same,
    require_surveyed,
)
from tilestream.pipeline.stages.simulated import (
    DriveLog,
    ScanParts,
    SimulatedCity,
    SurveyBlock,
    log,
    scan,
    scanned,
    survey,
)
from tilestream.simulation.city import data_file, stretches
from tilestream.simulation.settings import SimulationSettings
from tilestream.simulation.streets import Street, check_clear, read_streets, street_called
from tilestream.store import require_folder

STRETCH = 50
"""Sample points of a stretch: a task's worth."""
SMALL_RAYS = 4_000
"""Rays per metre of the survey of `size="small"`."""
BYTES_PER_RAY, BYTES_PER_SCAN = 4, 400_000
"""On disk, generously: of a survey, and of a scan while it waits for its log [bytes]."""


def simulate(
    settings: SimulationSettings,
    out: str | Path,
    *,
    paths: Sequence[str] | None = None,
    scans_per_point: int = 1,
    every: int = 1,
    survey_of: str | Path | None = None,
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
        every: only each so-many-th sample point is scanned.
        survey_of: the directory of a simulation of the same city whose survey is the map of this
            one too: then none is simulated. Its lidar, and how it drives, may differ.
        size: `small`: the first 40 m of each path and a thin survey, for demonstrations and tests.
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The directory.

    Raises:
        UsageError: an unknown path, a route through a building, a directory that holds another
            simulation, or a survey of another city or of fewer of its streets.
        PlanError: not enough space on the disk.
        LockedError: another process writes to the directory.
        PartialError: some tasks failed; the message lists them, the rest is there.
    """
    folder = Path(place_of(local_path(out)))
    require_folder(folder)
    plan = plan_simulation(
        settings,
        folder,
        paths=paths,
        scans_per_point=scans_per_point,
        every=every,
        survey_of=survey_of,
        size=size,
    )
    settings = _sized(settings, size)
    identity = identity_of(settings, scans_per_point, every, size)
    require_same(folder, identity)
    if survey_of is not None:
        surveyed = Path(place_of(local_path(survey_of)))
        require_surveyed(surveyed, identity, _surveys(settings, surveyed, paths, size))
    require_space(folder, _bytes_needed(plan))
    city = SimulatedCity(settings.model_dump_json()).read()
    for street in city.streets:
        check_clear(street, city.footprints)
    with only_writer(folder):
        begin_folder(folder, city, identity)
        outcomes = execute(plan, client, watch, shared=[str(folder)])
        failures = {outcome.key: outcome.reason for outcome in outcomes if not outcome.ok}
        for name in ("", "survey", f"logs/drive{settings.drive}"):
            Files.at(folder).under(name).remove_parts()
        if not failures:
            shutil.rmtree(folder / "parts", ignore_errors=True)
    require_all_done(folder, failures)
    return folder


def plan_simulation(
    settings: SimulationSettings,
    out: str | Path,
    *,
    paths: Sequence[str] | None = None,
    scans_per_point: int = 1,
    every: int = 1,
    survey_of: str | Path | None = None,
    size: Size = "full",
) -> Plan:
    """What `simulate` will run: surveys and scans of every stretch, then a log per driven street.

    Only the routes are read; no city is built and nothing is written. Arguments and errors as
    there.
    """
    if scans_per_point < 1 or scans_per_point > 64:
        raise UsageError(f"scans_per_point is {scans_per_point}: give 1 to 64")
    if every < 1:
        raise UsageError(f"every is {every}: give 1 or more")
    folder, settings = Path(place_of(local_path(out))), _sized(settings, size)
    tasks = [] if survey_of is not None else _surveys(settings, folder, paths, size)
    logs: list[Task] = []
    for street, pieces in _pieces(settings, paths, size):
        drive = _drive(settings, folder, street, pieces, (scans_per_point, every))
        tasks += drive[:-1]
        logs += drive[-1:]
    largest = max((task.promised_bytes for task in (*tasks, *logs)), default=0)
    return Plan.of((*tasks, *logs), largest)


def _pieces(
    settings: SimulationSettings, paths: Sequence[str] | None, size: Size
) -> Iterator[tuple[Street, list[tuple[int, int]]]]:
    """The streets that are simulated, each in stretches."""
    streets = read_streets(data_file(settings.city.routes))
    if paths is not None:
        streets = tuple(street_called(streets, name) for name in paths)
    for street in streets:
        end = len(street.xy) if size == "full" else min(len(street.xy), SMALL_POINTS)
        yield street, [(b, min(e, end)) for b, e in stretches(street, STRETCH) if b < end]


def _surveys(
    settings: SimulationSettings, folder: Path, paths: Sequence[str] | None, size: Size
) -> list[Task]:
    """Every pass of the survey along every stretch."""
    city = SimulatedCity(settings.model_dump_json())
    return [
        _survey(city, settings, folder, street, piece, passes)
        for street, pieces in _pieces(settings, paths, size)
        for passes in range(settings.survey.passes)
        for piece in pieces
    ]


def _survey(
    city: SimulatedCity,
    settings: SimulationSettings,
    folder: Path,
    street: Street,
    stretch: tuple[int, int],
    passes: int,
) -> Task:
    """One pass of the survey along a stretch."""
    points = stretch[1] - stretch[0]
    return Task(
        survey,
        f"{street.name}-{passes}-{stretch[0]}",
        SurveyBlock(
            str(folder / "survey" / f"{street.name}_{passes}_{stretch[0]:05d}.laz"),
            settings.city.crs,
        ),
        takes={"street": street.name, "stretch": stretch, "passes": passes},
        reads={"city": city},
        work=points,
        counts={"rays": points * settings.survey.rays_per_m},
    )


def _drive(
    settings: SimulationSettings,
    folder: Path,
    street: Street,
    pieces: Sequence[tuple[int, int]],
    turns: tuple[int, int],
) -> list[Task]:
    """The scans of a drive along a street, then its log; nothing where that is there.

    Args:
        settings: the experiment.
        folder: where all is.
        street: the street.
        pieces: its stretches.
        turns: how many are kept at a sample point, and at each how-many-th one.
    """
    scans_per_point, every = turns
    path = folder / "logs" / f"drive{settings.drive}" / f"{street.name}.mcap"
    if not street.driven or path.exists():
        return []
    city = SimulatedCity(settings.model_dump_json())
    takes = {"street": street.name, "scans_per_point": scans_per_point, "every": every}
    if settings.reverse:
        last = len(street.xy)
        pieces = [(last - end, last - begin) for begin, end in reversed(pieces)]
    parts = [
        Task(
            scan,
            f"{street.name}-{begin}",
            ScanParts(
                str(folder / "parts" / f"drive{settings.drive}_{street.name}_{begin:05d}.npz")
            ),
            takes={**takes, "stretch": (begin, end)},
            reads={"city": city},
            work=len(scanned((begin, end), every)),
            counts={"scans": len(scanned((begin, end), every)) * scans_per_point},
        )
        for begin, end in pieces
        if scanned((begin, end), every)
    ]
    stretch = pieces[0][0], pieces[-1][1]
    log_task = Task(
        log,
        street.name,
        DriveLog(str(path)),
        takes={**takes, "stretch": stretch},
        reads={"city": city, "parts": tuple(part.product for part in parts)},
        work=len(scanned(stretch, every)),
    )
    return [*parts, log_task]


def _bytes_needed(plan: Plan) -> int:
    """What the files that are not there yet may take, generously [bytes]."""
    missing = [task for task in plan.tasks if task.writes.known(task.identity) is None]
    rays, scans = (sum(task.counts.get(what, 0) for task in missing) for what in ("rays", "scans"))
    return rays * BYTES_PER_RAY + 2 * scans * BYTES_PER_SCAN


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
            "free: give another directory, fewer paths (--paths) or size small (--size small)"
        )


def _sized(settings: SimulationSettings, size: Size) -> SimulationSettings:
    """The settings that a size means."""
    if size == "full":
        return settings
    thin = settings.survey.model_copy(update={"rays_per_m": SMALL_RAYS})
    return settings.model_copy(update={"survey": thin})
