"""The answer in one call: a map and a vehicle in, the estimated error of every place out."""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tilestream.config import Settings
from tilestream.errors import StoreNotFoundError, UsageError
from tilestream.matcher import RegistrationSettings
from tilestream.model.registry import UNTRAINED
from tilestream.model.shipped import SHIPPED, is_shipped
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.jobs.run import run
from tilestream.pipeline.jobs.run_settings import ModelSettings, RunSettings
from tilestream.sensor import VLP16, Carrier
from tilestream.settings import (
    DEFAULT_MEMORY,
    PREDICTION_ERROR,
    CoarseSettings,
    LabelSettings,
    MapSettings,
    PlaceSettings,
    ReportSettings,
    VirtualSettings,
)
from tilestream.store import open_store

logger = logging.getLogger(__name__)
OUT = "tilestream-estimate"
"""The run directory of who names none."""
Named = str | os.PathLike[str]


def estimate(
    sources: Named | Iterable[Named],
    routes: Named | Iterable[Named] = (),
    *,
    out: Named = OUT,
    model: str | os.PathLike[str] | None = None,
    sensor: Carrier | str = VLP16,
    sensor_height: float = 2.0,
    range_max: float | None = None,
    blind_rear_deg: float = 0.0,
    matcher: RegistrationSettings | str | os.PathLike[str] = "autoware",
    prediction_error: float = PREDICTION_ERROR,
    spacing: float = 1.0,
    crs: str | None = None,
    project_to: str | None = None,
    threshold: float = 0.25,
    coarse: int | None = None,
    tolerance: float | None = None,
    client: Any | None = None,
    memory: int = DEFAULT_MEMORY,
    watch: Watch | None = None,
) -> Path | str:
    """Estimate the localization error along routes from a map alone; nobody has driven there.

    It is the main job (`run`) without drives: the same run directory, tables and report, which say
    at the top what the estimates are worth.

    Args:
        sources: the map: files, globs, a map directory, logs of a survey; or a tile store.
        routes: files of routes: TUM, KITTI, CSV, GeoJSON, Lanelet2 or logs; none: all lanes of the
            map; of a map without lanes the way of the logs that it is made of.
        out: the run directory, a path or a URL; a call that was stopped continues there.
        model: a model file; `shipped`: the one that comes with tilestream; `physics`: the virtual
            drive as it is. None: the one that ships, or `physics` where none does, which is logged.
        sensor: the vehicle's lidar, or lidars: a name that ships, a YAML file, or its data.
        sensor_height: height of the lidar above the road [m].
        range_max: its usable range [m]; None: the sensor's, as far as the model knows it.
        blind_rear_deg: sector to the rear that the vehicle hides [deg].
        matcher: the vehicle's scan matcher: `autoware`, `default`, its settings, or Autoware's own
            parameter file or folder.
        prediction_error: how far off the vehicle's filter predicts its pose, standard deviation in
            map x and in y [m]: covariances are of registrations that start from there.
        spacing: distance between places [m].
        crs: CRS of the map, where its files do not say.
        project_to: CRS to project routes to; None: the map's.
        threshold: estimates above this are listed as segments [m].
        coarse: evaluate about one place in so many first, others only where errors are high or
            change fast, and interpolate the rest; None: evaluate all.
        tolerance: with `coarse`: how far off an interpolated estimate may be [m]; None: 0.05.
        client: a Dask client to run on; None: this process.
        memory: what a task may use [bytes].
        watch: is told of each task that ended.

    Returns:
        The run directory; of one in an object store its URL.

    Raises:
        UsageError: settings that cannot be, or no routes and a map that has none.
        SourceError, StoreError, ModelError, PlanError, LockedError, IncompleteError, PartialError:
            as `run`.
    """
    seeing = VirtualSettings(range_max=range_max, blind_rear_deg=blind_rear_deg)
    places: dict[str, Any] = {"sensor": sensor, "sensor_height": sensor_height, "spacing": spacing}
    places |= {"project_to": project_to, "memory": memory, "prediction_error": prediction_error}
    settings = estimate_settings(
        _listed(sources),
        _listed(routes),
        out,
        model,
        PlaceSettings(**places),
        seeing,
        LabelSettings(matcher=matcher if isinstance(matcher, Settings) else str(matcher)),
        MapSettings(crs=crs),
        ReportSettings(threshold=threshold),
        coarse_settings(coarse, tolerance),
    )
    return run(settings, client, watch)


def coarse_settings(every: int | None, tolerance: float | None) -> CoarseSettings | None:
    """What is evaluated first; None: all is evaluated.

    Raises:
        UsageError: a tolerance without `every`, or values that cannot be.
    """
    if every is None and tolerance is not None:
        raise UsageError("tolerance (--tolerance) is of a coarse run: give coarse (--coarse) too")
    given: dict[str, Any] = {"every": every, "tolerance": tolerance}
    known = {name: value for name, value in given.items() if value is not None}
    return CoarseSettings(**known) if known else None


def _listed(named: Named | Iterable[Named]) -> list[str]:
    several = [named] if isinstance(named, str | os.PathLike) else named
    return [os.fspath(one) for one in several]


def estimate_settings(
    sources: Sequence[str],
    routes: Sequence[str],
    out: Named,
    model: Named | None,
    places: PlaceSettings,
    seeing: VirtualSettings,
    label: LabelSettings,
    map_: MapSettings,
    report: ReportSettings,
    coarse: CoarseSettings | None = None,
) -> RunSettings:
    """The job of an estimate: what is not given keeps the defaults of the main job.

    Args:
        sources: the map; a tile store alone, or what one is made of.
        routes: files of routes; none: those of the map.
        out: the run directory.
        model: as of `estimate`.
        places: from where is looked, and the vehicle.
        seeing: how it sees.
        label: its matcher.
        map_: how the map is made, but for `sources` and `store`.
        report: what is pointed out.
        coarse: what is evaluated first; None: all.

    Raises:
        UsageError: a store among other sources, or values that cannot be.
        StoreError: a store that cannot be opened.
    """
    of_model = _model_of(model)
    values: Mapping[str, Any] = {name: getattr(places, name) for name in places.model_fields_set}
    return RunSettings(
        **values,
        out=os.fspath(out),
        map=map_.model_copy(update=_map_of(sources)),
        routes=tuple(routes),
        observe=seeing,
        label=label,
        model=of_model,
        report=report,
        coarse=coarse,
    )


def _map_of(sources: Sequence[str]) -> dict[str, Any]:
    """`store` or `sources` of a map."""
    stores = [name for name in sources if _is_store(name)]
    if not stores:
        return {"sources": MapSettings(sources=tuple(sources)).sources}
    if len(sources) > 1:
        raise UsageError(f"{stores[0]} is a tile store, which is a whole map: give it alone")
    return {"store": MapSettings(store=stores[0]).store}


def _is_store(name: str) -> bool:
    """Whether a tile store is there, which may be a damaged one or of another version."""
    try:
        open_store(name)
    except (StoreNotFoundError, UsageError):  # a file, a glob, a folder of something else
        return False
    return True


def _model_of(model: Named | None) -> ModelSettings:
    """The model that was asked for; where none was, the one that ships, as far as one does."""
    if model is None and not is_shipped():
        logger.warning(
            "no model comes with this installation of tilestream: the estimates are the virtual "
            "drive as it is (%s)",
            UNTRAINED,
        )
        model = UNTRAINED
    if model == UNTRAINED:
        return ModelSettings(recipe=UNTRAINED)
    return ModelSettings(use=SHIPPED if model is None else os.fspath(model))
