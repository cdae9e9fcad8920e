"""Factors and errors of the same places, joined: what finds no partner is kept with its reason."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tilestream.errors import UsageError
from tilestream.model.dataset import TARGETS, Dataset
from tilestream.model.features import features_of, with_derived
from tilestream.records import Column, Float64, Int64

PLACE = ("route_id", "arc_length", "x", "y", "z", "heading")
"""Columns that say where a row is; never features."""
TOLERANCE = 0.5
"""How far a scan may be from the sample point whose factors it gets [m]: half the spacing."""
BLOCK = 200.0
"""Least length of a block [m]: twice the range of a vicinity."""
SAME = 1e-3
"""Distances this close are equal [m]: the resolution of the map."""
LONE = "the only label of its path"
"""Why a label alone on its path is lost."""


def join(
    factors: pd.DataFrame,
    labels: Mapping[str, pd.DataFrame],
    columns: Sequence[Column],
    *,
    own_factors: Mapping[str, pd.DataFrame] | None = None,
    tolerance: float = TOLERANCE,
    block: float = BLOCK,
    made_with: Mapping[str, Any] | None = None,
    data_sets: Mapping[str, Mapping[str, Any]] | None = None,
) -> Dataset:
    """Join factors and labels by place: each label gets the factors of the nearest sample point.

    Every label that is not joined is counted with its reason: it failed, a value is NaN, no sample
    point within the tolerance, two sample points equally near (within 1 mm), another scan of its
    group nearer to that sample point, or no other labelled place on its path: the end of a side
    street makes no path that could be held out.

    Args:
        factors: the factor table: place columns (`PLACE`), factors, `status` and `reason`.
        labels: the label tables (`x`, `y`, `z`, `sample`, `TARGETS`, `status`, …) by the name of
            their group: one log as seen by one sensor.
        columns: the catalogue of the factors; those absent from the table are no features.
        own_factors: the factor tables, of the same places, of groups that were seen with another
            lidar.
        tolerance: farthest sample point that a label takes its factors from [m].
        block: least length of a block along a path [m]; a shorter path is one block.
        made_with: what the factors were computed with (`made_with`).
        data_sets: the identity of each group's labels, as their tables carry it.

    Raises:
        UsageError: columns that a table lacks, a table with a row twice, a tolerance or block that
            is not positive, no rows or no factor in the factor table.
    """
    if not (tolerance > 0.0 and block > 0.0):
        raise UsageError(f"tolerance {tolerance!r} and block {block!r}: give positive lengths")
    places = _places(factors, block)
    features = tuple(c for c in features_of(columns) if c.name in places)
    if not features:
        raise UsageError("the factor table has none of the catalogue's factors")
    seen = {name: _places(table, block) for name, table in (own_factors or {}).items()}
    joined = [
        _joined(seen.get(name, places), name, labels[name], tolerance) for name in sorted(labels)
    ]
    table = pd.concat(joined or [_joined(places, "", _NO_LABELS, tolerance)], ignore_index=True)
    table = _without_lone(_checked(table, [column.name for column in features]))
    kept = table[table["reason"] == ""]
    order = ["group", "path", "arc_length", "x", "y", "z"]
    rows = kept.drop(columns=["reason", "detail", "status"]).sort_values(order, kind="stable")
    lost = table.loc[table["reason"] != "", ["group", "sample", "reason", "detail"]]
    return Dataset(
        rows.reset_index(drop=True),
        features,
        lost.sort_values(["group", "sample"], kind="stable").reset_index(drop=True),
        dict(made_with or {}),
        {name: dict(data) for name, data in (data_sets or {}).items()},
    )


_LABELLED = ("sample", "x", "y", "z", "error_mean", "status", "reason")
_NO_LABELS = pd.DataFrame({name: [] for name in _LABELLED})


def _places(factors: pd.DataFrame, block: float) -> pd.DataFrame:
    """The sample points in one order, with path and block."""
    _require(factors, (*PLACE, "status", "reason"), "the factor table")
    if factors.empty:
        raise UsageError("the factor table has no rows: no sample points on this map?")
    twice = factors.duplicated(["route_id", "arc_length"])
    if twice.any():
        row = factors[twice].iloc[0]
        raise UsageError(
            f"the factor table has two rows of route {row['route_id']!r} at "
            f"{row['arc_length']:g} m: was a file read twice?"
        )
    table = with_derived(factors).rename(
        columns={"route_id": "path", "status": "factor_status", "reason": "factor_reason"}
    )
    table = table.assign(path=table["path"].astype(str)).drop(columns="sample", errors="ignore")
    table = table.sort_values(["path", "arc_length"], kind="stable").reset_index(drop=True)
    return table.assign(block=_blocks(table, block))


def _blocks(table: pd.DataFrame, block: float) -> list[str]:
    """`<path>#<number>`: each path cut into equal pieces, none shorter than `block`."""
    arc = table["arc_length"]
    start = arc.groupby(table["path"]).transform("min")
    length = arc.groupby(table["path"]).transform("max") - start
    pieces = np.maximum(np.floor(length / block), 1.0)
    number = np.minimum(
        np.floor((arc - start) * pieces / length.where(length > 0, 1.0)), pieces - 1
    )
    return [f"{path}#{int(k):02d}" for path, k in zip(table["path"], number, strict=True)]


def _joined(
    places: pd.DataFrame, group: str, labels: pd.DataFrame, tolerance: float
) -> pd.DataFrame:
    """The labels of one group with the columns of their place, and why a row cannot be joined."""
    _require(labels, _LABELLED, f"group {group!r}")
    if labels["sample"].duplicated().any():
        sample = labels.loc[labels["sample"].duplicated(), "sample"].iloc[0]
        raise UsageError(f"group {group!r} has sample {sample} twice: was a file read twice?")
    labels = labels.sort_values("sample", kind="stable").reset_index(drop=True)
    failed = (labels["status"] != "done").to_numpy()
    detail = labels["reason"].where(failed, "").astype(str)
    reason = np.where(failed, "label failed", "").astype(object)
    at = labels[["x", "y", "z"]].to_numpy(np.float64)
    reason[(reason == "") & ~np.isfinite(at).all(axis=1)] = "label without a position"
    xyz = places[["x", "y", "z"]].to_numpy(np.float64)
    distance, second, place = _nearest(xyz, at)
    far = (reason == "") & ~(distance <= tolerance)
    reason[far] = "no sample point within the tolerance"
    detail[far] = _how_far(
        at[far & np.isfinite(distance)] - xyz[place[far & np.isfinite(distance)]]
    )
    reason[(reason == "") & (second <= distance + SAME)] = "two sample points equally near"
    _nearest_scan_only(reason, place, distance)
    kept = [n for n in (*TARGETS, "sample", "true_pose", "as_sensor", "status") if n in labels]
    here = places.iloc[np.minimum(place, len(places) - 1)].reset_index(drop=True)
    frame = here.assign(true_pose="", as_sensor="", group=group, distance=distance)
    for name in kept:
        frame[name] = labels[name].to_numpy()
    return frame.assign(reason=reason, detail=detail.to_numpy())


def _nearest(places: Float64, at: Float64) -> tuple[Float64, Float64, Int64]:
    """Distance to the nearest place and to the second nearest [m], and which it is."""
    finite = np.isfinite(at).all(axis=1)
    first = np.full(len(at), np.inf)
    second, place = first.copy(), np.zeros(len(at), np.int64)
    usable = np.flatnonzero(np.isfinite(places).all(axis=1))
    if usable.size and finite.any():
        origin = places[usable[0]]
        tree = cKDTree(places[usable] - origin)
        found = tree.query(at[finite] - origin, k=2)
        distance, index = np.asarray(found[0]), np.asarray(found[1])
        first[finite], second[finite] = distance[:, 0], distance[:, 1]
        place[finite] = usable[np.minimum(index[:, 0], usable.size - 1)]
    return first, second, place


def _how_far(apart: Float64) -> str:
    """In words, how far labels are from their nearest sample points, (n, 3) [m]."""
    if not len(apart):
        return ""
    ways = {"horizontally": np.hypot(apart[:, 0], apart[:, 1]), "vertically": abs(apart[:, 2])}
    told = [
        f"{way} at least {far.min():.2f} m, median {np.median(far):.2f} m"
        for way, far in ways.items()
    ]
    return f"from the nearest {', '.join(told)}"


def _nearest_scan_only(reason: NDArray[np.object_], place: Int64, distance: Float64) -> None:
    """Of the scans of one sample point, the nearest keeps it; equally near ones lose it."""
    claims = pd.DataFrame({"place": place, "distance": distance})[reason == ""]
    least = claims.groupby("place")["distance"].transform("min")
    nearest = claims["distance"] - least <= SAME
    ties = nearest.groupby(claims["place"]).transform("sum") > 1
    rows = claims.index.to_numpy()
    reason[rows[~nearest.to_numpy()]] = "another scan is nearer to the sample point"
    reason[rows[(nearest & ties).to_numpy()]] = "two scans equally near to the sample point"


def _checked(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """With the reasons that lie in the values: no factors, or a NaN among factors or labels."""
    reason = table["reason"].to_numpy(object).copy()
    detail = (
        table["detail"].to_numpy(object).copy() if "detail" in table else np.full(len(table), "")
    )
    no_factors = (reason == "") & (table["factor_status"] != "done").to_numpy()
    detail[no_factors] = table["factor_reason"].to_numpy()[no_factors]
    reason[no_factors] = "no factors at the sample point"
    for kind, wanted in (("factor", names), ("label", [n for n in TARGETS if n in table])):
        for name in wanted:
            bad = (reason == "") & ~np.isfinite(table[name].to_numpy(np.float64))
            reason[bad] = f"{kind} {name} is not a number"
    return table.assign(reason=reason, detail=detail)


def _without_lone(table: pd.DataFrame) -> pd.DataFrame:
    """With a reason for labels whose path has no second labelled place, in no group."""
    good = table["reason"] == ""
    places = table[good].groupby("path")["arc_length"].nunique()
    lone = good & table["path"].isin(places.index[places < 2])
    return table.assign(reason=table["reason"].mask(lone, LONE))


def _require(table: pd.DataFrame, names: Sequence[str], what: str) -> None:
    absent = [name for name in names if name not in table]
    if absent:
        raise UsageError(f"{what} has no column {', '.join(absent)}")
