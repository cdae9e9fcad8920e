"""Factors and errors of the same places in one table: what a model is trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import ModelError, UsageError
from tilestream.factors.along_route import AVERAGED, averaged_along
from tilestream.factors.virtual_drive import MOMENT_COLUMNS
from tilestream.notebook import html_table
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
LENGTHS = ("error_mean", "error_floor", "along_mean", "across_mean", "up_mean")
"""Targets that are positive lengths, of which a logarithm can be taken."""
LEAST = 1e-4
"""Errors below this count as this, before a logarithm [m]."""
POINTS_MIN = 50
"""Fewest labelled points that a model is trained on."""
WITHOUT_DRIVES = "`tilestream estimate` and model: {recipe: physics} need no drives"
"""What there is for whoever has nothing to learn from."""
OF_LIDAR = ("registration", "as_sensor")
"""What of the identity of labels may differ from run to run: a model over several knows it."""
MOMENTS = tuple(column.name for column in MOMENT_COLUMNS)
"""Columns of the virtual drive that a covariance is made of, and no estimate."""
VIRTUAL_DRIVES = ("group", "route_id", "sample", "arc_length", "status", *AVERAGED, *MOMENTS)
"""What is kept of the virtual drives of all places of the drives."""


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Labelled sample points: a row per drive (group) and place, in one order whatever came in.

    The columns of `rows` are `group` (log and sensor), `path`, `block`, `arc_length` [m], `x`, `y`,
    `z` [m, map frame], `heading` [rad], `distance` [m] of the place from its path, the factors, and
    the labels.
    """

    rows: pd.DataFrame
    """The points that have factors and labels, none of them NaN; their virtual drives each of its
    own place alone (`averaged`)."""
    columns: tuple[Column, ...]
    """The factors that are features of a model; never a position, a heading or a name."""
    lost: pd.DataFrame
    """The labels that are not joined: group, sample, reason, detail."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """What the factors were computed with; see `made_with`."""
    data_sets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The identity of each group's labels: matcher, starts, true pose, cell size, sensor."""
    virtual_drives: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame(columns=list(VIRTUAL_DRIVES))
    )
    """The virtual drives of all places of the drives, labelled or not, along each drive."""
    stages: Mapping[str, int] = field(default_factory=dict)
    """The versions of the stages that made factors and labels; empty: not known."""
    makings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of several runs: what the factors of each group were computed with, whole (`over_runs`), and
    the rows have `street`, `piece`, `district` and `lidar` too. Empty: of one run."""
    runs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of several runs: what is known of each, by its name: district, preset, seed."""

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        paths, lost = len(set(self.rows["path"])), len(self.lost)
        return (
            f"Dataset of {len(self):,} labelled places on {paths} paths, {len(self.names)} features"
            f" ({lost:,} labels lost)"
        )

    def _repr_html_(self) -> str:
        return html_table(
            repr(self), [str(name) for name in self.rows], self.rows.to_numpy(object).tolist()
        )

    @property
    def names(self) -> list[str]:
        """The names of the features, in order."""
        return [column.name for column in self.columns]

    @property
    def losses(self) -> dict[str, int]:
        """How many labels were lost, by reason."""
        counts = self.lost["reason"].value_counts()
        return {str(reason): int(count) for reason, count in sorted(counts.items())}

    @property
    def streets(self) -> NDArray[np.str_]:
        """(n,) what is held out as one path: the path, in all runs of its district."""
        return self.rows["street" if self.makings else "path"].to_numpy(str)

    @property
    def pieces(self) -> NDArray[np.str_]:
        """(n,) what is held out as one block: the block, in all runs of its district."""
        return self.rows["piece" if self.makings else "block"].to_numpy(str)

    def matrix(self) -> Float64:
        """(n, f) the features."""
        return matrix(self.rows, self.names)

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

    def averaged(self, width: float) -> "Dataset":
        """With virtual drives averaged along each drive (`averaged_along`); a dataset without them
        as it is.

        Args:
            width: of the kernel [m].
        """
        seen = self.virtual_drives
        if seen.empty:
            return self
        keys, names = ["group", "sample"], list(AVERAGED)
        found = averaged_along(seen, width, names, ("group", "route_id")).set_index(keys)[names]
        here = found.reindex(pd.MultiIndex.from_frame(self.rows[keys]))
        columns = {name: here[name].to_numpy(np.float64) for name in names}
        return replace(self, rows=self.rows.assign(**columns))

    def rows_of_one_drive(self) -> Int64:
        """(k,) rows of each path (`streets`) as the drive has it with the most labels there (equal:
        the first by name): with a repeated drive a random split would put a place on both sides.
        """
        rows = self.rows[["group"]].assign(path=self.streets)
        counts = rows.groupby(["path", "group"], as_index=False).size()
        order = counts.sort_values(["path", "size", "group"], ascending=[True, False, True])
        most = order.drop_duplicates("path").set_index("path")["group"]
        chosen = rows["path"].map(most) == rows["group"]
        return np.flatnonzero(chosen.to_numpy())

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
        lost = self.lost[self.lost["group"].isin(list(names))].reset_index(drop=True)
        return replace(self.take(which), lost=lost, data_sets=kept)

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
                leaves none), or labels of different identities (starts, true pose; of one run
                matcher and sensor too) together.
        """
        if len(self) < POINTS_MIN:
            losses = "; ".join(f"{count} {reason}" for reason, count in self.losses.items())
            raise ModelError(
                f"{len(self)} labelled points, and a model needs {POINTS_MIN}: localize a longer "
                f"drive, or more of them (lost: {losses or 'none'}); {WITHOUT_DRIVES}"
            )
        label = self.label(target)
        if label.min() == label.max():
            raise ModelError(
                f"{target} is {label[0]:g} at all {len(self)} points: nothing to learn from; "
                f"{WITHOUT_DRIVES}"
            )
        sizes = self.rows.groupby("path")["arc_length"].nunique()
        for path, size in sizes.items():
            if size < 2:
                raise ModelError(
                    f"path {path!r} has one point only: leave it out or drive more of it"
                )
        for name in ("true_pose",) if self.makings else ("true_pose", "as_sensor"):
            kinds = sorted(set(self.rows[name]))
            if len(kinds) > 1:
                raise ModelError(f"labels of different {name} ({', '.join(kinds)}): choose groups")
        may_differ = OF_LIDAR if self.makings else ()
        _one_identity(self.data_sets, may_differ)


def nearest_along(rows: pd.DataFrame, others: pd.DataFrame, reach: float) -> pd.DataFrame:
    """Rows with the columns that they lack of the nearest of other rows along the same path.

    Args:
        rows: with `path` and `arc_length` [m].
        others: likewise, no two at one place; what is farther along than `reach` [m] is not taken.
        reach: see there.

    Returns:
        The rows in their order; NaN where there is none within reach.
    """
    own = rows.sort_values("arc_length", kind="stable")
    kept = [name for name in others if name in ("path", "arc_length") or name not in rows]
    found = pd.merge_asof(
        own,
        others[kept].sort_values("arc_length", kind="stable"),
        on="arc_length",
        by="path",
        direction="nearest",
        tolerance=reach,  # type: ignore[arg-type]  # the stubs know integers only
    )
    return found.set_index(own.index).reindex(rows.index)


def matrix(places: pd.DataFrame, names: Sequence[str]) -> Float64:
    """(n, f) these columns of n places, in this order."""
    return np.ascontiguousarray(places[list(names)].to_numpy(np.float64))


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


def _one_identity(data_sets: Mapping[str, Mapping[str, Any]], may_differ: Sequence[str]) -> None:
    """Refuse labels of different making.

    Raises:
        ModelError: two groups differ; names the groups and the settings.
    """
    names = sorted(data_sets)
    for other in names[1:]:
        one, two = data_sets[names[0]], data_sets[other]
        names_of = (set(one) | set(two)) - set(may_differ)
        differ = sorted(k for k in names_of if one.get(k) != two.get(k))
        if differ:
            raise ModelError(
                f"groups {names[0]!r} and {other!r} were labelled with different "
                f"{', '.join(differ)}: train on one of them"
            )
