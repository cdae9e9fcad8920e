"""Label: sum up the starts of a slice of scans, a row per sample point."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from tilestream.label import FAILED, NEAR, summary
from tilestream.moments import AXES, NEAR_COLUMNS, autoware_scores, moments_of, scores_of
from tilestream.pipeline.engine.outputs import Made, Stored
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.drive_scans import Sample
from tilestream.pipeline.stages.register import SCAN_COLUMNS
from tilestream.records import Column

OFF_LOG = "log - refined; NaN where the true pose is the log's"
"""What the offsets of the log's poses are."""
ERROR_COLUMNS = (
    *SCAN_COLUMNS,
    Column("x", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("y", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("z", "place", "m", "True position of the lidar in the map.", "see true_pose"),
    Column("heading", "place", "rad", "True heading, from the map's x axis.", "see true_pose"),
    Column("lidar_height", "place", "m", "Of the log's pose above the ground of the map.", ""),
    Column("arc_length", "place", "m", "Length of the drive up to here.", "of the log's poses"),
    Column("true_pose", "label", "", "log or refined.", "definitions, section 5", dtype="str"),
    Column("as_sensor", "label", "", "As if by which sensor the log was read.", "", dtype="str"),
    Column("log_along", "place", "m", "Of the log's pose along the true heading.", OFF_LOG),
    Column("log_across", "place", "m", "Of the log's pose across it, left positive.", OFF_LOG),
    Column("log_up", "place", "m", "Of the log's pose in map z.", OFF_LOG),
    Column("log_yaw", "place", "rad", "Of the log's heading, in [-pi, pi).", OFF_LOG),
    Column("points", "label", "1", "Points of a scan as registered, thinned.", "", dtype="int64"),
    Column("starts", "label", "1", "Number of starts, of all scans.", "", dtype="int64"),
    Column("scans", "label", "1", "Scans that were measured here.", "", dtype="int64"),
    Column(
        "scan_spread",
        "label",
        "m",
        "Standard deviation of the mean error between the scans; NaN of one scan.",
        "definitions, section 5",
    ),
    Column("converged", "label", "1", "Share of starts that converged.", ""),
    Column("iterations", "label", "1", "Mean number of Newton steps.", ""),
    Column("nvtl", "label", "1", "Mean NVTL at the end.", "Autoware"),
    Column("error_mean", "label", "m", "Mean 3D error of all starts.", "the paper's label"),
    Column(
        "p_fail",
        "label",
        "1",
        "Share of starts with a 3D error above 0.5 m.",
        "definitions, section 5",
    ),
    Column("mean_held", "label", "m", "Mean 3D error of the starts that did not fail.", ""),
    Column("median_held", "label", "m", "Median of the same.", ""),
    Column("p95_held", "label", "m", "95th percentile of the same.", ""),
    Column("along_mean", "label", "m", "Mean of abs(along).", ""),
    Column("across_mean", "label", "m", "Mean of abs(across).", ""),
    Column("up_mean", "label", "m", "Mean of abs(up).", ""),
    Column("roll_mean", "label", "rad", "Mean of abs(roll).", ""),
    Column("pitch_mean", "label", "rad", "Mean of abs(pitch).", ""),
    Column("yaw_mean", "label", "rad", "Mean of abs(yaw).", ""),
    Column(
        "error_floor",
        "label",
        "m",
        "Mean 3D error of the starts within 1 m.",
        "definitions, section 5",
    ),
    Column("error_tail", "label", "m", "error_mean - error_floor.", "definitions, section 5"),
    *NEAR_COLUMNS,
    Column("status", "place", "", "done, or failed.", "", dtype="str"),
    Column("reason", "place", "", "Why it failed.", "", dtype="str"),
)


FIXED_BYTES = 100_000_000
"""Memory of the task besides what it reads: pandas and its tables."""
BYTES_PER_ROW = 600
"""Memory per start: its row, in parts, together and sorted."""


@stage(
    "label",
    version=5,
    memory=lambda counts: FIXED_BYTES + BYTES_PER_ROW * counts["rows"],
    seconds=0.006,
    columns=ERROR_COLUMNS,
)
def label(starts: Sequence[Stored], samples: Sequence[Sample]) -> Made:
    """A row per sample point, in their order.

    Args:
        starts: the starts of each batch, with what is true of all starts of a scan.
        samples: the scans of the sample points.
    """
    frame = pd.concat([part.rows for part in starts], ignore_index=True)
    facts: dict[str, dict[str, Any]] = {}
    for part in starts:
        for scan, fact in part.facts["scans"].items():  # the first batch that failed decides
            facts[scan] = fact | {"reason": facts.get(scan, fact)["reason"] or fact["reason"]}
    data_set = starts[0].facts["data_set"]
    points: dict[int, list[tuple[Sample, dict[str, Any]]]] = {}
    for sample in samples:
        points.setdefault(sample.number, []).append((sample, facts[str(sample.scan)]))
    rows = [_row(scans, data_set, frame) for scans in points.values()]
    names = {column.name: column.dtype for column in ERROR_COLUMNS}
    labels = pd.DataFrame(rows).reindex(columns=list(names)).astype(names)
    return Made(labels, {"data_set": data_set})


def _row(
    scans: Sequence[tuple[Sample, dict[str, Any]]], data_set: dict[str, Any], starts: pd.DataFrame
) -> dict[str, Any]:
    """The row of a sample point from its scans, the nearest first; without those that failed, as
    long as one did not.
    """
    good = [(sample, fact) for sample, fact in scans if not fact["reason"]]
    sample, fact = (good or scans)[0]
    row: dict[str, Any] = {
        "points": 0,
        "starts": 0,
        "scans": len(good),
        "sample": sample.number,
        "scan": sample.scan,
        "stamp_ns": sample.stamp_ns,
        "arc_length": sample.arc_length,
        "status": "failed" if fact["reason"] else "done",
        "true_pose": data_set["true_pose"],
        "as_sensor": data_set["as_sensor"],
        **fact,
    }
    if good:
        own = [sample.scan for sample, _ in good]
        row |= _summed(starts[starts["scan"].isin(own)], {s.scan: f["points"] for s, f in good})
        row["points"] = round(sum(fact["points"] for _, fact in good) / len(good))
    return row


def _summed(starts: pd.DataFrame, points: dict[int, int]) -> dict[str, float]:
    """The label of one sample point from the rows of the starts of all its scans.

    Args:
        starts: the rows.
        points: of each scan how many were registered.
    """
    starts = starts.sort_values(["scan", "start"])
    names = ("along", "across", "up", "roll", "pitch", "yaw", "error")
    errors = {name: starts[name].to_numpy() for name in names}
    distance = starts["distance"].to_numpy()
    near = starts[distance <= NEAR + 1e-9]
    held = near["error"].to_numpy() <= FAILED
    of_scan = near["scan"].map(points).to_numpy(np.float64)
    nvtl, score, hits = (near[name].to_numpy() for name in ("nvtl", "score", "hits"))
    nvtl, tp = autoware_scores(nvtl, score, hits, of_scan)
    return {
        "starts": len(starts),
        "scan_spread": float(starts.groupby("scan")["error"].mean().std()),
        "converged": float(starts["converged"].mean()),
        "iterations": float(starts["iterations"].mean()),
        "nvtl": float(starts["nvtl"].mean()),
        **summary(errors, distance),
        **moments_of("near", near[list(AXES)].to_numpy(), held),
        **scores_of("near", nvtl, tp, held),
    }
