"""How long work takes here: what a plan costs before it runs, kept up to date by every run.

Before the first run, a stage tells how long its work took in the runs of benchmarks/RESULTS.md.
"""

import json
from collections.abc import Collection, Iterable
from pathlib import Path

from tilestream.files import Files
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.stage import Task
from tilestream.user_cache import user_cache

LEAST = 0.03
"""Tasks that took less tell nothing [s]."""
ENOUGH = 10.0
"""Work of a stage that counts in full [s]; less of it, with what each task costs besides, counts as
much less.
"""


def calibration_file() -> Path:
    """Where this user's figures are kept."""
    return user_cache() / "seconds.json"


def seconds_per_work() -> dict[str, float]:
    """Seconds per unit of work of each stage that was measured here."""
    try:
        known = json.loads(calibration_file().read_text())
        return {str(stage): float(seconds) for stage, seconds in known.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def learn(tasks: Collection[Task], outcomes: Iterable[Outcome]) -> None:
    """Take the times of a run into the figures: their geometric mean with the old ones, of little
    work less than half of it. A full disk is no error.
    """
    work = {task.key: task.work for task in tasks}
    seconds: dict[str, float] = {}
    units: dict[str, int] = {}
    shipped = {task.stage: task.applies.seconds for task in tasks}
    for outcome in outcomes:
        if outcome.made and outcome.seconds >= LEAST and outcome.key in work:
            seconds[outcome.stage] = seconds.get(outcome.stage, 0.0) + outcome.seconds
            units[outcome.stage] = units.get(outcome.stage, 0) + work[outcome.key]
    known = seconds_per_work()
    for stage, count in units.items():
        if count:
            share = 0.5 * min(1.0, seconds[stage] / ENOUGH)
            old, fresh = known.get(stage, shipped[stage]), seconds[stage] / count
            known[stage] = old ** (1.0 - share) * fresh**share
    place = calibration_file()
    try:
        Files.at(place).write(json.dumps(known, indent=2, sort_keys=True).encode())
    except OSError:
        return


def core_hours(tasks: Iterable[Task]) -> dict[str, float]:
    """Estimated core-hours of each stage."""
    known = seconds_per_work()
    hours: dict[str, float] = {}
    for task in tasks:
        cost = task.work * known.get(task.stage, task.applies.seconds) / 3600.0
        hours[task.stage] = hours.get(task.stage, 0.0) + cost
    return hours
