"""The gate of a map update: what of it got worse by more than a limit, or is not known any more."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from tilestream.config import Settings
from tilestream.model.figures import SEGMENT
from tilestream.records import Float64
from tilestream.report.diff.data import Changes, MapDiff
from tilestream.report.drives import EVALUATED
from tilestream.report.gate import MISSING, Over, named, positive, windows
from tilestream.report.measured import Measured
from tilestream.report.segments import check_threshold


class DiffGateSettings(Settings):
    """What the gate of a map update asks for."""

    fail_worse: float | None = Field(
        default=None,
        allow_inf_nan=True,  # so that the check below tells what to give
        description="Exit with 1 if any estimate grew by more than this [m], if less than "
        f"{EVALUATED:.0%} of the estimates of a route could be compared, if more than "
        f"{MISSING:.0%} of all are lost, or if there are none; one that is interpolated "
        "(--coarse) counts, and is told.",
    )
    measure: Measured = "mean"
    """Part of the error that --fail-worse asks for; of p_fail it is a share."""
    over: Over = "places"
    """Of what --fail-worse asks: single places, or means over 12 m."""

    _positive = field_validator("fail_worse")(positive)


@dataclass(frozen=True)
class Verdict:
    """What a gate says of a map update."""

    limit: float
    """The most that an estimate may grow [m; of p_fail a share]."""
    measure: Measured
    """The part of the error that was asked for."""
    over: Over
    """Whether of single places or of means over 12 m."""
    judged: int
    """So many of them could be compared."""
    closed: tuple[str, ...]
    """Why the map does not pass; empty: it passes."""
    besides: tuple[str, ...] = ()
    """What was not judged, and what the growth is not of the map alone."""

    @property
    def told(self) -> str:
        """The verdict in a sentence."""
        why = self.closed or (self.passes,)
        state = "closed" if self.closed else "open"
        return f"the gate is {state}: {'; '.join((*why, *self.besides))}"

    @property
    def passes(self) -> str:
        """What holds where the gate is open."""
        what = "sample points" if self.over == "places" else f"means over {SEGMENT:g} m"
        return (
            f"{self.measure} grew by more than {with_unit(self.limit, self.measure)} at none of "
            f"{self.judged:,} {what}"
        )

    def plain(self) -> dict[str, Any]:
        """The same for machines."""
        return {
            "fail_worse": self.limit,
            "measure": self.measure,
            "over": self.over,
            "judged": self.judged,
            "passed": not self.closed,
            "why": [*(self.closed or (self.passes,)), *self.besides],
        }


def diff_gate(
    found: MapDiff, limit: float, measure: Measured = "mean", over: Over = "places"
) -> Verdict:
    """Whether a map update passes a limit.

    What is not compared does not pass: an update of which no place is compared, a route of which
    less than `EVALUATED` of the estimates of before are, and one by which more than `MISSING` of
    all estimates are lost or left behind. Estimates where there were none before are not judged,
    and interpolated ones are as any other; the verdict says how many there are of both.

    Args:
        found: what is compared.
        limit: the most that an estimate may grow [m]; of p_fail a share.
        measure: the part of the error that is asked for (`MEASURES`).
        over: `segments`: means over `SEGMENT` of a route instead of single places.

    Raises:
        UsageError: the limit is not positive, or no such measure.
    """
    check_threshold(limit, "fail_worse")
    before, after = found.places.estimates(measure)
    growth = after - before
    judged = found.places.places[["route_id", "arc_length"]].assign(
        error=growth, measured=False, interpolated=found.places.interpolated
    )
    judged = judged[np.isfinite(growth)]
    closed: list[str] = []
    if over == "segments" and len(judged):
        judged = windows(judged)
    above = judged[judged["error"] > limit]
    if len(above):
        between = int(above["interpolated"].sum())
        told = f" ({between:,} of them interpolated)" if between else ""
        worst = above.iloc[int(np.argmax(above["error"]))]
        what = "sample points" if over == "places" else f"segments of {SEGMENT:g} m"
        closed.append(
            f"{measure}: {len(above):,} of {len(judged):,} {what} grew by more than "
            f"{with_unit(limit, measure)}{told}, the worst by "
            f"{with_unit(worst['error'], measure)} on "
            f"{worst['route_id']} at {worst['arc_length']:.0f} m"
        )
    if not len(judged):
        closed.append(f"no place is compared: {_why_none(found, measure)}")
    closed += _not_compared(found.places, growth)
    return Verdict(limit, measure, over, len(judged), tuple(closed), tuple(_besides(found)))


def with_unit(growth: float, measure: str) -> str:
    """How much an estimate grew, as the messages of gates have it."""
    return f"{growth:.3g}" if measure == "p_fail" else f"{growth:.3g} m"


def _why_none(found: MapDiff, measure: str) -> str:
    if found.without:
        return f"no estimates in {' and '.join(found.without)}; name run directories that have some"
    if measure != "mean" and found.compared:
        return f"{measure} is not in the estimates of both"
    return "no two of the same place have an estimate"


def _not_compared(places: Changes, growth: Float64) -> list[str]:
    """What had an estimate and has none that could be compared."""
    routes = places.places["route_id"].astype(str).to_numpy()
    had = np.isfinite(places.estimates("mean")[0])
    kept = Counter(routes[np.isfinite(growth)])
    missing = Counter(routes[had & np.isnan(growth)])
    missing.update(places.left["route_id"].astype(str))
    told = []
    hardly = [
        f"{route} ({kept[route]:,} of {kept[route] + missing[route]:,})"
        for route in sorted(missing)
        if kept[route] < EVALUATED * (kept[route] + missing[route])
    ]
    if hardly:
        told.append(f"less than {EVALUATED:.0%} of the estimates are compared on {named(hardly)}")
    total = sum(kept.values()) + sum(missing.values())
    if sum(missing.values()) > MISSING * total:
        told.append(
            f"{sum(missing.values()):,} of {total:,} sample points that had an estimate have none "
            f"any more, more than {MISSING:.0%}"
        )
    return told


def _besides(found: MapDiff) -> Sequence[str]:
    """What opens no gate and closes none."""
    told = []
    if found.places.compared_interpolated:
        told.append(
            f"{found.places.compared_interpolated:,} of {found.places.compared:,} sample points "
            "have an estimate, before or after, that is interpolated and was not evaluated: how "
            "far off it may be, the report of its run says"
        )
    if found.places.appeared:
        told.append(
            f"{found.places.appeared:,} sample points had no estimate before and are not judged: "
            "`tilestream run --fail-over` judges them"
        )
    if found.otherwise:
        told.append("the estimates were made with other settings, not only of another map")
    return told
