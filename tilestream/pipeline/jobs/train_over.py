"""One model over several runs: other lidars, matchers, seeds, districts."""

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.files import Files, place_of
from tilestream.model.card import CHECKED
from tilestream.model.checked import checked_of
from tilestream.model.dataset import Dataset
from tilestream.model.file import save_model
from tilestream.model.over_runs import DISTRICT, Run, over_runs
from tilestream.model.registry import DEFAULT
from tilestream.model.training import Model, train
from tilestream.pipeline.jobs.run_inputs import observing_drive
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_names import CONFIG, DATASET
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.pipeline.stages.samples import DatasetFile
from tilestream.simulation.settings import load_preset


def train_over(
    runs: Mapping[str, str | os.PathLike[str] | Dataset],
    *,
    recipe: str = DEFAULT,
    seed: int = 0,
    districts: Mapping[str, str] | None = None,
    judge: bool = False,
    out: str | os.PathLike[str] | None = None,
) -> Model:
    """Train one model over several runs, each with its own lidar, matcher, seed or district.

    Args:
        runs: by name, run directories of the main job on this disk, or what `run.dataset_of` gives
            of them, which does not say more than what its factors were made with.
        recipe: a regressor on top of the virtual drive, which knows the lidar.
        seed: of the random numbers; the same seed and runs give the same model, to the bit.
        districts: where a run was driven, by its name. Streets of one district are the same where
            they have the same name or are near: none trains where it is held out. Not given: the
            city of a simulated run; all others are one district.
        judge: whether its card says what it is worth on streets, lidars and districts that are held
            out (`checked_of`), which takes minutes.
        out: where the model is written, a path or an fsspec URL; None: nowhere.

    Raises:
        SourceNotFoundError: no run directory there, or none with a dataset.
        UsageError: no run, one that is named twice, a district of an unknown run, or a recipe that
            does not know the lidar.
        ModelError: runs that differ in what must be equal (`over_runs`), or too few places.
    """
    dataset = dataset_over(runs, districts)
    model = train(dataset, recipe=recipe, seed=seed)
    if judge:
        model = replace(model, card={**model.card, CHECKED: checked_of(dataset, recipe, seed)})
    if out is not None:
        save_model(model, out)
    return model


def dataset_over(
    runs: Mapping[str, str | os.PathLike[str] | Dataset],
    districts: Mapping[str, str] | None = None,
) -> Dataset:
    """What `train_over` trains on; arguments and errors as there."""
    named = dict(districts or {})
    unknown = sorted(set(named) - set(runs))
    if unknown:
        raise UsageError(f"districts has {', '.join(unknown)}, and no run is named so")
    places = [of if isinstance(of, Dataset) else place_of(of) for of in runs.values()]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise UsageError(f"runs names {place} twice: its labels would count twice")
    return over_runs({name: _run(of, named.get(name)) for name, of in runs.items()})


def _run(of: str | os.PathLike[str] | Dataset, district: str | None) -> Run:
    if isinstance(of, Dataset):
        return Run(of, district or DISTRICT)
    place = place_of(of)
    measured = DatasetFile(f"{place}/{DATASET}").read()
    settings = read_settings(f"{place}/{CONFIG}")
    simulated = settings.simulate
    about: dict[str, Any] = {}
    if simulated is not None:
        about = {"preset": _preset(simulated.preset), "seed": simulated.seed}
    city = DISTRICT if simulated is None else simulated.city
    return Run(measured, district or city, as_read(settings), about)


def _preset(name: str) -> str:
    """What a preset is called; one whose file is gone, as its file was."""
    try:
        return load_preset(name).preset
    except SourceNotFoundError:
        return Files.at(name).name


def as_read(settings: RunSettings) -> dict[str, Mapping[str, Any]]:
    """What the drives of a job are made with, each as the lidar that it is read as."""
    if settings.observe is None:
        return {}
    whole = making_of(settings)
    found: dict[str, Mapping[str, Any]] = {}
    for drive in settings.drives:
        seen = observing_drive(settings, settings.observe, drive)
        found[drive.group] = whole | {
            "sensor": seen.sensor.model_dump(mode="json"),
            "seeing": seen.seeing.model_dump(mode="json"),
        }
    return found
