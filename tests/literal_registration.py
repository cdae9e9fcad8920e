"""3D-NDT registration as definitions, section 5, reads: NumPy, float64, slow.

The kernels must equal it. Nothing here is shared with them.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from tilestream.records import Cells
from tilestream.settings import RegistrationSettings

Floats = NDArray[np.float64]
FACES = ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def cross(v: Floats) -> Floats:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def expm(w: Floats) -> Floats:
    """Exp of a rotation vector, by its series."""
    total, term = np.eye(3), np.eye(3)
    for k in range(1, 25):
        term = term @ cross(w) / k
        total = total + term
    return total


def constants(size: float, outliers: float) -> tuple[float, float]:
    c1, c2 = 10 * (1 - outliers), outliers / size**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    return d1, -2 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)


def thinned(points: Floats, leaf: float) -> Floats:
    groups: dict[tuple[int, ...], list[Floats]] = {}
    for p in points:
        groups.setdefault(tuple(math.floor(x / leaf) for x in p), []).append(p)
    return np.array([np.mean(groups[key], axis=0) for key in sorted(groups)])


class Matcher:
    """Cells and settings, ready to score poses."""

    def __init__(self, cells: Cells, scan: Floats, settings: RegistrationSettings) -> None:
        self.cells, self.settings = cells, settings
        self.scan = thinned(scan, settings.scan_leaf) if settings.scan_leaf else scan
        self.d1, self.d2 = constants(cells.cell_size, settings.outlier_ratio)
        self.row = {tuple(v): k for k, v in enumerate(cells.index.tolist())}
        self.inverse = np.array([self.density(k) for k in range(len(cells))])

    def density(self, k: int) -> Floats:
        covariance, floor = self.cells.covariance[k], 0.01**2
        if self.settings.covariance == "seeded":
            covariance, floor = covariance + np.eye(3) / (self.cells.count[k] - 1), 0.0
        values, vectors = np.linalg.eigh(covariance)
        values = np.maximum(values, max(0.01 * values[-1], floor))
        return np.linalg.inv(vectors @ np.diag(values) @ vectors.T)

    def neighbours(self, y: Floats) -> list[int]:
        """Rows of the cells that score a point of the map frame."""
        if self.settings.neighbours == "radius":
            distance = np.linalg.norm(self.cells.mean - y, axis=1)
            return np.flatnonzero(distance <= self.cells.cell_size).tolist()
        voxel = np.floor(y / self.cells.cell_size).astype(int)
        faces = FACES[:1] if self.settings.neighbours == "direct1" else FACES
        keys = [tuple((voxel + face).tolist()) for face in faces]
        return [self.row[key] for key in keys if key in self.row]

    def pairs(self, T: Floats) -> list[list[int]]:
        return [self.neighbours(T[:3, :3] @ p + T[:3, 3]) for p in self.scan]

    def scores(self, T: Floats, pairs: list[list[int]] | None = None) -> list[list[float]]:
        """-d1 p of every point and cell."""
        pairs = pairs or self.pairs(T)
        _, q, B, _ = self.flat(T, pairs)
        squared = np.einsum("ki,kij,kj->k", q, B, q)
        flat = iter((-self.d1 * np.exp(-self.d2 / 2 * squared)).tolist())
        return [[next(flat) for _ in rows] for rows in pairs]

    def flat(self, T: Floats, pairs: list[list[int]]) -> tuple[Floats, Floats, Floats, Floats]:
        """Of every pair: r = R p, q from the mean to the point, inverse covariance, and J."""
        point = np.repeat(np.arange(len(pairs)), [len(rows) for rows in pairs])
        row = np.array([k for rows in pairs for k in rows], dtype=int)
        r = self.scan[point] @ T[:3, :3].T
        J = np.zeros((len(r), 3, 6))
        J[:, :, :3] = np.eye(3)
        for axis in range(3):
            J[:, :, 3 + axis] = np.cross(np.eye(3)[axis], r)
        return r, r + T[:3, 3] - self.cells.mean[row], self.inverse[row], J

    def score(self, T: Floats, pairs: list[list[int]] | None = None) -> float:
        return math.fsum(itertools.chain(*self.scores(T, pairs)))

    def nvtl_and_hits(self, T: Floats) -> tuple[float, int]:
        scores = self.scores(T)
        return sum(max(s, default=0.0) for s in scores) / len(scores), sum(map(bool, scores))

    def derivatives(self, T: Floats, euler: bool = False) -> tuple[Floats, Floats]:
        """Gradient and Hessian of the score, for (tau, w), or for (t, Euler angles)."""
        axes = euler_axes(euler_angles(T[:3, :3])) if euler else np.eye(3)
        r, q, B, J = self.flat(T, self.pairs(T))
        J[:, :, 3:] = J[:, :, 3:] @ axes
        f = np.einsum("kij,kj->ki", B, q)
        w = -self.d1 * self.d2 * np.exp(-self.d2 / 2 * np.einsum("ki,ki->k", q, f))
        curved = B - self.d2 * f[:, :, None] * f[:, None, :]
        g = -np.einsum("k,kij,ki->j", w, J, f)
        H = -np.einsum("k,kia,kij,kjb->ab", w, J, curved, J, optimize=True)
        for i, j in itertools.product(range(3), repeat=2):
            outer, inner = axes[:, min(i, j)], axes[:, max(i, j)]
            one = np.cross(outer, np.cross(inner, r))
            other = one if euler else np.cross(inner, np.cross(outer, r))
            H[3 + i, 3 + j] -= np.einsum("k,ki,ki->", w, f, (one + other) / 2)
        return g, H

    def step(self, T: Floats) -> tuple[Floats, float]:
        """The pose after one step, and the step's norm."""
        how = self.settings
        g, H = self.derivatives(T, how.rotation == "euler")
        d = definite(g, H, how) if how.solver == "definite" else raw(g, H, how)
        after = T.copy()
        after[:3, 3] += d[:3]
        if how.rotation == "euler":
            after[:3, :3] = from_euler(euler_angles(T[:3, :3]) + d[3:])
        else:
            after[:3, :3] = expm(d[3:]) @ T[:3, :3]
        return after, float(np.linalg.norm(d))

    def register(self, T: Floats) -> tuple[Floats, int, bool]:
        for k in range(self.settings.iterations_max):
            T, norm = self.step(T)
            if norm < self.settings.epsilon:
                return T, k + 1, True
        return T, self.settings.iterations_max, False


def definite(g: Floats, H: Floats, how: RegistrationSettings) -> Floats:
    D = np.diag([1, 1, 1, 0.1, 0.1, 0.1])
    e, V = np.linalg.eigh(D @ H @ D)
    e = -np.maximum(np.abs(e), 1e-6 * np.abs(e).max())
    d = D @ (V @ (-(V.T @ (D @ g)) / e))
    return d * min(1.0, how.step_max / np.linalg.norm(d))


def raw(g: Floats, H: Floats, how: RegistrationSettings) -> Floats:
    d = -np.linalg.lstsq(H, g, rcond=None)[0]
    if g @ d <= 0:
        d = -d
    norm = np.linalg.norm(d)
    return d / norm * max(min(norm, how.step_max), how.epsilon / 2)


def euler_angles(R: Floats) -> Floats:
    return np.array(
        [
            math.atan2(-R[1, 2], R[2, 2]),
            math.asin(R[0, 2]),
            math.atan2(-R[0, 1], R[0, 0]),
        ]
    )


def turn(axis: int, angle: float) -> Floats:
    return expm(np.eye(3)[axis] * angle)


def from_euler(angles: Floats) -> Floats:
    return turn(0, angles[0]) @ turn(1, angles[1]) @ turn(2, angles[2])


def euler_axes(angles: Floats) -> Floats:
    first = turn(0, angles[0])
    return np.column_stack([np.eye(3)[0], first[:, 1], (first @ turn(1, angles[1]))[:, 2]])
