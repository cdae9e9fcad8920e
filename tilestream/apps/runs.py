"""A run directory in Python: its places as one table, and a picture of them.

```
report/places.parquet, or factors, observability, predictions --+
errors (labels): the nearest to each place ---------------------+--> a row per place
```
"""

import io
import json
import os
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd

from tilestream.apps.run_plot import ESTIMATED, plot_places
from tilestream.bounded_yaml import parse_yaml
from tilestream.counts import count_of
from tilestream.errors import (
    SourceNotFoundError,
    StoreNotFoundError,
    UsageError,
    foreign_errors,
)
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.files import Files, place_of
from tilestream.model.join import ON_PATH, nearest_pass
from tilestream.model.training import ESTIMATES, MAIN
from tilestream.notebook import html_of
from tilestream.pipeline.jobs.run_book import ENDED, content_as_written
from tilestream.pipeline.jobs.run_folder import map_of, rows_of, table_paths
from tilestream.pipeline.jobs.run_inputs import seen_otherwise
from tilestream.pipeline.jobs.run_names import CONFIG
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.run_state import record_of
from tilestream.report.data import interpolated
from tilestream.store import TileStore
from tilestream.tables import read_tables

REPORT = "report/report.json"
"""The figures of the report of a run that has ended, in its directory."""
PLACES = "report/places.parquet"
"""The places of a run that has ended, in its directory."""
PLACE = [column.name for column in PLACE_COLUMNS]
MEASURED = {
    target: "measured" if target == MAIN else f"measured_{name}"
    for target, name in ESTIMATES.items()
}
"""Name of each label beside the estimate of the same."""
NEEDED = (
    ": give the run directory of `tilestream estimate` or `tilestream run`; tables of `localize` "
    "or `factors` alone have no estimates"
)
"""What has no estimates is told with this."""
OF_LABEL = ["drive", *MEASURED.values(), "measured_distance"]


def read_run(place: str | os.PathLike[str]) -> pd.DataFrame:
    """The places of a run with their estimates, measured errors and factors, a row each.

    The columns are: the place (`route_id`, `sample`, `arc_length`, `heading`, `x`, `y`, `z`,
    `above_ground`); what was measured there (`measured` [m] is the mean error of the paper;
    `measured_p_fail`, `measured_floor`, `measured_tail`, `measured_along`, `measured_across`,
    `measured_up`; on which `drive`, and `measured_distance` [m] from the place); the estimates
    (`estimate`, `low`, `high`, `p_fail`, `floor`, …, `in_domain`, `status`, `reason`); the factors.
    `ts.explain("floor")` says what a column of the tables means; `measured_floor` is what that
    estimates. What a job did not make has no column or is NaN.

    A measured scan counts at the nearest place within 5 m, and of several the nearest; a place has
    one label, of one drive; drives that were seen with another lidar than the vehicle's have none
    here. One that is near no place has a row of its own, with the drive as
    `route_id`. All labels with the factors of exactly their places are in `ts.dataset`.

    Args:
        place: a run directory of `run`, `localize` or `factors`, a path or an fsspec URL.

    Returns:
        The table. A GeoDataFrame in the map's CRS where geopandas is installed (without a CRS where
        the map has none, or has moved), else a DataFrame.

    Raises:
        SourceNotFoundError: no tables there.
        IncompleteError: a table that must be there is not: the job has not ended.
        DamagedError: a table is not what was written.
        UsageError: `config.yaml` there is no job of this version.

    Examples:
        >>> table = ts.read_run("run")
        >>> table[["sample", "measured", "estimate"]].iloc[:2].to_numpy().tolist()
        [[0.0, nan, 0.1], [1.0, 0.3, 0.2]]
    """
    labels = labels_of(place)
    done = labels[labels["status"] == "done"].reset_index(drop=True) if len(labels) else labels
    table = with_labels(places_of(place), done)
    if table.empty and not len(table.columns):
        raise SourceNotFoundError(f"{place}: no tables of a run; `ts.run` writes some")
    first = [name for name in (*PLACE, *OF_LABEL, *ESTIMATED) if name in table]
    table = table[[*first, *(name for name in table if name not in first)]]
    if find_spec("geopandas") is None:
        return table
    geopandas = import_module("geopandas")
    points = geopandas.points_from_xy(table["x"], table["y"], table["z"])
    found: pd.DataFrame = geopandas.GeoDataFrame(table, geometry=points, crs=crs_of_map(place))
    return found


def crs_of_map(place: str | os.PathLike[str]) -> str | None:
    """The CRS of the map of a run; None: it names none, or is gone."""
    try:
        return map_of(place).settings.crs
    except StoreNotFoundError:
        return None


def worth_of(place: str | os.PathLike[str]) -> list[str]:
    """What the estimates of a run are worth, as its report says it; nothing: there is none yet.

    Raises:
        DamagedError: the report is not what was written.
    """
    folder = Files.at(place)
    report, record = folder.under(REPORT), record_of(folder)
    if not report.there() or record.get("state") not in ENDED:
        return []
    worth = json.loads(content_as_written(report, record, REPORT))["worth"]
    return list(worth["told"]) if worth else []


def places_of(place: str | os.PathLike[str]) -> pd.DataFrame:
    """Every sample point of the routes; of a run that has ended as its report has it, else as far
    as its tables go, each virtual drive of its own place alone.

    Raises:
        DamagedError: the record, a table, or what the report has, is not what was written.
    """
    folder = Files.at(place)
    report, record = folder.under(PLACES), record_of(folder)
    if report.there() and record.get("state") in ENDED:
        shown = pd.read_parquet(io.BytesIO(content_as_written(report, record, PLACES)))
        return shown.drop(columns=["geometry", *OF_LABEL], errors="ignore")
    tables = [rows_of(place, name) for name in ("factors", "observability", "predictions")]
    found = pd.DataFrame()
    for table in tables:
        if table is None:
            continue
        if found.empty:
            found = table
            continue
        own = [name for name in table if name not in found or name in ("status", "reason")]
        found = found.drop(columns=["status", "reason"])
        own_rows = table[["route_id", "sample", *own]]
        found = found.merge(own_rows, on=["route_id", "sample"], how="left")
    if "status" in found:
        lost = found["status"].isna()
        found.loc[lost, ["status", "reason"]] = "failed", "its task failed, or has not run"
    return found


def labels_of(place: str | os.PathLike[str]) -> pd.DataFrame:
    """The labels of a run, with the drive of each; of a job none that was seen with another lidar
    than that of its estimates, or that does not fit the map.
    """
    unfit = record_of(Files.at(place)).get("unfit", {})
    tables, others = [], {*_otherwise(place), *unfit}
    for path in table_paths(place, "errors"):
        group = path.rsplit("/", 2)[1]
        if group in others:
            continue
        rows = read_tables([path])
        tables.append(rows.assign(drive="" if group == "errors" else group))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def _otherwise(place: str | os.PathLike[str]) -> list[str]:
    """The drives of a job that are observed with another lidar than the vehicle's."""
    settings = settings_of(place)
    return [] if settings is None else seen_otherwise(settings, settings.drives)


def settings_of(place: str | os.PathLike[str]) -> RunSettings | None:
    """The settings of the job that a run directory is of; None: of tables alone there are none.

    Raises:
        UsageError: they are of no job of this version.
    """
    config = Files.at(place).under(CONFIG)
    if not config.there():
        return None
    with foreign_errors(UsageError, f"{config.address}: no job", "give a run directory of ours"):
        return RunSettings(**parse_yaml(config.read().decode("utf-8")))


def with_labels(places: pd.DataFrame, labels: pd.DataFrame) -> pd.DataFrame:
    """Places with what was measured at each: the nearest label within `ON_PATH`, of the way
    there and not of that back (`nearest_pass`).

    Args:
        places: with `x`, `y`, `z` [m] and `heading` [rad]; may be empty.
        labels: likewise, with `drive` and the labels (`MEASURED`), all finite; may be empty.

    Returns:
        The places in their order with the columns `OF_LABEL`, then the labels that are near none.
    """
    if not len(labels):
        return places
    at = labels[["x", "y", "z"]].to_numpy(np.float64)
    told = labels.rename(columns=MEASURED)
    told = told[[name for name in OF_LABEL if name in told]]
    known = np.zeros(0, np.int64)
    distance, nearest = np.full(len(at), np.inf), np.zeros(len(at), np.int64)
    if len(places):
        where = places[["x", "y", "z"]].to_numpy(np.float64)
        known = np.flatnonzero(np.isfinite(where).all(axis=1))
    if known.size:
        along, heading = (t["heading"].to_numpy(np.float64) for t in (places, labels))
        row, distance = nearest_pass(where[known], along[known], at, heading)
        nearest = known[row]
    told = told.assign(measured_distance=np.where(distance <= ON_PATH, distance, np.nan))
    here = told[distance <= ON_PATH].set_index(nearest[distance <= ON_PATH])
    here = here.sort_values("measured_distance", kind="stable")
    here = here[~here.index.duplicated()]
    apart = labels[distance > ON_PATH]
    rest = told[distance > ON_PATH].assign(
        route_id=apart["drive"],
        **{name: apart[name] for name in PLACE if name in apart and name != "route_id"},
        **{name: apart[name] for name in ("status", "reason") if not len(places)},
    )
    beside = places.join(here.reindex(range(len(places)))) if len(places) else places
    parts = [part for part in (beside, rest) if len(part)]
    return pd.concat(parts, ignore_index=True)


@dataclass(frozen=True, eq=False)
class Run:
    """A run directory: its table, its map, a picture."""

    place: str
    """The directory, or its URL."""

    @cached_property
    def table(self) -> pd.DataFrame:
        """Its places (`read_run`)."""
        return read_run(self.place)

    @cached_property
    def store(self) -> TileStore:
        """Its map; errors as `ts.open_store`."""
        return map_of(self.place)

    @cached_property
    def report(self) -> dict[str, Any]:
        """The figures of its report; empty where it has none."""
        file = Files.at(self.place).under("report/report.json")
        found: dict[str, Any] = json.loads(file.read()) if file.there() else {}
        return found

    def plot(self, column: str | None = None, ax: Any | None = None) -> Any:
        """Its streets from above, coloured by error: large where measured, small where estimated,
        a dot where that is interpolated, grey crosses where neither is known; the axes.

        Args:
            column: a column of the table to colour by instead, e.g. a factor.
            ax: matplotlib's axes to draw on; None: those of a new figure.

        Raises:
            UsageError: the table has no such column, or it is no number.
        """
        table = self.table
        if column is not None and (column not in table or table[column].dtype.kind not in "iufb"):
            raise UsageError(f"{self.place}: {column!r} is no column of numbers: see `.table`")
        return plot_places(table, column, ax)

    def _repr_html_(self) -> str:
        table = self.table
        facts: dict[str, object] = {
            "places": f"{len(table):,}",
            "routes": ", ".join(dict.fromkeys(table["route_id"].astype(str))),
        }
        for name, told in (("estimate", "estimated"), ("measured", "measured")):
            if name in table:
                known = table[name].dropna()
                spans = f", {known.min():.3f} to {known.max():.3f} m" if len(known) else ""
                facts[told] = f"{count_of(len(known), 'place')}{spans}"
        if "status" in table and (between := int(interpolated(table).sum())):
            facts["interpolated"] = f"{between:,} of them: not evaluated"
        if self.report:
            facts["report"] = f"{self.place}/report/index.html"
        return html_of(f"Run {self.place}", facts)


def open_run(place: str | os.PathLike[str]) -> Run:
    """A run directory of `run`, `localize` or `factors`: `.table`, `.plot()`, `.store`, `.report`.

    Args:
        place: a path or an fsspec URL.

    Raises:
        SourceNotFoundError: nothing there. What is read later raises as `read_run`.

    Examples:
        >>> run = ts.open_run("run")
        >>> axes = run.plot()  # the street, coloured by error
        >>> int(run.table["measured"].notna().sum())
        2
    """
    if not Files.at(place).there():
        raise SourceNotFoundError(f"{place}: no such run directory")
    return Run(place_of(place))
