"""How much of a drive was measured, from its log and its labels."""

import pandas as pd

from tilestream.formats.logs import ScanLog, ScanSelection
from tilestream.pipeline.jobs.localize import choose_samples
from tilestream.report.drives import DriveMeasured

NOT_SELECTED = "not selected"
STANDS = "where another scan stands for the same sample point"
NO_LABEL = "whose task failed"
NO_REASON = "without a reason"


def drive_measured(
    drive: str, log: ScanLog, scans: ScanSelection, spacing: float, labels: pd.DataFrame
) -> DriveMeasured:
    """How much of a drive was measured.

    Args:
        drive: what to call it.
        log: its scans.
        scans: which of them were to be used.
        spacing: distance between sample points [m].
        labels: the rows of its sample points (`status`, `reason`), as far as there are any.

    Raises:
        UsageError: as `choose_samples`.
    """
    selected = scans.indices(log.stamps_ns)
    posed = int(log.posed[selected].sum())
    places = len(choose_samples(log, scans, spacing))
    failed = labels.loc[labels["status"] != "done", "reason"].astype(str).tolist()
    reasons = {
        **log.left_out,
        NOT_SELECTED: len(log) - len(selected),
        **log.unposed(selected),
        STANDS: posed - places,
        NO_LABEL: places - len(labels),
    }
    for reason in failed:
        told = f"failed: {reason or NO_REASON}"
        reasons[told] = reasons.get(told, 0) + 1
    left_out = sum(log.left_out.values())
    return DriveMeasured(
        drive=drive,
        scans=len(log) + left_out,
        selected=len(selected) + left_out,
        posed=posed,
        sample_points=places,
        measured=len(labels) - len(failed),
        reasons={
            why: n for why, n in sorted(reasons.items(), key=lambda item: (-item[1], item[0])) if n
        },
    )
