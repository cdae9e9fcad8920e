"""The job that measures: a log and a map in, the localization error of every sample point out."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import (
    SourceNotFoundError,
    TileNotReadyError,
    UsageError,
    require_all_done,
)
from tilestream.factors.rows import Samples, samples_of_drive
from tilestream.files import local_path, place_of
from tilestream.formats.logs import ScanSelection
from tilestream.grid import Box, TileGrid, TileKey, whole_mm
from tilestream.label import start_poses
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.plan import Plan, paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs.inventory import make_tables
from tilestream.pipeline.jobs.overlap import Overlap, overlap
from tilestream.pipeline.jobs.sample_scans import choose_samples
from tilestream.pipeline.stages.drive_scans import DriveScans, Reading, Sample, opened
from tilestream.pipeline.stages.label import label
from tilestream.pipeline.stages.map_plan import MapPlan, apart
from tilestream.pipeline.stages.register import MARGIN, Measuring, register
from tilestream.records import Float64, TruePose
from tilestream.settings import DEFAULT_MEMORY, LabelSettings, StartSettings
from tilestream.store import TileStore
from tilestream.tables import read_tables

SCANS_PER_TASK = 8
"""Scans of a slice: about a second of work with 317 starts."""
REACH = 250.0
"""How far a scan is taken to see where nothing limits it [m]: as far as road lidars do."""


def localize(
    store: TileStore,
    log: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    cell_size: float = 2.0,
    spacing: float = 1.0,
    registration: RegistrationSettings | None = None,
    starts: StartSettings | None = None,
    true_pose: TruePose = "log",
    scans_per_point: int = 1,
    scans: ScanSelection | None = None,
    reading: Reading | None = None,
    starts_per_task: int | None = None,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
    partial: bool = False,
    allow_overlap: bool = False,
) -> pd.DataFrame:
    """Localize a drive in a map from many starts per sample point: what the error there is.

    One scan is taken per sample point, or several and their mean. Scans are read slice by slice and
    registered by one task per slice; a run that was killed continues when called again. Tables of
    other scans or settings in the same folder are removed, so that two data sets are never mixed.

    Args:
        store: the map.
        log: a log with point clouds and poses, of any format (`formats.logs`).
        out: folder of the tables: `errors/` (a row per sample point), `starts/` (a row per start),
            a local path or any fsspec URL.
        cell_size: edge of an NDT cell [m].
        spacing: distance between sample points along the drive [m].
        registration: the matcher; default `autoware`, as of all jobs.
        starts: the starts; default the paper's 317.
        true_pose: `log`, or `refined` as the paper does.
        scans_per_point: scans that are measured at each sample point, where there are as many.
        scans: which scans to use; default all.
        reading: how the log is read (topics, as if by a simpler sensor: `ts.Reading`); its path is
            `log`.
        starts_per_task: splits the starts of a slice over several tasks; None: all in one.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.
        partial: go on with a map that is not whole; scans that could see what is missing say so.
        allow_overlap: measure also with scans that the map was made of, whose errors are too small.

    Returns:
        A row per sample point in the order of the drive; `status` and `reason` say where none
        could be measured, `unfit` whether they tell anything of this map.

    Raises:
        UsageError: settings that cannot be, a spacing below 1 cm, no scan selected, or
            one that the map was made of (`allow_overlap`).
        SourceNotFoundError: there is no such log.
        SourceError: the log cannot be read, has no clouds or no poses.
        TileNotReadyError: no tile of the map within reach of the drive.
        IncompleteError: the map is not whole, and not `partial`.
        LockedError: another process writes to the folder.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    how = replace(reading, path=os.fspath(log)) if reading else Reading(os.fspath(log))
    if not Path(local_path(log)).exists():
        raise SourceNotFoundError(f"{os.fspath(log)}: no such log; check the path")
    scans = scans or ScanSelection()
    if not allow_overlap:
        drive_overlap(how, scans, spacing, store.sources(), scans_per_point).require_none()
    plan = plan_localize(
        MapPlan.of_store(store, partial=partial),
        how,
        out,
        cell_size=cell_size,
        spacing=spacing,
        registration=registration or LabelSettings().registration,
        starts=starts or StartSettings(),
        true_pose=true_pose,
        scans_per_point=scans_per_point,
        scans=scans,
        starts_per_task=starts_per_task,
        memory=memory,
    )
    require_all_done(out, make_tables(plan, out, client, watch))
    return read_tables(paths_of(plan.outputs(label.name)))


def plan_localize(
    map_plan: MapPlan,
    reading: Reading,
    out: str | os.PathLike[str],
    *,
    cell_size: float,
    spacing: float,
    registration: RegistrationSettings,
    starts: StartSettings,
    true_pose: TruePose,
    scans_per_point: int = 1,
    scans: ScanSelection,
    starts_per_task: int | None,
    memory: int,
    group: str = "",
) -> Plan:
    """What `localize` will run; arguments and errors as there.

    Where a job has several logs, `group` names this one's labels: part of their keys and paths.
    """
    registration.require_cells(cell_size)
    reading = _absolute(reading)
    log = opened(reading)
    samples = choose_samples(log, scans, spacing, scans_per_point)
    measuring = Measuring(
        cell_size, true_pose, registration, starts, reading.as_sensor, scans_per_point
    )
    for size in measuring.cell_sizes:
        map_plan.store.grid.require_cell_size(whole_mm(size, "cell_size"))
    state = reading.state
    reach = (reading.range_max or REACH) + MARGIN
    places = log.T_map_lidar[:, :2, 3]
    if not tiles_in_reach(map_plan, places[[sample.scan for sample in samples]], reach):
        raise TileNotReadyError(
            f"{log.path}: {apart(map_plan, places[[sample.scan for sample in samples]], reach)}"
        )
    tasks: list[Task] = []
    for part in _slices(samples, max(1, SCANS_PER_TASK // scans_per_point)):
        tasks += slice_tasks(
            map_plan,
            tiles_in_reach(map_plan, places[[sample.scan for sample in part]], reach),
            DriveScans(reading, state, part),
            measuring,
            place_of(out),
            group,
            starts_per_task,
        )
    return Plan.of((*map_plan.tasks.values(), *tasks), memory)


def _absolute(reading: Reading) -> Reading:
    """With the whole path: workers may run elsewhere."""
    return replace(reading, path=place_of(local_path(reading.path)))


def _slices(samples: Sequence[Sample], points: int) -> Iterator[tuple[Sample, ...]]:
    """The scans of so many sample points at a time."""
    of_point = [tuple(scans) for _, scans in groupby(samples, lambda sample: sample.number)]
    for first in range(0, len(of_point), points):
        yield tuple(chain.from_iterable(of_point[first : first + points]))


def drive_overlap(
    reading: Reading,
    scans: ScanSelection,
    spacing: float,
    sources: Iterable[Mapping[str, Any]],
    per_point: int,
) -> Overlap:
    """What the scans of a drive that are localized share with the sources of a map.

    Raises:
        UsageError, SourceError: as `localize`.
    """
    log = opened(_absolute(reading))
    samples = choose_samples(log, scans, spacing, per_point)
    return overlap(log, [sample.scan for sample in samples], sources)


def labelled_places(
    grid: TileGrid, reading: Reading, scans: ScanSelection, spacing: float, group: str
) -> dict[TileKey, Samples]:
    """Where a log says that the scans were taken that are localized, by the tile that holds them.

    Args:
        grid: the tiles of the map.
        reading: the log.
        scans: which of its scans are used.
        spacing: distance between sample points [m].
        group: name of the drive.

    Raises:
        UsageError, SourceError: as `localize`.
    """
    log = opened(_absolute(reading))
    chosen = choose_samples(log, scans, spacing)
    return samples_of_drive(
        grid,
        group,
        np.array([sample.number for sample in chosen]),
        np.array([sample.arc_length for sample in chosen]),
        log.T_map_lidar[[sample.scan for sample in chosen]],
    )


def tiles_in_reach(map_plan: MapPlan, places: Float64, reach: float) -> list[TileKey]:
    """The tiles of the map within `reach` [m] of any of (k, 2) places, sorted."""
    boxes = [Box.around(place[None], reach) for place in places]
    return sorted({key for box in boxes for key in map_plan.over(box)})


def slice_tasks(
    map_plan: MapPlan,
    keys: Sequence[TileKey],
    scans: DriveScans,
    measuring: Measuring,
    folder: str,
    group: str,
    starts_per_task: int | None,
) -> list[Task]:
    """The register tasks of a slice of scans, and the label task that sums them up.

    Args:
        map_plan: the map.
        keys: its tiles in reach of the slice.
        scans: the slice.
        measuring: what is measured with.
        folder: of all tables.
        group: which drive, as whose sensor; empty where a job has one only.
        starts_per_task: starts of one task; None: all.

    Raises:
        UsageError: `starts_per_task` is below 1.
    """
    starts = len(start_poses(np.eye(4), measuring.starts))
    size = starts if starts_per_task is None else starts_per_task
    if size < 1:
        raise UsageError(f"starts_per_task is {size}: give at least 1")
    first = scans.samples[0]
    name = "/".join(part for part in (group, f"{first.scan:06d}") if part)
    key = "-".join(part for part in (group, str(first.number)) if part)
    cells = [
        map_plan.cells(tile, whole_mm(cell_size, "cell_size"))
        for cell_size in measuring.cell_sizes
        for tile in keys
    ]
    work = len(scans.samples)  # registrations; a label is one of a sample point
    registers = [
        Task(
            register,
            f"{key}-{low}",
            Parquet(f"{folder}/starts/{name}-{low:05d}.parquet"),
            takes={"measuring": measuring, "batch": (low, min(low + size, starts))},
            reads={"map_part": map_plan.part(keys, cells), "scans": scans},
            work=work,
            counts={"points": map_plan.count(keys)},
        )
        for low in range(0, starts, size)
    ]
    summed = Task(
        label,
        key,
        Parquet(f"{folder}/errors/{name}.parquet"),
        takes={"samples": scans.samples},
        reads={"starts": tuple(task.product for task in registers)},
        work=scans.sample_points,
        counts={"rows": starts * len(scans.samples)},
    )
    return [*registers, summed]
