"""What a job makes its factors with, and whether the model in use fits that."""

from typing import Any

from tilestream.errors import ModelError, SourceNotFoundError
from tilestream.factors.own import OWN, own_factors
from tilestream.files import Files
from tilestream.model.applicability import check_making
from tilestream.model.dataset import made_with
from tilestream.model.file import load_model
from tilestream.model.registry import UNTRAINED
from tilestream.model.shipped import file_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.samples import COLUMNS
from tilestream.store import open_store

LEADS_ON = (
    f"; without a model the virtual drive makes the estimates: --model {UNTRAINED}, or model: "
    f"{{recipe: {UNTRAINED}}}"
)
"""What there is besides a model that does not fit."""


def making_of(settings: RunSettings) -> dict[str, Any]:
    """What the factors are made with, as a model remembers it."""
    making = made_with(COLUMNS, settings.looking_sensor, settings.cell_size)
    making |= {"sensor": settings.vehicle.model_dump(mode="json")}
    making |= {"sensor_height": settings.sensor_height, "map_leaf": _map_leaf(settings)}
    own = own_factors(settings.factors)
    if own:
        making |= {OWN: {c.name: one.hash for one in own for c in one.columns}}
    if settings.observe is None:
        return making
    return making | {
        "seeing": settings.observe.model_dump(mode="json"),
        "matcher": settings.label.registration.model_dump(mode="json"),
    }


def _map_leaf(settings: RunSettings) -> float:
    """How the map is thinned that the job makes, or was thinned that is there [m]."""
    if settings.map.sources or settings.simulate is not None:
        return settings.map.map_leaf
    return open_store(settings.store_url).settings.map_leaf


def as_far_as_known(settings: RunSettings) -> RunSettings:
    """Where no usable range was asked for, at most the farthest that the model in use was trained
    over: what lies beyond tells little, and all places would be unlike the training places.
    """
    use, seeing = settings.model.use, settings.observe
    if seeing is None or seeing.range_max is not None or use is None:
        return settings
    if not Files.at(file_of(use)).there():
        return settings
    known = load_model(file_of(use)).card.get("inputs", {}).get("range_m")
    if known is None or not known[1] < settings.vehicle.range_max:
        return settings
    reach = {"observe": seeing.model_copy(update={"range_max": float(known[1])})}
    return settings.model_copy(update=reach)


def check_model(settings: RunSettings) -> None:
    """Refuse a model in use that cannot estimate these places, and files of factors that are none,
    before anything is made or measured.

    Raises:
        UsageError: a file of factors that cannot be; as `own_factors`.
        SourceNotFoundError: there is no such file.
        ModelError: the file is no model, or the model was trained for other factors; says which.
        StoreNotFoundError: the map is to be there and is not.
    """
    own_factors(settings.factors)
    if settings.model.use is None:
        return
    file = file_of(settings.model.use)
    if not Files.at(file).there():
        raise SourceNotFoundError(f"{file}: no such model file; see model.use (--model){LEADS_ON}")
    try:
        check_making(load_model(file), making_of(settings))
    except ModelError as error:
        told = str(error).removeprefix(f"{file}: ")
        raise ModelError(f"{settings.model.use}: {told}{LEADS_ON}") from None
