"""What is in a run directory of any job: its tables, and what its record says."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tilestream.apps.info.record import Info, told
from tilestream.counts import count_of
from tilestream.errors import IncompleteError, TilestreamError, alike
from tilestream.factors.stations import INTERPOLATED
from tilestream.files import Files
from tilestream.pipeline.jobs.run_folder import map_of, rows_of, table_paths
from tilestream.pipeline.jobs.run_names import TABLES
from tilestream.pipeline.jobs.run_state import record_of, state_told
from tilestream.settings import LogOptions


def described(path: str, _: LogOptions) -> Info:
    """A run directory of any job: its tables, and what its record says."""
    record = record_of(Files.at(path))
    state = state_told(Files.at(path), record)
    contents, wrong, rows, between = [], [], None, 0
    for table in TABLES:
        try:
            files = table_paths(path, table)
            found = rows_of(path, table) if files else None
        except TilestreamError as error:
            if state == "whole" or not isinstance(error, IncompleteError):
                wrong.append(str(error))
            continue
        if found is not None:
            contents.append(
                f"table {table}: {count_of(len(found), 'row')} in {count_of(len(files), 'file')}"
            )
            rows = found if rows is None else rows
            between += int((found["status"] == INTERPOLATED).sum())
    try:
        store = map_of(path)
        crs, made_on = store.settings.crs, store.url
        contents.append(f"made on the map {made_on}")
    except TilestreamError as error:
        crs = None
        wrong.append(f"its map: {error}")
    if not record and contents:
        command = "localize" if table_paths(path, "starts") else "factors"
        contents.insert(0, f"made by `tilestream {command}`")
    info = Info(
        path=path,
        kind="run",
        format="run directory" if record else "tables",
        state="; ".join([*([state] if state != "whole" else []), *wrong]) or "whole",
        crs=crs,
        points=None if rows is None else len(rows),
        coverage={
            "places": 0 if rows is None else len(rows),
            "places_done": 0 if rows is None else int((rows["status"] == "done").sum()),
            **({"places_interpolated": between} if between else {}),
            **_of_drives(record),
        },
        contents=contents,
        notes=[*told(record.get("notes", {})), *_failed(record)],
    )
    return info if rows is None else info.over(rows[["x", "y", "z"]].to_numpy(np.float64))


def _of_drives(record: Mapping[str, Any]) -> dict[str, int]:
    """How much of its drives a run has measured; nothing: it has none."""
    drives = record.get("drives", ())
    if not drives:
        return {}
    return {
        "drives": len(drives),
        "scans": sum(drive["scans"] for drive in drives),
        "scans_measured": sum(drive["measured"] for drive in drives),
    }


def _failed(record: Mapping[str, Any]) -> list[str]:
    return [f"failed: {line}" for line in alike(record.get("failures", {}))]
