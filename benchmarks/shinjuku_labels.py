"""Labels of the simulated paths: Table I, what each knob moves, and the ceiling of any estimate.

    python benchmarks/shinjuku_labels.py [--preset paper] [--out FOLDER] [--every 10] [--workers 1]
    python benchmarks/shinjuku_labels.py --drives 0 1     # the ceiling: two drives of every path
    python benchmarks/shinjuku_labels.py --knobs          # one phenomenon switched off at a time

Simulates what is not there yet, makes the map of every street, registers every n-th scan from 317
starts with the production matcher, and prints the shares of sample points beyond each limit. With
`--every 1` all 3612 sample points are labelled. `--knobs` simulates `--paths` anew for each knob.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import tilestream as ts
from tilestream.dataflow.plan import DEFAULT_MEMORY
from tilestream.dataflow.run import dask_client
from tilestream.dataflow.simulate import simulate
from tilestream.formats.mcap import ScanSelection
from tilestream.simulation.settings import SimulationSettings, load_preset

LIMITS = (0.10, 0.15, 0.20, 0.25)
PAPER = {
    "I": (28.9, 11.1, 4.3, 2.2),
    "II": (40.8, 17.9, 7.3, 1.9),
    "III": (27.6, 23.2, 20.7, 17.9),
    "IV": (18.7, 8.4, 4.12, 1.9),
    "V": (86.0, 33.4, 15.0, 7.0),
    "all": (41.9, 17.8, 8.45, 4.31),
}
"""Table I of the paper: share of sample points beyond each of `LIMITS` [%]."""
OFF: dict[str, dict[str, dict[str, Any]]] = {
    "as it is": {},
    "no blind sector": {"lidar": {"blind_deg": 0.0}},
    "range 100 m": {"lidar": {"range_max": None}},
    "no map drift": {"survey": {"drift": 0.0}},
    "no map noise": {"survey": {"noise": 0.0}},
    "no ghosts in the map": {"survey": {"traffic": 0.0}},
    "dense map": {"survey": {"rays_per_m": 30_000}},
    "nothing moves": {"traffic": {"cars_per_100m": 0.0, "people_per_100m": 0.0}},
    "cars parked as mapped": {"traffic": {"reparked": 0.0}},
    "leaves as mapped": {"traffic": {"regrown": False}},
    "no trees, no hedges": {"city": {"vegetation": 0.0}},
    "no motion distortion": {"lidar": {"distortion": False}},
    "no beam bias": {"lidar": {"beam_bias": 0.0}},
    "flat facades": {"city": {"relief": 0.0}},
}
"""What is switched off, one at a time."""


def labels(
    settings: SimulationSettings,
    folder: Path,
    every: int,
    workers: int,
    paths: list[str] | None = None,
) -> dict[str, pd.Series]:
    """Mean error of the labelled sample points of each path [m], by the number of their scan."""
    found = {}
    with dask_client(None, workers, DEFAULT_MEMORY) as client:
        simulate(settings, folder, paths=paths, client=client)
        store = ts.ingest(str(folder / "survey" / "*.laz"), folder / "map.zarr", client=client)
        for log in sorted((folder / "logs" / f"drive{settings.drive}").glob("*.mcap")):
            table = ts.localize(
                store,
                log,
                folder / f"labels-{every}" / f"drive{settings.drive}" / log.stem,
                registration=ts.RegistrationSettings.autoware(),
                scans=ScanSelection(every=every),
                client=client,
            )
            error = table.loc[table["status"] == "done"].set_index("scan")["error_mean"]
            found[log.stem] = error
    return found


def table_one(found: dict[str, pd.Series]) -> str:
    """Markdown: shares beyond each limit, ours and the paper's."""
    lines = ["| path | points | > 10 cm, paper | > 15 | > 20 | > 25 | median |", "|---" * 7 + "|"]
    for name, error in (found | {"all": pd.concat(list(found.values()))}).items():
        shares = (
            f"{100 * (error > limit).mean():.1f}, {paper:.1f}"
            for limit, paper in zip(LIMITS, PAPER[name], strict=True)
        )
        row = [name, str(len(error)), *shares, f"{100 * error.median():.1f} cm"]
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


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


def knobs(
    settings: SimulationSettings, folder: Path, every: int, workers: int, paths: list[str]
) -> None:
    """Print, for each knob switched off, the shares beyond each limit, the mean and the median."""
    print("| | > 10 cm | > 15 | > 20 | > 25 | mean | median | moved |")
    print("|---" * 8 + "|")
    usual: pd.Series | None = None
    for name, changes in OFF.items():
        parts = {
            part: getattr(settings, part).model_copy(update=values)
            for part, values in changes.items()
        }
        place = folder / name.replace(" ", "-")
        found = labels(settings.model_copy(update=parts), place, every, workers, paths)
        error = pd.concat(found)
        usual = error if usual is None else usual
        shares = [f"{100 * (error > limit).mean():.1f}" for limit in LIMITS]
        centre = [f"{100 * error.mean():.1f}", f"{100 * error.median():.1f}"]
        moved = f"{100 * (error - usual).abs().mean():.1f}"
        print("| " + " | ".join([name, *shares, *centre, moved]) + " |", flush=True)


def main() -> None:
    """Simulate, label, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--out", type=Path, default=Path("shinjuku-paper"))
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--drives", type=int, nargs="+", default=[0])
    parser.add_argument("--knobs", action="store_true")
    parser.add_argument("--paths", nargs="+", default=["III", "V"], help="of --knobs")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    settings = load_preset(given.preset)
    if given.knobs:
        knobs(settings, given.out / "knobs", given.every, given.workers, given.paths)
        return
    found = [
        labels(settings.model_copy(update={"drive": drive}), given.out, given.every, given.workers)
        for drive in given.drives
    ]
    for drive, table in zip(given.drives, found, strict=True):
        print(f"drive {drive}, preset {given.preset}:\n\n{table_one(table)}\n")
    for drive, table in zip(given.drives[1:], found[1:], strict=True):
        print(f"drive {drive} from drive {given.drives[0]}:\n\n{ceiling(found[0], table)}\n")


if __name__ == "__main__":
    main()
