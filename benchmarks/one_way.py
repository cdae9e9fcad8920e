"""What a map that was surveyed one way only costs, in a simulated city.

    python benchmarks/one_way.py --out FOLDER [--paths II IV] [--metres 120] [--spacing 2]

A stretch of each path is surveyed there and back. Two maps are made of it, of the way there alone
and of both ways, and two drives localized in each: the way there, in the lane of that survey, and
the way back in the other lane. So in one of the four cases the drive sees the street from where no
survey has seen it. Measured and estimated errors as in drives.py, with its bootstrap; the blocks
are squares of 15 m of the city, the same in all four cases.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="keep all here; continues there")
    parser.add_argument("--json", type=Path, help="write all figures into this file too")
    parser.add_argument("--preset", default="physical", help="settings of the city")
    parser.add_argument("--paths", nargs="+", default=["II", "IV"], help="streets by name")
    parser.add_argument("--metres", type=int, default=120, help="of each, from its beginning")
    parser.add_argument("--rays", type=int, help="of the survey, per metre")
    parser.add_argument("--spacing", type=float, default=2.0, help="between places [m]")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from typing import Any

import numpy as np
import pandas as pd
from drives import BLOCK, PARTS, Figure, Judged, Rows, figure, level_told, show, spearman, told

import tilestream as ts
from tilestream.factors.seen_from import SURVEY_COLUMNS
from tilestream.pipeline.jobs.simulate import simulate
from tilestream.simulation.city import data_file
from tilestream.simulation.settings import SimulationSettings, load_preset

SIDE = 1.5
"""How far right of the street's middle the drives keep [m]; the survey keeps 0.8 m."""
MAPS = {"one way": "*_0_*.laz", "both ways": "*.laz"}
"""Files of the survey that each map is made of."""
DRIVES = ("there", "back")
WITH_BRACKETS = ("mean", "along", "across", "floor")
COSTS = ("mean", "along", "across")
"""Parts whose ratios are printed with their bootstrap: measured / estimated, one way / both."""


def stretch(given: argparse.Namespace, settings: SimulationSettings) -> Path:
    """The file of the streets, cut to the stretches that are wanted."""
    streets = json.loads(data_file(settings.city.routes).read_text())
    kept = []
    for street in streets["features"]:
        told_of, line = street["properties"], street["geometry"]
        if told_of["name"] in given.paths:
            line["coordinates"] = line["coordinates"][: given.metres]
            end = len(line["coordinates"]) - 1
            spots = [spot | {"end": min(spot["end"], end)} for spot in told_of.get("spots", [])]
            told_of["spots"] = [spot for spot in spots if spot["begin"] < end]
            kept.append(street)
    path: Path = given.out / "streets.geojson"
    path.write_text(json.dumps(streets | {"features": kept}))
    return path


def simulated(given: argparse.Namespace) -> dict[str, Path]:
    """The folder of each drive; that of the way there has the survey."""
    given.out.mkdir(parents=True, exist_ok=True)
    settings = load_preset(given.preset)
    city = settings.city.model_copy(update={"routes": str(stretch(given, settings))})
    survey = settings.survey.model_copy(update={"passes": 2})
    if given.rays:
        survey = survey.model_copy(update={"rays_per_m": given.rays})
    there = settings.model_copy(update={"city": city, "survey": survey, "side": SIDE})
    no_survey = survey.model_copy(update={"passes": 1, "rays_per_m": 1})
    back = there.model_copy(update={"survey": no_survey, "reverse": True})
    return {
        name: simulate(each, given.out / name)
        for name, each in zip(DRIVES, (there, back), strict=True)
    }


def measured(given: argparse.Namespace) -> pd.DataFrame:
    """Labels and estimates of all maps (`street`) and drives (`lidar`), with their `block`."""
    folders, lidar = simulated(given), load_preset(given.preset).lidar
    tables = []
    for name, files in MAPS.items():
        out = given.out / name.replace(" ", "-")
        settings = ts.RunSettings(
            out=str(out),
            sensor=lidar.model,
            sensor_height=lidar.height,
            map={"sources": [str(folders["there"] / "survey" / files)]},
            drives=[
                {"log": str(folders[drive] / "logs" / "drive0" / f"{path}.mcap"), "name": group}
                for drive in DRIVES
                for path in given.paths
                for group in [f"{drive} {path}"]
            ],
            routes=[str(folders["there"] / "routes.geojson")],
            spacing=given.spacing,
            observe={"blind_rear_deg": lidar.blind_deg},
            label={"matcher": "autoware"},
            model={"recipe": "physics", "offset": 0.0},
        )
        ts.run(settings)
        tables.append(ts.dataset(out).assign(street=name))
    table = pd.concat(tables, ignore_index=True)
    table["lidar"] = table["group"].str.split(" ").str[0]
    square = np.floor(table[["x", "y"]] / BLOCK).astype(int).astype(str)
    return table.assign(block=square["x"] + " " + square["y"])


def cost(judged: Judged, column: str, drive: str) -> Figure:
    """The median of a column in the map of one way over that in the map of both ways."""
    values, street = judged.numbers[column], judged.table["street"].to_numpy(str)

    def ratio(rows: Rows) -> float:
        one, both = (values[rows[street[rows] == name]] for name in MAPS)
        return float(np.median(one) / np.median(both)) if len(one) and len(both) else np.nan

    return figure(judged.table, judged.rows(lidar=drive), ratio)


def follows(judged: Judged, column: str) -> dict[str, Figure]:
    """Spearman of a column with which map it is, and with measured / estimated of `COSTS`."""
    table = judged.table
    against = {"one way": (table["street"] == next(iter(MAPS))).to_numpy(np.float64)}
    for part in COSTS:
        label, estimate = (judged.numbers[name] for name in PARTS[part])
        against[part] = label / estimate
    seen = table[column].to_numpy(np.float64)
    return {
        name: figure(table, judged.rows(), lambda rows, y=y: spearman(seen[rows], y[rows]))
        for name, y in against.items()
    }


def figures(judged: Judged) -> dict[str, Any]:
    """All figures, by name."""
    label, estimate = PARTS["mean"]
    cases = {
        f"{name}, {drive}": {"street": name, "lidar": drive} for name in MAPS for drive in DRIVES
    }
    return {
        "level": {
            name: {part: judged.level(part, **which) for part in PARTS}
            for name, which in cases.items()
        },
        "ranks": {name: judged.ranks(estimate, label, **which) for name, which in cases.items()},
        "cost": {
            drive: {part: [cost(judged, column, drive) for column in PARTS[part]] for part in COSTS}
            for drive in DRIVES
        },
        "columns": {each.name: follows(judged, each.name) for each in SURVEY_COLUMNS},
    }


def tell(found: dict[str, Any]) -> None:
    """Print all figures."""
    levels = [
        (name, str(found["ranks"][name]["places"]), *(level_told(*part) for part in level.items()))
        for name, level in found["level"].items()
    ]
    title = "Measured / estimated [cm; p_fail: share]: ratio"
    show(title, f"survey and drive, places, {', '.join(PARTS)}", levels)
    ratios = [
        (name, *(told(level[part]) for part in WITH_BRACKETS), told(found["ranks"][name]))
        for name, level in found["level"].items()
    ]
    names = f"survey and drive, {', '.join(WITH_BRACKETS)}, Spearman of mean"
    show("Measured / estimated, with the bootstrap", names, ratios)
    costs = [
        (drive, *(told(each) for part in parts.values() for each in part))
        for drive, parts in found["cost"].items()
    ]
    names = ", ".join(f"{part} {what}" for part in COSTS for what in ("measured", "estimated"))
    show("One way / both ways", f"drive, {names}", costs)
    lines = [(name, *map(told, one.values())) for name, one in found["columns"].items()]
    names = ", ".join(f"measured / estimated {part}" for part in COSTS)
    show("Spearman of what the map shows of its survey", f"column, one way, {names}", lines)


def main(given: argparse.Namespace) -> None:
    """Simulate, run, judge, print."""
    table = measured(given)
    table.to_parquet(given.out / "places.parquet")
    found = figures(Judged(table))
    tell(found)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(GIVEN)
