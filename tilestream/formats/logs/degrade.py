"""A scan degraded to what a simpler lidar records: fewer beams, less range, a blind rear."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.records import Float64, Scan
from tilestream.sensor import in_blind_sector, kept_beams

COLUMN_DEG = 0.25
"""Width of the azimuth columns in which gaps between beams are measured: about a firing [deg]."""
SAME_BEAM_DEG = 0.1
"""Neighbours in a column that are closer than this are of one beam [deg]."""


def degraded(
    scan: Scan,
    *,
    beams: int | None = None,
    range_max: float | None = None,
    blind_rear_deg: float | None = None,
    recorded_beams: int | None = None,
) -> Scan:
    """The points of a scan that a simpler lidar would have seen, in their order and frame.

    Args:
        scan: a scan of a spinning lidar whose z axis points up and x axis ahead.
        beams: how many beams remain, evenly spread over those recorded; None: all. Where the log
            records rings, whole rings remain. Else a beam is a slice of elevations: `beams`
            slices from the lowest to the highest elevation of the scan (its 0.5th and 99.5th
            percentile), each as thick as the gap between two recorded beams.
        range_max: largest range [m]; None: as recorded.
        blind_rear_deg: width of the sector without returns, centred on -x [deg]; None or 0: none.
        recorded_beams: how many beams the lidar had. None: with rings, the highest number and one;
            else from the median gap between returns that lie above each other in a column of
            0.25 deg, which is right to a tenth (a HDL-64E in a street counts 68 or 69); a sensor
            with very uneven beams and no rings is thinned only roughly.

    Raises:
        UsageError: a number outside of its range, or more beams asked for than were recorded.
    """
    if range_max is not None and not range_max > 0:
        raise UsageError(f"range_max = {range_max}: must be a positive length in metres")
    if blind_rear_deg is not None and not 0 <= blind_rear_deg < 360:
        raise UsageError(f"blind_rear_deg = {blind_rear_deg}: must be from 0 to below 360")
    keep = np.ones(len(scan.points), dtype=bool)
    if beams is not None:
        keep &= _on_beams(scan, beams, recorded_beams)
    if range_max is not None:
        keep &= (scan.points**2).sum(axis=1) <= range_max**2
    if blind_rear_deg:
        keep &= ~in_blind_sector(scan.points, blind_rear_deg, slack=0.0)
    return select(scan, keep)


def select(scan: Scan, keep: NDArray[np.bool_]) -> Scan:
    """The scan with only some of its points."""
    return replace(
        scan,
        points=scan.points[keep],
        intensity=None if scan.intensity is None else scan.intensity[keep],
        ring=None if scan.ring is None else scan.ring[keep],
        time_offset=None if scan.time_offset is None else scan.time_offset[keep],
    )


def _on_beams(scan: Scan, beams: int, recorded: int | None) -> NDArray[np.bool_]:
    if beams < 1:
        raise UsageError(f"beams = {beams}: must be at least 1")
    if not len(scan.points):
        return np.zeros(0, dtype=bool)
    if scan.ring is not None:
        recorded = recorded or int(scan.ring.max()) + 1
        _check_enough(beams, recorded)
        order = _rings_by_elevation(scan.points, scan.ring, recorded)
        return np.isin(scan.ring, order[kept_beams(recorded, beams)])
    elevation = _elevation_deg(scan.points)
    low, high = np.percentile(elevation, [0.5, 99.5])
    if recorded:
        gap = (high - low) / max(recorded - 1, 1)
    else:
        gap = _beam_gap_deg(scan.points, elevation)
        recorded = round((high - low) / gap) + 1
    _check_enough(beams, recorded)
    if beams == 1:
        low = high = (low + high) / 2
    spacing = (high - low) / max(beams - 1, 1) or 1.0
    nearest = np.clip(np.round((elevation - low) / spacing), 0, beams - 1)
    off_beam = elevation - (low + nearest * spacing)
    on_beam: NDArray[np.bool_] = np.abs(off_beam) <= gap / 2
    return on_beam


def _check_enough(beams: int, recorded: int) -> None:
    if beams > recorded:
        raise UsageError(f"beams = {beams}: the scan has only {recorded}")


def _rings_by_elevation(
    points: Float64, ring: NDArray[np.int32], recorded: int
) -> NDArray[np.int64]:
    """All ring numbers, from the lowest beam to the highest. Rings without a return take the place
    that their number has among the others, so a scan of an open place keeps the same rings.
    """
    elevation = _elevation_deg(points)
    seen = np.unique(ring)
    mean = np.bincount(ring, elevation, minlength=recorded)[seen] / np.bincount(ring)[seen]
    if len(seen) < 2:
        return np.arange(recorded)
    return np.argsort(np.interp(np.arange(recorded), seen, mean), kind="stable")


def _elevation_deg(points: Float64) -> Float64:
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def _beam_gap_deg(points: Float64, elevation: Float64) -> float:
    """Median gap between returns above each other [deg]."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    column = np.floor(azimuth / COLUMN_DEG)
    order = np.lexsort((elevation, column))
    gaps = np.diff(elevation[order])[np.diff(column[order]) == 0]
    gaps = gaps[gaps > SAME_BEAM_DEG]
    if not len(gaps):
        raise UsageError("the beams of the scan cannot be told apart; give recorded_beams")
    return float(np.median(gaps))
