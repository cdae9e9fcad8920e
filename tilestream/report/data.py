"""What a report is made of: the tables that a run has made, checked once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.errors import UsageError
from tilestream.factors.stations import INTERPOLATED
from tilestream.formats.routes import Lane
from tilestream.from_above import FromAbove
from tilestream.model.registry import DEFAULT
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.notes import Notes
from tilestream.records import Float64
from tilestream.report.colours import FIXED, Scale, scale_of
from tilestream.report.drives import DriveMeasured
from tilestream.report.worth import Worth

PLACE_COLUMNS = ("route_id", "sample", "arc_length", "heading", "x", "y", "z")
"""Where a sample point is: its route, its number there, and the map frame [m, rad]."""
LABEL_COLUMNS = ("group", "path", "block", "arc_length", "error_mean", "held_out", "low", "high")
"""What a labelled place must have."""
BESIDE = 60.0
"""How far beside the places the map is drawn behind them [m]."""
AROUND = 40.0
"""How far round a place its picture reaches [m]."""
Ends = Callable[[str, int], pd.DataFrame]
"""Where the starts of a group's sample point began and ended, as `starts_of` tells it."""
Around = Callable[[float, float, float], Float64]
"""(n, 3) map points [m] within about `AROUND` of a place in the map frame."""
MapPoints = Callable[[int], Float64]
"""(n, 3) a fair sample [m] of at most so many points of the map beside the places."""


@dataclass(frozen=True, eq=False)
class LaneletMap:
    """A Lanelet2 map whose lanes are routes of a run."""

    file: str
    """Where it is, on a disk."""
    lanes: Callable[[], Sequence[tuple[str | None, Lane]]]
    """Its lanes, each with the name that its route has in the run; None: it is none of its routes.
    """


Seen = Callable[[Float64, float], Float64]
"""(k, 3) what the lidar sees [m, map frame] from a place (3,) [m] with a heading [rad]."""


def _none() -> pd.DataFrame:
    return pd.DataFrame()


@dataclass(frozen=True, eq=False)
class Findings:
    """All that a report shows of a run. Of an empty table it says that it is empty, and why.

    Raises:
        UsageError: no places, a column that a table lacks, a place that is there twice.
    """

    title: str
    """Headline of the page."""
    places: pd.DataFrame
    """A row per sample point: `PLACE_COLUMNS`, `PREDICTION_COLUMNS` (`in_domain` may be null) and
    the factors."""
    labels: pd.DataFrame = field(default_factory=_none)
    """A row per drive and labelled place: `Dataset.rows`, and `held_out` [m]: the estimate by a
    model that has not seen the place's path, and `low` and `high` [m], the ends of its interval;
    NaN where there is none. A row that repeats another in every column counts once."""
    protocols: pd.DataFrame = field(default_factory=_none)
    """`evaluation.figures_by_protocol` of the mean error, of every model."""
    parts: pd.DataFrame = field(default_factory=_none)
    """Of the parts of the error, with the column `target`."""
    table_iv: pd.DataFrame = field(default_factory=_none)
    """The same of each factor set, with the column `factors`: its name."""
    importances: pd.DataFrame = field(default_factory=_none)
    """`evaluation.importances_of`, with the column `model`: `used` of the model that made the
    estimates, `paper` of the paper's on its own factors."""
    criterion_importances: pd.DataFrame = field(default_factory=_none)
    """`evaluation.criterion_importances`, likewise; `paper` on all factors."""
    coverage: pd.DataFrame = field(default_factory=_none)
    """`intervals.coverage`."""
    differences: pd.DataFrame = field(default_factory=_none)
    """`evaluation.differences_by_protocol` of the model in use and physics, with the column
    `target`."""
    ceilings: dict[str, dict[str, float]] = field(default_factory=dict)
    """`repeats.repeated` by target; empty without a repeated drive."""
    model: str = DEFAULT
    """Which of the models of `protocols` has made the estimates; one that is not among them was
    trained elsewhere."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Run facts by name; a dictionary among them becomes a table of its own. `attributions` is a
    list of sentences."""
    notes: Notes = field(default_factory=dict)
    """What was noticed of the inputs, by source."""
    drives: tuple[DriveMeasured, ...] = ()
    """How much of each drive was measured."""
    lost_labels: Sequence[Mapping[str, Any]] = ()
    """The labels that no model can learn from: `reason`, `count`, `detail`, `kept_by`."""
    worth: Worth | None = None
    """What the estimates are worth; None: nobody has said it."""
    own_range: bool = False
    """Colours of the estimates' own range instead of those that all reports have."""
    above: FromAbove | None = None
    """The map behind the places, from above; None: they are drawn on nothing."""
    cell_size: float | None = None
    """Edge of the cells that labels were measured with [m]; None: not known."""
    crs: str | None = None
    """CRS of x and y, anything that pyproj reads; None: a local frame."""
    ends: Ends | None = None
    """The starts of a labelled place, for the pictures of the worst measured ones; None: no
    pictures."""
    around: Around | None = None
    """The map round a place, for the pictures of the worst ones; None: no pictures."""
    map_points: MapPoints | None = None
    """The map in 3D, for the scene of Foxglove; None: the scene is without it."""

    lanelet_maps: tuple[LaneletMap, ...] = ()
    """The Lanelet2 maps whose lanes are among the routes, for copies with the estimates."""

    seen: Seen | None = None
    """What the virtual lidar sees at a place, for the same pictures; None: it did not look."""

    @property
    def scale(self) -> Scale:
        """From an error to its colour on maps."""
        return scale_of(estimates(self.places)) if self.own_range else FIXED

    @property
    def digits(self) -> int | None:
        """With how many significant digits estimates are told; None: their worth is not known."""
        return None if self.worth is None else self.worth.digits

    @property
    def worth_told(self) -> str:
        """What the estimates are worth as one line; empty: nobody has said it."""
        return "" if self.worth is None else " ".join(self.worth.told)

    def __post_init__(self) -> None:
        predicted = tuple(column.name for column in PREDICTION_COLUMNS)
        _require(self.places, (*PLACE_COLUMNS, *predicted), "places")
        if self.places.empty:
            raise UsageError("a report needs places: give at least one sample point")
        twice = self.places.duplicated(["route_id", "sample"])
        if twice.any():
            row = self.places[twice].iloc[0]
            raise UsageError(f"places: route {row['route_id']!r} has sample {row['sample']} twice")
        if len(self.labels):
            _require(self.labels, LABEL_COLUMNS, "labels")
            labels = self.labels.drop_duplicates()
            object.__setattr__(self, "labels", labels)
            at = ["group", "path", "arc_length", *(["sample"] if "sample" in labels else [])]
            again = labels.duplicated(at)
            if again.any():
                row = labels[again].iloc[0]
                raise UsageError(
                    f"labels: group {row['group']!r} has path {row['path']!r} at "
                    f"{row['arc_length']:g} m twice"
                )
        for name in ("places", "labels"):
            object.__setattr__(self, name, _in_order(getattr(self, name)))


def _require(table: pd.DataFrame, names: tuple[str, ...], what: str) -> None:
    absent = [name for name in names if name not in table]
    if absent:
        raise UsageError(f"{what}: no column {', '.join(absent)}")


def _in_order(table: pd.DataFrame) -> pd.DataFrame:
    """Rows along each route or path, so that a report does not depend on the order of tiles."""
    keys = [k for k in ("route_id", "sample", "path", "arc_length", "group") if k in table]
    if not keys or table.empty:
        return table.reset_index(drop=True)
    keys = ["route_id", "sample"] if "route_id" in table else ["path", "arc_length", "group"]
    # a copy lies in one piece, whatever columns were added one by one
    return table.sort_values(keys, kind="stable").reset_index(drop=True).copy()


def estimates(places: pd.DataFrame) -> Float64:
    """(n,) the estimates [m]; NaN where there is none."""
    return places["estimate"].to_numpy(np.float64)


def interpolated(places: pd.DataFrame) -> NDArray[np.bool_]:
    """(n,) whether an estimate is that of places before and behind it: it was not evaluated."""
    found: NDArray[np.bool_] = (places["status"] == INTERPOLATED).to_numpy(bool)
    return found


def like_training(places: pd.DataFrame) -> NDArray[np.str_]:
    """(n,) `yes`, `no`, or `not known`: no estimate, one that is interpolated, or nothing was
    trained.
    """
    like = places["in_domain"].astype("boolean")
    known = like.notna().to_numpy() & np.isfinite(estimates(places))
    return np.where(known, np.where(like.fillna(False).to_numpy(bool), "yes", "no"), "not known")
