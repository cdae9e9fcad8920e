"""The data types that modules exchange: frozen, every field documented, frames in names."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.errors import UsageError
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.kernels import cells as kernels
from tilestream.kernels.eigen import eigen
from tilestream.notebook import draw_cells, draw_line, html_of

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
LEAST_SPACING = 0.01
"""Sample points lie at least so far apart along a route or drive [m]: a map is not known better."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a lidar, in its own frame."""

    stamp_ns: int
    """Time of the scan's header [ns since the epoch]."""
    points: Float64
    """(n, 3) points in the lidar frame [m]; all finite."""
    T_map_lidar: Float64 | None = None
    """(4, 4) pose of the lidar in the map at `stamp_ns`; None where the log has none."""
    intensity: NDArray[np.float32] | None = None
    """(n,) intensity as recorded, no unit; None where the log has none."""
    ring: NDArray[np.int32] | None = None
    """(n,) index of the beam, as recorded; None where the log has none."""
    time_offset: Float64 | None = None
    """(n,) time of each point minus `stamp_ns` [s]; None where the log has none."""
    dropped: int = 0
    """Points of the recorded scan that were left out as they are no returns: not finite, or at the
    lidar's own origin."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time."""

    stamps_ns: Int64
    """(k,) times, strictly rising [ns since the epoch]."""
    T_map_lidar: Float64
    """(k, 4, 4) poses at these times."""
    frame: str = ""
    """Name of the frame that moves, as recorded."""


@dataclass(frozen=True, eq=False, repr=False)
class Route:
    """A path along which a vehicle drives, k >= 2 points of it."""

    route_id: str
    """Name of the route, unique in its file."""
    positions: Float64
    """(k, 3) points on the road [m, map frame]; z is NaN in all where the route has none."""
    arc_length: Float64
    """(k,) length along the route from its first point [m], strictly rising from 0; of the route in
    three dimensions where it has z."""
    heading: Float64
    """(k,) direction of travel [rad, from the map's x axis towards y, in (-pi, pi]]."""
    crs: str | None = None
    """Coordinate reference system, where the file or the user names it."""
    dropped: int = 0
    """Points of the file that were left out: less than 0.5 m from the one before that was not."""

    def __repr__(self) -> str:
        points, length = len(self.positions), self.arc_length[-1]
        return f"Route {self.route_id} ({points:,} points, {length:,.1f} m, CRS {self.crs})"

    def _repr_html_(self) -> str:
        facts = {
            "points": f"{len(self.positions):,}",
            "length [m]": f"{self.arc_length[-1]:,.1f}",
            "heights": "none" if np.isnan(self.positions[:, 2]).all() else "of the route",
            "CRS": self.crs or "not named",
        }
        return html_of(f"Route {self.route_id}", facts)

    def plot(self, ax: Any | None = None) -> Any:
        """The path from above, with a dot where it begins; the axes.

        Args:
            ax: matplotlib's axes to draw on; None: those of a new figure.
        """
        return draw_line(self.positions, self.route_id, ax)


@dataclass(frozen=True, eq=False, repr=False)
class Cells:
    """Normal distributions on the map's lattice: the NDT map, or a part of it.

    Made by `cells_of`, by `tile.cells`, or from arrays in any order; the rows are then sorted by
    voxel index, lexicographically, and the arrays are copies of their own type.

    Raises:
        UsageError: arrays of the wrong shape or of unequal length, values that are not finite, a
            covariance that is not symmetric, a count below 1, two cells of one index, a cell size
            that is not a positive number of whole millimetres.
    """

    index: Int64
    """(n, 3) voxel index: floor of the coordinates over the cell size, lexicographic."""
    count: Int64
    """(n,) number of map points in the voxel."""
    mean: Float64
    """(n, 3) mean of these points [m, map frame]."""
    covariance: Float64
    """(n, 3, 3) their unbiased covariance [m^2], as it is: not regularised."""
    cell_size: float = 2.0
    """Edge of a voxel [m], whole millimetres."""

    def __post_init__(self) -> None:
        if whole_mm(self.cell_size, "cell_size") <= 0:
            raise UsageError(f"cell_size is {self.cell_size!r} m: give more than 0")
        index = _whole(self.index, "index")
        n = index.shape[0] if index.ndim else 0
        count = _whole(self.count, "count")
        mean = _real(self.mean, "mean")
        covariance = _real(self.covariance, "covariance")
        for name, array, shape in (
            ("index", index, (n, 3)),
            ("count", count, (n,)),
            ("mean", mean, (n, 3)),
            ("covariance", covariance, (n, 3, 3)),
        ):
            if array.shape != shape:
                raise UsageError(f"Cells: {name} has shape {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise UsageError(f"Cells: {name} has values that are not finite")
        if n and count.min() < 1:
            raise UsageError("Cells: a count is below 1; a cell has points")
        scale = np.abs(covariance).max(axis=(1, 2), initial=0.0)
        skew = np.abs(covariance - covariance.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
        if (skew > 1e-6 * scale).any():
            row = int(np.argmax(skew - 1e-6 * scale))
            raise UsageError(f"Cells: the covariance of row {row} is not symmetric")
        order = kernels.lexicographic_order(index)
        index = index[order]
        twice = (index[1:] == index[:-1]).all(axis=1)
        if twice.any():
            voxel = tuple(index[1:][twice][0].tolist())
            raise UsageError(f"Cells: two cells have the index {voxel}; each voxel has one")
        object.__setattr__(self, "index", index)
        object.__setattr__(self, "count", count[order])
        object.__setattr__(self, "mean", mean[order])
        object.__setattr__(self, "covariance", covariance[order])
        object.__setattr__(self, "cell_size", float(self.cell_size))

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        text = f"Cells({len(self)} of {self.cell_size:g} m"
        if len(self):
            low, high = self.mean.min(axis=0), self.mean.max(axis=0)
            spans = zip("xyz", low, high, strict=True)
            text += ", " + ", ".join(f"{a} {lo:.1f} to {hi:.1f}" for a, lo, hi in spans) + " m"
            text += f", {self.count.sum()} points"
        return text + ")"

    def _repr_html_(self) -> str:
        facts = {"cells": f"{len(self):,}", "edge [m]": f"{self.cell_size:g}"}
        if len(self):
            low, high = self.mean.min(axis=0), self.mean.max(axis=0)
            spans = zip("xyz", low, high, strict=True)
            facts |= {f"{axis} [m]": f"{lo:.1f} to {hi:.1f}" for axis, lo, hi in spans}
            facts["points"] = f"{self.count.sum():,}"
        return html_of("Cells", facts)

    def plot(self, ax: Any | None = None) -> Any:
        """The cells from above, ellipses of two standard deviations coloured by height; the axes.

        Args:
            ax: matplotlib's axes to draw on; None: those of a new figure.
        """
        return draw_cells(self.mean, self.covariance, ax)

    @property
    def cell_mm(self) -> int:
        """Edge of a voxel [mm]."""
        return round(self.cell_size * MM_PER_M)

    @cached_property
    def _eigen(self) -> tuple[Float64, Float64]:
        return eigen(self.covariance)

    @cached_property
    def _regularised(self) -> tuple[Float64, Float64]:
        return kernels.regularise(*self._eigen)

    @property
    def eigenvalues(self) -> Float64:
        """(n, 3) raw eigenvalues of the covariance [m^2], descending; those below 0 are 0."""
        return self._eigen[0]

    @property
    def eigenvectors(self) -> Float64:
        """(n, 3, 3) unit eigenvectors in the columns: [:, :, 0] belongs to the largest."""
        return self._eigen[1]

    @cached_property
    def normal(self) -> Float64:
        """(n, 3) unit normals with the map-wide sign: the largest component is positive."""
        return kernels.normals(*self._eigen)

    @property
    def regularised(self) -> Float64:
        """(n, 3, 3) covariance [m^2] with eigenvalues max(lam_i, 0.01 lam1, (0.01 m)^2)."""
        return self._regularised[0]

    @property
    def precision(self) -> Float64:
        """(n, 3, 3) inverse of the regularised covariance [1/m^2]."""
        return self._regularised[1]


def _real(values: ArrayLike, name: str) -> Float64:
    """A copy as float64; UsageError if it is not numeric."""
    given = np.asarray(values)
    if given.dtype.kind not in "iuf":
        raise UsageError(f"Cells: {name} has type {given.dtype}, expected numbers")
    return np.array(given, np.float64, order="C")


def _whole(values: ArrayLike, name: str) -> Int64:
    """A copy as int64; UsageError if a number is not whole."""
    given = np.asarray(values)
    if given.dtype.kind not in "iuf":
        raise UsageError(f"Cells: {name} has type {given.dtype}, expected whole numbers")
    if given.dtype.kind == "f" and not (np.isfinite(given) & (given == np.rint(given))).all():
        raise UsageError(f"Cells: {name} has values that are no whole numbers")
    return np.array(given, np.int64, order="C")


Criterion = Literal["FS", "RQ", "LY", "LS", "OB", "place", "label"]
"""FS feature sufficiency, RQ representation quality, LY layout, LS local similarity (the paper,
section V), OB observability; `place`: which row it is; `label`: what was measured or estimated
there."""
FactorSet = Literal["faithful", "robust", "observability", "own"]
"""The paper's own factors, or others (`Column.factor_set`)."""


@dataclass(frozen=True)
class Column:
    """One column of a table, documented once: docs, checks and reports are made from this."""

    name: str
    """Its name in every table."""
    criterion: Criterion
    """Criterion of a factor, or the kind of another column."""
    unit: str
    """Unit of its values: `m`, `bit`, `1` for a plain number, …"""
    meaning: str
    """What it says, in a sentence or two."""
    source: str
    """The formula, and where it comes from: `eq. 4`, `definitions, section 4`, …"""
    factor_set: FactorSet = "faithful"
    """The paper's own, or a twin that is not degenerate (definitions, section 3 and
    definitions, section 4); `own`: of a file of the user's (`factors/own.py`)."""
    dtype: str = "float64"
    """Type of its values."""


@dataclass(frozen=True, eq=False)
class Registrations:
    """The result of registering one scan from k starts; a row per start, in the order of the
    starts.
    """

    T_map_lidar: Float64
    """(k, 4, 4) final poses."""
    converged: NDArray[np.bool_]
    """(k,) whether the last step was shorter than epsilon; never because the iterations ended."""
    iterations: Int64
    """(k,) Newton steps taken."""
    score: Float64
    """(k,) sum over scan points and their cells of -d1 p at the final pose, no unit, >= 0."""
    nvtl: Float64
    """(k,) mean over all scan points of their best cell's -d1 p, 0 for a point without a cell, no
    unit."""
    hits: Int64
    """(k,) scan points with at least one cell at the final pose."""
    hessian: Float64
    """(k, 6, 6) of `score` at the final pose, raw, for steps (tau, w): t + tau [m, map frame],
    Exp(w) R [rad] about the scan's origin. -hessian^-1 is a covariance where it is definite."""
    points: int
    """Number of scan points that were scored, after thinning."""

    def __len__(self) -> int:
        return len(self.converged)


TruePose = Literal["log", "refined"]
"""Source of a true pose: the log (or the simulator), or refined with the same scan."""
RouteZ = Literal["ground", "road", "lidar"]
"""What is made of z of a route: it only says near which ground of the map the road is; it is the
road; it is the lidar."""


@dataclass(frozen=True, eq=False)
class LocalizationError:
    """How far registrations end from the true pose: the label of a sample point.

    Errors are final minus true position in the frame of the true heading. A start has failed when
    its 3D error exceeds 0.5 m, converged or not. The mean of nothing is NaN.
    """

    T_map_lidar: Float64
    """(4, 4) the true pose."""
    true_pose: TruePose
    """Source of the true pose; labels of the two kinds are never mixed."""
    T_map_lidar_starts: Float64
    """(k, 4, 4) the starts."""
    registrations: Registrations
    """Their results."""
    along: Float64
    """(k,) error along the true heading [m], forward positive."""
    across: Float64
    """(k,) error across it [m], left positive."""
    up: Float64
    """(k,) error in map z [m]."""
    roll: Float64
    """(k,) component of the rotation error along the true heading [rad]. The rotation error is the
    rotation vector w of Exp(w) R_true = R_final, no longer than pi."""
    pitch: Float64
    """(k,) its component across the true heading [rad], positive where the nose goes down."""
    yaw_vector: Float64
    """(k,) its component in map z [rad]."""
    yaw: Float64
    """(k,) error of the heading [rad], in [-pi, pi); as `yaw_vector` while roll and pitch are
    right."""
    error: Float64
    """(k,) 3D norm of the error [m]."""
    error_mean: float
    """Mean 3D error of all starts [m]: the label of the paper."""
    p_fail: float
    """Share of starts that failed, no unit."""
    mean_held: float
    """Mean 3D error of the starts that did not fail [m]."""
    median_held: float
    """Median of the same [m]."""
    p95_held: float
    """Their 95th percentile [m], linear between ranks."""
    along_mean: float
    """Mean of abs(along) over all starts [m]."""
    across_mean: float
    """Mean of abs(across) [m]."""
    up_mean: float
    """Mean of abs(up) [m]."""
    roll_mean: float
    """Mean of abs(roll) [rad]."""
    pitch_mean: float
    """Mean of abs(pitch) [rad]."""
    yaw_mean: float
    """Mean of abs(yaw) [rad]."""
    error_floor: float
    """Mean 3D error of the starts within 1.0 m of the true position [m]."""
    error_tail: float
    """error_mean - error_floor [m]."""

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(k,) whether the start converged."""
        return self.registrations.converged

    @property
    def iterations(self) -> Int64:
        """(k,) Newton steps taken."""
        return self.registrations.iterations


District = Literal["shinjuku", "sendagaya"]
"""A district that ships with tilestream: the one of the paper's five paths, or another with three
streets."""
