"""The job that measures: a log and a map in, the localization error of every sample point out."""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tilestream.config import RegistrationSettings, StartSettings
from tilestream.dataflow.localize_tasks import (
    MARGIN,
    CellsTask,
    LabelTask,
    Measuring,
    Reading,
    RegisterTask,
    Sample,
    box_around,
    file_state,
)
from tilestream.dataflow.plan import DEFAULT_MEMORY, Plan, Task
from tilestream.dataflow.run import Watch, execute
from tilestream.errors import PartialError, TileNotReadyError, UsageError
from tilestream.formats.mcap import ScanLog, ScanSelection
from tilestream.kernels.fixed_order import norms
from tilestream.localization import FINE_CELL, start_poses
from tilestream.records import TruePose
from tilestream.store import TileStore, hash_of
from tilestream.tables import read_tables, remove_others
from tilestream.tiling import TileKey, whole_mm

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
    scans: ScanSelection | None = None,
    reading: Reading | None = None,
    starts_per_task: int | None = None,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
) -> pd.DataFrame:
    """Localize a drive in a map from many starts per sample point: what the error there is.

    One scan is taken per sample point. Scans are read slice by slice and registered by one task
    per slice; a run that was killed continues when called again. Tables of other scans or settings
    in the same folder are removed, so that two data sets are never mixed.

    Args:
        store: the map.
        log: an MCAP log with point clouds and poses.
        out: folder of the tables: `errors/` (a row per sample point), `starts/` (a row per start),
            a local path or any fsspec URL.
        cell_size: edge of an NDT cell [m].
        spacing: distance between sample points along the drive [m].
        registration: the matcher; default `RegistrationSettings()`.
        starts: the starts; default the paper's 317.
        true_pose: `log`, or `refined` as the paper does.
        scans: which scans to use; default all.
        reading: how the log is read (topics, as if by a lesser sensor); its path is `log`.
        starts_per_task: splits the starts of a slice over several tasks; None: all in one.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.

    Returns:
        A row per sample point in the order of the drive; `status` and `reason` say where none
        could be measured.

    Raises:
        UsageError: settings that cannot be, a spacing that is not positive, no scan selected.
        SourceError: the log cannot be read, has no clouds or no poses.
        TileNotReadyError: no tile of the map within reach of the drive.
        PlanError: a task does not fit `memory`.
        PartialError: some tasks failed; the message lists them, the rest is done.
    """
    plan = plan_localize(
        store,
        replace(reading, path=os.fspath(log)) if reading else Reading(os.fspath(log)),
        out,
        cell_size=cell_size,
        spacing=spacing,
        registration=registration or RegistrationSettings(),
        starts=starts or StartSettings(),
        true_pose=true_pose,
        scans=scans or ScanSelection(),
        starts_per_task=starts_per_task,
        memory=memory,
    )
    for kind in (RegisterTask, LabelTask):
        remove_others([task.out for task in plan.tasks if isinstance(task, kind)])
    outcomes = execute(plan.tasks, client, watch)
    failures = {outcome.key: outcome.reason for outcome in outcomes if not outcome.ok}
    if failures:
        raise PartialError(f"{out}: {len(failures)} tasks failed, the rest is done:", failures)
    return read_tables([task.out for task in plan.tasks if isinstance(task, LabelTask)])


def plan_localize(
    store: TileStore,
    reading: Reading,
    out: str | os.PathLike[str],
    *,
    cell_size: float,
    spacing: float,
    registration: RegistrationSettings,
    starts: StartSettings,
    true_pose: TruePose,
    scans: ScanSelection,
    starts_per_task: int | None,
    memory: int,
    group: str = "",
    have: Mapping[TileKey, str] | None = None,
) -> Plan:
    """What `localize` will run; arguments and errors as there.

    Where a job has several logs, `group` names this one's labels: part of their keys and paths.
    `have` is the identity of the points of each tile of the map; None: as the store has them.
    """
    reading = replace(reading, path=str(Path(reading.path).absolute()))
    log = reading.open()
    samples = choose_samples(log, scans, spacing)
    measuring = Measuring(cell_size, true_pose, registration, starts, reading.as_sensor)
    sizes = {cell_size, FINE_CELL} if true_pose == "refined" else {cell_size}
    for size in sizes:
        store.grid.require_cell_size(whole_mm(size, "cell_size"))
    have = store.identities() if have is None else have
    log_state = hash_of(file_state(reading.path), repr(reading), measuring.identity())
    reach = (reading.range_max or REACH) + MARGIN
    cells: dict[str, Task] = {}
    slices: list[Task] = []
    for first in range(0, len(samples), SCANS_PER_TASK):
        part = samples[first : first + SCANS_PER_TASK]
        keys = tiles_in_reach(store, log, part, reach, have)
        needed = {
            task.key: task
            for size in sorted(sizes)
            for task in (CellsTask(store.url, key, whole_mm(size, "cell_size")) for key in keys)
        }
        cells |= needed
        register = RegisterTask(
            store_url=store.url,
            reading=reading,
            measuring=measuring,
            samples=part,
            batch=(0, len(start_poses(np.eye(4), starts))),
            out=os.fspath(out),
            group=group,
            map_state=hash_of([(str(key), have[key]) for key in keys]),
            identity=log_state,
            needs=tuple(needed),
        )
        slices += _slice_tasks(register, starts_per_task)
    if not cells:
        x, y = log.T_map_lidar[samples[0].scan, :2, 3]
        raise TileNotReadyError(
            f"{store.url}: no tile within {reach:g} m of {log.path}, which begins at "
            f"({x:.1f}, {y:.1f}) m: is the log in the map's frame?"
        )
    return Plan((*cells.values(), *slices), memory).check()


def choose_samples(log: ScanLog, scans: ScanSelection, spacing: float) -> tuple[Sample, ...]:
    """One scan per `spacing` metres of the drive: the one nearest to each multiple of it.

    Raises:
        UsageError: `spacing` is not positive, or no scan with a pose is selected.
    """
    if not 0.0 < spacing < np.inf:
        raise UsageError(f"spacing is {spacing!r}: give a positive length in metres")
    chosen = scans.indices(log.stamps_ns)
    chosen = chosen[log.posed[chosen]]
    if not len(chosen):
        raise UsageError(f"{log.path}: no scan with a pose is selected; {len(log)} scans are there")
    steps = norms(np.diff(log.T_map_lidar[chosen, :3, 3], axis=0))
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.arange(0.0, arc[-1] + 0.5 * spacing, spacing)
    after = np.clip(np.searchsorted(arc, places), 1, max(1, len(arc) - 1))
    nearer = places - arc[after - 1] <= arc[np.minimum(after, len(arc) - 1)] - places
    rows = np.unique(np.where(nearer, after - 1, np.minimum(after, len(arc) - 1)))
    return tuple(
        Sample(number, int(chosen[row]), int(log.stamps_ns[chosen[row]]), float(arc[row]))
        for number, row in enumerate(rows)
    )


def tiles_in_reach(
    store: TileStore,
    log: ScanLog,
    samples: Sequence[Sample],
    reach: float,
    have: Collection[TileKey],
) -> list[TileKey]:
    """Those of the tiles that the store has that any of the scans may see, sorted."""
    places = log.T_map_lidar[[sample.scan for sample in samples], :2, 3]
    touched = {key for at in places for key in store.grid.keys_over(box_around(at[None], reach))}
    return sorted(touched.intersection(have))


def _slice_tasks(whole: RegisterTask, starts_per_task: int | None) -> list[Task]:
    """The register tasks of a slice of scans, and the label task that sums them up.

    Args:
        whole: all starts of the slice; its `out` is the folder of all tables, its `identity` that
            of the log and the settings.
        starts_per_task: starts of one task; None: all.
    """
    size = whole.batch[1] if starts_per_task is None else starts_per_task
    if size < 1:
        raise UsageError(f"starts_per_task is {size}: give at least 1")
    name = "/".join(part for part in (whole.group, f"{whole.samples[0].scan:06d}") if part)
    registers = []
    for low in range(0, whole.batch[1], size):
        batch = (low, min(low + size, whole.batch[1]))
        identity = hash_of(whole.identity, whole.map_state, repr(whole.samples), batch)
        path = f"{whole.out}/starts/{name}-{low:05d}.parquet"
        registers.append(replace(whole, batch=batch, out=path, identity=identity))
    label = LabelTask(
        whole.samples,
        tuple(task.out for task in registers),
        f"{whole.out}/errors/{name}.parquet",
        hash_of([task.identity for task in registers]),
        tuple(task.key for task in registers),
        whole.group,
    )
    return [*registers, label]
