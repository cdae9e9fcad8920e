"""Coarse first: at which places of a route a virtual drive is taken, and what is said of those
between (definitions, section 4.6).

The places of a route are numbered from 0 at equal steps of arc length. All arrays are of one route.
"""

import hashlib

import numpy as np
from numpy.typing import NDArray

from tilestream.factors.along_route import CUT, SLACK
from tilestream.preprocessing import mixed
from tilestream.records import Float64, Int64

Bool = NDArray[np.bool_]
INTERPOLATED = "interpolated"
"""Status of a place whose estimate is not that of a run of all places: a line between what is known
before and behind it."""


def half_support(width: float, spacing: float) -> int:
    """How many places to each side the kernel of a place reaches (`averaged_along`).

    Args:
        width: of the kernel [m].
        spacing: of the places [m].
    """
    return int((CUT * width + SLACK) / spacing)


def first_stations(places: int, half: int, every: int) -> Int64:
    """Both ends of a route, and evenly between them so many stations that about one place in
    4 `every` is taken up by them and their supports: most of the first virtual drives are probes,
    since a short rise of the error that none of them meets stays unseen.

    Args:
        places: of the route.
        half: places to each side that a station's kernel reaches.
        every: one place in so many.
    """
    between = round(places / (4 * every * (2 * half + 1)))
    return np.unique(np.rint(np.linspace(0, places - 1, between + 2)).astype(np.int64))


def probes(stations: Int64, every: int) -> Int64:
    """The places between stations, evenly spread, where a virtual drive is taken without those
    around it, to see whether something lies between: about three places in 4 `every`.

    Args:
        stations: those of a route, rising.
        every: one place in so many.
    """
    step = 4 * every / 3
    found = [np.zeros(0)]
    for a, b in zip(stations[:-1].tolist(), stations[1:].tolist(), strict=True):
        found.append(np.linspace(a, b, max(round((b - a) / step), 1) + 1)[1:-1])
    places: Int64 = np.rint(np.concatenate(found)).astype(np.int64)
    return places


def support(stations: Int64, taken: Bool, half: int) -> Bool:
    """(n,) the places that stations need and that are not taken yet.

    The kernel takes neighbours in pairs, so that near an end of the route it needs no more to the
    other side; where that is taken and the station has no whole kernel yet, since a place of it is
    not done, it may reach all the way.

    Args:
        stations: places whose kernels are to be whole.
        taken: (n,) where a virtual drive has been taken.
        half: places to each side that a kernel reaches.
    """
    n = len(taken)
    wanted = np.zeros(n, bool)
    for at in stations.tolist():
        paired = min(half, at, n - 1 - at)
        reach = half if taken[at - paired : at + paired + 1].all() else paired
        wanted[max(at - reach, 0) : at + reach + 1] = True
    return wanted & ~taken


def known(taken: Bool, done: Bool, half: int) -> Bool:
    """(n,) the places of which is known by now what is known of them if all places are taken.

    Those that could not be done have no estimate then either. The kernel of the others must be
    whole: all within its reach is taken, or all of its pairs are done.

    Args:
        taken: (n,) where a virtual drive has been taken.
        done: (n,) where it has succeeded.
        half: places to each side that a kernel reaches.
    """
    n = len(taken)
    at = np.arange(n)
    paired = np.minimum(half, np.minimum(at, n - 1 - at))
    low, high = np.maximum(at - half, 0), np.minimum(at + half, n - 1)
    kernel = _all(taken, low, high) | _all(done, at - paired, at + paired)
    found: Bool = kernel | (taken & ~done)
    return found


def _all(some: Bool, low: Int64, high: Int64) -> Bool:
    """(k,) whether all from `low` to `high` are true."""
    total = np.concatenate([[0], np.cumsum(some)])
    found: Bool = total[high + 1] - total[low] == high + 1 - low
    return found


def gaps(ends: Bool) -> Int64:
    """(k, 2) the places that are known with unknown ones between them, one behind the other.

    Args:
        ends: (n,) the known places, the ends of the route among them.
    """
    at = np.flatnonzero(ends)
    pairs = np.column_stack([at[:-1], at[1:]])
    found: Int64 = pairs[np.diff(at) > 1]
    return found


def halved(of: Int64, estimate: Float64, tolerance: float, high: float) -> Int64:
    """The stations that halve those gaps over which nothing may be interpolated: where an end has
    no estimate, both differ by more than the tolerance, or a place of it, whose kernel need not be
    whole, is high or farther than that from the line between the ends.

    Args:
        of: (k, 2) gaps.
        estimate: (n,) of the places, from as much of their kernels as is taken [m]; NaN where none
            is.
        tolerance: how far off an interpolated estimate may be [m].
        high: an estimate above this is high [m].
    """
    wanted = []
    for a, b in of.tolist():
        seen = estimate[a : b + 1]
        line = np.linspace(seen[0], seen[-1], b - a + 1)
        there = np.isfinite(seen)
        close = np.abs(seen - line)[there] <= tolerance
        even = abs(seen[-1] - seen[0]) <= tolerance  # which no NaN is
        if not (even and close.all() and (seen[there] <= high).all()):
            wanted.append((a + b) // 2)
    return np.array(wanted, np.int64)


def numbers(route_id: str, samples: Int64, seed: int) -> NDArray[np.uint64]:
    """(k,) a number of each place of a route, as if drawn and always the same: the places with the
    smallest are those that are checked.

    Args:
        route_id: its name.
        samples: (k,) the places.
        seed: of the draw.
    """
    name = hashlib.blake2b(f"{seed} {route_id}".encode(), digest_size=8).digest()
    return mixed(samples.astype(np.uint64) + np.frombuffer(name, "<u8"))
