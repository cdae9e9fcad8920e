"""What is in what we have written ourselves: maps, run directories, models."""

import json
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tilestream.apps.info.record import Info, Kind
from tilestream.errors import TilestreamError, alike
from tilestream.files import Files
from tilestream.marks import unsealed
from tilestream.model.card import card_told
from tilestream.model.file import load_model
from tilestream.notes import Notes, shared
from tilestream.pipeline.jobs.inventory import INVENTORY
from tilestream.pipeline.jobs.run_book import RECORD
from tilestream.pipeline.jobs.run_folder import map_of, rows_of, table_paths
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.settings import LogOptions
from tilestream.store import NODE, POINTS, open_store

TABLES = ("factors", "observability", "errors", "predictions")
"""The tables of a run directory that are told, with their rows; the first that is there gives the
extent."""
MODEL = ".skops"
"""How a model's file ends."""


MADE_WITH = ("cell_size", "sensor_height", "map_leaf")
"""What of the making of a model's factors is told, besides the sensor."""


def _of_store(path: str, _: LogOptions) -> Info:
    """A tile store: its tiles, and what it was made from."""
    store = open_store(path)
    marks = store.marks(POINTS)
    done = [mark.facts for mark in marks.values() if mark.status == "done"]
    corners = [facts[end] for facts in done for end in ("lowest", "highest")]
    statuses = Counter(mark.status for mark in marks.values())
    settings = store.settings
    return Info(
        path=path,
        kind="map",
        format="tile store",
        state=str(store.condition()),
        crs=settings.crs,
        points=sum(facts["points"] for facts in done),
        coverage={
            "tiles": len(marks),
            **{f"tiles_{status}": count for status, count in sorted(statuses.items())},
            "area_m2": len(done) * settings.tile_size**2,
            "points_read": sum(facts["read"] for facts in done),
        },
        contents=[
            f"tiles of {settings.tile_size:g} m, thinned to {settings.map_leaf:g} m",
            *(
                f"{one['path']}: {one['format']}, {one['points']:,} points"
                for one in store.sources()
            ),
        ],
        notes=_told(map_notes(store)),
    ).over(np.array(corners, np.float64).reshape(-1, 3))


def _of_run(path: str, _: LogOptions) -> Info:
    """A run directory of any job: its tables, and what its record says."""
    record, state = _record(path)
    contents, wrong, rows = [], [], None
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
            "drives": len(drives),
            "scans": sum(drive["scans"] for drive in drives),
            "scans_measured": sum(drive["measured"] for drive in drives),
        },
        contents=contents,
        notes=[*_told(record.get("notes", {})), *_failed(record)],
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


def _of_model(path: str, _: LogOptions) -> Info:
    """A model: what it was trained on, and for which vehicle."""
    model = load_model(path)
    sensor = model.made_with.get("sensor", {})
    sensors = sensor.get("sensors", [sensor] if sensor else [])
    made = {name: model.made_with[name] for name in MADE_WITH if name in model.made_with}
    return Info(
        path=path,
        kind="model",
        format="model",
        size_bytes=os.stat(path).st_size,  # noqa: PTH116
        coverage={"factors": len(model.factors), "targets": len(model.regressors)},
        contents=[
            *(f"for {one['name']}" for one in sensors),
            *([] if sensors else [f"for {lidar}" for lidar in model.card.get("lidars", [])]),
            f"factors: {', '.join(model.factors)}",
            f"targets: {', '.join(model.regressors)}",
            *(f"{name}: {value}" for name, value in {**made, **model.facts}.items()),
            *(f"labels: {name}: {value}" for name, value in model.data_set.items()),
            *(f"card: {line}" for line in card_told(model.card)),
        ],
    )


def _told(notes: Notes) -> list[str]:
    return [str(note) for note in shared(notes)]


def _is_run(path: str, names: frozenset[str]) -> bool:
    """Whether a job has written there: its record, or a folder of tables with an inventory."""
    return RECORD in names or any(
        Files.at(path).under(f"{table}/{INVENTORY}").there() for table in TABLES if table in names
    )


KINDS = (
    Kind("tile stores", lambda _, names: NODE in names, _of_store),
    Kind("run directories", _is_run, _of_run),
    Kind(
        f"models ({MODEL})",
        lambda path, _: Path(path).is_file() and Path(path).suffix.lower() == MODEL,
        _of_model,
    ),
)
