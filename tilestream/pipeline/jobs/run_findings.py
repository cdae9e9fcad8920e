"""What the main job found: the tables of a run directory, gathered for its report."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from tilestream.factors.along_route import AVERAGED
from tilestream.factors.scan_at import scan_at
from tilestream.factors.stations import INTERPOLATED
from tilestream.from_above import FromAbove, seen_from_above
from tilestream.grid import MM_PER_M, Box, TileKey
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.dataset import TARGETS, Dataset, nearest_along
from tilestream.model.evaluation import (
    factor_sets,
)
from tilestream.model.file import load_model
from tilestream.model.intervals import with_intervals
from tilestream.model.physics import Physics
from tilestream.model.registry import UNTRAINED
from tilestream.model.shipped import SHIPPED, file_of
from tilestream.model.training import MAIN, PREDICTION_COLUMNS
from tilestream.pipeline.engine.plan import paths_of
from tilestream.pipeline.jobs.estimator import Estimator
from tilestream.pipeline.jobs.run_done import Done, without
from tilestream.pipeline.jobs.run_evaluation import ceilings, evaluation_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.run_worth import worth_of
from tilestream.pipeline.stages.samples import places_with_factors
from tilestream.records import Float64
from tilestream.report.data import AROUND, BESIDE, Findings, Seen
from tilestream.report.measured import with_measured
from tilestream.report.worth import Worth
from tilestream.store import POINTS, TileStore
from tilestream.tables import read_tables
from tilestream.thinned import thinned

PLACE = ["route_id", "sample"]
MOST_PIXELS = 1_200_000
"""Of the map behind the places."""
ROUNDING = 1e-6
"""How far a label may be beyond half a spacing of the place that has it [m]."""
_NO_POINTS = pd.DataFrame({name: [] for name in ("row", "estimate", "low", "high")})
"""Where nothing could be held out."""


def places_of(done: Done) -> pd.DataFrame:
    """Every sample point with its factors and its estimate, or why it has none."""
    factors, observed = (
        [task.writes.read() for task in done.outputs(stage)] for stage in ("factors", "observe")
    )
    places = places_with_factors(factors, observed, done.width)
    places = places.drop(columns=["status", "reason"])
    tables = paths_of(done.outputs("predict"))
    columns = (*PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)
    names = [column.name for column in columns]
    if tables:
        found = read_tables(tables)[[*PLACE, *names]]
    else:
        found = pd.DataFrame(columns=[*PLACE, *names])
    joined = places.merge(found, on=PLACE, how="left", validate="one_to_one")
    lost = joined["status"].isna()
    joined["in_domain"] = joined["in_domain"].astype("boolean")
    joined.loc[lost, "status"] = "failed"
    joined.loc[lost, "reason"] = "no estimate: its task failed, see run.json"
    dtypes = {c.name: c.dtype for c in columns if c.dtype == "float64"}
    between = joined["status"] == INTERPOLATED  # their kernels are not whole
    joined.loc[between, [name for name in AVERAGED if name in joined]] = np.nan
    return joined.astype(dtypes)


def mapped_told(mapped: Sequence[str]) -> str:
    """A warning of drives of which scans are in the map; empty: there are none."""
    if not mapped:
        return ""
    return (
        f"The map was made of scans that drives were measured with ({', '.join(mapped)}): these "
        "errors are too small, and so is what is learnt of them or checked by them."
    )


def labels_of(
    dataset: Dataset | None,
    places: pd.DataFrame,
    points: pd.DataFrame | None,
    reach: float,
    own: Collection[str] = (),
    offset: float | None = None,
) -> pd.DataFrame:
    """The measured places, with what a model said of them that had not seen them.

    Args:
        dataset: what was measured.
        places: every sample point.
        points: held-out points of the model that leaves paths out, with intervals; None: the model
            in use was trained elsewhere, so that its estimates are held out as they are. Their
            `row` counts the labels that are not `own`.
        reach: how far along the path of a label that may have been said [m].
        own: groups of labels that were seen with another lidar than the vehicle's, for which the
            estimates of `places` are. They have none by a model, which is trained for the
            vehicle's; without one that of their own virtual drive.
        offset: without a model: what a real scan adds to the error of a virtual one [m].
    """
    if dataset is None:
        return pd.DataFrame()
    names = ["held_out", "low", "high"]
    if points is not None:
        learnt = (~dataset.rows["group"].isin(list(own))).to_numpy()
        rows = np.where(learnt, np.cumsum(learnt) - 1, -1)
        said = points.set_index("row")[["estimate", "low", "high"]]
        here = said.reindex(rows).to_numpy(np.float64)
        return dataset.rows.assign(**dict(zip(names, here.T, strict=True)))
    said = places.rename(columns={"route_id": "path", "estimate": "held_out"})
    found = nearest_along(dataset.rows, said[["path", "arc_length", *names]], reach)
    others = found["group"].isin(list(own))
    found.loc[others, names] = np.nan
    if offset is not None:
        physics = Physics.as_it_is(MAIN, offset)
        found.loc[others, "held_out"] = physics.predict(found[others])
    return found


def findings_of(
    done: Done,
    store: TileStore,
    dataset: Dataset | None,
    facts: Mapping[str, Any],
    settings: RunSettings,
    estimator: Estimator,
    otherwise: Collection[str],
    mapped: Sequence[str] = (),
) -> tuple[Findings, dict[str, Any]]:
    """All that the report tells, and the figures of the evaluation for machines.

    `otherwise` are the groups of labels that were seen with another lidar than the vehicle's,
    `mapped` those of which scans are in the map.
    Held-out estimates are those of the model's own recipe, and there are none where no path could
    be left out; of a model that was not trained on these labels all estimates are held out as they
    are.
    """
    model = settings.model
    places, found = places_of(done), done.evaluations()
    sets = [] if dataset is None else list(factor_sets(dataset.columns))
    tables = evaluation_of(found, sets, model.recipe)
    held = found.get((MAIN, model.recipe, ""), {}).get("path")
    points = with_intervals(held) if isinstance(held, pd.DataFrame) else _NO_POINTS
    weights = paths_of(done.outputs("importance"))
    weighed = read_tables(weights) if weights else pd.DataFrame({"factor": []})
    ceiling_of = ceilings(without(dataset, otherwise), TARGETS)
    labels = labels_of(
        None if dataset is None else dataset.averaged(done.width),
        places,
        points if estimator.trained else None,
        settings.spacing,
        otherwise,
        (model.offset or 0.0) if estimator.untrained else None,
    )
    told = (estimator.few, mapped_told(mapped), str(facts.get("coarse", {}).get("told", "")))
    warnings = [warning for warning in told if warning]
    worth = _worth(done, settings, estimator, (places, labels, tables["protocols"]), warnings)
    own = labels if labels.empty else labels[~labels["group"].isin(list(otherwise))]
    places = with_measured(places, own, 0.5 * settings.spacing + ROUNDING)
    gathered = Findings(
        title=settings.report.title or settings.folder.name,
        own_range=settings.report.own_range,
        places=places,
        labels=labels,
        protocols=tables["protocols"],
        table_iv=tables["table_iv"],
        importances=weighed[weighed["factor"] != ""].reset_index(drop=True),
        criterion_importances=weighed[weighed["factor"] == ""].reset_index(drop=True),
        coverage=tables["coverage"],
        differences=tables["differences"],
        parts=tables["parts"],
        ceilings=ceiling_of,
        model="" if estimator.use else UNTRAINED if estimator.untrained else model.recipe,
        facts=dict(facts),
        crs=store.settings.crs,
        worth=worth,
        around=lambda x, y, _: points_around(store, x, y, AROUND),
        seen=_seen(done, store),
        above=_above(done, store, places),
        map_points=lambda most: points_beside(done, store, most),
    )
    evaluation = {name: table.to_dict("records") for name, table in tables.items()}
    return gathered, evaluation | {"ceilings": ceiling_of, "worth": worth.plain()}


def _above(done: Done, store: TileStore, places: pd.DataFrame) -> FromAbove | None:
    """The map behind the places; None: of none of them is the position known."""
    at = places[["x", "y"]].dropna().to_numpy(np.float64)
    tiles = _tiles_beside(done)
    if not len(at) or not tiles:
        return None
    return seen_from_above(store, tiles, Box.around(at, BESIDE), MOST_PIXELS)


def _seen(done: Done, store: TileStore) -> Seen | None:
    """What the virtual lidar sees at a place; None: it has looked from none."""
    looked = done.outputs("observe")
    if not looked:
        return None
    by = looked[0].takes["observing"]
    return lambda at, heading: scan_at(store, at, heading, by.sensor, by.seeing, AROUND)


def _tiles_beside(done: Done) -> list[TileKey]:
    """The tiles within about `BESIDE` of the places."""
    return [task.tile for task in done.outputs("above") if task.tile is not None]


def points_beside(done: Done, store: TileStore, most: int) -> Float64:
    """A fair sample of at most so many points of the tiles beside the places, (n, 3) [m]."""
    marks = store.marks(POINTS, _tiles_beside(done))
    counts = {key: mark.facts["points"] for key, mark in marks.items() if mark.status == "done"}
    return thinned(store, counts, most)


def _worth(
    done: Done,
    settings: RunSettings,
    estimator: Estimator,
    tables: tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame],
    warnings: Sequence[str],
) -> Worth:
    """What the estimates are worth, from places, labels, the figures by protocol, and what warns of
    them.
    """
    places, labels, protocols = tables
    model, own = None, settings.model.recipe
    if estimator.use is not None:
        model = load_model(file_of(estimator.use))
        shipped = estimator.use == SHIPPED
        words = "the model that ships with tilestream" if shipped else f"the model {estimator.use}"
    elif estimator.untrained:
        words = "the virtual drive as it is, without a model"
    else:
        trained = done.outputs("train")
        model = trained[0].writes.read() if trained else None
        words = f"a model trained here ({own})" if trained else f"none: {own} could not be trained"
    of_blocks = [
        {str(name): value for name, value in row.items()}
        for row in protocols.to_dict("records")
        if (row["protocol"], row["model"]) == ("blocks", own) and estimator.trained
    ]
    return worth_of(
        places,
        labels,
        model=words,
        card={} if model is None else model.card,
        facts={} if model is None else model.facts,
        blocks=of_blocks[0] if of_blocks else None,
        simulated=settings.simulate is not None,
        shipped=estimator.use == SHIPPED,
        warnings=warnings,
    )


def points_around(store: TileStore, x: float, y: float, reach: float) -> Float64:
    """The map points within a square of 2 `reach` around a place, (n, 3) [m]."""
    points = store.points_in(Box.around(np.array([[x, y]]), reach)) / MM_PER_M
    near = (np.abs(points[:, :2] - (x, y)) <= reach).all(axis=1)
    kept: Float64 = points[near]
    return kept
