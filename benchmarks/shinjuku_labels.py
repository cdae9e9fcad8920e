"""Labels of the five simulated paths, and Table I beside the paper's.

    python benchmarks/shinjuku_labels.py [--preset paper] [--out FOLDER] [--every 10] [--drive 0]

Simulates what is not there yet, makes the map of every street, registers every n-th scan from 317
starts with the production matcher, and prints the shares of sample points beyond each limit. With
`--every 1` all 3612 sample points are labelled.
"""

import argparse
from pathlib import Path

import pandas as pd

import tilestream as ts
from tilestream.dataflow.plan import DEFAULT_MEMORY
from tilestream.dataflow.run import dask_client
from tilestream.dataflow.simulate import simulate
from tilestream.formats.mcap import ScanSelection
from tilestream.simulation.settings import load_preset

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


def labels(folder: Path, preset: str, drive: int, every: int, workers: int) -> dict[str, pd.Series]:
    """Mean error of the labelled sample points of each path [m]."""
    settings = load_preset(preset).model_copy(update={"drive": drive})
    found = {}
    with dask_client(None, workers, DEFAULT_MEMORY) as client:
        simulate(settings, folder, client=client)
        store = ts.ingest(str(folder / "survey" / "*.laz"), folder / "map.zarr", client=client)
        for log in sorted((folder / "logs" / f"drive{drive}").glob("*.mcap")):
            table = ts.localize(
                store,
                log,
                folder / "labels" / f"drive{drive}" / log.stem,
                registration=ts.RegistrationSettings.autoware(),
                scans=ScanSelection(every=every),
                client=client,
            )
            found[log.stem] = table.loc[table["status"] == "done", "error_mean"]
    return found


def table_one(found: dict[str, pd.Series]) -> str:
    """Markdown: shares beyond each limit, ours and the paper's."""
    lines = ["| path | points | > 10 cm, paper | > 15 | > 20 | > 25 |", "|---" * 6 + "|"]
    for name, error in (found | {"all": pd.concat(list(found.values()))}).items():
        shares = (
            f"{100 * (error > limit).mean():.1f}, {paper:.1f}"
            for limit, paper in zip(LIMITS, PAPER[name], strict=True)
        )
        lines.append(f"| {name} | {len(error)} | " + " | ".join(shares) + " |")
    return "\n".join(lines)


def main() -> None:
    """Simulate, label, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--out", type=Path, default=Path("shinjuku-paper"))
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--drive", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    print(table_one(labels(given.out, given.preset, given.drive, given.every, given.workers)))


if __name__ == "__main__":
    main()
