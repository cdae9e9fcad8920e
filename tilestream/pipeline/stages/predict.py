"""Predict: the estimated error of the sample points of a tile."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from tilestream.factors.along_route import WIDTH
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.model.covariance import COVARIANCE_COLUMNS, as_it_is, calibrated, cores
from tilestream.model.explain import without_training
from tilestream.model.physics import Physics
from tilestream.model.prediction import predict as predicted
from tilestream.model.training import ESTIMATES, PREDICTION_COLUMNS, Model
from tilestream.pipeline.engine.outputs import Stored
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.between import Between
from tilestream.pipeline.stages.samples import BYTES_PER_ROW, places_with_factors

LARGE_ERROR = 0.10
"""Without training: an estimate above this has a reason [m] (the least error of the paper's
Table I)."""
MODEL_BYTES = 300_000_000
"""Memory of the task besides its rows: the model and what reads it."""


@stage(
    "predict",
    version=9,
    memory=lambda counts: MODEL_BYTES + BYTES_PER_ROW * counts["places"],
    seconds=0.004,
    columns=(*PLACE_COLUMNS, *PREDICTION_COLUMNS, *COVARIANCE_COLUMNS),
)
def predict(
    factors: Stored,
    observed: Sequence[Stored],
    making: dict[str, Any],
    offset: float,
    prediction_error: float,
    model: Model | None = None,
    between: Between | None = None,
) -> pd.DataFrame:
    """The estimates of sample points, a row each.

    Args:
        factors: the table of factors of their tile.
        observed: the tables of observability of this tile and of those around it; none: the job
            has no virtual drive.
        making: what the factors were made with.
        offset: without a model: what a real scan adds to the error of a virtual one [m].
        prediction_error: how far off a filter's prediction is from which a registration starts,
            standard deviation in map x and in y [m].
        model: None: the virtual drive as it is.
        between: where places are interpolated, whatever was observed of them; None: nowhere.
    """
    places = places_with_factors([factors], observed, WIDTH if model is None else model.width)

    def evaluated(own: pd.DataFrame) -> pd.DataFrame:
        found = physical(own, offset) if model is None else predicted(model, own, making)
        return pd.concat([found, covariances(own, observed, prediction_error, model)], axis=1)

    if between is None:
        found = evaluated(places)
    else:
        found = between.filled(places, (factors.rows["status"] == "done").to_numpy(), evaluated)
    return pd.concat([places[[c.name for c in PLACE_COLUMNS]], found], axis=1)


@stage(
    "stations",
    version=predict.version,
    memory=predict.memory,
    seconds=predict.seconds,
    columns=predict.columns,
)
def stations(
    factors: Stored,
    observed: Sequence[Stored],
    making: dict[str, Any],
    offset: float,
    prediction_error: float,
    model: Model | None = None,
) -> pd.DataFrame:
    """The same after a round of a coarse run: right where the kernels of places are whole, which
    decides where others are evaluated.
    """
    made: pd.DataFrame = predict.function(
        factors, observed, making, offset, prediction_error, model
    )
    return made


def covariances(
    places: pd.DataFrame,
    observed: Sequence[Stored],
    prediction_error: float,
    model: Model | None,
) -> pd.DataFrame:
    """`COVARIANCE_COLUMNS` of places, on their index; NaN without a virtual drive.

    Args:
        places: with `route_id` and `sample`.
        observed: the tables of observability of these and their neighbours.
        prediction_error: see `predict`.
        model: None, or one that knows of no covariances: the virtual drive as it is.
    """
    names = [column.name for column in COVARIANCE_COLUMNS]
    if not observed:
        return pd.DataFrame(np.nan, index=places.index, columns=names)
    known = None if model is None else model.covariance
    known = known or as_it_is(WIDTH if model is None else model.width)
    seen = pd.concat([table.rows for table in observed], ignore_index=True)
    found = calibrated(cores(seen, prediction_error, known.width), known)
    keys = ["route_id", "sample"]
    found.index = pd.MultiIndex.from_frame(seen[keys])
    return found.reindex(pd.MultiIndex.from_frame(places[keys])).set_index(places.index)


def physical(places: pd.DataFrame, offset: float) -> pd.DataFrame:
    """What the virtual drive says of places, in the columns of a model's estimates.

    There is no interval, and no training place to be like: `low`, `high`, `domain_distance` and
    `in_domain` are empty. Estimates above `LARGE_ERROR` have a reason.
    """
    good = places["status"] == "done"
    values: dict[str, Any] = {
        name: Physics.as_it_is(target, offset).predict(places) for target, name in ESTIMATES.items()
    }
    blank = {c.name: np.nan for c in PREDICTION_COLUMNS if c.dtype == "float64"}
    frame = pd.DataFrame({**blank, **values}, index=places.index)
    frame.loc[~good, list(values)] = np.nan
    reason = places["reason"].astype(object)
    large = good & (frame["estimate"] > LARGE_ERROR)
    reason[large] = without_training(places[large])
    unknown = pd.array([None] * len(places), dtype="boolean")
    words: dict[str, Any] = {"in_domain": unknown, "status": places["status"], "reason": reason}
    return frame.assign(**words)[[column.name for column in PREDICTION_COLUMNS]]
