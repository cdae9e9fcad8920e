"""What a run noticed of its inputs and labels, and how much of its drives it can use."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from tilestream.errors import SourceError
from tilestream.factors.heights import note_of_drive, notes_of_routes
from tilestream.model.dataset import POINTS_MIN, Dataset
from tilestream.model.join import KEPT_BY, NOT_A_NUMBER
from tilestream.notes import MATCHER, noticed
from tilestream.pipeline.engine.plan import paths_of
from tilestream.pipeline.jobs.along_routes import off_map
from tilestream.pipeline.jobs.drive_measured import to_measure, with_labels
from tilestream.pipeline.jobs.estimator import Estimator
from tilestream.pipeline.jobs.localize import drive_overlap
from tilestream.pipeline.jobs.run_done import Done
from tilestream.pipeline.jobs.run_inputs import (
    JOB,
    Inputs,
    reading_of,
    seen_otherwise,
)
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.sources import map_notes, scans_of
from tilestream.pipeline.jobs.unfit import labels_by_drive
from tilestream.pipeline.stages.drive_scans import opened
from tilestream.pipeline.stages.label import label
from tilestream.report.drives import DriveMeasured
from tilestream.report.log_poses import note_of_log_poses
from tilestream.store import TileStore
from tilestream.tables import read_tables

NO_ROWS = pd.DataFrame({"status": [], "reason": []})
"""Where a drive has no labels."""


def with_logs(
    settings: RunSettings, inputs: Inputs, sources: Sequence[Mapping[str, Any]]
) -> Inputs:
    """The files of a job with what the logs of its drives tell, each opened once: notes, also on
    what they share with the sources of the map, and which scans are to be measured.

    Args:
        settings: the job.
        inputs: its files.
        sources: what the map is made of, as a store records it.

    Raises:
        UsageError: scans that are to be localized are in the map, and not `allow_overlap`.
    """
    notes: list[dict[str, list[str]]] = []
    found, mapped = [], []
    for drive in inputs.drives:
        reading, scans, spacing = reading_of(drive), scans_of(drive), settings.spacing
        several = settings.label.scans_per_point
        try:
            log = opened(reading)
            shared = drive_overlap(reading, scans, spacing, sources, several)
        except (SourceError, OSError):  # it is left out, see `plan_measure`
            continue
        if not settings.label.allow_overlap:
            shared.require_none()
        notes.append({drive.log: [*log.notes, *shared.notes]})
        found.append(to_measure(drive.group, log, scans, spacing, several))
        mapped += [drive.group] if shared.mapped else []
    notes_of = noticed(inputs.notes, *notes)
    return replace(inputs, notes=notes_of, to_measure=tuple(found), mapped=tuple(mapped))


def run_notes(settings: RunSettings, inputs: Inputs, store: TileStore) -> dict[str, list[str]]:
    """All that was noticed of the inputs of a run whose map is there, by source."""
    of_job = [*_on_range(settings), *_on_degraded(settings, inputs)]
    own = {JOB: of_job, MATCHER: settings.label.registration.notes}
    known = () if store.manifest is None else store.manifest.identities
    far = {"routes": off_map(known, store.grid, inputs.routes)}
    return noticed(inputs.notes, own, far, map_notes(store))


def _on_range(settings: RunSettings) -> list[str]:
    """A note where virtual scans end before the lidar's range does."""
    used = None if settings.observe is None else settings.observe.range_max
    most = settings.looking_sensor.range_max
    if used is None or used >= most:
        return []
    return [f"virtual scans reach {used:g} m of the lidar's {most:g} m (observe.range_max)"]


def _on_degraded(settings: RunSettings, inputs: Inputs) -> list[str]:
    """What a reader must know of drives that were read as another lidar than the vehicle's."""
    groups = seen_otherwise(settings, inputs.drives)
    if not groups:
        return []
    told = f"observed as the lidar that they are read as: {', '.join(groups)}"
    return [f"{told}; the estimates along the routes are for the vehicle as it is"]


def drives_measured(inputs: Inputs, done: Done) -> tuple[DriveMeasured, ...]:
    """How much of each drive was measured."""
    tables = labels_by_drive(done.outputs(label.name))
    return tuple(
        with_labels(drive, tables.get(drive.drive, NO_ROWS)) for drive in inputs.to_measure
    )


def heights_told(done: Done, settings: RunSettings) -> dict[str, list[str]]:
    """What the heights of the routes and of the drives' lidars tell, by what it is about."""
    places = read_tables(paths_of(done.outputs("factors")))
    notes = {"routes": notes_of_routes(places, settings.sensor_height, settings.route_z)}
    for name, rows in labels_by_drive(done.outputs(label.name)).items():
        notes[f"drive {name}"] = note_of_drive(rows["lidar_height"], settings.sensor_height)
    return notes


def offset_told(labelled: int, settings: RunSettings, estimator: Estimator) -> list[str]:
    """A note where `physics` makes the estimates as it is, with so many labels to learn from, and
    nobody asked for that.
    """
    fits = estimator.untrained and not estimator.few
    if not labelled or settings.model.offset is not None or not fits:
        return []
    told = f"{labelled} places are measured, and a model needs {POINTS_MIN}: the estimates are the"
    return [f"{told} virtual drive as it is (model.offset 0)."]


def log_poses_told(done: Done) -> dict[str, list[str]]:
    """How far the logs' poses are from refined ones, by drive."""
    tables = labels_by_drive(done.outputs(label.name))
    return {f"drive {name}": note_of_log_poses(rows) for name, rows in tables.items()}


def lost_labels(dataset: Dataset | None) -> list[dict[str, Any]]:
    """The labels that no model can learn from: `reason`, `count`, in `detail` the commonest of what
    is known besides, and `kept_by`, what would have kept them; the commonest reason first.
    """
    if dataset is None or dataset.lost.empty:
        return []
    found = []
    for reason, rows in dataset.lost.groupby("reason"):
        detail = rows["detail"].astype(str).value_counts()
        more = f" (and {len(detail) - 1:,} others)" if len(detail) > 1 else ""
        told = str(detail.index[0]) + more if detail.index[0] else ""
        keeps = KEPT_BY.get(str(reason), NOT_A_NUMBER)
        lost = {"reason": str(reason), "count": len(rows), "detail": told, "kept_by": keeps}
        found.append(lost)
    return sorted(found, key=lambda lost: (-int(str(lost["count"])), str(lost["reason"])))
