"""What is told of the poses of a log beside the refined ones that labels were measured from."""

import math

import numpy as np
import pandas as pd

from tilestream.report.formatting import CM_PER_M


def note_of_log_poses(labels: pd.DataFrame) -> list[str]:
    """A sentence on how far a drive's log has its poses from the refined true poses; none where
    no pose was refined.

    Args:
        labels: rows of the label table of one drive (`log_along`, `log_across`, `log_up` [m],
            `log_yaw` [rad]).
    """
    off = labels[["log_along", "log_across", "log_up", "log_yaw"]].dropna().to_numpy(np.float64)
    if not len(off):
        return []
    far = np.linalg.norm(off[:, :3], axis=1) * CM_PER_M
    along, across, up = np.median(off[:, :3], axis=0) * CM_PER_M
    yaw = math.degrees(float(np.median(off[:, 3])))
    told = (
        f"its log's poses are {np.median(far):.1f} cm from the refined ones (median of {len(off)} "
        f"scans, 95 % within {np.quantile(far, 0.95):.1f} cm); in the median, log - refined: "
        f"{along:+.1f} cm along, {across:+.1f} cm across, {up:+.1f} cm up, {yaw:+.2f} deg"
    )
    return [told]
