"""Coarse first, over all routes: what is evaluated so far, what is evaluated next, and how often
what is interpolated is off (definitions, section 4.6).
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from tilestream.factors.stations import (
    first_stations,
    gaps,
    halved,
    known,
    numbers,
    probes,
    support,
)
from tilestream.records import Float64, Int64
from tilestream.settings import CoarseSettings

CHECKED_OF = 50
"""One of so many interpolated places is checked, at most: each takes a whole kernel of places."""


@dataclass(frozen=True)
class Told:
    """What a coarse run did, and how far its interpolated places can be trusted."""

    every: int
    """First about one place in so many was evaluated."""
    tolerance: float
    """How far off an interpolated estimate may be [m]."""
    places: int
    """All sample points."""
    first: int
    """Virtual drives of the first round."""
    evaluated: int
    """Virtual drives of all rounds."""
    interpolated: int
    """Places that are interpolated …"""
    alone: int
    """… of which so many have a virtual drive, but not all that their estimate averages."""
    rounds: int
    """How many rounds there were."""
    checked: int
    """Interpolated places, chosen by lot, that were evaluated after all …"""
    off: int
    """… of which so many were farther off than the tolerance, or had no estimate."""
    off_mean: float | None
    """How far off those were that had one, in the mean [m]; None: none was checked …"""
    off_most: float | None
    """… at most …"""
    off_bias: float | None
    """… and with its sign: above 0, they were interpolated too high; None: none was checked."""
    off_of: float | None
    """What they were evaluated to, in the mean [m]; None: none was checked."""
    off_share: float | None
    """Share of these; None: none was checked …"""
    off_low: float | None
    """… and the ends of its 95 % interval (Wilson)."""
    off_high: float | None
    """See `off_low`."""

    @property
    def words(self) -> str:
        """The same as sentences."""
        n = self.interpolated
        said = (
            f"{self.evaluated:,} virtual drives were taken for {self.places:,} places, an estimate "
            f"averages those around it: {self.places - n:,} have what a run of all places gives"
        )
        if not n:
            return f"{said}, none is interpolated."
        said += f"; {n:,} others are interpolated along their route where they have ground, "
        said += f"{self.alone:,} of them through a virtual drive of their own. "
        if self.off_share is None:
            return f"{said}None of them was checked: how often they are off is not known."
        centimetres = f"{100.0 * self.tolerance:g} cm"
        return (
            f"{said}Of {self.checked:,} such places that were checked by lot {self.off:,} were off "
            f"by more than {centimetres}: {self.off_share:.0%} ({self.off_low:.0%} to "
            f"{self.off_high:.0%}).{self._by}"
        )

    @property
    def _by(self) -> str:
        """By how much, in words."""
        mean, most, bias, of = self.off_mean, self.off_most, self.off_bias, self.off_of
        if mean is None or most is None or bias is None or of is None:
            return ""
        cm = [f"{100.0 * length:.1f}" for length in (of, mean, most, abs(bias))]
        side = "low" if bias < 0.0 else "high"
        return (
            f" They were evaluated to {cm[0]} cm on average; interpolated they were off by {cm[1]} "
            f"cm on average, at most {cm[2]}, and in the mean {cm[3]} cm too {side}."
        )

    def plain(self) -> dict[str, object]:
        """The fields, and `told`: the same in words."""
        return {**asdict(self), "told": self.words}


class Coarse:
    """What is known of the places of all routes, which are numbered one route after the other."""

    def __init__(self, routes: Mapping[str, int], half: int, settings: CoarseSettings) -> None:
        """Before anything is evaluated.

        Args:
            routes: how many places each route has.
            half: places to each side that a kernel reaches (`half_support`).
            settings: what decides.
        """
        self._routes, self._half, self._settings = dict(routes), half, settings
        total = sum(self._routes.values())
        self._taken = np.zeros(total, bool)
        self._lost = np.zeros(total, bool)
        self._estimate = np.full(total, np.nan)
        self._checked: Int64 | None = None
        self._said = np.zeros(0)  # of the checked places, before they were evaluated [m]
        self._found = np.zeros(0)  # what they were evaluated to [m]
        self._first = self._rounds = 0

    def next(self) -> Int64:
        """The places to evaluate next; none: the rest is interpolated.

        When nothing is left to halve, some interpolated places are chosen by lot; what these show
        may ask for more.
        """
        if not self._rounds:
            wanted = self._begun()
            self._first = len(wanted)
        else:
            self._check()
            coarse = self._settings
            wanted = self._supports(
                halved(self.gaps, self._estimate, coarse.tolerance, coarse.high)
            )
            if not wanted.size and self._checked is None:
                wanted = self._supports(self._lots())
        self._rounds += bool(wanted.size)
        self._taken[wanted] = True
        return wanted

    def learn(self, estimate: Float64) -> None:
        """What the estimates are now.

        Args:
            estimate: (n,) of all places [m]; NaN where there is none.
        """
        self._estimate = np.where(self._taken & ~self._lost, estimate, np.nan)

    def lose(self, places: Int64) -> None:
        """Of these places nothing can be known."""
        self._lost[places] = self._taken[places] = True

    @property
    def gaps(self) -> Int64:
        """(k, 2) the known places between which all others lie, each pair of one route."""
        done = np.isfinite(self._estimate)
        found = [np.zeros((0, 2), np.int64)]
        for _, begin, count in self._parts():
            part = slice(begin, begin + count)
            found.append(begin + gaps(known(self._taken[part], done[part], self._half)))
        return np.concatenate(found)

    @property
    def interpolated(self) -> Int64:
        """The places in the gaps."""
        inside = [np.arange(a + 1, b) for a, b in self.gaps.tolist()]
        return np.concatenate([*inside, np.zeros(0, np.int64)])

    @property
    def between(self) -> tuple[Int64, NDArray[np.bool_]]:
        """(k, 2) the places with an estimate between which the gaps are interpolated, one behind
        the other, each pair of one gap; (k,) whether the second is the end of its gap, and not in
        it with the estimate of as much of its kernel as is taken.
        """
        there = np.isfinite(self._estimate)
        pairs, ends = [np.zeros((0, 2), np.int64)], [np.zeros(0, bool)]
        for a, b in self.gaps.tolist():
            at = a + np.flatnonzero(there[a : b + 1])
            pairs.append(np.column_stack([at[:-1], at[1:]]))
            ends.append(at[1:] == b)
        return np.concatenate(pairs), np.concatenate(ends)

    def told(self) -> Told:
        """What was done, and how often what is interpolated is off."""
        inside, difference = self.interpolated, self._said[: len(self._found)] - self._found
        known = np.isfinite(difference)
        there = difference[known]
        off = int((~(np.abs(difference) <= self._settings.tolerance)).sum())
        count = 0 if self._checked is None else len(self._checked)
        share = low = high = None
        if count:
            interval = binomtest(off, count).proportion_ci(0.95, method="wilson")
            share, low, high = off / count, float(interval.low), float(interval.high)
        return Told(
            every=self._settings.every,
            tolerance=self._settings.tolerance,
            places=len(self._taken),
            first=self._first,
            evaluated=int((self._taken & ~self._lost).sum()),
            interpolated=len(inside),
            alone=int(np.isfinite(self._estimate[inside]).sum()),
            rounds=self._rounds,
            checked=count,
            off=off,
            off_mean=float(np.abs(there).mean()) if there.size else None,
            off_most=float(np.abs(there).max()) if there.size else None,
            off_bias=float(there.mean()) if there.size else None,
            off_of=float(self._found[known].mean()) if there.size else None,
            off_share=share,
            off_low=low,
            off_high=high,
        )

    def _parts(self) -> Iterator[tuple[str, int, int]]:
        """Name, first place and number of places of each route."""
        begin = 0
        for name, count in self._routes.items():
            yield name, begin, count
            begin += count

    def _begun(self) -> Int64:
        """The places of the first round."""
        every, half = self._settings.every, self._half
        stations, between = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for _, begin, count in self._parts():
            of_route = first_stations(count, half, every)
            stations.append(begin + of_route)
            between.append(begin + probes(of_route, every))
        return np.union1d(self._supports(np.concatenate(stations)), np.concatenate(between))

    def _supports(self, stations: Int64) -> Int64:
        """The places that stations need and that are not taken."""
        wanted = np.zeros(len(self._taken), bool)
        for _, begin, count in self._parts():
            own = stations[(stations >= begin) & (stations < begin + count)] - begin
            part = slice(begin, begin + count)
            wanted[part] = support(own, self._taken[part], self._half)
        return np.flatnonzero(wanted)

    def _lots(self) -> Int64:
        """The interpolated places that are checked."""
        inside = self.interpolated
        drawn: NDArray[np.uint64] = np.concatenate(
            [
                numbers(name, np.arange(count), self._settings.seed)
                for name, _, count in self._parts()
            ]
        )
        count = min(self._settings.checks, -(-len(inside) // CHECKED_OF))
        self._checked = np.sort(inside[np.argsort(drawn[inside], kind="stable")[:count]])
        there = np.flatnonzero(np.isfinite(self._estimate))
        if count:
            self._said = np.interp(self._checked, there, self._estimate[there])
        return self._checked

    def _check(self) -> None:
        """Keep what the checked places were evaluated to, once they are."""
        if self._checked is not None and not self._found.size:
            self._found = self._estimate[self._checked]
