"""Train one model over simulated runs of several lidars, presets, seeds and matchers.

python pipelines/retrain.py pipelines/retrain.yaml [--dry-run]

Each run is the main job in a folder of its own: a call that was stopped continues when it is called
again. The runs train no models of their own; the model over all of them is written at the end.
--dry-run prints what each run costs and in all; it writes the presets of the lidars, no more.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

import tilestream as ts
from tilestream.bounded_yaml import read_yaml
from tilestream.config import Settings
from tilestream.errors import TilestreamError, UsageError
from tilestream.marks import unsealed
from tilestream.pipeline.engine.costs import core_hours
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run_settings import Recipe
from tilestream.sensor import Sensor, Vehicle, sensor_of
from tilestream.settings import VirtualSettings
from tilestream.simulation.settings import load_preset

MODEL = "model.skops"
SIMULATION = ("survey", "scan", "log")
"""Stages of a city, which its matchers share."""


class Lidar(Settings):
    """A lidar, and how its vehicle carries it."""

    sensor: Any
    """A name that ships, a YAML file, or the fields of a sensor."""
    beams: Annotated[int, Field(ge=2)] | None = None
    """So many of its beams; not given: all."""
    range_max: Annotated[float, Field(gt=0.0)] | None = None
    """Usable range [m]; not given: the sensor's."""
    blind_rear_deg: Annotated[float, Field(ge=0.0, lt=360.0)] = 0.0
    """Sector to the rear that the vehicle hides [deg]."""
    height: Annotated[float, Field(gt=0.0)] = 2.0
    """Above the road [m]."""

    @property
    def model(self) -> Sensor:
        """The sensor's data.

        Raises:
            UsageError: a list of sensors: the simulated vehicle has one.
        """
        found = sensor_of(self.sensor)
        if isinstance(found, Vehicle):
            raise UsageError("the simulated vehicle has one lidar: give one sensor")
        return found if self.beams is None else found.with_beams(self.beams)


class Retraining(Settings):
    """What is simulated, measured and trained over."""

    out: str
    """Where all of it goes."""
    lidars: Annotated[dict[str, Lidar], Field(min_length=1)]
    """By name."""
    presets: Annotated[tuple[str, ...], Field(min_length=1)] = ("physical", "paper")
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = (0,)
    matchers: Annotated[tuple[str, ...], Field(min_length=1)] = ("autoware",)
    recipe: Recipe = "corrected"
    seed: int = 0
    spacing: Annotated[float, Field(gt=0.0)] = 5.0
    size: str = "full"
    drives: int = 1
    paths: tuple[str, ...] | None = None
    observe: VirtualSettings = VirtualSettings()


def runs_of(wanted: Retraining) -> Iterator[tuple[str, ts.RunSettings]]:
    """The runs by name; the preset of each city, with its lidar, is written beside it."""
    for preset in wanted.presets:
        for seed in wanted.seeds:
            for name, lidar in wanted.lidars.items():
                city = f"{wanted.out}/cities/{Path(preset).stem}-{seed}-{name}"
                file = f"{city}.yaml"
                _write_preset(preset, lidar, file)
                for matcher in wanted.matchers:
                    run = f"{Path(preset).stem}-{seed}-{name}-{Path(matcher).stem}"
                    yield run, _run(wanted, lidar, run, matcher, (file, seed, city))


def _write_preset(preset: str, lidar: Lidar, file: str) -> None:
    known = load_preset(preset)
    carried = known.lidar.model_copy(
        update={
            "sensor": lidar.model,
            "height": lidar.height,
            "range_max": lidar.range_max,
            "blind_deg": lidar.blind_rear_deg,
        }
    )
    values = known.model_copy(update={"lidar": carried}).model_dump(mode="json")
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    Path(file).write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def _run(
    wanted: Retraining, lidar: Lidar, name: str, matcher: str, city: tuple[str, int, str]
) -> ts.RunSettings:
    preset, seed, folder = city
    seeing = {"range_max": lidar.range_max, "blind_rear_deg": lidar.blind_rear_deg}
    return ts.RunSettings(
        out=f"{wanted.out}/runs/{name}",
        simulate={
            "preset": preset,
            "size": wanted.size,
            "drives": wanted.drives,
            "paths": wanted.paths,
            "seed": seed,
            "folder": folder,
        },
        spacing=wanted.spacing,
        sensor=lidar.model,
        sensor_height=lidar.height,
        observe=wanted.observe.model_copy(update=seeing),
        label={"matcher": matcher},
        model={"recipe": "physics", "offset": 0.0},  # nothing is trained of one run alone
    )


def retrain(wanted: Retraining) -> str:
    """Run all, train over them; the model file."""
    names = []
    for name, settings in runs_of(wanted):
        print(f"run {name}", flush=True)
        ts.run(settings)
        names.append(name)
    folders = {name: f"{wanted.out}/runs/{name}" for name in names}
    path = f"{wanted.out}/{MODEL}"
    model = ts.train_over(folders, recipe=wanted.recipe, seed=wanted.seed, out=path)
    for lidar in model.card["lidars"]:
        print(f"trained over {lidar}")
    spent = sum(_core_hours(folder) for folder in folders.values())
    print(f"{model.card['places']} places, {spent:.3f} core-hours without the simulation: {path}")
    return path


def _core_hours(folder: str) -> float:
    """What all calls of a run have cost."""
    record = unsealed(json.loads(Path(f"{folder}/run.json").read_text(encoding="utf-8")))
    return sum(stage["core_seconds"] for stage in record["stages"].values()) / 3600.0


def plan(wanted: Retraining) -> float:
    """Print each run with its forecast, a city only once; the sum [core-hours]."""
    total, cities = 0.0, set()
    for name, settings in runs_of(wanted):
        told = forecast(settings)
        hours = core_hours(told.tasks)
        if settings.simulate.folder in cities:
            hours = {stage: one for stage, one in hours.items() if stage not in SIMULATION}
        cities.add(settings.simulate.folder)
        total += sum(hours.values())
        parts = ", ".join(f"{stage} {one:.3f}" for stage, one in hours.items() if one >= 0.001)
        print(f"{name}: {sum(hours.values()):.3f} core-hours ({parts})")
        for note in told.notes.get("plan", ()):
            print(f"  {note}")
    print(f"{total:.3f} core-hours in all")
    return total


def main() -> int:
    """From the command line; 0 good, 1 some failed, 2 usage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config")
    parser.add_argument("--dry-run", action="store_true")
    given = parser.parse_args()
    try:
        wanted = Retraining(**(read_yaml(Path(given.config), UsageError) or {}))
        plan(wanted) if given.dry_run else retrain(wanted)
    except (UsageError, TypeError) as error:
        print(error)
        return 2
    except TilestreamError as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
