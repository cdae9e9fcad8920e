"""Labels of the simulated paths: Table I, what each knob moves, and what a second drive knows.

    python benchmarks/shinjuku_labels.py [--preset paper] [--out FOLDER] [--every 10] [--workers 1]
    python benchmarks/shinjuku_labels.py --drives 0 1     # two drives of every path
    python benchmarks/shinjuku_labels.py --against FOLDER # are they those of another run's folder?
    python benchmarks/shinjuku_labels.py --knobs drive    # one phenomenon switched off at a time
    python benchmarks/shinjuku_labels.py --knobs map --paths III

Simulates what is not there yet, makes the map of every street, registers every n-th scan from 317
starts with the production matcher, and prints the shares of sample points beyond each limit. With
`--every 1` all 3612 sample points are labelled. `--knobs drive` measures anew at the sample points,
in one map; `--knobs map` simulates anew for each knob. `--size small`: 40 m of each path.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--out", type=Path, default=Path("shinjuku-paper"), help="continues there")
    parser.add_argument("--every", type=int, default=10, help="label each n-th sample point")
    parser.add_argument("--drives", type=int, nargs="+", default=[0], help="numbers of the drives")
    parser.add_argument("--knobs", choices=("drive", "map"), help="switch off those of the drive")
    parser.add_argument("--paths", nargs="+", help="only these; all by default")
    parser.add_argument("--size", choices=("full", "small"), default="full")
    parser.add_argument("--workers", type=int, default=1, help="worker processes")
    parser.add_argument("--against", type=Path, help="a folder of --out: compare with its labels")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import ks_2samp

import tilestream as ts
from tilestream.formats.logs import ScanSelection
from tilestream.grid import Box
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.jobs.simulate import simulate
from tilestream.pipeline.jobs.simulation_record import SMALL_POINTS
from tilestream.records import Float64
from tilestream.report.paper_tables import LIMITS, paper_table_i, table_i
from tilestream.settings import DEFAULT_MEMORY
from tilestream.simulation.city import build_city
from tilestream.simulation.drive import scans
from tilestream.simulation.settings import SimulationSettings, load_preset
from tilestream.simulation.streets import Street

TABLE_ONE = ["path", "points", "median [cm]", "> 10 cm, paper [%]", "> 15", "> 20", "> 25"]
"""The head of `table_one`."""
OF_THE_DRIVE: dict[str, dict[str, dict[str, Any]]] = {
    "as it is": {},
    "no blind sector": {"lidar": {"blind_deg": 0.0}},
    "range 100 m": {"lidar": {"range_max": None}},
    "nothing moves": {"traffic": {"cars_per_100m": 0.0, "people_per_100m": 0.0}},
    "parked cars and leaves as mapped": {"traffic": {"reparked": 0.0, "regrown": False}},
    "no motion distortion": {"lidar": {"distortion": False}},
    "no beam bias": {"lidar": {"beam_bias": 0.0}},
}
"""What is switched off in the drive, one at a time; the map stays."""
OF_THE_MAP: dict[str, dict[str, dict[str, Any]]] = {
    "as it is": {},
    "no drift": {"survey": {"drift": 0.0}},
    "no noise": {"survey": {"noise": 0.0}},
    "no ghosts": {"survey": {"traffic": 0.0}},
    "30 000 rays per m": {"survey": {"rays_per_m": 30_000}},
    "no trees, no hedges": {"city": {"vegetation": 0.0}},
    "flat facades": {"city": {"relief": 0.0}},
}
"""What is switched off in the city or its map, one at a time: simulated anew."""
REACH = 110.0
"""How far from a scan its map reaches [m]."""


def labels(
    settings: SimulationSettings, folder: Path, given: argparse.Namespace
) -> dict[str, pd.Series]:
    """Mean error of the labelled sample points of each path [m], by the number of their scan."""
    found = {}
    with dask_client(None, given.workers, DEFAULT_MEMORY) as client:
        simulate(settings, folder, paths=given.paths, size=given.size, client=client)
        store = ts.ingest(str(folder / "survey" / "*.laz"), folder / "map.zarr", client=client)
        for log in sorted((folder / "logs" / f"drive{settings.drive}").glob("*.mcap")):
            if given.paths is not None and log.stem not in given.paths:
                continue
            table = ts.localize(
                store,
                log,
                folder / f"labels-{given.every}" / f"drive{settings.drive}" / log.stem,
                registration=ts.RegistrationSettings.autoware(),
                scans=ScanSelection(every=given.every),
                client=client,
            )
            error = table.loc[table["status"] == "done"].set_index("scan")["error_mean"]
            found[log.stem] = error
    return found


def table_one(labels: pd.DataFrame) -> list[list[str]]:
    """Rows of Markdown cells: path, labels, median, shares beyond each limit, ours and the paper's.

    Args:
        labels: `path` and `error_mean` [m] of each, of one lidar.
    """
    (ours,), paper = table_i(labels), paper_table_i()
    of_paper = {row["path"]: row["shares_over"] for row in paper["paths"]}
    of_paper |= {"all": paper["weighted"]["shares_over"]}
    lines = []
    for row in [*ours["paths"], {"path": "all", **ours["weighted"]}]:
        theirs = of_paper.get(row["path"], {})
        shares = [
            f"{100 * share:.1f}, " + (f"{100 * theirs[limit]:.1f}" if theirs else "")
            for limit, share in row["shares_over"].items()
        ]
        middle = f"{100 * row['median']:.1f}"
        lines.append([row["path"], str(row["points"]), middle, *shares])
    return lines


def markdown(rows: list[list[str]], head: list[str]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def ceiling(first: dict[str, pd.Series], second: dict[str, pd.Series]) -> str:
    """Markdown: how well one drive's labels tell those of the next drive of the same path."""
    pairs = {name: pd.concat([first[name], second[name]], axis=1).dropna() for name in first}
    pairs["all"] = pd.concat(list(pairs.values()))
    lines = ["| path | points | correlation | of ranks | MAE | skill |", "|---" * 6 + "|"]
    for name, pair in pairs.items():
        one, other = (pair.iloc[:, drive].to_numpy() for drive in (0, 1))
        miss, spread = np.abs(other - one).mean(), np.abs(other - np.median(other)).mean()
        ranks = np.corrcoef(pair.rank().to_numpy().T)[0, 1]
        lines.append(
            f"| {name} | {len(pair)} | {np.corrcoef(one, other)[0, 1]:.2f} | {ranks:.2f} "
            f"| {100 * miss:.1f} cm | {1.0 - miss / spread:.2f} |"
        )
    return "\n".join(lines)


def against(before: pd.Series, after: pd.Series) -> str:
    """Markdown: two runs' labels, their distributions and the differences at the same scans."""
    both = pd.DataFrame({"before": before, "after": after})
    told = both.describe(percentiles=[0.1, 0.25, 0.5, 0.75, 0.9]).drop("count").mul(100)
    for limit in LIMITS:
        told.loc[f"> {100 * limit:.0f} cm"] = 100 * (both > limit).mean()
    lines = [
        f"| {len(before)} and {len(after)} labels [cm, %] | before | after |",
        "|---" * 3 + "|",
    ]
    lines += [f"| {row.Index} | {row.before:.2f} | {row.after:.2f} |" for row in told.itertuples()]
    test = ks_2samp(before, after)
    change = (both["after"] - both["before"]).dropna()
    return "\n".join(lines) + (
        f"\n\ntwo-sample Kolmogorov-Smirnov: D = {test.statistic:.3f}, p = {test.pvalue:.2f}\n"
        f"paired: {len(change)} scans, {(change == 0).sum()} with the same bits, mean change "
        f"{1000 * change.mean():.3f} mm, largest {1000 * change.abs().max():.3f} mm"
    )


def labels_in(folder: Path, every: int, drive: int) -> pd.Series:
    """Mean errors [m] that a run left in its folder, by path and number of the scan."""
    runs = sorted((folder / f"labels-{every}" / f"drive{drive}").iterdir())
    tables = {run.name: pd.read_parquet(run / "errors") for run in runs}
    table = pd.concat(tables, names=["path"])
    done = table[table["status"] == "done"].set_index("scan", append=True)
    return done["error_mean"].droplevel(1)


def changed(settings: SimulationSettings, changes: dict[str, dict[str, Any]]) -> SimulationSettings:
    """The settings with some fields of their parts set otherwise."""
    parts = {
        part: getattr(settings, part).model_copy(update=values) for part, values in changes.items()
    }
    return settings.model_copy(update=parts)


def knobs_of_the_drive(settings: SimulationSettings, given: argparse.Namespace) -> None:
    """Print what the drive's knobs move, at every n-th sample point in the map of the folder."""
    with dask_client(None, given.workers, DEFAULT_MEMORY) as client:
        simulate(settings, given.out, paths=given.paths, size=given.size, client=client)
        survey = str(given.out / "survey" / "*.laz")
        store = ts.ingest(survey, given.out / "map.zarr", client=client)
    city = build_city(settings)
    places = [
        (street, point)
        for street in city.streets
        if street.driven and (given.paths is None or street.name in given.paths)
        for point in range(given.every // 2, end_of(street, given.size), given.every)
    ]
    maps = [ts.cells_of(_points_around(store, street.xy[point])) for street, point in places]
    matcher = ts.RegistrationSettings.autoware()
    usual = None
    for name, changes in OF_THE_DRIVE.items():
        other = replace(city, settings=changed(settings, changes))
        error = []
        for (street, point), cells in zip(places, maps, strict=True):
            scan = next(iter(scans(other, street, range(point, point + 1))))
            assert scan.T_map_lidar is not None
            label = ts.localization_error(cells, scan.points, scan.T_map_lidar, settings=matcher)
            error.append(label.error_mean)
        found = pd.Series(error)
        usual = found if usual is None else usual
        print(row_of(name, found, usual), flush=True)


def end_of(street: Street, size: str) -> int:
    """How many of a street's sample points are simulated."""
    return len(street.xy) if size == "full" else min(len(street.xy), SMALL_POINTS)


def _points_around(store: ts.TileStore, place: Float64) -> Float64:
    """The map points of all tiles within reach of a place."""
    there = set(store.keys())
    keys = [key for key in store.grid.keys_over(Box.around(place[None], REACH)) if key in there]
    return np.concatenate([store.tile(key).points() for key in keys])


def knobs_of_the_map(settings: SimulationSettings, given: argparse.Namespace) -> None:
    """Print what the knobs of city and map move, on some paths, simulated anew for each."""
    usual = None
    for name, changes in OF_THE_MAP.items():
        place = given.out / "knobs" / name.replace(",", "").replace(" ", "-")
        found = pd.concat(labels(changed(settings, changes), place, given))
        usual = found if usual is None else usual
        print(row_of(name, found, usual), flush=True)


def row_of(name: str, error: pd.Series, usual: pd.Series) -> str:
    """Markdown: shares beyond each limit, mean and median, mean change against the usual."""
    shares = [f"{100 * (error > limit).mean():.1f}" for limit in LIMITS]
    centre = [f"{100 * value:.1f}" for value in (error.mean(), error.median())]
    moved = f"{100 * (error - usual).abs().mean():.1f}"
    return "| " + " | ".join([name, str(len(error)), *shares, *centre, moved]) + " |"


def main(given: argparse.Namespace) -> None:
    """Simulate, label, print."""
    settings = load_preset(given.preset)
    if given.knobs is not None:
        print("| switched off | points | > 10 cm | > 15 | > 20 | > 25 | mean | median | moved |")
        print("|---" * 9 + "|", flush=True)
        knobs = knobs_of_the_drive if given.knobs == "drive" else knobs_of_the_map
        knobs(settings, given)
        return
    found = [
        labels(settings.model_copy(update={"drive": drive}), given.out, given)
        for drive in given.drives
    ]
    for drive, table in zip(given.drives, found, strict=True):
        rows = pd.concat([pd.DataFrame({"path": p, "error_mean": e}) for p, e in table.items()])
        told = markdown(table_one(rows), TABLE_ONE)
        print(f"drive {drive}, preset {given.preset}:\n\n{told}\n")
    for drive, table in zip(given.drives[1:], found[1:], strict=True):
        print(f"drive {drive} from drive {given.drives[0]}:\n\n{ceiling(found[0], table)}\n")
    if given.against is not None:
        runs = (
            labels_in(folder, given.every, given.drives[0]) for folder in (given.against, given.out)
        )
        print(against(*runs))


if __name__ == "__main__":
    main(GIVEN)
