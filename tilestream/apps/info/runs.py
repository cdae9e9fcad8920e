"""What is in a run directory of any job: its tables, and what its record says."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from tilestream.apps.info.record import Info, told
from tilestream.errors import TilestreamError, alike
from tilestream.factors.stations import INTERPOLATED
from tilestream.files import Files
from tilestream.marks import unsealed
from tilestream.pipeline.jobs.run_folder import map_of, rows_of, table_paths
from tilestream.pipeline.jobs.run_names import RECORD, TABLES
from tilestream.settings import LogOptions


def described(path: str, _: LogOptions) -> Info:
    """A run directory of any job: its tables, and what its record says."""
    record, state = _record(path)
    contents, wrong, rows, between = [], [], None, 0
    for table in TABLES:
        try:
            files = table_paths(path, table)
            found = rows_of(path, table) if files else None
        except TilestreamError as error:
            wrong.append(str(error))
            continue
        if found is not None:
            contents.append(f"table {table}: {len(found):,} rows in {len(files):,} files")
            rows = found if rows is None else rows
            between += int((found["status"] == INTERPOLATED).sum())
    try:
        store = map_of(path)
        crs, made_on = store.settings.crs, store.url
        contents.append(f"made on the map {made_on}")
    except TilestreamError as error:
        crs = None
        wrong.append(f"its map: {error}")
    drives = record.get("drives", ())
    info = Info(
        path=path,
        kind="run",
        format="run directory" if record else "tables",
        state="; ".join([*([state] if state != "done" else []), *wrong]) or "whole",
        crs=crs,
        points=None if rows is None else len(rows),
        coverage={
            "places": 0 if rows is None else len(rows),
            "places_done": 0 if rows is None else int((rows["status"] == "done").sum()),
            **({"places_interpolated": between} if between else {}),
            "drives": len(drives),
            "scans": sum(drive["scans"] for drive in drives),
            "scans_measured": sum(drive["measured"] for drive in drives),
        },
        contents=contents,
        notes=[*told(record.get("notes", {})), *_failed(record)],
    )
    return info if rows is None else info.over(rows[["x", "y", "z"]].to_numpy(np.float64))


def _record(path: str) -> tuple[Mapping[str, Any], str]:
    """The record of a run, and its state; of tables alone there is none."""
    file = Files.at(path).under(RECORD)
    if not file.there():
        return {}, "done"
    try:
        record = unsealed(json.loads(file.read()))
    except (ValueError, OSError) as error:
        return {"state": "damaged"}, f"damaged: its {RECORD} is not what was written ({error})"
    return record, str(record["state"])


def _failed(record: Mapping[str, Any]) -> list[str]:
    return [f"failed: {line}" for line in alike(record.get("failures", {}))]
