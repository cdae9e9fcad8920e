"""Train one model over simulated runs of several lidars, presets, seeds and matchers.

python pipelines/retrain.py pipelines/retrain.yaml [--dry-run]

Each run is the main job in a folder of its own: a call that was stopped continues when it is called
again. The runs train no models of their own; the model over all of them is judged on streets,
lidars and districts that are held out, and written with its card at the end.
--dry-run prints what each run costs and in all; it writes the presets of the lidars, no more.
"""

import argparse
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import Field, model_validator

import tilestream as ts
from tilestream.bounded_yaml import read_yaml
from tilestream.config import Settings
from tilestream.errors import TilestreamError, UsageError
from tilestream.marks import unsealed
from tilestream.model.file import save_model
from tilestream.pipeline.engine.costs import core_hours
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run_settings import Recipe
from tilestream.sensor import Sensor, Vehicle, sensor_of
from tilestream.settings import VirtualSettings
from tilestream.simulation.city import data_file
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


class Share(Settings):
    """A share of the runs: each of its presets x seeds x lidars x matchers is one."""

    city: str = "shinjuku"
    """The district."""
    paths: tuple[str, ...] | None = None
    """Only these of its streets; not given: all."""
    presets: Annotated[tuple[str, ...], Field(min_length=1)] = ("physical", "paper")
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = (0,)
    lidars: Annotated[tuple[str, ...], Field(min_length=1)]
    """By name."""
    matchers: Annotated[tuple[str, ...], Field(min_length=1)] = ("autoware",)
    spacing: Annotated[int, Field(ge=1)] = 5
    """Between measured places [m]."""
    drives: int = 1
    """Of each path."""


class Retraining(Settings):
    """What is simulated, measured and trained over."""

    out: str
    """Where all of it goes."""
    lidars: Annotated[dict[str, Lidar], Field(min_length=1)]
    """By name."""
    shares: Annotated[tuple[Share, ...], Field(min_length=1)]
    """What is run."""
    recipe: Recipe = "corrected"
    seed: int = 0
    """Of the training."""
    size: str = "full"
    """`small`: 40 m of each path, to try it."""
    observe: VirtualSettings = VirtualSettings()
    """How the virtual drive is drawn: the same for all."""
    real: str | None = None
    """What `benchmarks/drives.py --model … --json` says of the model on real drives, for its card;
    they judge and never train."""

    @model_validator(mode="after")
    def _named(self) -> Self:
        unknown = {name for share in self.shares for name in share.lidars} - set(self.lidars)
        if unknown:
            raise ValueError(f"has a share of {', '.join(sorted(unknown))}, and no such lidar")
        return self


def runs_of(wanted: Retraining) -> Iterator[tuple[str, ts.RunSettings]]:
    """The runs by name, none twice; the preset of each lidar is written.

    Runs of one city, preset and seed share its survey, which the first of them simulates, and its
    map. None estimates along a route: two places of one stand for all.
    """
    surveyed: dict[str, str] = {}
    seen: set[str] = set()
    for share in wanted.shares:
        for preset, seed in itertools.product(share.presets, share.seeds):
            city = f"{wanted.out}/cities/{share.city}-{Path(preset).stem}-{seed}"
            for lidar, matcher in itertools.product(share.lidars, share.matchers):
                drive = f"{city}-{lidar}-{share.spacing}m"
                name = f"{Path(drive).name}-{Path(matcher).stem}"
                if name in seen:
                    raise UsageError(f"run {name} is in two shares: leave it out of one")
                seen.add(name)
                first = surveyed.setdefault(city, drive)
                simulate = {
                    "city": share.city,
                    "preset": _write_preset(preset, wanted.lidars[lidar], f"{drive}.yaml"),
                    "size": wanted.size,
                    "drives": share.drives,
                    "paths": share.paths,
                    "every": share.spacing,
                    "seed": seed,
                    "folder": drive,
                    "survey_of": None if first == drive else first,
                }
                yield name, _run(wanted, wanted.lidars[lidar], name, matcher, simulate, city)


def _write_preset(preset: str, lidar: Lidar, file: str) -> str:
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
    return file


def _run(
    wanted: Retraining, lidar: Lidar, name: str, matcher: str, simulate: dict[str, Any], city: str
) -> ts.RunSettings:
    seeing = {"range_max": lidar.range_max, "blind_rear_deg": lidar.blind_rear_deg}
    return ts.RunSettings(
        out=f"{wanted.out}/runs/{name}",
        simulate=simulate,
        map={"store": f"{city}/map.zarr"},
        routes=(_two_places(simulate["city"], simulate["every"], f"{simulate['folder']}.geojson"),),
        spacing=float(simulate["every"]),
        memory="2GB",
        sensor=lidar.model,
        sensor_height=lidar.height,
        observe=wanted.observe.model_copy(update=seeing),
        label={"matcher": matcher},
        model={"recipe": "physics", "offset": 0.0},  # nothing is trained of one run alone
    )


def _two_places(city: str, spacing: int, file: str) -> str:
    routes = json.loads(data_file(f"{city}_routes.geojson").read_text(encoding="utf-8"))
    first = routes["features"][0]
    first["geometry"]["coordinates"] = first["geometry"]["coordinates"][: spacing + 2]
    Path(file).write_text(json.dumps(routes | {"features": [first]}), encoding="utf-8")
    return file


def retrain(wanted: Retraining) -> str:
    """Run all, train over them; the model file."""
    names = []
    for name, settings in runs_of(wanted):
        print(f"run {name}", flush=True)
        ts.run(settings)
        names.append(name)
    folders = {name: f"{wanted.out}/runs/{name}" for name in names}
    path = f"{wanted.out}/{MODEL}"
    model = ts.train_over(folders, recipe=wanted.recipe, seed=wanted.seed, judge=True)
    if wanted.real is not None:
        real = json.loads(Path(wanted.real).read_text(encoding="utf-8"))
        model.card["checked"]["real drives"] = on_real_drives(real)
    save_model(model, path)
    for lidar in model.card["lidars"]:
        print(f"trained over {lidar}")
    for name, told in model.card["checked"].items():
        if "skill" not in told:
            continue
        low, high = told["skill"][1:]
        print(
            f"{name}: {told['places']} places, skill {told['skill'][0]:.2f} ({low:.2f}-{high:.2f})"
        )
    spent = sum(_core_hours(folder) for folder in folders.values())
    print(f"{model.card['places']} places, {spent:.3f} core-hours without the simulation: {path}")
    return path


def on_real_drives(found: dict[str, Any]) -> dict[str, Any]:
    """What a card keeps of real drives: counts, the pooled rank correlation with its interval, by
    how much estimates are off and their median, the share of the errors that the intervals hold
    with its standard error, and both and the level (estimated / measured, medians) by lidar.
    """
    streets = [name for name in found["pooled"] if name != "all"]
    of_model = found["model"]["all"]
    pooled = of_model["all"]["spearman"]
    lidars = {name: one for name, one in of_model.items() if name != "all"}
    held = {
        name: [one["held"][k] for k in ("value", "standard_error")]
        for name, one in of_model.items()
    }
    return {
        "places": found["places"],
        "drives": len(streets),
        "streets": streets,
        "spearman": [pooled[name] for name in ("value", "low", "high")],
        "mae_m": of_model["all"]["off"]["value"],
        "median_m": of_model["all"]["estimated"]["value"],
        "coverage": held.pop("all"),
        "coverage_by_lidar": held,
        "mae_m_by_lidar": {name: one["off"]["value"] for name, one in lidars.items()},
        "level": {
            name: one["estimated"]["value"] / one["measured"]["value"]
            for name, one in lidars.items()
        },
    }


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
