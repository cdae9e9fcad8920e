"""The definitions, taken literally: slow, brute force, vicinity by vicinity, one function a factor.

This is the judge of the fast code, so it shares nothing with it: plain NumPy and SciPy, written
from the definitions alone (map, cells, points; sample point and vicinity; the 20 factors). Lengths
are metres, angles radians, entropies bits.

Where a distance is compared ("within r", "0 <"), 1e-9 m count as nothing, as in the bins, so that
rounding decides nothing on regular maps either.

Everything runs near the origin: the map is first moved by a whole number of lattice steps, which
the definitions cannot see, so that coordinates of 4e6 m cost no digits.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tilestream.sensor import Sensor

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

MIN_POINTS = 6
OUTLIER_RATIO = 0.55
NEIGHBOUR_RADIUS = 5.0
TIE = 1e-9
DEPTH_EDGE_MM = 500
SHIFTS = [(i / 5, j / 5) for i in range(-10, 11) for j in range(-10, 11)]


# --- 1. Map, cells, points


def whole_mm(points: Floats) -> Ints:
    """Coordinates rounded to whole millimetres, half to even."""
    return np.rint(np.asarray(points, np.float64) * 1000.0).astype(np.int64)


def voxel_groups(points_mm: Ints, edge_mm: int) -> Iterator[tuple[Ints, Ints]]:
    """(voxel index, numbers of its points), in lexicographic order of the index."""
    voxels, voxel_of = np.unique(points_mm // edge_mm, axis=0, return_inverse=True)
    by_voxel = np.argsort(voxel_of.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(voxel_of.ravel(), minlength=len(voxels)))
    if len(voxels):
        yield from zip(voxels, np.split(by_voxel, ends[:-1]), strict=True)


def thinned_mm(points_mm: Ints, edge_mm: int) -> Ints:
    """One point per voxel: integer sum / count, rounded to 1 mm."""
    centroids = [
        np.rint(points_mm[group].sum(axis=0) / len(group))
        for _, group in voxel_groups(points_mm, edge_mm)
    ]
    return np.array(centroids, np.int64).reshape(-1, 3)


def literal_thinned(points: Floats, leaf: float) -> Floats:
    """The map points that `ingest` stores for `map_leaf` = `leaf` [m]; 0 keeps all."""
    points_mm = whole_mm(points)
    return (thinned_mm(points_mm, round(leaf * 1000)) if leaf else points_mm) / 1000.0


@dataclass(frozen=True, eq=False)
class LiteralCells:
    """The cells of a map, ordered by voxel index."""

    edge: float
    index: Ints
    """(m, 3) voxel index in the map frame."""
    count: Ints
    mean: Floats
    covariance: Floats
    """(m, 3, 3) unbiased."""
    eigenvalues: Floats
    """(m, 3) raw, lam1 >= lam2 >= lam3 >= 0."""
    regularised: Floats
    """(m, 3, 3) same eigenvectors, floored eigenvalues."""
    precision: Floats
    """(m, 3, 3) inverses of the regularised covariances."""
    normal: Floats
    dimension: Ints
    """(m,) 1, 2 or 3: the shape class."""

    def __len__(self) -> int:
        return len(self.index)


def normal_of(eigenvalues: Floats, e1: Floats, e3: Floats) -> Floats:
    """The unit normal of a cell, with the sign of the whole map."""
    lam1, lam2, lam3 = eigenvalues
    normal = e3
    if lam2 - lam3 <= 1e-9 * lam1:
        across = np.cross([0.0, 0.0, 1.0], e1)
        length = np.linalg.norm(across)
        normal = across / length if length > TIE else np.array([1.0, 0.0, 0.0])
    size = np.abs(normal)
    decides = np.flatnonzero(size >= size.max() - 1e-6)[0]
    return normal if normal[decides] > 0 else -normal


def dimension_of(eigenvalues: Floats) -> int:
    """1, 2 or 3 by the largest of a1, a2, a3 (eq. 3); ties go to the lower dimension."""
    s1, s2, s3 = np.sqrt(eigenvalues)
    if s1 <= 1e-6:
        return 3
    a1, a2, a3 = (s1 - s2) / s1, (s2 - s3) / s1, s3 / s1
    if a1 >= max(a2, a3) - 1e-12:
        return 1
    return 2 if a2 >= a3 - 1e-12 else 3


def cells_of_mm(points_mm: Ints, edge_mm: int) -> tuple[LiteralCells, Ints]:
    """The cells, and the cell of each point (-1: its voxel holds too few points)."""
    cell_of_point = np.full(len(points_mm), -1)
    rows = []
    for voxel, group in voxel_groups(points_mm, edge_mm):
        if len(group) < MIN_POINTS:
            continue
        cell_of_point[group] = len(rows)
        corner_mm = voxel * edge_mm
        offsets = (points_mm[group] - corner_mm) / 1000.0
        centre = offsets.mean(axis=0)
        away = offsets - centre
        covariance = away.T @ away / (len(group) - 1)
        rising, vectors = np.linalg.eigh(covariance)
        lam = np.maximum(rising[::-1], 0.0)
        axes = vectors[:, ::-1]
        floored = np.maximum(lam, max(0.01 * lam[0], 0.01**2))
        rows.append(
            (
                voxel,
                len(group),
                corner_mm / 1000.0 + centre,
                covariance,
                lam,
                axes @ np.diag(floored) @ axes.T,
                axes @ np.diag(1.0 / floored) @ axes.T,
                normal_of(lam, axes[:, 0], axes[:, 2]),
                dimension_of(lam),
            )
        )
    shapes = ((3,), (), (3,), (3, 3), (3,), (3, 3), (3, 3), (3,), ())
    kinds = (np.int64, np.int64, *[np.float64] * 6, np.int64)
    columns = zip(*rows, strict=True) if rows else [()] * len(shapes)
    arrays = [
        np.array(column, kind).reshape(-1, *shape)
        for column, kind, shape in zip(columns, kinds, shapes, strict=True)
    ]
    return LiteralCells(edge_mm / 1000.0, *arrays), cell_of_point


def literal_cells(points: Floats, cell_size: float) -> LiteralCells:
    """The cells of any (n, 3) array, in its own frame."""
    return cells_of_mm(whole_mm(points), round(cell_size * 1000))[0]


def magnusson(edge: float) -> tuple[float, float]:
    """d1 and d2 of the density, for cells of that edge."""
    c1, c2 = 10.0 * (1.0 - OUTLIER_RATIO), OUTLIER_RATIO / edge**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    d2 = -2.0 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)
    return d1, d2


# --- Bins and ties


def wrapped_bin(x: Floats, low: float, width: float, bins: int) -> Ints:
    """Bin on a full circle."""
    return np.floor((x - low) / width + TIE).astype(np.int64) % bins


def clipped_bin(x: Floats, low: float, width: float, bins: int) -> Ints:
    """Bin in a closed range."""
    return np.clip(np.floor((x - low) / width + TIE).astype(np.int64), 0, bins - 1)


def azimuth(vectors: Floats) -> Floats:
    """atan2(y, x); 0 where the horizontal part is below 1e-9."""
    flat = np.hypot(vectors[:, 0], vectors[:, 1]) < TIE
    return np.where(flat, 0.0, np.arctan2(vectors[:, 1], vectors[:, 0]))


def snapped(x: Floats) -> Floats:
    """Magnitudes below 1e-9 are 0, as in exact arithmetic: else rounding picks -pi or pi."""
    return np.where(np.abs(x) < TIE, 0.0, x)


def elevation(vectors: Floats) -> Floats:
    """Angle above the horizontal."""
    return np.arcsin(np.clip(vectors[:, 2] / np.linalg.norm(vectors, axis=1), -1.0, 1.0))


def entropy(weights: Floats | Ints) -> float:
    """Entropy of weights normalised to sum 1; an empty bin adds 0; no weight at all: NaN."""
    total = weights.sum()
    if not total > 0:
        return math.nan
    p = weights[weights > 0] / total
    return float(-(p * np.log2(p)).sum())


# --- 2. Sample point and vicinity


@dataclass(frozen=True, eq=False)
class World:
    """A map near the origin, with its cells."""

    origin: Floats
    """(3,) where the world's zero lies in the map frame [m]."""
    points: Floats
    """(n, 3) all map points."""
    cells: LiteralCells
    cell_of_point: Ints
    """(n,) -1 for points in no cell."""
    depth_points: Floats
    """The map points thinned to 0.5 m: the float64 of the map frame, moved exactly, since on which
    side of a pixel's edge a point lies is exact too."""
    means: cKDTree


def world_of(points: Floats, cell_size: float) -> World:
    """The map moved by whole lattice steps (of the cells and of the 0.5 m voxels) to the origin."""
    edge_mm = round(cell_size * 1000)
    points_mm = whole_mm(points)
    step_mm = math.lcm(edge_mm, DEPTH_EDGE_MM)
    low = points_mm.min(axis=0) if len(points_mm) else np.zeros(3, np.int64)
    origin_mm = low // step_mm * step_mm
    points_mm = points_mm - origin_mm
    cells, cell_of_point = cells_of_mm(points_mm, edge_mm)
    return World(
        origin=origin_mm / 1000.0,
        points=points_mm / 1000.0,
        cells=cells,
        cell_of_point=cell_of_point,
        depth_points=(thinned_mm(points_mm, DEPTH_EDGE_MM) + origin_mm) / 1000.0
        - origin_mm / 1000.0,
        means=cKDTree(cells.mean),
    )


def literal_ground(points: Floats, x: float, y: float) -> float:
    """z of the ground at (x, y): the 5th percentile within 1.0 m horizontally; NaN: missing."""
    mapped = whole_mm(points) / 1000.0
    near = np.hypot(mapped[:, 0] - x, mapped[:, 1] - y) <= 1.0
    return float(np.percentile(mapped[near, 2], 5.0)) if near.any() else math.nan


@dataclass(frozen=True, eq=False)
class View:
    """What one sample point sees of its world."""

    world: World
    place: Floats
    """(3,) the sample point, near the origin like its world."""
    sensor: Sensor
    members: Ints
    """Numbers of the cells of the vicinity, rising."""

    @property
    def rays(self) -> Floats:
        """(N, 3) mu - P of the cells of the vicinity."""
        return self.world.cells.mean[self.members] - self.place

    @property
    def points(self) -> Floats:
        """The vicinity points: the map points in the voxels of the vicinity's cells."""
        return self.world.points[np.isin(self.world.cell_of_point, self.members)]


def in_view(place: Floats, targets: Floats, sensor: Sensor) -> Ints:
    """Numbers of the targets with 0 < |t - P| <= R and an elevation within the field of view.

    A target within 1e-9 m is at P: at UTM coordinates no float64 can say it better.
    """
    rays = targets - place
    distance = np.linalg.norm(rays, axis=1)
    near = np.flatnonzero((distance > TIE) & (distance <= sensor.range_max + TIE))
    low, high = np.radians(sensor.fov_deg)
    up = elevation(rays[near])
    return near[(low <= up) & (up <= high)]


def view_from(world: World, P: Floats, sensor: Sensor) -> View:
    """The vicinity of a sample point (map frame): the cells in view."""
    place = np.asarray(P, np.float64) - world.origin
    return View(world, place, sensor, in_view(place, world.cells.mean, sensor))


# --- 3. The 20 factors


def feature_count(view: View) -> float:
    return float(len(view.members))


def dimension_count(view: View, dimension: int) -> float:
    return float((view.world.cells.dimension[view.members] == dimension).sum())


def D1_count(view: View) -> float:
    return dimension_count(view, 1)


def D2_count(view: View) -> float:
    return dimension_count(view, 2)


def D3_count(view: View) -> float:
    return dimension_count(view, 3)


def D1_ratio(view: View) -> float:
    return D1_count(view) / feature_count(view)


def D2_ratio(view: View) -> float:
    return D2_count(view) / feature_count(view)


def D3_ratio(view: View) -> float:
    return D3_count(view) / feature_count(view)


def row_edges_deg(sensor: Sensor) -> Floats:
    """Edges of the depth image's rows: halfway between beams, the outer ones mirrored [deg]."""
    beams = np.array(sensor.elevations_deg)
    between = (beams[:-1] + beams[1:]) / 2.0
    return np.concatenate([[2.0 * beams[0] - between[0]], between, [2.0 * beams[-1] - between[-1]]])


def depth_image(view: View) -> Flags:
    """(rows, 360) which pixels hold a map point with 0 < range <= R."""
    rays = view.world.depth_points - view.place
    distance = np.linalg.norm(rays, axis=1)
    rays = rays[(distance > 0.0) & (distance <= view.sensor.range_max)]
    columns = wrapped_bin(azimuth(rays) % (2 * np.pi), 0.0, np.radians(1.0), 360)
    up = np.degrees(elevation(rays))
    edges = row_edges_deg(view.sensor)
    image = np.zeros((len(edges) - 1, 360), bool)
    for row, (low, high) in enumerate(itertools.pairwise(edges)):
        part = (up - low) / (high - low) + TIE
        last = row == len(image) - 1
        inside = (part >= 0.0) & ((part <= 1.0 + 2 * TIE) if last else (part < 1.0))
        image[row, columns[inside]] = True
    return image


def occupancy_ratio(view: View) -> float:
    image = depth_image(view)
    return float(image.sum() / image.size)


def nearest_cells(world: World, x: Floats, limit: float = math.inf) -> tuple[Floats, Ints]:
    """Distance and number of the cell whose mean is nearest; beyond `limit`: inf and m.

    A tie (1e-9 m) goes to the smaller voxel index, that is to the smaller number.
    """
    reach = limit + 1e-3
    distance, cell = world.means.query(x, k=2, distance_upper_bound=reach)
    tied = np.isfinite(distance[:, 1]) & (distance[:, 1] <= distance[:, 0] + TIE)
    nearest = cell[:, 0].astype(np.int64)
    rival_distance, rivals = world.means.query(x[tied], k=8)  # a lattice has no more in one place
    level = rival_distance <= rival_distance[:, :1] + TIE
    nearest[tied] = np.where(level, rivals, len(world.cells)).min(axis=1)
    far = np.vstack([world.cells.mean, np.full(3, np.inf)])
    length = np.linalg.norm(x - far[nearest], axis=1)
    outside = length > limit + TIE
    return np.where(outside, np.inf, length), np.where(outside, len(world.cells), nearest)


def squared_mahalanobis(world: World, x: Floats, cell: Ints) -> Floats:
    """(x - mu)^T Sigma'^-1 (x - mu), regularised covariance."""
    y = x - world.cells.mean[cell]
    return np.einsum("ni,nij,nj->n", y, world.cells.precision[cell], y)


def euclidean_dist(view: View) -> float:
    return float(nearest_cells(view.world, view.points)[0].mean())


def mahalanobis_dist(view: View) -> float:
    x = view.points
    _, cell = nearest_cells(view.world, x)
    return float(np.sqrt(squared_mahalanobis(view.world, x, cell)).mean())


def r_average(view: View) -> float:
    return float(np.linalg.norm(view.rays, axis=1).mean())


def normal_entropy(view: View, m: int) -> float:
    normals = view.world.cells.normal[view.members]
    around = wrapped_bin(azimuth(normals), -np.pi, 2 * np.pi / m, m)
    up = clipped_bin(np.arcsin(np.clip(normals[:, 2], -1.0, 1.0)), -np.pi / 2, np.pi / m, m)
    return entropy(np.bincount(around * m + up, minlength=m * m))


def normal_H_8(view: View) -> float:
    return normal_entropy(view, 8)


def normal_H_16(view: View) -> float:
    return normal_entropy(view, 16)


def normal_H_90(view: View) -> float:
    return normal_entropy(view, 90)


def angular_H(view: View) -> float:
    around = wrapped_bin(azimuth(view.rays) % (2 * np.pi), 0.0, 2 * np.pi / 90, 90)
    return entropy(np.bincount(around, minlength=90))


def FDOP(view: View) -> float:
    variances = (view.rays**2).mean(axis=0)
    return float(1.0 / np.sqrt(variances.sum()))


def score_of_shift(world: World, x: Floats, shift: tuple[float, float]) -> Floats:
    """(n,) score of each point moved by `shift` in x and y."""
    d1, d2 = magnusson(world.cells.edge)
    moved = x + np.array([*shift, 0.0])
    distance, cell = nearest_cells(world, moved, limit=world.cells.edge)
    hit = np.isfinite(distance)
    score = np.zeros(len(x))
    score[hit] = -d1 * np.exp(-d2 / 2 * squared_mahalanobis(world, moved[hit], cell[hit]))
    return score


@cache
def score_field(view: View) -> Floats:
    """(441,) sum of the vicinity points' scores per shift, i slowest."""
    x = view.points
    return np.array([score_of_shift(view.world, x, shift).sum() for shift in SHIFTS])


def score_H(view: View) -> float:
    return entropy(score_field(view))


def neighbours(cells: LiteralCells, c: int) -> Ints:
    """Numbers of the other cells whose means lie within 5.0 m."""
    near = np.linalg.norm(cells.mean - cells.mean[c], axis=1) <= NEIGHBOUR_RADIUS + TIE
    near[c] = False
    return np.flatnonzero(near)


def literal_pfh(cells: LiteralCells, c: int) -> Floats | None:
    """(125,) point feature histogram of a cell, sum 1; None: it has none."""
    around = neighbours(cells, c)
    if len(around) < 3:
        return None
    group = np.sort(np.append(around, c))
    first, second = (group[k] for k in np.triu_indices(len(group), 1))
    d = cells.mean[second] - cells.mean[first]
    length = np.linalg.norm(d, axis=1)
    distinct = length > 0.0
    first, second, d, length = first[distinct], second[distinct], d[distinct], length[distinct]

    def along(cell: Ints) -> Floats:
        return np.abs((cells.normal[cell] * d).sum(axis=1)) / length

    turned = along(second) > along(first) + TIE  # else the first one is larger, or it is a tie
    source, target = np.where(turned, second, first), np.where(turned, first, second)
    d = np.where(turned[:, None], -d, d)
    u, n_t = cells.normal[source], cells.normal[target]
    v = np.cross(d, u)
    size = np.linalg.norm(v, axis=1)
    counted = size > 1e-6 * length
    if not counted.any():
        return None
    u, n_t, d, length = u[counted], n_t[counted], d[counted], length[counted]
    v = v[counted] / size[counted, None]
    w = np.cross(u, v)
    alpha = (v * n_t).sum(axis=1)
    phi = (u * d).sum(axis=1) / length
    theta = np.arctan2(snapped((w * n_t).sum(axis=1)), snapped((u * n_t).sum(axis=1)))
    box = clipped_bin(alpha, -1.0, 0.4, 5) * 25 + clipped_bin(phi, -1.0, 0.4, 5) * 5
    box += clipped_bin(theta, -np.pi, 2 * np.pi / 5, 5)
    histogram = np.bincount(box, minlength=125)
    return histogram / histogram.sum()


@cache
def histograms_around(view: View) -> tuple[dict[int, Ints], dict[int, Floats | None]]:
    """Neighbours of each cell of the vicinity, and the histograms of all of these cells."""
    cells = view.world.cells
    around = {c: neighbours(cells, c) for c in view.members.tolist()}
    involved = set(around) | {k for near in around.values() for k in near.tolist()}
    return around, {c: literal_pfh(cells, c) for c in involved}


def pfh_sim_H(view: View) -> float:
    around, histograms = histograms_around(view)
    entropies = [entropy(h) for c in around if (h := histograms[c]) is not None]
    return float(np.mean(entropies)) if entropies else math.nan


def pfh_distances(view: View) -> list[float]:
    """L1 distance of each cell of the vicinity and each neighbour, both having histograms."""
    around, histograms = histograms_around(view)
    return [
        float(np.abs(a - b).sum())
        for c, near in around.items()
        for k in near.tolist()
        if (a := histograms[c]) is not None and (b := histograms[k]) is not None
    ]


def pfh_sim_mnht(view: View) -> float:
    return float(sum(pfh_distances(view)))


def bhattacharyya(cells: LiteralCells, c: int, others: Ints) -> Floats:
    """Eq. 17 of a cell and each of the others, regularised covariances."""
    d = cells.mean[others] - cells.mean[c]
    S_c, S_k = cells.regularised[c], cells.regularised[others]
    middle = (S_c + S_k) / 2.0
    quadratic = np.einsum("ni,nij,nj->n", d, np.linalg.inv(middle), d) / 8.0
    spread = np.linalg.det(middle) / np.sqrt(np.linalg.det(S_c) * np.linalg.det(S_k))
    return quadratic + 0.5 * np.log(spread)


def bhatt_sim(view: View) -> float:
    cells = view.world.cells
    return float(sum(bhattacharyya(cells, c, neighbours(cells, c)).sum() for c in view.members))


# --- 4. The robust set: formulas as the catalogue of columns documents them


def shape_shares(view: View) -> Floats:
    """(N, 3) a1, a2, a3 of the cells of the vicinity; (0, 0, 1) where s1 <= 1e-6 m."""
    rows = []
    for s1, s2, s3 in np.sqrt(view.world.cells.eigenvalues[view.members]):
        rows.append(((s1 - s2) / s1, (s2 - s3) / s1, s3 / s1) if s1 > 1e-6 else (0.0, 0.0, 1.0))
    return np.array(rows)


def D1_share(view: View) -> float:
    return float(shape_shares(view)[:, 0].mean())


def D2_share(view: View) -> float:
    return float(shape_shares(view)[:, 1].mean())


def D3_share(view: View) -> float:
    return float(shape_shares(view)[:, 2].mean())


def loose_share(view: View) -> float:
    """Points of voxels with too few for a cell, whose mean is in view, among all points in view."""
    world = view.world
    loose = world.points[world.cell_of_point < 0]
    groups = voxel_groups(whole_mm(loose), round(world.cells.edge * 1000))
    centres = [(loose[group].mean(axis=0), len(group)) for _, group in groups]
    seen = sum(n for centre, n in centres if len(in_view(view.place, centre[None], view.sensor)))
    return seen / (seen + len(view.points))


def dilution(directions: Floats) -> tuple[float, float]:
    """sqrt(C_xx + C_yy) and sqrt(C_zz), C = (mean of d d^T)^-1; NaN: they do not span space."""
    spread = directions.T @ directions / len(directions)
    minors = (np.trace(spread) ** 2 - np.trace(spread @ spread)) / 2.0
    if not (minors > 1e-6 and np.linalg.det(spread) > 1e-6 * minors):
        return math.nan, math.nan
    C = np.linalg.inv(spread)
    return math.sqrt(C[0, 0] + C[1, 1]), math.sqrt(C[2, 2])


def sight_lines(view: View) -> Floats:
    return view.rays / np.linalg.norm(view.rays, axis=1)[:, None]


def normals_in_view(view: View) -> Floats:
    return view.world.cells.normal[view.members]


def sight_HDOP(view: View) -> float:
    return dilution(sight_lines(view))[0]


def sight_VDOP(view: View) -> float:
    return dilution(sight_lines(view))[1]


def normal_HDOP(view: View) -> float:
    return dilution(normals_in_view(view))[0]


def normal_VDOP(view: View) -> float:
    return dilution(normals_in_view(view))[1]


def standing(view: View) -> Flags:
    """Which cells of the vicinity have |n_z| < 0.9."""
    return np.abs(normals_in_view(view)[:, 2]) < 0.9


def wall_H(view: View) -> float:
    axes = azimuth(normals_in_view(view)[standing(view)]) % np.pi
    counts = np.bincount(wrapped_bin(axes, 0.0, np.pi / 36, 36), minlength=36)
    smooth = np.zeros(36)
    for step, weight in ((-2, 1), (-1, 2), (0, 3), (1, 2), (2, 1)):
        smooth += weight * np.roll(counts, step) / 9
    return entropy(smooth)


def structure_tensor(view: View) -> tuple[Floats, Floats]:
    """Eigenvalues, rising, and eigenvectors of the sum of (n_x, n_y) (n_x, n_y)^T."""
    flat = normals_in_view(view)[:, :2]
    values, vectors = np.linalg.eigh(flat.T @ flat)
    return np.maximum(values, 0.0), vectors


def wall_major(view: View) -> float:
    return float(structure_tensor(view)[0][1])


def wall_minor(view: View) -> float:
    return float(structure_tensor(view)[0][0])


def wall_balance(view: View) -> float:
    return wall_minor(view) / wall_major(view)


def weak_axis(view: View) -> float:
    """Direction of the smaller eigenvalue in [0, pi); NaN: neither is smaller (1e-9)."""
    (minor, major), vectors = structure_tensor(view)
    if major - minor <= 1e-9 * (major + minor):
        return math.nan
    return float(np.arctan2(vectors[1, 0], vectors[0, 0]) % np.pi)


def empty_sector(view: View) -> float:
    """The longest run of 4 deg bins without a standing cell, round the circle."""
    around = azimuth(view.rays[standing(view)]) % (2 * np.pi)
    occupied = np.unique(wrapped_bin(around, 0.0, 2 * np.pi / 90, 90))
    if len(occupied) == 0:
        return 2 * math.pi
    gaps = np.diff(np.append(occupied, occupied[0] + 90)) - 1
    return float(gaps.max() * np.radians(4.0))


def mean_score(view: View) -> Floats:
    """(21, 21) s(v): mean over the vicinity points of their scores; i is the row."""
    return (score_field(view) / len(view.points)).reshape(21, 21)


def softmax(view: View) -> Floats:
    """(21, 21) P(v) ~ exp(s(v) / 0.05)."""
    s = mean_score(view)
    weight = np.exp((s - s.max()) / 0.05)
    return weight / weight.sum()


def score_soft_H(view: View) -> float:
    return entropy(softmax(view).ravel())


def curvature(view: View) -> Floats:
    """Eigenvalues, rising, of -H in s(v) = c + g.v + v^T H v / 2, least squares on 5 x 5 shifts."""
    s = mean_score(view)[8:13, 8:13].ravel()
    x, y = (np.ravel(v) for v in np.meshgrid(*[np.arange(-2, 3) / 5] * 2, indexing="ij"))
    design = np.column_stack([np.ones(25), x, y, x * x / 2, x * y, y * y / 2])
    xx, xy, yy = np.linalg.lstsq(design, s)[0][3:]
    return np.linalg.eigvalsh(-np.array([[xx, xy], [xy, yy]]))


def score_curvature_min(view: View) -> float:
    return float(curvature(view)[0])


def score_curvature_max(view: View) -> float:
    return float(curvature(view)[1])


def score_peaks(view: View) -> float:
    """Local maxima besides the highest with at least 0.01 of its P; equal: the first is higher."""
    P = softmax(view)
    peaks = 0
    for i, j in np.ndindex(21, 21):
        beside = [
            (i + a, j + b)
            for a in (-1, 0, 1)
            for b in (-1, 0, 1)
            if (a, b) != (0, 0) and 0 <= i + a < 21 and 0 <= j + b < 21
        ]
        higher = all(P[i, j] > P[k] or (P[i, j] == P[k] and (i, j) < k) for k in beside)
        peaks += higher and P[i, j] >= 0.01 * P.max()
    return peaks - 1.0


def score_covariance(view: View) -> Floats:
    P = softmax(view).ravel()
    v = np.array(SHIFTS)
    away = v - P @ v
    return (away * P[:, None]).T @ away


def score_cov_xx(view: View) -> float:
    return float(score_covariance(view)[0, 0])


def score_cov_xy(view: View) -> float:
    return float(score_covariance(view)[0, 1])


def score_cov_yy(view: View) -> float:
    return float(score_covariance(view)[1, 1])


def pfh_mean(view: View) -> float:
    """pfh_sim_mnht per pair of neighbours that both have a histogram; no such pair: NaN."""
    distances = pfh_distances(view)
    return float(np.mean(distances)) if distances else math.nan


def bhatt_mean(view: View) -> float:
    """bhatt_sim per pair of neighbours; no pair: NaN."""
    pairs = sum(len(neighbours(view.world.cells, c)) for c in view.members)
    return bhatt_sim(view) / pairs if pairs else math.nan


COUNTS = (feature_count, D1_count, D2_count, D3_count)
FAITHFUL = (
    *COUNTS,
    D1_ratio,
    D2_ratio,
    D3_ratio,
    occupancy_ratio,
    euclidean_dist,
    mahalanobis_dist,
    r_average,
    normal_H_8,
    normal_H_16,
    normal_H_90,
    angular_H,
    FDOP,
    score_H,
    pfh_sim_H,
    pfh_sim_mnht,
    bhatt_sim,
)


ROBUST = (
    D1_share,
    D2_share,
    D3_share,
    loose_share,
    sight_HDOP,
    sight_VDOP,
    normal_HDOP,
    normal_VDOP,
    wall_H,
    wall_major,
    wall_minor,
    wall_balance,
    weak_axis,
    empty_sector,
    score_soft_H,
    score_curvature_min,
    score_curvature_max,
    score_peaks,
    score_cov_xx,
    score_cov_xy,
    score_cov_yy,
    pfh_mean,
    bhatt_mean,
)


def factors_of(
    view: View, which: tuple[Callable[[View], float], ...] = FAITHFUL
) -> dict[str, float]:
    """The factors in the order of the table; an empty vicinity: counts 0, the rest NaN."""
    if len(view.members) == 0:
        return {f.__name__: 0.0 if f in COUNTS else math.nan for f in which}
    return {factor.__name__: factor(view) for factor in which}


def literal_factors(
    points: Floats, P: Floats, sensor: Sensor, cell_size: float
) -> dict[str, float]:
    """The 20 factors of one sample point of a map given by all its points (map frame)."""
    return factors_of(view_from(world_of(points, cell_size), P, sensor))
