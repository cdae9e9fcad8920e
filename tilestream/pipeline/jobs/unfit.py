"""Drives whose labels tell nothing of the map: of another place, or with poses of another frame."""

from collections.abc import Iterable

import pandas as pd

from tilestream.pipeline.engine.plan import paths_of
from tilestream.pipeline.engine.stage import Task
from tilestream.tables import read_tables

NVTL = 2.3
"""Autoware takes a pose whose NVTL is below this as not converged (its ndt_scan_matcher)."""
MANY = 0.2
"""Share of the starts near the true pose that fail, from which on many do."""


def unfit(rows: pd.DataFrame) -> str:
    """Why the labels of a drive tell nothing of the map; empty: they do.

    At half of its places or more, many of the starts near the true pose leave it, and where they
    end scan and map do not agree: a hard street has the one and not the other (of 40 drives, real
    and simulated, of lidars down to 15 m, the lowest median is 3.0, and 6 % of near starts fail).

    Args:
        rows: of the label table of one drive.
    """
    there = rows[rows["status"] == "done"]
    if there.empty:
        return ""
    fail, agree = (float(there[name].median()) for name in ("near_p_fail", "near_nvtl"))
    if not (fail >= MANY and agree < NVTL):
        return ""
    return (
        f"it does not fit the map: at half of its {len(there):,} places {fail:.0%} or more of the "
        f"starts near the true pose end more than 0.5 m off, where scan and map do not agree (NVTL "
        f"{agree:.1f}; {NVTL} is the least that Autoware takes): is it of this map, are its poses "
        "in the map's frame?"
    )


def labels_by_drive(labels: Iterable[Task]) -> dict[str, pd.DataFrame]:
    """The rows of label tasks that are done, by drive."""
    of_drive: dict[str, list[str]] = {}
    for path in paths_of(labels):
        of_drive.setdefault(path.rsplit("/", 2)[1], []).append(path)
    return {name: read_tables(paths) for name, paths in of_drive.items()}


def unfit_drives(labels: Iterable[Task]) -> dict[str, str]:
    """The drives of these labels that do not fit the map, and why."""
    found = {name: unfit(rows) for name, rows in labels_by_drive(labels).items()}
    return {name: why for name, why in found.items() if why}
