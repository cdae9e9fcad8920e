"""The gate of a map release: what of a map exceeds a limit, or is not known."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, field_validator

from tilestream.config import Settings
from tilestream.counts import count_of
from tilestream.model.figures import SEGMENT
from tilestream.report.data import interpolated
from tilestream.report.drives import EVALUATED
from tilestream.report.measured import Measured, measure_of
from tilestream.report.segments import check_threshold

MISSING = 0.05
"""Share of the places that may be without an estimate where a gate opens."""
Over = Literal["places", "segments"]
"""What a gate asks of."""
NAMED = 5
"""Routes that are named where a gate stays closed."""


def positive(limit: float | None) -> float | None:
    """The limit of a gate as it was given; a field's own check.

    Raises:
        ValueError: it is no length above 0.
    """
    if limit is not None and not (np.isfinite(limit) and limit > 0.0):
        raise ValueError(f"is {limit!r}: give metres above 0")
    return limit


class GateSettings(Settings):
    """What a gate asks for."""

    fail_over: float | None = Field(
        default=None,
        allow_inf_nan=True,  # so that the check below tells what to give
        description="Exit with 1 if any error, estimated or measured, is above this [m], if less "
        f"than {EVALUATED:.0%} of a drive was measured or of the places of a route have an "
        f"estimate, or if more than {MISSING:.0%} of all have none; one that is interpolated "
        "(--coarse) counts, and is told.",
    )
    measure: Measured = "mean"
    """Part of the error that --fail-over asks for; of p_fail it is a share."""
    over: Over = "places"
    """Of what --fail-over asks: single places, or means over 12 m."""

    _positive = field_validator("fail_over")(positive)


def gate(
    places: pd.DataFrame,
    limit: float,
    drives: Sequence[Mapping[str, Any]] = (),
    measure: str = "mean",
    over: Over = "places",
) -> list[str]:
    """Why a map does not pass a limit; empty: it passes.

    A measured error counts as an estimate does, and an interpolated one as any other. What is not
    known does not pass: a route without any estimate fails the gate, and so does one of whose
    places less than `EVALUATED` have one, a drive that was not evaluated to that share, and a map
    of which more than `MISSING` of the places have no estimate.

    Args:
        places: route_id, arc_length [m], status and the estimates of every sample point, with what
            was measured there (`with_measured`).
        limit: greatest error that passes [m]; of p_fail a share.
        drives: how much of each drive was measured (`DriveMeasured.plain`).
        measure: the part of the error that is asked for (`MEASURES`).
        over: `segments`: means over `SEGMENT` of a route instead of single places.

    Raises:
        UsageError: the limit is not positive, or no such measure.
    """
    check_threshold(limit)
    one = measure_of(places, measure)
    estimate, known_error = one.estimate, one.known
    found, total = [], len(places)
    judged = places[["route_id", "arc_length"]].assign(
        error=known_error,
        measured=known_error == one.measured,
        interpolated=interpolated(places) & ~np.isfinite(one.measured),
    )
    judged = windows(judged) if over == "segments" else judged
    above = judged[judged["error"] > limit]
    if len(above):
        worst = above.iloc[int(np.argmax(above["error"]))]
        unit = "" if measure == "p_fail" else " m"
        between = int(above["interpolated"].sum())
        what = "sample points" if over == "places" else f"segments of {SEGMENT:g} m"
        found.append(
            f"{measure}: {len(above)} of {len(judged)} {what} are above {limit:g}{unit}"
            f"{f' ({between} of them interpolated)' if between else ''}, the worst "
            f"{worst['error']:.2f}{unit} on {worst['route_id']} at {worst['arc_length']:.0f} m, "
            f"{'measured' if worst['measured'] else 'estimated'}"
        )
    known = pd.Series(np.isfinite(estimate)).groupby(places["route_id"].to_numpy(str)).mean()
    blind = known.index[known == 0.0].tolist()
    if blind:
        found.append(f"no estimate at all on {named(blind)}")
    hardly = known[(known > 0.0) & (known < EVALUATED)]
    if len(hardly):
        told = [f"{route} ({share:.0%})" for route, share in hardly.items()]
        found.append(f"less than {EVALUATED:.0%} of the places have an estimate on {named(told)}")
    unseen = [
        f"{one['drive']} ({one['measured']:,} of {one['scans']:,} scans)"
        for one in drives
        if not one["evaluated"]
    ]
    if unseen:
        found.append(f"less than {EVALUATED:.0%} was measured of drive {named(unseen)}")
    missing = int(np.isnan(estimate).sum())
    if missing > MISSING * total:
        found.append(
            f"{missing:,} of {count_of(total, 'sample point')} without an estimate, more than "
            f"{MISSING:.0%}; report/index.html lists why"
        )
    return found


def windows(judged: pd.DataFrame) -> pd.DataFrame:
    """Means of `error` over each `SEGMENT` of a route, of the places that have one; `measured`
    where any of them is, `interpolated` where all are.
    """
    there = judged[judged["error"].notna()]
    number = (there["arc_length"] // SEGMENT).rename("number")
    parts = there.groupby(["route_id", number])
    how = {"error": "mean", "arc_length": "min", "measured": "any", "interpolated": "all"}
    return parts.agg(how).reset_index()


def named(names: Sequence[str]) -> str:
    """The first of some names, for a message."""
    return ", ".join(names[:NAMED]) + (", …" if len(names) > NAMED else "")
