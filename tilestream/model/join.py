"""Labels and the factors of their places, joined: what finds none is kept with its reason."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from tilestream.errors import UsageError
from tilestream.kernels.fixed_order import norms
from tilestream.model.dataset import TARGETS, Dataset
from tilestream.model.features import features_of, with_derived
from tilestream.moments import NEAR_COLUMNS
from tilestream.records import Column, Float64, Int64

PLACE = ("route_id", "arc_length", "x", "y", "z", "heading")
"""Columns that say where a row is; never features."""
ON_PATH = 5.0
"""How far from a route a place lies on it, horizontally [m]."""
BLOCK = 200.0
"""Least length of a block [m]: twice the range of a vicinity."""
LONE = "the only label of its path"
"""Why a label alone on its path is lost."""
NOWHERE = "no factors at its place"
"""Why a label is lost whose place could not be looked from."""
FAILED = "label failed"
"""Why a label is lost that was not measured."""
KEPT_BY = {
    FAILED: "a scan there with enough points, over a part of the map that is mapped",
    NOWHERE: "the height and the mount of the lidar as they are, and the map around its place",
    LONE: "a second label on its path: a longer drive, or a route along this one",
}
"""What would keep a label that is lost, by the reason."""
NOT_A_NUMBER = "more of the map around its place, or of the scan there"
"""What would keep one of which a value is not known."""


def join(
    routes: pd.DataFrame,
    factors: Mapping[str, pd.DataFrame],
    labels: Mapping[str, pd.DataFrame],
    columns: Sequence[Column],
    *,
    block: float = BLOCK,
    made_with: Mapping[str, Any] | None = None,
    data_sets: Mapping[str, Mapping[str, Any]] | None = None,
) -> Dataset:
    """Join each label with the factors of its own place, and name the path that it lies on.

    The path is the route that is nearest, if within 5 m horizontally, and `arc_length` that of the
    route there (`nearest_pass`); else the drive itself. Every label that is not joined is counted
    with its reason: it failed, a value is NaN, no factors at its place, or no other labelled place
    on its path: the end of a side street makes no path that could be held out.

    Args:
        routes: sample points of the routes: place columns (`PLACE`).
        factors: by the name of a group (one log as seen by one sensor), the factor table of the
            places of its scans: place columns, `sample`, factors, `status` and `reason`.
        labels: by group, the label table (`x`, `y`, `z`, `sample`, `TARGETS`, `status`, …).
        columns: the catalogue of the factors; those that no table has are no features.
        block: least length of a block along a path [m]; a shorter path is one block.
        made_with: what the factors were computed with (`made_with`).
        data_sets: the identity of each group's labels, as their tables carry it.

    Raises:
        UsageError: columns that a table lacks, a table with a row twice, a block that is not
            positive, no routes, or no factor in the factor tables.
    """
    if not block > 0.0:
        raise UsageError(f"block {block!r}: give a positive length")
    paths = _paths(routes)
    seen = {name: with_derived(table) for name, table in factors.items()}
    there = {column for table in seen.values() for column in table}
    features = tuple(column for column in features_of(columns) if column.name in there)
    if seen and not features:
        raise UsageError("the factor tables have none of the catalogue's factors")
    joined = [_joined(name, seen.get(name), labels[name]) for name in sorted(labels)]
    table = pd.concat(joined or [_joined("", None, _NO_LABELS)], ignore_index=True)
    table = _with_paths(table, paths)
    table = table.assign(block=_blocks(table, paths, block))
    table = _without_lone(_checked(table, [column.name for column in features]))
    kept = table[table["reason"] == ""]
    order = ["group", "path", "arc_length", "x", "y", "z"]
    rows = kept.drop(columns=["reason", "detail"]).sort_values(order, kind="stable")
    lost = table.loc[table["reason"] != "", ["group", "sample", "reason", "detail"]]
    return Dataset(
        rows.reset_index(drop=True),
        features,
        lost.sort_values(["group", "sample"], kind="stable").reset_index(drop=True),
        dict(made_with or {}),
        {name: dict(data) for name, data in (data_sets or {}).items()},
    )


_LABELLED = ("sample", "x", "y", "z", "error_mean", "status", "reason")
_NO_LABELS = pd.DataFrame({name: [] for name in (*_LABELLED, "arc_length", "heading")})


def _paths(routes: pd.DataFrame) -> pd.DataFrame:
    """The sample points of the routes: path, arc length, place."""
    _require(routes, PLACE, "the table of routes")
    if routes.empty:
        raise UsageError("the table of routes has no rows: no sample points on this map?")
    twice = routes.duplicated(["route_id", "arc_length"])
    if twice.any():
        row = routes[twice].iloc[0]
        raise UsageError(
            f"the table of routes has two rows of route {row['route_id']!r} at "
            f"{row['arc_length']:g} m: was a file read twice?"
        )
    table = routes[list(PLACE)].rename(columns={"route_id": "path"})
    table = table.assign(path=table["path"].astype(str))
    return table.sort_values(["path", "arc_length"], kind="stable").reset_index(drop=True)


def _joined(group: str, factors: pd.DataFrame | None, labels: pd.DataFrame) -> pd.DataFrame:
    """The labels of one group with the factors of their places, and why a row cannot be joined."""
    _require(labels, _LABELLED, f"group {group!r}")
    for table, what in ((labels, "sample"), (factors, "the factors of sample")):
        if table is not None and table["sample"].duplicated().any():
            sample = table.loc[table["sample"].duplicated(), "sample"].iloc[0]
            raise UsageError(f"group {group!r} has {what} {sample} twice: was a file read twice?")
    labels = labels.sort_values("sample", kind="stable").reset_index(drop=True)
    near = (column.name for column in NEAR_COLUMNS)
    kept = [n for n in (*TARGETS, *near, "sample", "true_pose", "as_sensor") if n in labels]
    measured = pd.DataFrame({"true_pose": "", "as_sensor": ""}, index=labels.index)
    measured = measured.assign(label_status=labels["status"], label_reason=labels["reason"])
    measured[kept] = labels[kept]
    if factors is None:
        here = labels.reindex(columns=["sample", *PLACE[1:]])
        here = here.assign(status="failed", reason="its task failed")
    else:
        _require(factors, (*PLACE, "sample", "status", "reason"), f"the factor table of {group!r}")
        here = factors.drop(columns="route_id")
    table = measured.merge(here, on="sample", how="left", validate="one_to_one")
    failed = (table["label_status"] != "done").to_numpy()
    blind = (table["status"] != "done").to_numpy()
    why = table["reason"].fillna("its task failed").astype(str).to_numpy(object)
    return table.assign(
        group=group,
        reason=np.where(failed, FAILED, np.where(blind, NOWHERE, "")),
        detail=np.where(failed, table["label_reason"].astype(str), np.where(blind, why, "")),
    ).drop(columns=["label_status", "label_reason", "status"])


def _with_paths(table: pd.DataFrame, paths: pd.DataFrame) -> pd.DataFrame:
    """With the path that each place lies on, the arc length there, and its distance from it [m]."""
    at = table[["x", "y"]].to_numpy(np.float64)
    known = np.isfinite(at).all(axis=1)
    route = paths[["x", "y"]].to_numpy(np.float64)
    distance, nearest = np.full(len(at), np.inf), np.zeros(len(at), np.int64)
    along, heading = (t["heading"].to_numpy(np.float64) for t in (paths, table))
    nearest[known], distance[known] = nearest_pass(route, along, at[known], heading[known])
    row = paths.iloc[nearest].reset_index(drop=True)
    ahead = _ahead(at - route[nearest], along[nearest])
    on = distance <= ON_PATH
    own = table["arc_length"].to_numpy(np.float64)
    return table.assign(
        path=np.where(on, row["path"], table["group"].astype(str) + ", off the routes"),
        arc_length=np.where(on, row["arc_length"].to_numpy(np.float64) + ahead, own),
        distance=np.where(on, distance, np.nan),
    )


def nearest_pass(
    route: Float64, along: Float64, at: Float64, heading: Float64
) -> tuple[Int64, Float64]:
    """The place of a route that each of some places lies at: the nearest, but where the route
    passes there and back, of those within `ON_PATH` the nearest that heads the same way, within a
    right angle.

    Args:
        route: (k, d) places of the route [m], k > 0.
        along: (k,) headings there [rad].
        at: (n, d) places [m].
        heading: (n,) headings there [rad]; NaN: not known.

    Returns:
        (n,) rows of the route, and (n,) distances from there [m].
    """
    tree = cKDTree(route - route[0])
    found, rows = tree.query(at - route[0])
    distance, nearest = np.asarray(found, np.float64), np.asarray(rows, np.int64)
    against = (np.cos(along[nearest] - heading) < 0.0) & (distance <= ON_PATH)
    for place in np.flatnonzero(against):
        near = np.array(tree.query_ball_point(at[place] - route[0], ON_PATH))
        same = near[np.cos(along[near] - heading[place]) >= 0.0]
        if len(same):
            apart = norms(route[same] - at[place])
            nearest[place], distance[place] = same[np.argmin(apart)], apart.min()
    return nearest, distance


def _ahead(offset: Float64, heading: Float64) -> Float64:
    """(k,) how far (k, 2) offsets lead along headings."""
    ahead: Float64 = offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading)
    return ahead


def _blocks(table: pd.DataFrame, paths: pd.DataFrame, block: float) -> list[str]:
    """`<path>#<number>`: each path cut into equal pieces, none shorter than `block`; a path is as
    long as its route, else as the drive.
    """
    ways = pd.concat([paths, table[~table["path"].isin(paths["path"])]])[["path", "arc_length"]]
    ends = ways.groupby("path")["arc_length"].agg(["min", "max"])
    start = table["path"].map(ends["min"]).to_numpy(np.float64)
    length = np.nan_to_num(table["path"].map(ends["max"] - ends["min"]).to_numpy(np.float64))
    pieces = np.maximum(np.floor(length / block), 1.0)
    share = (table["arc_length"].to_numpy(np.float64) - start) / np.where(length > 0, length, 1.0)
    number = np.clip(np.floor(np.nan_to_num(share * pieces)), 0.0, pieces - 1.0)
    return [f"{path}#{int(k):02d}" for path, k in zip(table["path"], number, strict=True)]


def _checked(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """With the reasons that lie in the values: a NaN among factors or labels."""
    reason = table["reason"].to_numpy(object).copy()
    for kind, wanted in (("factor", names), ("label", [n for n in TARGETS if n in table])):
        for name in wanted:
            bad = (reason == "") & ~np.isfinite(table[name].to_numpy(np.float64))
            reason[bad] = f"{kind} {name} is not a number"
    return table.assign(reason=reason)


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
