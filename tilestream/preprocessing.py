"""What is done to a scan before it is registered: cropped, limited in range, thinned, sampled.

The same for a real scan and a virtual one (definitions, section 5.1). The result depends neither on
the order of the points nor on how the starts are split.
"""

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import RegistrationError
from tilestream.grid import MM_PER_M, whole_mm
from tilestream.kernels.fixed_order import norms, turned
from tilestream.matcher import RegistrationSettings
from tilestream.records import Float64

LEAST_POINTS = 10
"""Fewest points of a scan that is registered, as given and after each step."""
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""The step of splitmix64 (Steele, Lea and Flood 2014)."""


def preprocessed(points: Float64, settings: RegistrationSettings) -> Float64:
    """The points of a scan that are registered.

    Args:
        points: (n, 3) in the lidar frame [m], finite.
        settings: the matcher: `crop`, `range_min`, `range_max`, `scan_leaf`, `random_sample`, in
            this order.

    Returns:
        (m, 3) points, sorted by voxel, or by x, y, z where `scan_leaf` is 0.

    Raises:
        RegistrationError: a step leaves fewer than 10 points, or the farthest point that is left is
            nearer than `required_distance`.
    """
    kept = kept_of(points, settings)
    if kept is not None:
        points = points[kept]
        if len(points) < LEAST_POINTS:
            raise RegistrationError(
                f"the scan has {len(points)} of {len(kept)} points in the crop box and range: "
                f"give at least {LEAST_POINTS}, or a wider crop"
            )
    points = thinned(points, settings.scan_leaf)
    if settings.random_sample is not None and settings.random_sample < len(points):
        points = points[sampled(points, settings.random_sample, settings.random_seed)]
    if settings.required_distance:
        reach = float(norms(points).max())
        if reach < settings.required_distance:
            raise RegistrationError(
                f"the scan reaches {reach:.1f} m, and the matcher wants points beyond "
                f"{settings.required_distance:g} m (required_distance)"
            )
    return points


def kept_of(points: Float64, settings: RegistrationSettings) -> NDArray[np.bool_] | None:
    """(n,) which points are within crop box and range; None: all are, nothing limits them."""
    limits = settings.crop, settings.range_min or None, settings.range_max
    if limits == (None, None, None):
        return None
    kept = np.ones(len(points), np.bool_)
    if settings.crop is not None:
        T_base_lidar = settings.mount.T_base_lidar
        in_base = turned(T_base_lidar[:3, :3], points) + T_base_lidar[:3, 3]
        inside = (in_base >= settings.crop.lowest) & (in_base <= settings.crop.highest)
        kept &= inside.all(axis=1) != settings.crop.negative
    ranges = norms(points)
    kept &= ranges >= settings.range_min
    if settings.range_max is not None:
        kept &= ranges <= settings.range_max
    return kept


def thinned(points: Float64, leaf: float) -> Float64:
    """The centroid of each voxel of the lidar frame's lattice, by voxel index; leaf 0: as given.

    Sums are fixed point (2^-30 m), so the order of the points has no effect. With leaf 0 the points
    are only sorted.

    Raises:
        RegistrationError: fewer than 10 are left.
    """
    leaf = whole_mm(leaf, "scan_leaf") / MM_PER_M
    if leaf == 0.0:
        return points[np.lexsort(points.T[::-1])]
    voxel = np.floor(points / leaf)
    order = np.lexsort(voxel.T[::-1])
    points, voxel = points[order], voxel[order]
    begins = np.flatnonzero(np.r_[True, (voxel[1:] != voxel[:-1]).any(axis=1)])
    if len(begins) < LEAST_POINTS:
        raise RegistrationError(
            f"the scan has {len(begins)} points after thinning to {leaf:g} m: "
            f"give at least {LEAST_POINTS}, or a smaller scan_leaf"
        )
    offset = np.rint((points - voxel * leaf) * 2.0**30).astype(np.int64)
    count = np.diff(np.r_[begins, len(points)])
    centroid = np.add.reduceat(offset, begins) / count[:, None] / 2.0**30
    found: Float64 = voxel[begins] * leaf + centroid
    return found


def sampled(points: Float64, count: int, seed: int) -> NDArray[np.intp]:
    """Rows of a random sample of points without repetition, rising.

    Each point gets a number from its coordinates and the seed alone (splitmix64); those with the
    smallest are taken, of equal ones the first.

    Args:
        points: (n, 3) [m], sorted.
        count: how many, at most n.
        seed: another one takes others.
    """
    number = np.full(len(points), seed, np.uint64)
    for coordinate in np.ascontiguousarray(points.T):
        number = mixed(number + GOLDEN) ^ (coordinate + 0.0).view(np.uint64)  # -0.0 is 0.0
    return np.sort(np.argsort(mixed(number + GOLDEN), kind="stable")[:count])


def mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The hash of splitmix64."""
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))
