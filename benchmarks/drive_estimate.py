"""Estimated against measured errors of a run, drive by drive, for RESULTS.md.

    tilestream run pipelines/drive.yaml
    python benchmarks/drive_estimate.py drive

Read from the run directory. Lengths are centimetres.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run_dir", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import pandas as pd
from scipy.stats import spearmanr

import tilestream as ts
from tilestream.model.dataset import nearest_along

CM = 100.0
REACH = 0.5
"""How far along its path an estimate may be from a label [m]."""


def table(run_dir: Path) -> str:
    """Markdown: a row per drive."""
    places = pd.read_parquet(run_dir / "report" / "places.parquet")
    said = places[["route_id", "arc_length", "estimate", "low", "high"]]
    said = said.rename(columns={"route_id": "path"})
    rows = nearest_along(ts.dataset(run_dir), said, REACH).dropna(subset="estimate")
    lines = [
        "| drive | points | measured, mean | median | estimated, median | MAE | Spearman | held |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, part in rows.groupby("group"):
        error, estimate = part["error_mean"], part["estimate"]
        held = ((part["low"] <= error) & (error <= part["high"])).mean()
        figures = (error.mean(), error.median(), estimate.median(), (error - estimate).abs().mean())
        lengths = " | ".join(f"{CM * value:.1f}" for value in figures)
        rho = spearmanr(error, estimate).statistic
        lines.append(f"| {name} | {len(part)} | {lengths} | {rho:.2f} | {CM * held:.0f} % |")
    return "\n".join(lines)


def main(given: argparse.Namespace) -> None:
    """Print the table of a run directory."""
    print(table(given.run_dir))


if __name__ == "__main__":
    main(GIVEN)
