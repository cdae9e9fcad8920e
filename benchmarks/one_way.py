"""What a map that was surveyed one way only costs, in a simulated city.

    python benchmarks/one_way.py --out FOLDER [--paths II IV] [--metres 120] [--json FILE]

A stretch of each path is surveyed there and back. Two maps are made of it, of the way there alone
and of both ways, and two drives localized in each: the way there, in the lane of that survey, and
the way back in the other lane. So in one of the four cases the drive sees the street from where no
survey has seen it. Measured and estimated errors as in drives.py, with its bootstrap.
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
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json

import pandas as pd
from drives import PARTS, Judged, blocks, level_told, show, told

import tilestream as ts
from tilestream.pipeline.jobs.simulate import simulate
from tilestream.simulation.city import data_file
from tilestream.simulation.settings import SimulationSettings, load_preset

SIDE = 1.5
"""How far right of the street's middle the drives keep [m]; the survey keeps 0.8 m."""
MAPS = {"one way": "*_0_*.laz", "both ways": "*.laz"}
"""Files of the survey that each map is made of."""
DRIVES = ("there", "back")


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
            spacing=2.0,
            observe={"blind_rear_deg": lidar.blind_deg},
            label={"matcher": "autoware"},
            model={"recipe": "physics", "offset": 0.0},
        )
        ts.run(settings)
        tables.append(ts.dataset(out).rows.assign(street=name))
    table = pd.concat(tables, ignore_index=True)
    table["lidar"] = table["group"].str.split(" ").str[0]
    return table.assign(block=blocks(table, "path"))


def main(given: argparse.Namespace) -> None:
    """Simulate, run, print."""
    table = measured(given)
    table.to_parquet(given.out / "places.parquet")
    judged, found, lines = Judged(table), {}, []
    label, estimate = PARTS["mean"]
    for name in MAPS:
        for drive in DRIVES:
            which = {"street": name, "lidar": drive}
            level = {part: judged.level(part, **which) for part in PARTS}
            rank = judged.ranks(estimate, label, **which)
            found[f"{name}, {drive}"] = {"level": level, "spearman": rank}
            words = (level_told(part, one) for part, one in level.items())
            lines.append(
                (name, drive, str(rank["places"]), *words, told(level["mean"]), told(rank))
            )
    parts = ", ".join(PARTS)
    show(
        "Measured / estimated [cm; p_fail: share]: ratio",
        f"survey, drive, places, {parts}, ratio of mean, Spearman",
        lines,
    )
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(GIVEN)
