"""First returns of beams that are cast at the surfels of a map, voxel by voxel.

Voxels are grouped in bricks of 8 x 8 x 8, the bricks lie on a dense grid, and free space is crossed
brick by brick. A voxel stores one surfel, the nearest of those that enter it; so a beam also meets
a disc where it crosses it in a neighbouring voxel. In the voxels that store a disc, the disc is its
whole plane, so that no beam passes between the points of a wall. Ranges are computed from whole
millimetres relative to the beams' origin: the same bits for any tiling and any map origin.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.cache import njit

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]

BRICK = 8
"""Voxels along the edge of a brick."""
VOXELS = BRICK**3
"""Voxels of a brick."""
OVER = 0.125
"""A disc enters a voxel whose centre is at most this far beside it [edges]."""
HUGE = 1e300
"""In place of 1 / 0: 0 times it is 0, not NaN."""
ROUNDING = 1e-3
"""Tolerance for rounding at the faces of a box [mm]."""
FREE = -1
"""In `grid` and `voxels`: no surfel."""
X, Y, Z, NX, NY, NZ, RADIUS = range(7)
"""Columns of a surfel: centre from the corner of the grid [mm], unit normal or 0 of a ball, radius
[mm]. Whole millimetres below 2^24 are exact in float32."""


class Bricks(NamedTuple):
    """Surfels around some places, indexed for ray casting."""

    edge: int
    """Edge of a voxel [mm]."""
    corner: Int64
    """(3,) the grid's lowest corner [mm, map frame], on the lattice of bricks."""
    grid: Int32
    """(nx, ny, nz) number of each brick, or `FREE`."""
    voxels: Int32
    """(bricks, 512) row in `surfels` of each voxel, z fastest, or `FREE`."""
    bounds: Float32
    """(bricks, 6) box of the voxels that are not free, lowest and highest [mm from the corner]."""
    surfels: Float32
    """(n, 8) surfels, columns `X` to `RADIUS`."""
    gone: NDArray[np.bool_]
    """(n,) surfels that no beam meets."""


@njit(nogil=True, error_model="numpy")
def mark_bricks(surfels: Float32, edge: int, grid: Int32) -> int:
    """Number the bricks of the grid that surfels may enter; return how many there are."""
    inverse = 1.0 / (BRICK * edge)
    for s in range(len(surfels)):
        x, y, z, r = surfels[s, X], surfels[s, Y], surfels[s, Z], surfels[s, RADIUS]
        for i in range(int((x - r) * inverse), int((x + r) * inverse) + 1):
            for j in range(int((y - r) * inverse), int((y + r) * inverse) + 1):
                for k in range(int((z - r) * inverse), int((z + r) * inverse) + 1):
                    grid[i, j, k] = 0
    count = 0
    flat = grid.reshape(-1)
    for b in range(flat.size):
        if flat[b] != FREE:
            flat[b] = count
            count += 1
    return count


@njit(nogil=True, error_model="numpy")
def _closer(surfels, a, b, x, y, z):  # type: ignore[no-untyped-def]
    """Whether the centre of surfel a is nearer to (x, y, z) than that of b; at equal distance:
    whether it comes first lexicographically. All are multiples of half a millimetre: no rounding
    decides.
    """
    da = (surfels[a, X] - x) ** 2 + (surfels[a, Y] - y) ** 2 + (surfels[a, Z] - z) ** 2
    db = (surfels[b, X] - x) ** 2 + (surfels[b, Y] - y) ** 2 + (surfels[b, Z] - z) ** 2
    if da != db:
        return da < db
    for axis in range(3):
        if surfels[a, axis] != surfels[b, axis]:
            return surfels[a, axis] < surfels[b, axis]
    return False


@njit(nogil=True, error_model="numpy", boundscheck=False)
def fill_bricks(surfels: Float32, edge: int, grid: Int32, voxels: Int32) -> None:
    """Give every voxel the nearest of the surfels that enter it.

    A disc enters the voxel of its centre, and those where its plane does and the centre of the
    voxel, moved onto that plane, lies on the disc or no more than `OVER` edges beside it.
    """
    half, inverse = 0.5 * edge, 1.0 / edge
    for s in range(len(surfels)):
        cx, cy, cz = np.float64(surfels[s, X]), np.float64(surfels[s, Y]), np.float64(surfels[s, Z])
        nx, ny, nz = (
            np.float64(surfels[s, NX]),
            np.float64(surfels[s, NY]),
            np.float64(surfels[s, NZ]),
        )
        r = np.float64(surfels[s, RADIUS])
        ball = nx == 0.0 and ny == 0.0 and nz == 0.0
        thick = half * (abs(nx) + abs(ny) + abs(nz))
        wide = (r + OVER * edge) ** 2
        for i in range(int((cx - r) * inverse), int((cx + r) * inverse) + 1):
            x = (i + 0.5) * edge
            for j in range(int((cy - r) * inverse), int((cy + r) * inverse) + 1):
                y = (j + 0.5) * edge
                for k in range(int((cz - r) * inverse), int((cz + r) * inverse) + 1):
                    z = (k + 0.5) * edge
                    dx, dy, dz = x - cx, y - cy, z - cz
                    off = abs(nx * dx + ny * dy + nz * dz)
                    beside = dx * dx + dy * dy + dz * dz - off * off > wide
                    own = max(abs(dx), abs(dy), abs(dz)) <= half
                    if not (ball or own) and (off > thick or beside):
                        continue
                    b = grid[i // BRICK, j // BRICK, k // BRICK]
                    v = ((i % BRICK) * BRICK + j % BRICK) * BRICK + k % BRICK
                    holds = voxels[b, v]
                    if holds == FREE or _closer(surfels, s, holds, x, y, z):
                        voxels[b, v] = s


@njit(nogil=True, error_model="numpy")
def bound_bricks(edge: int, grid: Int32, voxels: Int32) -> Float32:
    """(bricks, 6) the box of the voxels of each brick that are not free [mm from the corner]."""
    bounds = np.empty((len(voxels), 6), np.float32)
    bounds[:, :3], bounds[:, 3:] = np.inf, -np.inf
    for i, j, k in np.ndindex(grid.shape):
        b = grid[i, j, k]
        if b == FREE:
            continue
        for v in range(VOXELS):
            if voxels[b, v] != FREE:
                at = (
                    i * BRICK + v // BRICK**2,
                    j * BRICK + v // BRICK % BRICK,
                    k * BRICK + v % BRICK,
                )
                for axis in range(3):
                    bounds[b, axis] = min(bounds[b, axis], at[axis] * edge)
                    bounds[b, 3 + axis] = max(bounds[b, 3 + axis], (at[axis] + 1) * edge)
    return bounds


@njit(nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _meet(surfel, px, py, pz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Where a ray from p [mm from the grid's corner] along d meets a surfel: the range to the plane
    of a disc, or to the closest point to a ball's centre [mm]; by how much it misses the surfel
    [mm^2], inf if it misses a ball; the cosine of incidence.
    """
    x, y, z = np.float64(surfel[X]) - px, np.float64(surfel[Y]) - py, np.float64(surfel[Z]) - pz
    nx, ny, nz = np.float64(surfel[NX]), np.float64(surfel[NY]), np.float64(surfel[NZ])
    r = np.float64(surfel[RADIUS])
    slope = nx * dx + ny * dy + nz * dz
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        t, cosine = x * dx + y * dy + z * dz, 1.0
    elif slope == 0.0:
        return np.inf, np.inf, 0.0
    else:
        t, cosine = (nx * x + ny * y + nz * z) / slope, abs(slope)
    ox, oy, oz = t * dx - x, t * dy - y, t * dz - z
    miss = ox * ox + oy * oy + oz * oz - r * r
    return t, miss if slope != 0.0 or miss <= 0.0 else np.inf, cosine


@njit(nogil=True, error_model="numpy", inline="always")
def _crossing(position, index, d, size):  # type: ignore[no-untyped-def]
    """Range at which a ray leaves box `index` along an axis, and the range from border to border
    [mm].
    """
    if d > 0.0:
        return ((index + 1) * size - position) / d, size / d
    if d < 0.0:
        return (index * size - position) / d, -size / d
    return np.inf, np.inf


@njit(nogil=True, error_model="numpy", inline="always")
def _voxel_at(position, brick, edge):  # type: ignore[no-untyped-def]
    """Voxel of a coordinate [mm] along an axis, counted from its brick's corner, clipped to it."""
    voxel = np.int64(math.floor(position / edge)) - brick * BRICK
    return min(max(voxel, 0), BRICK - 1)


@njit(nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _slab(low, high, position, inverse, t, t_out):  # type: ignore[no-untyped-def]
    """The part of a ray's range t to t_out [mm] between two planes of an axis, with a little
    margin.
    """
    first = (np.float64(low) - position) * inverse
    second = (np.float64(high) - position) * inverse
    return max(t, min(first, second) - ROUNDING), min(t_out, max(first, second) + ROUNDING)


@njit(nogil=True, error_model="numpy", boundscheck=False)
def _through_brick(voxels, surfels, gone, edge, brick, start, p, d, t, t_out, near, best):  # type: ignore[no-untyped-def]
    """The first surfel met in a brick between t and t_out, if nearer than `best` [mm].

    `brick` and `start` count from the brick in which the ray starts, `p` from the grid's corner:
    so no rounding depends on where that corner is.
    """
    px, py, pz = p
    dx, dy, dz = d
    i, j, k = brick
    fx, fy, fz = start
    u = _voxel_at(fx + dx * t, i, edge)
    v = _voxel_at(fy + dy * t, j, edge)
    w = _voxel_at(fz + dz * t, k, edge)
    tu, su = _crossing(fx, u + i * BRICK, dx, edge)
    tv, sv = _crossing(fy, v + j * BRICK, dy, edge)
    tw, sw = _crossing(fz, w + k * BRICK, dz, edge)
    du = 1 if dx > 0.0 else -1
    dv = 1 if dy > 0.0 else -1
    dw = 1 if dz > 0.0 else -1
    cosine, which = 0.0, FREE
    while t <= t_out and t < best:
        s = voxels[(u * BRICK + v) * BRICK + w]
        leaves = min(tu, tv, tw)
        if s != FREE and not gone[np.uint64(s)]:
            surfel = surfels[np.uint64(s)]
            met, miss, its_cosine = _meet(surfel, px, py, pz, dx, dy, dz)
            solid = t - ROUNDING <= met <= leaves + ROUNDING and miss < np.inf
            if near <= met < best and (miss <= 0.0 or solid):
                best, cosine, which = met, its_cosine, s
        t = leaves
        if tu <= tv and tu <= tw:
            tu, u = tu + su, u + du
        elif tv <= tw:
            tv, v = tv + sv, v + dv
        else:
            tw, w = tw + sw, w + dw
        if not (0 <= u < BRICK and 0 <= v < BRICK and 0 <= w < BRICK):
            break
    return best, cosine, which


@njit(nogil=True, error_model="numpy", boundscheck=False)
def cast(
    bricks: Bricks,
    place_mm: Int64,
    directions: Float64,
    near: float,
    reach: float,
    out_range: Float64,
    out_cosine: Float64,
    out_surfel: Int32,
) -> None:
    """The first surfel that each beam meets.

    A 3-D digital differential analyser (Amanatides and Woo 1987) steps from brick to brick, and in
    a brick that is not free from voxel to voxel. It ends when it is beyond the nearest surfel met.

    Args:
        bricks: the surfels around the place.
        place_mm: (3,) where the beams start [mm, map frame].
        directions: (n, 3) unit vectors in the map frame.
        near: surfels nearer than this are ignored [mm]: the vehicle itself is there.
        reach: surfels farther than this are ignored [mm].
        out_range: (n,) receives the ranges [m]; inf where nothing is met.
        out_cosine: (n,) receives the cosines of incidence; 0 where nothing is met.
        out_surfel: (n,) receives the rows of what is met; `FREE` where nothing is.
    """
    edge = bricks.edge
    size = np.int64(BRICK * edge)
    grid, voxels, surfels, bounds = bricks.grid, bricks.voxels, bricks.surfels, bricks.bounds
    nx, ny, nz = grid.shape
    x, y, z = place_mm[0], place_mm[1], place_mm[2]
    x, y, z = x - bricks.corner[0], y - bricks.corner[1], z - bricks.corner[2]
    i0, j0, k0 = x // size, y // size, z // size
    px, py, pz = float(x), float(y), float(z)
    fx, fy, fz = float(x - i0 * size), float(y - j0 * size), float(z - k0 * size)
    for n in range(len(directions)):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        ix = 1.0 / dx if dx != 0.0 else HUGE
        iy = 1.0 / dy if dy != 0.0 else HUGE
        iz = 1.0 / dz if dz != 0.0 else HUGE
        i, j, k = np.int64(0), np.int64(0), np.int64(0)
        ti, si = _crossing(fx, i, dx, size)
        tj, sj = _crossing(fy, j, dy, size)
        tk, sk = _crossing(fz, k, dz, size)
        di = 1 if dx > 0.0 else -1
        dj = 1 if dy > 0.0 else -1
        dk = 1 if dz > 0.0 else -1
        t, best, cosine, which = 0.0, np.inf, 0.0, FREE
        while t < best and t <= reach:
            gi, gj, gk = i + i0, j + j0, k + k0
            if not (0 <= gi < nx and 0 <= gj < ny and 0 <= gk < nz):
                break
            t_out = min(ti, tj, tk)
            b = grid[gi, gj, gk]
            if b != FREE:
                box = bounds[np.uint64(b)]
                begin, end = _slab(box[2], box[5], pz, iz, t, t_out)
                begin, end = _slab(box[0], box[3], px, ix, begin, end)
                begin, end = _slab(box[1], box[4], py, iy, begin, end)
                if begin <= end:
                    met, its_cosine, its_row = _through_brick(
                        voxels[np.uint64(b)],
                        surfels,
                        bricks.gone,
                        edge,
                        (i, j, k),
                        (fx, fy, fz),
                        (px, py, pz),
                        (dx, dy, dz),
                        begin,
                        end,
                        near,
                        best,
                    )
                    if met < best:
                        best, cosine, which = met, its_cosine, its_row
            t = t_out
            if ti <= tj and ti <= tk:
                ti, i = ti + si, i + di
            elif tj <= tk:
                tj, j = tj + sj, j + dj
            else:
                tk, k = tk + sk, k + dk
        met = best <= reach
        out_range[n] = best / 1000.0 if met else np.inf
        out_cosine[n] = cosine if met else 0.0
        out_surfel[n] = which if met else FREE


@njit(nogil=True, error_model="numpy")
def leave_map(
    mapped: NDArray[np.bool_],
    corner: Int64,
    size: int,
    place_mm: Int64,
    directions: Float64,
    ranges: Float64,
    reach: float,
) -> NDArray[np.bool_]:
    """Which beams without a return pass over a column in which the map has nothing.

    Args:
        mapped: (nx, ny) columns of the map that hold anything; those beyond hold nothing.
        corner: (2,) the lowest corner of the columns [mm, map frame].
        size: edge of a column [mm].
        place_mm: (3,) where the beams start [mm, map frame].
        directions: (n, 3) unit vectors in the map frame.
        ranges: (n,) what they met [m], inf: nothing.
        reach: how far they go [mm].
    """
    out = np.zeros(len(directions), np.bool_)
    x, y = float(place_mm[0] - corner[0]), float(place_mm[1] - corner[1])
    for n in range(len(directions)):
        if np.isfinite(ranges[n]):
            continue
        dx, dy = directions[n, 0], directions[n, 1]
        i, j = int(x // size), int(y // size)
        ti, si = _crossing(x, i, dx, size)
        tj, sj = _crossing(y, j, dy, size)
        t = 0.0
        while t <= reach:
            inside = 0 <= i < mapped.shape[0] and 0 <= j < mapped.shape[1]
            if not (inside and mapped[i, j]):
                out[n] = True
                break
            if ti <= tj:
                t, ti, i = ti, ti + si, i + (1 if dx > 0.0 else -1)
            else:
                t, tj, j = tj, tj + sj, j + (1 if dy > 0.0 else -1)
    return out
