"""Factors and errors of the same places in one table: what a model is trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tilestream.errors import ModelError, UsageError
from tilestream.records import Column, Float64, Int64
from tilestream.sensor import Sensor

TARGETS = (
    "error_mean",
    "p_fail",
    "error_floor",
    "error_tail",
    "along_mean",
    "across_mean",
    "up_mean",
)
"""What is estimated, by the names of the label table (definitions, section 5)."""
PLACE = ("route_id", "arc_length", "x", "y", "z", "heading")
"""Where a row is: never a feature."""
TOLERANCE = 0.5
"""How far a scan may be from the sample point whose factors it gets [m]: half the spacing."""
BLOCK = 200.0
"""Least length of a block [m]: twice the range of a vicinity."""
SAME = 1e-3
"""Distances this close are equal [m]: the resolution of the map."""
LONE = "the only label of its path"
"""Why a label alone on its path is lost."""
POINTS_MIN = 50
"""Fewest labelled points that a model is trained on."""
WEAK_ALONG = Column(
    "weak_along",
    "LY",
    "1",
    "How much the direction that walls fix least is that of travel, 0 to 1.",
    "abs(cos(weak_axis - heading))",
    "robust",
)
SPREAD_ALONG, SPREAD_ACROSS = (
    Column(
        f"score_var_{axis}",
        "LS",
        "m^2",
        f"Variance of where the map's points would be found, {axis} the direction of travel.",
        "u^T C u, C of score_cov_xx, _xy, _yy, u the direction",
        "robust",
    )
    for axis in ("along", "across")
)
IN_MAP_AXES: dict[str, Column | None] = {
    "weak_axis": WEAK_ALONG,
    "score_cov_xx": SPREAD_ALONG,
    "score_cov_yy": SPREAD_ACROSS,
    "score_cov_xy": None,
}
"""Directions in the map name a street as its position does: these take their place."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Labelled sample points: a row per drive (group) and place, in one order whatever came in.

    The columns of `rows` are `group` (log and sensor), `path`, `block`, `arc_length` [m], `x`, `y`,
    `z` [m, map frame], `heading` [rad], `distance` [m] between scan and sample point, the factors,
    and the labels. Rows of one place have the same path and arc length in all groups.
    """

    rows: pd.DataFrame
    """The points that have factors and labels, none of them NaN."""
    columns: tuple[Column, ...]
    """The factors that are features of a model; never a position, a heading or a name."""
    lost: pd.DataFrame
    """The labels that found no place: group, sample, reason, detail; and the unlabelled places."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """What the factors were computed with; see `made_with`."""
    data_sets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The identity of each group's labels: matcher, starts, true pose, cell size, sensor."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
        """The names of the features, in order."""
        return [column.name for column in self.columns]

    @property
    def losses(self) -> dict[str, int]:
        """How many labels were lost, by reason."""
        counts = self.lost["reason"].value_counts()
        return {str(reason): int(count) for reason, count in sorted(counts.items())}

    def matrix(self) -> Float64:
        """(n, f) the features."""
        return np.ascontiguousarray(self.rows[self.names].to_numpy(np.float64))

    def label(self, target: str = "error_mean") -> Float64:
        """(n,) what was measured.

        Raises:
            ModelError: the labels do not have this target.
        """
        if target not in self.rows:
            has = ", ".join(name for name in TARGETS if name in self.rows)
            raise ModelError(f"the labels have no {target}; they have {has}")
        return self.rows[target].to_numpy(np.float64)

    def take(self, which: Int64) -> "Dataset":
        """These rows only."""
        return replace(self, rows=self.rows.iloc[which].reset_index(drop=True))

    def first_drives(self) -> "Dataset":
        """Each place once, as the first of its groups by name has it: what models are judged on.

        With a repeated drive a random split would put the same place on both sides.
        """
        return self.take(np.flatnonzero(~self.rows.duplicated(["path", "arc_length"])))

    def groups(self, names: Sequence[str]) -> "Dataset":
        """The rows of these groups only.

        Raises:
            UsageError: a group that is not there.
        """
        known = sorted(set(self.rows["group"]))
        for name in names:
            if name not in known:
                raise UsageError(f"no group {name!r}; there are {', '.join(known)}")
        which = np.flatnonzero(self.rows["group"].isin(list(names)).to_numpy())
        kept = {name: self.data_sets[name] for name in names if name in self.data_sets}
        return replace(self.take(which), data_sets=kept)

    def with_columns(self, columns: Sequence[Column]) -> "Dataset":
        """With these factors as features.

        Raises:
            ModelError: there are none.
        """
        if not columns:
            raise ModelError("a model needs at least one factor")
        return replace(self, columns=tuple(columns))

    def check(self, target: str = "error_mean") -> None:
        """Refuse what no model can learn from.

        Raises:
            ModelError: fewer than 50 labelled points, labels all alike, a path of one point (`join`
                leaves none), or labels of different identities (matcher, true pose, sensor) under
                one roof.
        """
        if len(self) < POINTS_MIN:
            losses = "; ".join(f"{count} {reason}" for reason, count in self.losses.items())
            raise ModelError(
                f"{len(self)} labelled points, and a model needs {POINTS_MIN}: localize a longer "
                f"drive, or more of them (lost: {losses or 'none'})"
            )
        label = self.label(target)
        if label.min() == label.max():
            raise ModelError(
                f"{target} is {label[0]:g} at all {len(self)} points: nothing to learn"
            )
        sizes = self.rows.groupby("path")["arc_length"].nunique()
        for path, size in sizes.items():
            if size < 2:
                raise ModelError(
                    f"path {path!r} has one point only: leave it out or drive more of it"
                )
        for name in ("true_pose", "as_sensor"):
            kinds = sorted(set(self.rows[name]))
            if len(kinds) > 1:
                raise ModelError(f"labels of different {name} ({', '.join(kinds)}): choose groups")
        _one_identity(self.data_sets)


def made_with(columns: Sequence[Column], sensor: Sensor, cell_size: float) -> dict[str, Any]:
    """What factors were computed with, as a model remembers and compares it.

    Args:
        columns: the catalogue of the factors.
        sensor: for which sensor.
        cell_size: edge of the cells [m].
    """
    return {
        "sensor": sensor.model_dump(mode="json"),
        "cell_size": float(cell_size),
        "units": {column.name: column.unit for column in columns},
    }


def features_of(columns: Sequence[Column]) -> tuple[Column, ...]:
    """The factors of a catalogue that may be features, map axes turned into the route's."""
    factors = (column for column in columns if column.criterion not in ("place", "label"))
    turned = (IN_MAP_AXES.get(column.name, column) for column in factors)
    return tuple(column for column in turned if column is not None)


def with_derived(factors: pd.DataFrame) -> pd.DataFrame:
    """A factor table with what is in map axes turned into the route's, by its `heading`."""
    if "heading" not in factors:
        return factors
    heading = factors["heading"].to_numpy(np.float64)
    c, s = np.cos(heading), np.sin(heading)
    turned: dict[str, Float64] = {}
    if "weak_axis" in factors:
        turned["weak_along"] = np.abs(np.cos(factors["weak_axis"].to_numpy(np.float64) - heading))
    if {"score_cov_xx", "score_cov_xy", "score_cov_yy"} <= set(factors):
        xx, xy, yy = (factors[f"score_cov_{a}"].to_numpy(np.float64) for a in ("xx", "xy", "yy"))
        turned["score_var_along"] = c * c * xx + 2.0 * c * s * xy + s * s * yy
        turned["score_var_across"] = s * s * xx - 2.0 * c * s * xy + c * c * yy
    return factors.assign(**turned)


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
    table = _without_lone(_judged(table, [column.name for column in features]))
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
    """The labels of one group with the columns of their place, and why a row is no pair."""
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
    distance, second, place = _nearest(places[["x", "y", "z"]].to_numpy(np.float64), at)
    open_ = reason == ""
    reason[open_ & ~(distance <= tolerance)] = "no sample point within the tolerance"
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


def _nearest_scan_only(reason: NDArray[np.object_], place: Int64, distance: Float64) -> None:
    """Of the scans of one sample point, the nearest keeps it; equally near ones lose it."""
    claims = pd.DataFrame({"place": place, "distance": distance})[reason == ""]
    least = claims.groupby("place")["distance"].transform("min")
    nearest = claims["distance"] - least <= SAME
    ties = nearest.groupby(claims["place"]).transform("sum") > 1
    rows = claims.index.to_numpy()
    reason[rows[~nearest.to_numpy()]] = "another scan is nearer to the sample point"
    reason[rows[(nearest & ties).to_numpy()]] = "two scans equally near to the sample point"


def _judged(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
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


def _one_identity(data_sets: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse labels of different making.

    Raises:
        ModelError: two groups differ; names the groups and the settings.
    """
    names = sorted(data_sets)
    for other in names[1:]:
        one, two = data_sets[names[0]], data_sets[other]
        differ = sorted(k for k in set(one) | set(two) if one.get(k) != two.get(k))
        if differ:
            raise ModelError(
                f"groups {names[0]!r} and {other!r} were labelled with different "
                f"{', '.join(differ)}: train on one of them"
            )
