"""How long work takes here: what a plan costs before it runs, kept up to date by every run."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from tilestream.dataflow.plan import Task
from tilestream.dataflow.tasks import Outcome

SECONDS_PER_WORK: Mapping[str, float] = {
    "survey": 0.07,
    "scan": 0.03,
    "log": 0.02,
    "scatter": 5.5e-8,
    "merge": 0.1,
    "cells": 0.12,
    "terms": 1.6,
    "factors": 0.002,
    "surfels": 0.7,
    "observe": 0.18,
    "register": 0.45,
    "label": 0.006,
    "join": 5.0,
    "judge": 45.0,
    "weigh": 100.0,
    "train": 80.0,
    "predict": 0.004,
}
"""Before the first run: seconds per unit of work (point, tile, scan, sample point) of each stage,
as in the runs of benchmarks/RESULTS.md, rounded; a run replaces them."""
LEAST = 0.03
"""Tasks that took less found their work done, or tell nothing [s]."""


def calibration_file() -> Path:
    """Where this user's figures are kept: `$XDG_CACHE_HOME` (or `~/.cache`) `/tilestream`."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "tilestream" / "seconds.json"


def seconds_per_work() -> dict[str, float]:
    """Seconds per unit of work of each stage, as far as known: measured here, or shipped."""
    try:
        known = json.loads(calibration_file().read_text())
        measured = {str(stage): float(seconds) for stage, seconds in known.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        measured = {}
    return {**SECONDS_PER_WORK, **measured}


def learn(tasks: Iterable[Task], outcomes: Iterable[Outcome]) -> None:
    """Take the times of a run into the figures, half new and half old; a full disk is no error."""
    work = {task.key: task.work for task in tasks}
    seconds: dict[str, float] = {}
    units: dict[str, int] = {}
    for outcome in outcomes:
        if outcome.ok and outcome.seconds >= LEAST and outcome.key in work:
            seconds[outcome.stage] = seconds.get(outcome.stage, 0.0) + outcome.seconds
            units[outcome.stage] = units.get(outcome.stage, 0) + work[outcome.key]
    known = seconds_per_work()
    for stage, count in units.items():
        if count:
            fresh = seconds[stage] / count
            known[stage] = (known[stage] + fresh) / 2.0 if stage in known else fresh
    place = calibration_file()
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_name(f"{place.name}.{os.getpid()}.part")
        part.write_text(json.dumps(known, indent=2, sort_keys=True))
        part.replace(place)
    except OSError:
        return


def core_hours(tasks: Iterable[Task]) -> dict[str, float]:
    """Estimated core-hours of each stage."""
    known = seconds_per_work()
    hours: dict[str, float] = {}
    for task in tasks:
        cost = task.work * known.get(task.stage, 1.0) / 3600.0
        hours[task.stage] = hours.get(task.stage, 0.0) + cost
    return hours
