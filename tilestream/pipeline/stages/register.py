"""Register: a slice of the scans of a drive, from a batch of their starts."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import PoseError, RegistrationError, TileNotReadyError, UsageError
from tilestream.factors.ground import ground_under
from tilestream.grid import Box, TileKey
from tilestream.kernels.fixed_order import norms
from tilestream.label import FINE_CELL, refined_pose, start_errors, start_poses
from tilestream.marks import canonical
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.drive_scans import OpenedScans
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.records import Cells, Column, Float64, Scan, TruePose
from tilestream.registration import register as register_scan
from tilestream.settings import StartSettings
from tilestream.store import open_store

MARGIN = 10.0
"""Map around what a scan sees: the way a start can go, and a cell [m]."""
FIXED_BYTES = 300_000_000
"""Memory of the task besides what it reads: some scans, their starts and rows."""
BYTES_PER_POINT = 30
"""Memory per map point in sight of the slice, of which the cells are held twice."""

ROTATION = "component of w, Exp(w) = R_final R_true^T"
"""What the components of a rotation error are of."""
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
    Column("roll", "label", "rad", "Rotation error along the true heading.", ROTATION),
    Column("pitch", "label", "rad", "Rotation error across the true heading.", ROTATION),
    Column("yaw_vector", "label", "rad", "Rotation error in map z.", ROTATION),
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


OF_LOG = ("along", "across", "up", "yaw")
"""What is kept of how far the log's pose is from a refined one."""


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
    scans_per_point: int = 1
    """Scans of a sample point, at most."""

    @property
    def cell_sizes(self) -> tuple[float, ...]:
        """Edges of all cells that are needed [m]: finer ones refine a true pose."""
        fine = {FINE_CELL} if self.true_pose == "refined" else set()
        return tuple(sorted({self.cell_size, *fine}))


@stage(
    "register",
    version=4,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_POINT * counts["points"],
    seconds=0.45,
    columns=START_COLUMNS,
)
def register(
    map_part: MapPart, scans: OpenedScans, measuring: Measuring, batch: tuple[int, int]
) -> Made:
    """A row per start of each scan, and what is true of all starts of a scan, or why it failed.

    Args:
        map_part: the cells of the tiles in reach of any of the scans.
        scans: the scans.
        measuring: what is measured with.
        batch: first and last (exclusive) start.
    """
    rows: list[pd.DataFrame] = [NO_ROWS]
    facts: dict[str, dict[str, Any]] = {}  # by the number of the scan
    heights = _lidar_heights(map_part, scans)
    for (sample, scan), height in zip(scans, heights, strict=True):
        place: dict[str, float | None] = {"sample": sample.number, "lidar_height": height}
        if measuring.true_pose == "log":
            place |= _place(scan.T_map_lidar)
        try:
            seen = scans.seen(scan)
            T_map_true = _true_pose(map_part, seen, measuring)
            found, points = _registered(map_part, seen, T_map_true, measuring, batch)
        except (RegistrationError, PoseError, UsageError, TileNotReadyError) as error:
            facts[str(sample.scan)] = place | {"reason": str(error)}
        else:
            which = {"sample": sample.number, "scan": sample.scan, "stamp_ns": scan.stamp_ns}
            rows.append(found.assign(**which))
            place |= _place(T_map_true) | _off_log(scan, T_map_true, measuring)
            facts[str(sample.scan)] = place | {"points": points, "reason": ""}
    names = {column.name: column.dtype for column in START_COLUMNS}
    frame = pd.concat(rows, ignore_index=True)[list(names)].astype(names)
    known = {"data_set": canonical(measuring), "store": map_part.store.url}
    return Made(frame, {**known, "scans": facts})


def _registered(
    map_part: MapPart,
    scan: Scan,
    T_map_true: Float64,
    measuring: Measuring,
    batch: tuple[int, int],
) -> tuple[pd.DataFrame, int]:
    """The rows of one scan, and how many of its points were registered."""
    starts = start_poses(T_map_true, measuring.starts)[slice(*batch)]
    cells = _cells_around(map_part, scan, T_map_true, measuring.cell_size)
    found = register_scan(cells, scan.points, starts, measuring.registration)
    rows = {
        "start": np.arange(*batch),
        "distance": norms(starts[:, :3, 3] - T_map_true[:3, 3]),
        **start_errors(T_map_true, found.T_map_lidar),
        **{name: getattr(found, name) for name in ("converged", "iterations", "score", "nvtl")},
        "hits": found.hits,
    }
    return pd.DataFrame(rows), found.points


def _place(T_map_true: Float64 | None) -> dict[str, float]:
    assert T_map_true is not None  # a drive's scans have a pose
    x, y, z = T_map_true[:3, 3].tolist()
    return {"x": x, "y": y, "z": z, "heading": math.atan2(T_map_true[1, 0], T_map_true[0, 0])}


def _off_log(scan: Scan, T_map_true: Float64, measuring: Measuring) -> dict[str, float]:
    """How far the log's pose is from a refined true pose, in its frame; else nothing."""
    if measuring.true_pose == "log":
        return {}
    assert scan.T_map_lidar is not None  # a drive's scans have a pose
    off = start_errors(T_map_true, scan.T_map_lidar[None])
    return {f"log_{name}": float(off[name][0]) for name in OF_LOG}


def _lidar_heights(map_part: MapPart, scans: OpenedScans) -> list[float | None]:
    """How high the lidar is above the ground of the map at each scan [m]; None: not known."""
    chosen = [sample.scan for sample in scans.wanted.samples]
    places: Float64 = scans.log.T_map_lidar[chosen, :3, 3]
    ground, _ = ground_under(places, map_part.store, "lidar")
    return [None if math.isnan(height) else height for height in (places[:, 2] - ground).tolist()]


def _true_pose(map_part: MapPart, scan: Scan, measuring: Measuring) -> Float64:
    assert scan.T_map_lidar is not None  # a drive's scans have a pose
    if measuring.true_pose == "log":
        return scan.T_map_lidar
    cells = _cells_around(map_part, scan, scan.T_map_lidar, FINE_CELL)
    return refined_pose(cells, scan.points, scan.T_map_lidar)


def _cells_around(map_part: MapPart, scan: Scan, T_map_lidar: Float64, cell_size: float) -> Cells:
    """The cells of the tiles in reach of a scan."""
    ranges = norms(scan.points[:, :2])
    reach = (float(ranges.max()) if ranges.size else 0.0) + MARGIN
    store = map_part.store
    keys = tuple(store.grid.keys_over(Box.around(T_map_lidar[None, :2, 3], reach)))
    return _cells_of(store.url, keys, cell_size, map_part.identity)


@lru_cache(maxsize=2)
def _cells_of(
    url: str,
    keys: tuple[TileKey, ...],
    cell_size: float,
    identity: str,  # noqa: ARG001 - the cells of a changed map are others
) -> Cells:
    """One map of the cells of some tiles; successive scans mostly ask for the same."""
    store = open_store(url)
    low, high = store.grid.core(keys[0]), store.grid.core(keys[-1])
    return store.cells_in(Box(low.x_lo, low.y_lo, high.x_hi, high.y_hi), cell_size)


NO_ROWS = pd.DataFrame({c.name: pd.Series(dtype=c.dtype) for c in START_COLUMNS})
"""No starts."""
