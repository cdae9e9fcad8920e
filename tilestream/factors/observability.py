"""Observability: how well a scan constrains the pose, per axis of the route (definitions,
section 4.4).

A fifth criterion that the paper lacks, from the map alone: the virtual scan of the sensor from the
sample point (`virtual_scan.py`), the NDT Hessian of that scan at the sample point (`hessian.py`),
and where registrations of it end (`virtual_drive.py`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from tilestream.errors import RegistrationError, TileNotReadyError, UsageError
from tilestream.factors.beams import Beams
from tilestream.factors.hessian import HESSIAN_COLUMNS, hessian_factors, turned_by
from tilestream.factors.scene import Scene
from tilestream.factors.seen_from import SURVEY_COLUMNS, survey_factors
from tilestream.factors.surfels import Surfels, can_be_met, in_view, surfel_mm, surfels_in
from tilestream.factors.table import NO_GROUND, places_of
from tilestream.factors.virtual_drive import COLUMNS as DRIVE_COLUMNS
from tilestream.factors.virtual_drive import Ends, ends_of, stratified_starts, virtual_drive
from tilestream.factors.virtual_scan import (
    Returns,
    VirtualScan,
    look,
    look_past,
    near_share,
    scan_in_world,
    virtual_scan,
    whole_places,
)
from tilestream.factors.worlds import passed_by
from tilestream.grid import MM_PER_M, Box
from tilestream.local_map import LocalCells
from tilestream.matcher import RegistrationSettings
from tilestream.records import Cells, Column, Float64, Int64
from tilestream.sensor import VLP16, Carrier, fov_deg_of
from tilestream.settings import VirtualSettings
from tilestream.store import TileStore

BLOCK = 25.0
"""Sample points within a square of this edge share a scene [m]."""
MARGIN = 10.0
"""Map beyond the range of a scan that is read: how far a start can move, and a cell [m]."""
INSIDE = 0.4
"""A place is inside a wall if more than this share of the beams meet the map within `range_min`."""
NOTHING = "nothing in view: {} of {} beams come back"
WALLED = "inside a wall: {:.0%} of the beams meet the map within {:g} m"


Row = dict[str, object]
"""A row of the table by column name; columns that are not known are left out."""


def _column(name: str, unit: str, meaning: str, source: str = "definitions, section 4.4") -> Column:
    return Column(name, "OB", unit, meaning, source, "observability")


VIEW_COLUMNS = (
    _column("ob_score", "1", "Expected score at the sample point, mean per scan point.", "eq. 12"),
    _column("ob_nvtl", "1", "Expected NVTL at the sample point.", "Autoware"),
    _column("ob_points", "1", "Points of the virtual scan after thinning."),
    _column(
        "ob_cells", "1", "Cells whose voxels the points of the virtual scan hit, before thinning."
    ),
    _column("ob_returns", "1", "Share of the beams that come back."),
    _column("ob_unmapped", "1", "Share of the beams that meet nothing and leave the mapped area."),
    _column("ob_ghosts", "1", "Share of the beams that traffic in the map would stop, left out."),
)
COLUMNS = (*HESSIAN_COLUMNS, *VIEW_COLUMNS, *SURVEY_COLUMNS, *DRIVE_COLUMNS)
"""All columns of the criterion."""


def observability(
    store: TileStore,
    positions: ArrayLike,
    headings: ArrayLike,
    sensor: Carrier = VLP16,
    seeing: VirtualSettings | None = None,
    registration: RegistrationSettings | None = None,
    cell_size: float = 2.0,
) -> pd.DataFrame:
    """The observability factors and the virtual drive at sample points of a map.

    Places are taken in whole millimetres, rounded. The result has the same bits for any tiling
    of the map, any choice and any order of the places.

    Args:
        store: the map.
        positions: (k, 3) places of the lidar [m, map frame], already at its height. NaN as z: a
            place without ground, see `sample_points`.
        headings: (k,) directions of travel [rad, from the map's x axis].
        sensor: beams, range and noise; or a vehicle of several.
        seeing: usable range, blind sector, drop-outs, starts; default `VirtualSettings()`.
        registration: the matcher of the vehicle; default `RegistrationSettings()`.
        cell_size: edge of a cell [m]; the tile size is a multiple of it.

    Returns:
        A row per position: `COLUMNS`, then `status` and `reason`. `missing`: no ground, or nothing
        in view. `failed`: inside a wall, too little for the matcher, or a tile in range failed. All
        columns are NaN there, but for those of the view where a scan was taken.

    Raises:
        UsageError: positions or headings of another shape or not finite, a cell size of which the
            tile size is no multiple.
    """
    places = places_of(positions)
    turns = _headings(headings, len(places))
    seeing, registration = seeing or VirtualSettings(), registration or RegistrationSettings()
    view = _View(store, sensor, seeing, registration, cell_size)
    rows: list[Row] = [{"status": "missing", "reason": NO_GROUND} for _ in places]
    for some in tiles_of(places, store):
        for row, found in view.rows(places, turns, some):
            rows[row] = found
    numbers = [[row.get(column.name, math.nan) for column in COLUMNS] for row in rows]
    table = pd.DataFrame(
        np.array(numbers, np.float64).reshape(len(rows), len(COLUMNS)),
        columns=[column.name for column in COLUMNS],
    )
    return table.assign(
        status=np.array([row["status"] for row in rows], dtype=str),
        reason=np.array([row["reason"] for row in rows], dtype=object),
    )


class _View:
    """Map, sensor and settings that all sample points share."""

    def __init__(
        self,
        store: TileStore,
        sensor: Carrier,
        seeing: VirtualSettings,
        registration: RegistrationSettings,
        cell_size: float,
    ) -> None:
        self.store = store
        self.fov_deg = fov_deg_of(sensor)
        self.seeing = seeing
        self.registration = registration
        self.cell_size = cell_size
        self.beams = Beams.of(sensor, seeing)
        self.starts = [stratified_starts(seeing.starts, draw) for draw in range(seeing.draws)]

    def rows(self, places: Float64, turns: Float64, some: Int64) -> Iterator[tuple[int, Row]]:
        """The rows of some places, for which the map is read once.

        Where a part of the map cannot be read, each place is computed alone, so that none fails
        because of another one.
        """
        try:
            surfels, ghosts, cells = self.around(places[some])
        except TileNotReadyError as error:
            if len(some) == 1:
                yield int(some[0]), {"status": "failed", "reason": str(error)}
                return
            for row in some:
                yield from self.rows(places, turns, np.array([row]))
            return
        for block in blocks_of(places, some):
            around = self.block(surfels, ghosts, cells, places[block])
            for row in block:
                yield int(row), self.seen_from(around, places[row], turns[row])

    def around(self, places: Float64) -> tuple[Surfels, Surfels, Cells]:
        """The surfels that can be seen from the places, those of them that are ghosts apart, and
        the cells around.
        """
        reach = self.beams.range_max + self.beams.rim
        surfels = surfels_in(self.store, Box.around(places, reach + 1.0))
        cells = self.store.cells_in(Box.around(places, reach + MARGIN), self.cell_size)
        ghost = surfels.ghost & self.seeing.without_ghosts
        real, ghosts = (self.in_view(surfels.where(chosen), places) for chosen in (~ghost, ghost))
        return real, ghosts, cells

    def block(
        self, surfels: Surfels, ghosts: Surfels, cells: Cells, places: Float64
    ) -> "_Block | None":
        """What places near one another share; None: nothing is in view."""
        near, passed = (self.in_view(those, places) for those in (surfels, ghosts))
        if not len(near):
            return None
        scene = self.scene(near, places)
        balls, seed, draws = ~near.flat, self.seeing.seed, self.seeing.draws
        first, *others = (
            scene.without(passed_by(near.centre_mm, balls, seed, draw))
            for draw in (0, *range(draws - self.seeing.worlds, draws))
        )
        return _Block(
            near,
            scene,
            first,
            tuple(others),
            self.scene(passed, places) if len(passed) else None,
            self.listed(cells, places),
        )

    def listed(self, cells: Cells, places: Float64) -> Cells | LocalCells:
        """The cells that scans at the places can reach, listed once for all of them."""
        reach = self.beams.range_max + self.beams.rim + MARGIN
        try:
            return LocalCells.around(cells, places, reach, self.registration)
        except RegistrationError:
            return cells  # of which each place says so itself

    def scene(self, near: Surfels, places: Float64) -> Scene:
        """The scene that places near one another share, of the surfels that are in view."""
        stands = whole_places(np.concatenate([places - self.beams.rim, places + self.beams.rim]))
        return Scene.of(near, stands, surfel_mm(self.store))

    def in_view(self, surfels: Surfels, places: Float64) -> Surfels:
        """The surfels that a beam from any of the places can meet, and a few more."""
        return in_view(surfels, places, self.fov_deg, self.beams.range_max, self.beams.rim)

    def seen_from(self, around: "_Block | None", place: Float64, heading: float) -> Row:
        """The row of a place; columns that are not known there are left out."""
        nothing: Row = {"status": "missing", "reason": NOTHING.format(0, len(self.beams))}
        if around is None:
            return nothing
        fov, rim = self.fov_deg, self.beams.rim
        own = can_be_met(around.near, place[None], fov, self.beams.range_max, rim)
        if not own.any():
            return nothing
        place_mm = whole_places(place)
        walled = near_share(around.scene, place_mm, self.beams, self.seeing.range_min)
        if walled > INSIDE:
            reason = WALLED.format(walled, self.seeing.range_min)
            return {"status": "failed", "reason": reason}
        whole = look(around.scene, place_mm, heading, self.seeing, self.beams)
        mapped = around.mapped.seen_from(own)
        found = look_past(mapped, whole, self.seeing, self.beams)
        scan = virtual_scan(mapped, found, place_mm, self.seeing, self.beams)
        view: Row = {
            "ob_returns": scan.return_share,
            "ob_unmapped": scan.unmapped_share,
            "ob_ghosts": self.hidden_by(around.ghosts, scan, place_mm, heading),
        }
        if not len(scan.points):
            reason = NOTHING.format(0, len(self.beams))
            return {**view, "status": "missing", "reason": reason}
        T_map_lidar = np.eye(4)
        T_map_lidar[:2, :2] = turned_by(heading)
        T_map_lidar[:3, 3] = place_mm / MM_PER_M
        scans = self.scans(around, whole, found, place_mm)
        try:
            held = hessian_factors(around.cells, scan.points, T_map_lidar, self.registration)
            drives = self.drives(around.cells, scans, T_map_lidar)
        except RegistrationError as error:
            return {**view, "status": "failed", "reason": str(error)}
        cells = around.cells
        cells = cells.cells if isinstance(cells, LocalCells) else cells
        survey = survey_factors(cells, scan.points, T_map_lidar)
        return {**view, **held, **survey, **virtual_drive(drives), "status": "done", "reason": ""}

    def scans(
        self,
        around: "_Block",
        whole: tuple[Returns, ...],
        found: tuple[Returns, ...],
        place_mm: Int64,
    ) -> Iterator[Float64]:
        """The points of each draw, in the lidar frame: of the street as it was mapped, of which
        the beams meet `found`, then of others; `whole` is what they would meet of all surfels.
        """
        seeing, beams = self.seeing, self.beams
        still = seeing.draws - seeing.worlds
        for draw in range(still):
            yield virtual_scan(around.mapped, found, place_mm, seeing, beams, draw).points
        for draw, scene in enumerate(around.worlds, start=still):
            met = look_past(scene, whole, seeing, beams)
            yield scan_in_world(met, place_mm, seeing, beams, draw)

    def drives(
        self, cells: Cells | LocalCells, scans: Iterator[Float64], T_map_lidar: Float64
    ) -> list[Ends]:
        """Where the registrations of each draw end; draws that cannot be registered are left out.

        Raises:
            RegistrationError: none can be; why the first cannot.
        """
        ends, failures = [], []
        for starts, points in zip(self.starts, scans, strict=True):
            try:
                ends.append(ends_of(cells, points, T_map_lidar, self.registration, starts))
            except RegistrationError as error:
                failures.append(error)
        if not ends:
            raise failures[0]
        return ends

    def hidden_by(
        self, ghosts: Scene | None, scan: VirtualScan, place_mm: Int64, heading: float
    ) -> float:
        """Share of the beams that ghosts would stop before the return of the scan."""
        if ghosts is None:
            return 0.0
        found = look(ghosts, place_mm, heading, self.seeing, self.beams)
        ranges = np.concatenate([met.ranges for met in found])
        return float((ranges < scan.ranges).mean())


@dataclass(frozen=True, eq=False)
class _Block:
    """What places near one another share."""

    near: Surfels
    """What is in view of any of them."""
    scene: Scene
    """The same as a scene."""
    mapped: Scene
    """The same without the balls that beams pass by …"""
    worlds: tuple[Scene, ...]
    """… and without others in each of the streets that are not as they were mapped."""
    ghosts: Scene | None
    """The ghosts that would be."""
    cells: Cells | LocalCells
    """The cells around."""


def tiles_of(places: Float64, store: TileStore) -> Iterator[Int64]:
    """Rows of the places in each tile; places without a height are left out."""
    there = np.flatnonzero(~np.isnan(places[:, 2]))
    keys = [store.grid.key_at(x, y) for x, y in places[there, :2].tolist()]
    for key in sorted(set(keys)):
        yield there[[near == key for near in keys]]


def blocks_of(places: Float64, some: Int64) -> Iterator[Int64]:
    """The rows `some`, grouped by the scene that they share."""
    blocks = np.floor(places[some, :2] / BLOCK).astype(np.int64)
    for block in np.unique(blocks, axis=0):
        yield some[(blocks == block).all(axis=1)]


def _headings(headings: ArrayLike, k: int) -> Float64:
    turns = np.asarray(headings)
    if turns.dtype.kind not in "iuf" or turns.shape != (k,) or not np.isfinite(turns).all():
        raise UsageError(
            f"headings have shape {turns.shape} and type {turns.dtype}: give {k} finite radians"
        )
    return turns.astype(np.float64)
