"""The three stages that measure errors: cells (of a tile), register (a slice of scans), label."""

import math
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tilestream.config import RegistrationSettings, StartSettings
from tilestream.dataflow.plan import BASE_BYTES
from tilestream.dataflow.tasks import perform
from tilestream.errors import PoseError, RegistrationError, TaskError, UsageError
from tilestream.formats.deskew import Sweep, deskew
from tilestream.formats.lesser import as_lesser
from tilestream.formats.mcap import ScanLog, open_log
from tilestream.localization import (
    FINE_CELL,
    refined_pose,
    register,
    start_errors,
    start_poses,
    summary,
)
from tilestream.ndt import cells_of_mm
from tilestream.records import Cells, Column, Float64, Scan, TruePose
from tilestream.store import POINTS, Mark, TileStore, cells_mark, cells_table, hash_of, open_store
from tilestream.tables import is_done, read_mark, read_tables, write_table
from tilestream.tiling import MM_PER_M, Box, TileKey
from tilestream.version import VERSION

LABEL_VERSION = 1
"""Raise it when the labels that are made from the same scans and cells change."""
MARGIN = 10.0
"""Map around what a scan sees: the way a start can go, and a cell [m]."""
CELLS_BYTES = 400_000_000
"""Memory of a cells task beyond the interpreter: the points of one tile, and their sums."""
REGISTER_BYTES = 500_000_000
"""Memory of a register task beyond the interpreter: the cells in sight of a slice of scans."""

SCAN_COLUMNS = (
    Column(
        "sample", "place", "1", "Number of the sample point along the drive.", "", dtype="int64"
    ),
    Column("scan", "place", "1", "Index of the scan in the log.", "by header stamp", dtype="int64"),
    Column(
        "stamp_ns", "place", "ns", "Header stamp of the scan.", "since the epoch", dtype="int64"
    ),
)
START_COLUMNS = (
    *SCAN_COLUMNS,
    Column("start", "label", "1", "Number of the start.", "i slowest", dtype="int64"),
    Column("distance", "label", "m", "Of the start from the true position.", ""),
    Column(
        "along", "label", "m", "Error along the true heading, forward positive.", "final - true"
    ),
    Column("across", "label", "m", "Error across the true heading, left positive.", "final - true"),
    Column("up", "label", "m", "Error in map z.", "final - true"),
    Column("yaw", "label", "rad", "Error of the heading, in [-pi, pi).", "final - true"),
    Column("error", "label", "m", "3D error.", "norm of along, across, up"),
    Column("converged", "label", "1", "Whether the last step was below epsilon.", "", dtype="bool"),
    Column("iterations", "label", "1", "Newton steps taken.", "", dtype="int64"),
    Column("score", "label", "1", "Sum of -d1 p over points and cells at the end.", "eq. 12"),
    Column(
        "nvtl", "label", "1", "Mean over points of the best cell's -d1 p at the end.", "Autoware"
    ),
    Column("hits", "label", "1", "Scan points with a cell at the end.", "", dtype="int64"),
)
ERROR_COLUMNS = (
    *SCAN_COLUMNS,
    Column("x", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("y", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("z", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("heading", "place", "rad", "True heading, from the map's x axis.", "see true_pose"),
    Column("arc_length", "place", "m", "Length of the drive up to here.", "of the log's poses"),
    Column("true_pose", "label", "", "log or refined.", "definitions, section 5", dtype="str"),
    Column("as_sensor", "label", "", "As if by which sensor the log was read.", "", dtype="str"),
    Column("points", "label", "1", "Scan points that were registered, thinned.", "", dtype="int64"),
    Column("starts", "label", "1", "Number of starts.", "", dtype="int64"),
    Column("converged", "label", "1", "Share of starts that converged.", ""),
    Column("iterations", "label", "1", "Mean number of Newton steps.", ""),
    Column("nvtl", "label", "1", "Mean NVTL at the end.", "Autoware"),
    Column("error_mean", "label", "m", "Mean 3D error of all starts.", "the paper's label"),
    Column(
        "p_fail",
        "label",
        "1",
        "Share of starts with a 3D error above 0.5 m.",
        "definitions, section 5",
    ),
    Column("mean_held", "label", "m", "Mean 3D error of the starts that did not fail.", ""),
    Column("median_held", "label", "m", "Median of the same.", ""),
    Column("p95_held", "label", "m", "95th percentile of the same.", ""),
    Column("along_mean", "label", "m", "Mean of abs(along).", ""),
    Column("across_mean", "label", "m", "Mean of abs(across).", ""),
    Column("up_mean", "label", "m", "Mean of abs(up).", ""),
    Column("yaw_mean", "label", "rad", "Mean of abs(yaw).", ""),
    Column(
        "error_floor",
        "label",
        "m",
        "Mean 3D error of the starts within 1 m.",
        "definitions, section 5",
    ),
    Column("error_tail", "label", "m", "error_mean - error_floor.", "definitions, section 5"),
    Column("status", "place", "", "done, or failed.", "", dtype="str"),
    Column("reason", "place", "", "Why it failed.", "", dtype="str"),
)


@dataclass(frozen=True)
class CellsTask:
    """Make the NDT cells of one size of one tile."""

    store_url: str
    tile: TileKey
    cell_mm: int
    promised_bytes: int = BASE_BYTES + CELLS_BYTES
    stage: str = "cells"
    work: int = 1

    @property
    def needs(self) -> tuple[str, ...]:
        """The tile's points, where the same plan makes them."""
        return (f"merge-{self.tile}",)

    @property
    def key(self) -> str:
        """`cells-<cell size in mm>-<tile>`."""
        return f"cells-{self.cell_mm}-{self.tile}"


@dataclass(frozen=True)
class Reading:
    """How a log is read: which topics, as if by which sensor."""

    path: str
    """The log."""
    points_topic: str | None = None
    """Topic of the scans; None: found by type."""
    pose_topic: str | None = None
    """Topic of the poses; None: found by type."""
    beams: int | None = None
    """Beams that remain; None: all."""
    range_max: float | None = None
    """Largest range [m]; None: as recorded."""
    blind_rear_deg: float | None = None
    """Blind sector at the rear [deg]; None: none."""
    deskew: bool = False
    """Whether the distortion of motion is removed by the time of each point."""
    sweep_s: float | None = None
    """Duration of a turn [s], for logs without the time of each point; None: they have it."""

    @property
    def as_sensor(self) -> str:
        """As if by which sensor the scans are read, in words."""
        parts = [
            f"{self.beams} beams" if self.beams else "",
            f"{self.range_max:g} m" if self.range_max else "",
            f"rear blind {self.blind_rear_deg:g} deg" if self.blind_rear_deg else "",
            "de-skewed" if self.deskew else "",
        ]
        return ", ".join(part for part in parts if part) or "as recorded"

    def __post_init__(self) -> None:
        """Refuse what no scan could be read as, before any task runs.

        Raises:
            UsageError: a number outside of its range.
        """
        self._lesser(Scan(0, np.zeros((0, 3))))
        if self.sweep_s is not None and not 0.0 < self.sweep_s < math.inf:
            raise UsageError(f"sweep is {self.sweep_s!r}: give a positive time in seconds")

    def open(self) -> ScanLog:
        """The log."""
        return open_log(self.path, points_topic=self.points_topic, pose_topic=self.pose_topic)

    def seen(self, scan: Scan, log: ScanLog) -> Scan:
        """A scan of the log as it is to be localized."""
        if self.deskew:
            sweep = None if self.sweep_s is None else Sweep(self.sweep_s)
            scan = deskew(scan, log.trajectory, sweep=sweep)
        return self._lesser(scan)

    def _lesser(self, scan: Scan) -> Scan:
        return as_lesser(
            scan,
            beams=self.beams,
            range_max=self.range_max,
            blind_rear_deg=self.blind_rear_deg,
        )


@dataclass(frozen=True)
class Measuring:
    """What an error is measured with: the identity of a data set of labels."""

    cell_size: float
    """Edge of a cell [m]."""
    true_pose: TruePose
    """Where the true pose is from."""
    registration: RegistrationSettings
    """The matcher."""
    starts: StartSettings
    """The starts."""
    as_sensor: str
    """As if by which sensor the log was read."""

    def identity(self) -> dict[str, Any]:
        """What is kept with every label: two data sets that differ in it are never mixed."""
        return {
            **asdict(self),
            "registration": self.registration.model_dump(),
            "starts": self.starts.model_dump(),
            "label_version": LABEL_VERSION,
            "code": VERSION,
        }


@dataclass(frozen=True, slots=True)
class Sample:
    """A sample point of a drive: one scan of the log."""

    number: int
    """Number along the drive."""
    scan: int
    """Index of the scan in the log."""
    stamp_ns: int
    """Its header stamp [ns since the epoch]."""
    arc_length: float
    """Length of the drive up to here [m]."""


@dataclass(frozen=True)
class RegisterTask:
    """Register a slice of scans from a batch of their starts; a row per start."""

    store_url: str
    reading: Reading
    measuring: Measuring
    samples: tuple[Sample, ...]
    batch: tuple[int, int]
    """First and last (exclusive) start."""
    out: str
    """Where the table goes."""
    map_state: str
    """Hash of the map around the slice."""
    identity: str
    """Hash of everything that the rows depend on."""
    needs: tuple[str, ...]
    group: str = ""
    """Which drive, as whose sensor; empty where a job has one only."""
    promised_bytes: int = BASE_BYTES + REGISTER_BYTES
    stage: str = "register"

    @property
    def work(self) -> int:
        """Scans of the slice."""
        return len(self.samples)

    @property
    def key(self) -> str:
        """`register-<group>-<first sample>-<first start>`."""
        return "-".join(_named("register", self.group, self.samples[0].number, self.batch[0]))


@dataclass(frozen=True)
class LabelTask:
    """Sum up the starts of a slice of scans; a row per sample point."""

    samples: tuple[Sample, ...]
    parts: tuple[str, ...]
    """The tables of the slice's register tasks."""
    out: str
    identity: str
    needs: tuple[str, ...]
    group: str = ""
    promised_bytes: int = BASE_BYTES
    stage: str = "label"

    @property
    def work(self) -> int:
        """Scans of the slice."""
        return len(self.samples)

    @property
    def key(self) -> str:
        """`label-<group>-<first sample>`."""
        return "-".join(_named("label", self.group, self.samples[0].number))


def _named(*parts: object) -> list[str]:
    return [str(part) for part in parts if part != ""]


@perform.register
def _cells(task: CellsTask) -> Mark:
    store = open_store(task.store_url)
    tile, name = store.tile(task.tile), cells_table(task.cell_mm)
    wanted = cells_mark(tile.require(POINTS), task.cell_mm)
    known = tile.mark(name)
    if known.same_work(wanted):
        return known
    cells = cells_of_mm(tile.points_mm(), task.cell_mm)
    columns = {
        "index": cells.index,
        "count": cells.count,
        "mean": cells.mean,
        "covariance": cells.covariance,
    }
    made = replace(wanted, facts={"cells": len(cells)})
    tile.write_table(name, columns, made)
    return made


@perform.register
def _register(task: RegisterTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    store, log = open_store(task.store_url), _opened(task.reading, file_state(task.reading.path))
    rows: list[pd.DataFrame] = [_NO_ROWS]
    facts: dict[int, dict[str, Any]] = {}
    scans = log.scans_at([sample.scan for sample in task.samples])
    for sample, scan in zip(task.samples, scans, strict=True):
        place = _place(scan.T_map_lidar) if task.measuring.true_pose == "log" else {}
        try:
            found, fact = _register_scan(store, log, sample, scan, task)
        except (RegistrationError, PoseError, UsageError) as error:
            facts[sample.number] = place | {"reason": str(error)}
        else:
            rows.append(found)
            facts[sample.number] = fact | {"reason": ""}
    frame = pd.concat(rows, ignore_index=True).astype({c.name: c.dtype for c in START_COLUMNS})
    mark = {"identity": task.identity, "samples": facts, "data_set": task.measuring.identity()}
    write_table(task.out, frame, START_COLUMNS, mark)
    return len(frame)


def _register_scan(
    store: TileStore, log: ScanLog, sample: Sample, scan: Scan, task: RegisterTask
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The rows of one scan, and what is true of all of them."""
    seen = task.reading.seen(scan, log)
    measuring = task.measuring
    T_map_true = _true_pose(store, seen, task)
    starts = start_poses(T_map_true, measuring.starts)[slice(*task.batch)]
    cells = _cells_around(store, seen, T_map_true, measuring.cell_size, task.map_state)
    found = register(cells, seen.points, starts, measuring.registration)
    rows = {
        "sample": sample.number,
        "scan": sample.scan,
        "stamp_ns": scan.stamp_ns,
        "start": np.arange(*task.batch),
        "distance": np.linalg.norm(starts[:, :3, 3] - T_map_true[:3, 3], axis=1),
        **start_errors(T_map_true, found.T_map_lidar),
        **{name: getattr(found, name) for name in ("converged", "iterations", "score", "nvtl")},
        "hits": found.hits,
    }
    return pd.DataFrame(rows), _place(T_map_true) | {"points": found.points}


def _place(T_map_true: Float64 | None) -> dict[str, float]:
    assert T_map_true is not None  # `ScanLog.scans_at` gives scans that have a pose
    x, y, z = T_map_true[:3, 3].tolist()
    return {"x": x, "y": y, "z": z, "heading": math.atan2(T_map_true[1, 0], T_map_true[0, 0])}


def _true_pose(store: TileStore, scan: Scan, task: RegisterTask) -> Float64:
    assert scan.T_map_lidar is not None  # `ScanLog.scans_at` gives scans that have a pose
    if task.measuring.true_pose == "log":
        return scan.T_map_lidar
    cells = _cells_around(store, scan, scan.T_map_lidar, FINE_CELL, task.map_state)
    return refined_pose(cells, scan.points, scan.T_map_lidar)


def _cells_around(
    store: TileStore, scan: Scan, T_map_lidar: Float64, cell_size: float, map_state: str
) -> Cells:
    """The cells of the tiles in reach of a scan."""
    ranges = np.linalg.norm(scan.points[:, :2], axis=1)
    reach = (float(ranges.max()) if ranges.size else 0.0) + MARGIN
    box = box_around(T_map_lidar[None, :2, 3], reach)
    return _cells_of(store.url, tuple(store.grid.keys_over(box)), cell_size, map_state)


@lru_cache(maxsize=2)
def _cells_of(
    url: str,
    keys: tuple[TileKey, ...],
    cell_size: float,
    map_state: str,  # noqa: ARG001 - the cells of a changed map are others
) -> Cells:
    """One map of the cells of some tiles; successive scans mostly ask for the same."""
    store = open_store(url)
    low, high = store.grid.core(keys[0]), store.grid.core(keys[-1])
    return store.cells_in(Box(low.x_lo, low.y_lo, high.x_hi, high.y_hi), cell_size)


def box_around(places: Float64, reach: float) -> Box:
    """The box of (k, 2) places with `reach` metres around them."""
    low = np.floor((places.min(axis=0) - reach) * MM_PER_M).astype(int)
    high = np.ceil((places.max(axis=0) + reach) * MM_PER_M).astype(int)
    return Box(*low.tolist(), *high.tolist())


@lru_cache(maxsize=4)
def _opened(reading: Reading, state: str) -> ScanLog:  # noqa: ARG001 - a changed file is another
    return reading.open()


def file_state(path: str) -> str:
    """Hash of the size and time of change of a file."""
    stat = Path(path).stat()
    return hash_of(path, stat.st_size, stat.st_mtime_ns)


@perform.register
def _label(task: LabelTask) -> int:
    """Rows written; 0 where they were there."""
    if is_done(task.out, task.identity):
        return 0
    frame = _NO_ROWS
    facts: dict[str, dict[str, Any]] = {}
    data_set: dict[str, Any] = {}
    for part in task.parts:
        mark = read_mark(part)
        if mark is None:
            raise TaskError(f"{part} is gone: run the same command again")
        frame = pd.concat([frame, read_tables([part])], ignore_index=True)
        for number, fact in mark["samples"].items():  # the first batch that failed decides
            facts[number] = fact | {"reason": facts.get(number, fact)["reason"] or fact["reason"]}
        data_set = mark["data_set"]
    rows = []
    for sample in task.samples:
        fact = dict(facts[str(sample.number)])
        reason = fact.pop("reason")
        row: dict[str, Any] = {
            "sample": sample.number,
            "scan": sample.scan,
            "stamp_ns": sample.stamp_ns,
        }
        row |= {"arc_length": sample.arc_length, "status": "failed" if reason else "done"}
        row |= {"reason": reason, "true_pose": data_set["true_pose"], **fact}
        row |= {"as_sensor": data_set["as_sensor"], "points": 0, "starts": 0} | row
        if not reason:
            row |= _summed(frame[frame["sample"] == sample.number])
        rows.append(row)
    columns = [column.name for column in ERROR_COLUMNS]
    labels = (
        pd.DataFrame(rows).reindex(columns=columns).astype({c.name: c.dtype for c in ERROR_COLUMNS})
    )
    write_table(task.out, labels, ERROR_COLUMNS, {"identity": task.identity, "data_set": data_set})
    return len(labels)


def _summed(starts: pd.DataFrame) -> dict[str, float]:
    """The label of one sample point from the rows of its starts."""
    starts = starts.sort_values("start")
    names = ("along", "across", "up", "yaw", "error")
    errors = {name: starts[name].to_numpy() for name in names}
    return {
        "starts": len(starts),
        "converged": float(starts["converged"].mean()),
        "iterations": float(starts["iterations"].mean()),
        "nvtl": float(starts["nvtl"].mean()),
        **summary(errors, starts["distance"].to_numpy()),
    }


_NO_ROWS = pd.DataFrame({c.name: pd.Series(dtype=c.dtype) for c in START_COLUMNS})
