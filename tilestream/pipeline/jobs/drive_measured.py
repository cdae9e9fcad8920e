"""How much of a drive was measured, from its log and its labels."""

from collections import Counter
from dataclasses import replace

import pandas as pd

from tilestream.formats.logs import ScanLog, ScanSelection
from tilestream.pipeline.jobs.sample_scans import choose_samples
from tilestream.report.drives import DriveMeasured

NOT_SELECTED = "not selected"
BESIDE = "beside another scan of the same sample point"
STANDS = "where another scan stands for the same sample point"
NO_LABEL = "whose task failed"
NO_REASON = "without a reason"


def drive_measured(
    drive: str,
    log: ScanLog,
    scans: ScanSelection,
    spacing: float,
    labels: pd.DataFrame,
    per_point: int = 1,
) -> DriveMeasured:
    """How much of a drive was measured: `to_measure`, then `with_labels`."""
    return with_labels(to_measure(drive, log, scans, spacing, per_point), labels)


def to_measure(
    drive: str, log: ScanLog, scans: ScanSelection, spacing: float, per_point: int = 1
) -> DriveMeasured:
    """The scans of a drive before any is measured.

    Args:
        drive: what to call it.
        log: its scans.
        scans: which of them are to be used.
        spacing: distance between sample points [m].
        per_point: scans of a sample point, at most.

    Raises:
        UsageError: as `choose_samples`.
    """
    selected = scans.indices(log.stamps_ns)
    posed = int(log.posed[selected].sum())
    chosen = choose_samples(log, scans, spacing, per_point)
    places = chosen[-1].number + 1
    left_out = sum(log.left_out.values())
    return DriveMeasured(
        drive=drive,
        scans=len(log) + left_out,
        selected=len(selected) + left_out,
        posed=posed,
        sample_points=places,
        measured=0,
        reasons={
            **log.left_out,
            NOT_SELECTED: len(log) - len(selected),
            **log.unposed(selected),
            STANDS: posed - len(chosen),
            BESIDE: len(chosen) - places,
            NO_LABEL: places,
        },
    )


def with_labels(drive: DriveMeasured, labels: pd.DataFrame) -> DriveMeasured:
    """How much of a drive was measured.

    Args:
        drive: its scans before (`to_measure`).
        labels: the rows of its sample points (`status`, `reason`), as far as there are any.
    """
    failed = labels.loc[labels["status"] != "done", "reason"].astype(str).tolist()
    why = Counter(f"failed: {reason or NO_REASON}" for reason in failed)
    reasons = {**drive.reasons, **why, NO_LABEL: drive.sample_points - len(labels)}
    order = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    return replace(
        drive,
        measured=len(labels) - len(failed),
        reasons={reason: count for reason, count in order if count},
    )
