"""The job that advises: what would mend the poor stretches of a run, from the map alone."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from tilestream.apps.choices import choice_tasks, tables_by_choice
from tilestream.apps.remedies import FIRST_GUESS, remedies_of
from tilestream.apps.runs import NEEDED, places_of, settings_of, worth_of
from tilestream.errors import SourceNotFoundError, UsageError, require_all_done
from tilestream.factors.rows import samples_of_places
from tilestream.files import Files
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.jobs.inventory import make_tables
from tilestream.pipeline.jobs.run_folder import map_of, rows_of
from tilestream.pipeline.jobs.run_inputs import observing_of
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.observe import observe
from tilestream.records import Int64
from tilestream.report.segments import check_threshold, reaches, stretches
from tilestream.report.write import THRESHOLD
from tilestream.tables import read_tables

MOST = 5
"""Places of a stretch that are looked at."""
CLEAR = 2.0
"""A remedy helps where the virtual drive is better by more than so many standard errors of the
difference."""
OF_REMEDIES = (
    "With a remedy it is the estimate times what a virtual drive gains by it at up to "
    f"{MOST} places of a stretch; no remedy was measured on a drive."
)
"""What the figures of remedies are worth."""
PLACE = ["route_id", "sample"]
OF_DRIVE = ["vd_mean", "vd_mean_sd", "vd_floor", "vd_floor_sd", "vd_draws"]
STRETCH = (
    *("route", "begin_m", "end_m", "length_m", "places"),
    *("now_m", "best", "best_m", "mends"),
)
REMEDY = ("stretch", "remedy", "after_m", "helps", "virtual_now_m", "virtual_after_m")
"""Columns of `Advice`."""


@dataclass(frozen=True, eq=False)
class Advice:
    """What would mend the stretches over a threshold."""

    stretches: pd.DataFrame
    """A row per stretch: `route`, `begin_m`, `end_m`, `length_m`, `places` (how many were looked
    at), `now_m` (mean estimate there), `best` (the remedy with the least estimate of those that
    help clearly; empty: none does), `best_m`, and `mends` (whether that is below the threshold).
    """
    remedies: pd.DataFrame
    """A row per stretch and remedy: `stretch` (its number), `remedy`, `after_m` (the estimate with
    it; NaN: not known), `helps`, and what it rests on: `virtual_now_m`, `virtual_after_m`."""
    left_out: Mapping[str, str]
    """Remedies that are not tried, and why."""
    threshold: float
    """Of the estimate [m]."""
    worth: tuple[str, ...] = ()
    """What the figures are worth, as sentences."""


def advise(
    place: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    threshold: float = THRESHOLD,
    client: Any | None = None,
    watch: Watch | None = None,
) -> Advice:
    """What would mend each stretch of a run over a threshold, from the map alone: half the cell
    size, more range, no blind sector, another lidar that ships, a better first guess.

    Each remedy is a virtual drive of at most `MOST` places of each stretch, evenly among those over
    the threshold. The estimate with it is the estimate of the run times virtual drive with it /
    virtual drive without; with a better first guess it is the floor that the run estimates.

    Args:
        place: a run directory of `run` or `estimate`, a path or an fsspec URL.
        out: folder of the tables of the virtual drives; None: `advise` in the run directory.
        threshold: stretches whose estimate is above this [m].
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The stretches, and what each remedy does there.

    Raises:
        UsageError: a threshold that cannot be, or a run without virtual drives or estimates.
        SourceNotFoundError: no tables there.
        StoreNotFoundError: its map is gone.
        IncompleteError, DamagedError: a table or the map is not as it was written.
        LockedError: another process writes to the folder.
        PlanError: a task does not fit the memory that the job allows.
        PartialError: some tasks failed; the message lists them.
    """
    check_threshold(threshold)
    places, settings = _known(place), settings_of(place)
    if settings is None or settings.observe is None:
        raise UsageError(
            f"{place}: has no virtual drives to compare with: `tilestream estimate` makes them"
        )
    store, now = map_of(place), observing_of(settings, settings.observe)
    poor = stretches(places, np.flatnonzero(places["estimate"] > threshold))
    looked_at = [_looked_at(places, rows, threshold) for rows in poor]
    tried, left_out = remedies_of(now, store.grid)
    seen: dict[str, pd.DataFrame] = {}
    if poor:
        at = places.iloc[np.concatenate(looked_at)]
        map_plan = MapPlan.of_store(store, partial=settings.map.partial)
        folder = Files.at(place).under("advise").address if out is None else out
        tasks = choice_tasks(
            map_plan,
            samples_of_places(store.grid, at),
            folder,
            tuple(tried.values()),
            replace(now, route_z="lidar"),  # as high as the run has it
            settings.memory,
        )
        plan = Plan.of((*map_plan.tasks.values(), *tasks), settings.memory)
        require_all_done(folder, make_tables(plan, folder, client, watch))
        tables = tables_by_choice(plan.outputs(observe.name))
        seen |= {name: read_tables(tables[choice.name]) for name, choice in tried.items()}
    found = _advice(places, poor, looked_at, seen, left_out, threshold)
    return replace(found, worth=(*worth_of(place), OF_REMEDIES))


def _known(place: str | os.PathLike[str]) -> pd.DataFrame:
    """The places of a run along each route: their estimates, and their virtual drives each of its
    own place alone; errors as `advise`.
    """
    places, drives = places_of(place), rows_of(place, "observability")
    if places.empty:
        raise SourceNotFoundError(f"{place}: no tables of a run{NEEDED}")
    if "estimate" not in places or drives is None:
        raise UsageError(f"{place}: has no estimates by virtual drives{NEEDED}")
    shown = ["arc_length", "heading", "x", "y", "z", "estimate", "floor"]
    places = places[[*PLACE, *shown]].merge(drives[[*PLACE, *OF_DRIVE]], on=PLACE, how="left")
    return places.sort_values(PLACE, kind="stable", ignore_index=True)


def _looked_at(places: pd.DataFrame, rows: Int64, threshold: float) -> Int64:
    """At most `MOST` of the rows of a stretch, evenly among those over the threshold."""
    over = rows[(places["estimate"].iloc[rows] > threshold).to_numpy()]
    chosen: Int64 = over[np.linspace(0, len(over) - 1, min(MOST, len(over))).round().astype(int)]
    return chosen


def _advice(
    places: pd.DataFrame,
    poor: Sequence[Int64],
    looked_at: Sequence[Int64],
    seen: Mapping[str, pd.DataFrame],
    left_out: Mapping[str, str],
    threshold: float,
) -> Advice:
    """What the virtual drives say.

    Args:
        places: of the run.
        poor: rows of each stretch.
        looked_at: the rows of each that were looked at.
        seen: the virtual drives of these as each remedy has them.
        left_out: see `Advice`.
        threshold: see `Advice`.
    """
    reach, told, rows = reaches(places), [], []
    of_remedy = {name: table.set_index(PLACE)[OF_DRIVE] for name, table in seen.items()}
    for number, (part, chosen) in enumerate(zip(poor, looked_at, strict=True)):
        now = places.iloc[chosen].set_index(PLACE)
        tried = [
            {"stretch": number, "remedy": name, **_effect(now, after.reindex(now.index))}
            for name, after in of_remedy.items()
        ]
        tried.append({"stretch": number, "remedy": FIRST_GUESS, **_effect(now, _guessed(now))})
        tried[-1]["after_m"] = float(now["floor"].mean())
        helping = [one for one in tried if one["helps"]]
        best = min(helping, key=lambda one: one["after_m"], default=None)
        rows += tried
        stretch = places.iloc[part]
        told.append(
            {
                "route": str(stretch["route_id"].iloc[0]),
                "begin_m": float(stretch["arc_length"].iloc[0]),
                "end_m": float(stretch["arc_length"].iloc[-1]),
                "length_m": float(reach[part].sum()),
                "places": len(chosen),
                "now_m": float(now["estimate"].mean()),
                "best": best["remedy"] if best else "",
                "best_m": best["after_m"] if best else math.nan,
                "mends": bool(best and best["after_m"] <= threshold),
            }
        )
    return Advice(
        pd.DataFrame(told, columns=list(STRETCH)),
        pd.DataFrame(rows, columns=list(REMEDY)),
        left_out,
        threshold,
    )


def _guessed(now: pd.DataFrame) -> pd.DataFrame:
    """The virtual drives of starts within 1.0 m alone."""
    return now.assign(vd_mean=now["vd_floor"], vd_mean_sd=now["vd_floor_sd"])


def _effect(now: pd.DataFrame, after: pd.DataFrame) -> dict[str, Any]:
    """What a remedy does to a stretch, at the places where both virtual drives are known."""
    known = (now["vd_mean"].notna() & after["vd_mean"].notna()).to_numpy()
    if not known.any():
        nothing = dict.fromkeys(("after_m", "virtual_now_m", "virtual_after_m"), math.nan)
        return nothing | {"helps": False}
    now, after = now[known], after[known]
    was, becomes = float(now["vd_mean"].mean()), float(after["vd_mean"].mean())
    # not known of a single draw: then nothing is clear
    noise = sum(
        (one["vd_mean_sd"] ** 2 / one["vd_draws"]).sum(skipna=False) for one in (now, after)
    )
    return {
        "after_m": float(now["estimate"].mean()) * becomes / was,
        "virtual_now_m": was,
        "virtual_after_m": becomes,
        "helps": was - becomes > CLEAR * math.sqrt(noise) / len(now),
    }
