"""The settings of the main job, and how a YAML file gives them."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from tilestream.bounded_yaml import parse_yaml, read_yaml
from tilestream.config import Settings
from tilestream.errors import SourceNotFoundError, UsageError, foreign_errors
from tilestream.files import Files, local_path, place_of
from tilestream.matcher import RegistrationSettings, matcher_named
from tilestream.model.dataset import POINTS_MIN, WITHOUT_DRIVES
from tilestream.model.registry import DEFAULT, OF_VIRTUAL_DRIVES, REGRESSORS, UNTRAINED
from tilestream.model.shipped import SHIPPED
from tilestream.settings import (
    NAME,
    CoarseSettings,
    DriveSettings,
    LabelSettings,
    LocalFile,
    MapSettings,
    Place,
    PlaceSettings,
    ReportSettings,
    SimulateSettings,
    VirtualSettings,
)

BEGIN = "`tilestream template` prints one, and `tilestream estimate MAP` needs none"
"""What to do without a job."""


def _known(recipe: str) -> str:
    if recipe not in REGRESSORS:
        raise ValueError(f"is {recipe!r}: choose from {', '.join(REGRESSORS)}")
    return recipe


Recipe = Annotated[
    str,
    AfterValidator(_known),
    Field(
        description="What estimates the error: "
        + "; ".join(f"`{name}` ({one.words})" for name, one in REGRESSORS.items())
        + f". They are trained on the drives; `{UNTRAINED}` needs none."
    ),
]
"""Name of a regressor."""


def _model_place(name: str) -> str:
    return name if name == SHIPPED else place_of(name)


ModelPlace = Annotated[str, AfterValidator(_model_place)]
"""A model file, or `shipped`."""


def _factors_file(name: str) -> str:
    return place_of(local_path(name)) if name.endswith(".py") else name


FactorsFile = Annotated[str, AfterValidator(_factors_file)]
"""A file of factors, made absolute here, or the name of an entry point."""


class ModelSettings(Settings):
    """How the errors of the measured places become those of all places."""

    recipe: Recipe = DEFAULT
    offset: Annotated[float, Field(ge=0.0)] | None = None
    """With `physics`: what a real scan adds to the error of a virtual one [m]; nothing is trained
    then. Not given: the drives tell it, 0 where fewer than 50 places are measured."""
    use: ModelPlace | None = None
    """A model file to use instead of training, or `shipped`: the one that comes with tilestream;
    null: train on the drives."""
    seed: int = 0
    """Seed of all that is random in training."""

    def untrained(self, labelled: int) -> bool:
        """Whether the virtual drive as it is makes the estimates.

        Args:
            labelled: how many places are measured.
        """
        told = self.offset is not None or labelled < POINTS_MIN
        return self.recipe == UNTRAINED and self.use is None and told


class RunSettings(PlaceSettings):
    """The main job: from map and drives to the estimated error of every sample point."""

    out: Place
    """The run directory: a path, or a URL of an object store."""
    simulate: SimulateSettings | None = None
    """Simulate a city; null: real files."""
    map: MapSettings = MapSettings()
    """The map."""
    drives: tuple[DriveSettings, ...] = ()
    """The logs to measure on; empty with `simulate`: its drives."""
    routes: tuple[LocalFile, ...] = ()
    """Files of routes to estimate along; empty: those of the simulation, or of the drives; without
    drives, all lanes of a map directory with `lanelet2_map.osm` among the sources, else the way of
    the logs that the map is made of."""
    factors: tuple[FactorsFile, ...] = ()
    """Factors of your own besides ours: Python files (`my_factor.py`), or entry points of the group
    `tilestream.factors`."""
    observe: VirtualSettings | None = VirtualSettings()
    """How the vehicle's lidar sees in the virtual drive: usable range, blind sector, starts; null:
    no virtual drive, the paper's factors and their twins only."""
    coarse: CoarseSettings | None = None
    """Evaluate some places first, and others only where errors are high or change fast; null: all.
    With a model in use, or the virtual drive as it is."""
    label: LabelSettings = LabelSettings()
    """How errors are measured."""
    model: ModelSettings = ModelSettings()
    """How they are estimated."""
    report: ReportSettings = ReportSettings()
    """What is reported."""

    @field_validator("drives", "routes", mode="before")
    @classmethod
    def _emptied(cls, values: Any) -> Any:
        """A key of YAML whose list is commented out holds nothing."""
        return () if values is None else values

    @model_validator(mode="before")
    @classmethod
    def _cells_of_the_matcher(cls, values: Any) -> Any:
        """The cells that the matcher wants, where it wants some."""
        label = values.get("label") if isinstance(values, Mapping) else None
        if isinstance(label, LabelSettings):
            label = {name: getattr(label, name) for name in label.model_fields_set}
        if not isinstance(label, Mapping):
            return values
        try:
            matcher = matcher_named(label.get("matcher"))
        except UsageError:  # which is told where the matcher is
            return values
        wanted = matcher.get("resolution") if isinstance(matcher, Mapping) else None
        wanted = matcher.resolution if isinstance(matcher, RegistrationSettings) else wanted
        if wanted is None:
            return values
        if values.get("cell_size", wanted) != wanted:
            raise ValueError(
                f"has cell_size {values['cell_size']} and a matcher of {wanted} m (its resolution):"
                " leave cell_size out, or give the same"
            )
        return {**values, "label": {**label, "matcher": matcher}, "cell_size": wanted}

    @model_validator(mode="after")
    def _check(self) -> Self:
        for drive in self.drives:
            if re.fullmatch(NAME, drive.group) is None:
                raise ValueError(
                    f"has a drive that {drive.log!r} cannot name: give it a name of letters, digits"
                    " and _ . + - or spaces, the first a letter, a digit or _"
                )
        names = [drive.group for drive in one_of_each(self.drives)[0]]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"has two drives named {', '.join(twice)}: give each its own name")
        if self.simulate is None and not self.map.sources and self.map.store is None:
            raise ValueError("has no map: give map.sources (files), map.store, or simulate")
        recipe, use = self.model.recipe, self.model.use
        if not (self.simulate or self.drives or use or recipe == UNTRAINED):
            raise ValueError(
                f"has nothing to learn from: give drives, simulate, or model.use; {WITHOUT_DRIVES}"
            )
        if recipe in OF_VIRTUAL_DRIVES and self.observe is None and not use:
            others = ", ".join(name for name in REGRESSORS if name not in OF_VIRTUAL_DRIVES)
            raise ValueError(
                f"has model.recipe {recipe}, which needs observe: give observe, or one of {others}"
            )
        reach = None if self.observe is None else self.observe.range_max
        if reach is not None and reach > self.vehicle.range_max:
            raise ValueError(
                f"has observe.range_max (--range-max) {reach:g} m, and {self.vehicle.name} sees "
                f"{self.vehicle.range_max:g} m: give no more than that"
            )
        learns = self.drives or self.simulate
        as_it_is = recipe == UNTRAINED and not (learns and self.model.offset is None)
        if self.coarse is not None and (self.observe is None or not (use or as_it_is)):
            raise ValueError(
                "has coarse (--coarse), which chooses among virtual drives by what a model says of "
                "them: give observe and model.use, e.g. shipped, or model.recipe "
                f"{UNTRAINED} without drives"
            )
        if recipe == UNTRAINED and use:
            raise ValueError(f"has model.recipe {UNTRAINED} and model.use: give one of them")
        return self

    @property
    def folder(self) -> Files:
        """The run directory."""
        return Files.at(self.out)

    @property
    def store_url(self) -> str:
        """Where the tile store is."""
        return self.map.store or f"{self.out}/map.zarr"


def one_of_each(drives: Sequence[DriveSettings]) -> tuple[tuple[DriveSettings, ...], list[str]]:
    """The drives without those that are another one again, whatever the name of drive and log, and
    a note on each of these.
    """
    first: dict[tuple[str, str], DriveSettings] = {}
    notes = []
    for drive in drives:
        how = drive.model_dump_json(exclude={"log", "name"})
        before = first.setdefault((os.path.realpath(drive.log), how), drive)
        if before is not drive:
            notes.append(
                f"Drive {drive.group}, {drive.log}, is drive {before.group} again: measured once."
            )
    return tuple(first.values()), notes


def read_settings(path: str | os.PathLike[str], changes: Sequence[str] = ()) -> RunSettings:
    """The settings of a job from a YAML file; relative paths in it are from where one is.

    Args:
        path: the file.
        changes: `key=value` with dots between levels and YAML values, applied on top.

    Raises:
        SourceNotFoundError: no such file.
        UsageError: no YAML, an unknown key at any level (names the nearest right one), a value that
            cannot be.
    """
    place = Path(local_path(path))
    if place.is_dir():
        raise UsageError(f"{place}: a directory, and a job is a YAML file; {BEGIN}")
    if not place.is_file():
        raise SourceNotFoundError(f"{place}: no such config; {BEGIN}")
    values = read_yaml(place, UsageError)
    if not isinstance(values, dict):
        raise UsageError(f"{place}: give the fields of a job, e.g. out: run; {BEGIN}")
    for change in changes:
        _apply(values, change)
    try:
        return RunSettings(**values)
    except (UsageError, ValidationError, TypeError) as error:
        told = str(error).removeprefix(f"{RunSettings.__name__}: ")
        raise UsageError(f"{place}: {told}") from None


def _apply(values: dict[str, object], change: str) -> None:
    """Set one value; levels that are not there are made, and checked with the rest."""
    key, equals, text = change.partition("=")
    if not equals or not key:
        raise UsageError(f"{change!r}: give key=value, e.g. label.matcher=default")
    *levels, last = key.split(".")
    at = values
    for level in levels:
        below = at.setdefault(level, {})
        if not isinstance(below, dict):
            raise UsageError(f"{change!r}: {level} holds a value, nothing lies below it")
        at = below
    with foreign_errors(UsageError, f"{change!r}: no YAML", "give a plain value"):
        at[last] = parse_yaml(text)
