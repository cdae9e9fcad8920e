"""Where the starts of one place of a drive began and ended: the paper's Fig. 11."""

import os
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import SourceNotFoundError, StoreError, UsageError
from tilestream.files import Files
from tilestream.label import start_errors, start_poses
from tilestream.pipeline.jobs.inventory import tables_in
from tilestream.pipeline.stages.register import START_COLUMNS
from tilestream.records import Column
from tilestream.settings import StartSettings
from tilestream.tables import read_mark, read_tables

FROM = ("along", "across", "up", "yaw")
"""What is told of where a start was."""
FROM_COLUMNS = (
    Column("from_along", "label", "m", "Of the start along the true heading.", "start - true"),
    Column("from_across", "label", "m", "Of the start across it, left positive.", "start - true"),
    Column("from_up", "label", "m", "Of the start in map z.", "start - true"),
    Column("from_yaw", "label", "rad", "Of the start's heading, in [-pi, pi).", "start - true"),
)
ENDS_COLUMNS = (*START_COLUMNS, *FROM_COLUMNS)
"""The columns of `starts_of`."""


def starts_of(place: str | os.PathLike[str], sample: int, drive: str = "") -> pd.DataFrame:
    """Where the starts of a sample point began and ended, in the frame of the true heading.

    Args:
        place: a run directory, or the folder of the tables of `localize` (a path or a URL).
        sample: number of the sample point along the drive.
        drive: name of the drive in a run directory, e.g. of `tables/starts/<drive>`; not needed
            where there is one.

    Returns:
        A row per start, by scan and number: the columns of the table `starts`, and where it was:
        `from_along`, `from_across`, `from_up` [m], `from_yaw` [rad].

    Raises:
        UsageError: several drives and none is named, or none of that name.
        SourceNotFoundError: no tables there, no such sample point, or one that was not measured:
            says why.
        StoreError: tables of an older version.
        IncompleteError: the job that makes the tables has not ended.
        DamagedError: a table is not what was written.
    """
    folder = _folder(place, drive)
    parts: list[pd.DataFrame] = []
    failed: dict[int, str] = {}
    for path in tables_in(folder):
        facts = read_mark(path).facts
        if "scans" not in facts:
            raise StoreError(
                f"{path} is of an older version of tilestream: run the job that makes it again"
            )
        scans = {int(scan): of for scan, of in facts["scans"].items() if of["sample"] == sample}
        rows = read_tables([path]) if scans else pd.DataFrame()
        for scan, of in scans.items():
            if of["reason"]:
                failed[scan] = of["reason"]
            else:
                parts.append(_with_places(rows[rows["scan"] == scan], of, facts["data_set"]))
    parts = [rows for rows in parts if rows["scan"].iloc[0] not in failed]
    if not parts:
        why = next((f"has no ends: {why}" for why in failed.values()), "is not among the labels")
        raise SourceNotFoundError(f"{folder}: sample {sample} {why}")
    found = pd.concat(parts).sort_values(["scan", "start"], ignore_index=True)
    return found[[column.name for column in ENDS_COLUMNS]]


def _folder(place: str | os.PathLike[str], drive: str) -> str:
    """The folder of the starts of a drive."""
    for below in ("tables/starts", "starts"):
        folder = Files.at(place).under(below)
        names = folder.names()
        drives = [name for name in names if "." not in name]
        if not names:
            continue
        if drive in drives or (not drives and not drive):
            return folder.under(drive).address
        if len(drives) == 1 and not drive:
            return folder.under(drives[0]).address
        known = ", ".join(drives) or "one without a name"
        raise UsageError(
            f"{folder.address}: {f'no drive {drive!r}' if drive else 'name a drive'}; there are "
            f"{known}"
        )
    raise SourceNotFoundError(f"{os.fspath(place)}: no tables of starts: no drive was localized")


def _with_places(
    rows: pd.DataFrame, fact: dict[str, Any], data_set: dict[str, Any]
) -> pd.DataFrame:
    """The starts of a scan with where they were: as its data set says, round its true heading."""
    heading = fact["heading"]
    T_true = np.eye(4)
    T_true[:2, 0] = np.cos(heading), np.sin(heading)
    T_true[:2, 1] = -np.sin(heading), np.cos(heading)
    at = start_errors(T_true, start_poses(T_true, StartSettings(**data_set["starts"])))
    number = rows["start"].to_numpy()
    return rows.assign(**{f"from_{name}": at[name][number] for name in FROM})
