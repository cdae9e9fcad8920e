"""What estimates over several runs are worth: the runs of pipelines/retrain.py, judged.

    python benchmarks/over_runs.py RETRAINED [--json FILE] [--competitors corrected physics …]

First each preset for itself, the lidar VLP16 in all seeds: whole paths left out, and blocks. Then
all runs together: paths, lidars and districts left out, and each lidar on left-out paths. Every
figure has a 90 % interval by resampled blocks of 200 m; of paths the same street of every seed and
lidar is left out together.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("retrained", type=Path, help="the folder of the retraining")
    parser.add_argument("--json", type=Path, help="write all figures into this file too")
    parser.add_argument(
        "--competitors", nargs="+", default=["corrected", "physics", "forest"], help="models"
    )
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from collections.abc import Mapping
from typing import Any

import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import TARGETS, Dataset
from tilestream.model.evaluation import held_out
from tilestream.model.figures import difference, with_spans
from tilestream.model.intervals import coverage
from tilestream.model.physics import Physics
from tilestream.model.registry import OF_VIRTUAL_DRIVES
from tilestream.model.splits import protocols_of
from tilestream.pipeline.jobs.train_over import dataset_over

MAIN = TARGETS[0]
PROTOCOLS = ("path", "blocks", "lidar", "district")
CM = 100.0


def datasets(folder: Path) -> dict[str, tuple[Dataset, tuple[str, ...]]]:
    """What is judged, each with its protocols."""
    runs = {run.name: run for run in sorted((folder / "runs").iterdir())}
    found = {}
    for preset in ("paper", "physical"):
        kept = {
            name: run
            for name, run in runs.items()
            if name.startswith(f"shinjuku-{preset}-")
            and "-VLP16-" in name
            and "autoware" in name
            and not any(lesser in name for lesser in ("-short-", "-near-", "-8-"))
        }
        if kept:
            found[preset] = dataset_over(kept), ("path", "blocks")
    found["all runs"] = dataset_over(runs), ("path", "lidar", "district")
    return found


def judged(
    dataset: Dataset, protocols: tuple[str, ...], competitors: list[str]
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    """A row per protocol, target and competitor; and the points of the first protocol and mean."""
    rows, kept = [], pd.DataFrame()
    for protocol in protocols_of(dataset):
        if protocol.name not in protocols:
            continue
        try:
            splits = protocol.splits(dataset, 0)
        except ModelError as error:
            print(f"{protocol.name}: {error}")
            continue
        for target in TARGETS if protocol.name == "path" else TARGETS[:4]:
            physics = held_out(dataset, splits, Physics.name, target)
            for name in competitors:
                points = (
                    physics if name == Physics.name else held_out(dataset, splits, name, target)
                )
                row = {"protocol": protocol.name, "target": target, "competitor": name}
                rows.append(row | figures(points, physics, target))
                if (protocol.name, target, name) == ("path", MAIN, competitors[0]):
                    kept = points
    return rows, kept


def figures(points: pd.DataFrame, physics: pd.DataFrame, target: str) -> dict[str, Any]:
    """Figures with their intervals, the difference from physics, and for the mean the coverage."""
    found: dict[str, Any] = with_spans(points)
    found |= {f"over_{k}": v for k, v in difference(points, physics).items() if k != "points"}
    if target == MAIN:
        held = coverage(points).iloc[0]
        found |= {
            "covered": held["covered"],
            "covered_error": held["error"],
            "width": held["width"],
        }
    return found


def told(rows: list[dict[str, Any]]) -> None:
    """Print a table."""
    print(
        "| left out | of | model | places | MAE | skill | segments | rank | over physics | held |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for r in rows:
        unit = f"{r['mae']:.3f}" if r["target"] == "p_fail" else f"{CM * r['mae']:.2f} cm"
        held = (
            f"{100 * r['covered']:.0f} +- {100 * r['covered_error']:.0f} %"
            if "covered" in r
            else ""
        )
        print(
            f"| {r['protocol']} | {r['target']} | {r['competitor']} | {r['points']:.0f} | {unit} "
            f"| {ended(r, 'skill')} | {ended(r, 'segment_skill')} | {ended(r, 'spearman')} "
            f"| {ended(r, 'over_skill', '+.3f')} | {held} |"
        )


def ended(row: Mapping[str, Any], name: str, how: str = ".2f") -> str:
    """A figure with its interval."""
    return f"{row[name]:{how}} ({row[f'{name}_low']:{how}}, {row[f'{name}_high']:{how}})"


def by_lidar(dataset: Dataset, points: pd.DataFrame) -> None:
    """Each lidar on left-out paths: level, rank, coverage by intervals of the others' paths."""
    lidar = dataset.rows["lidar"].to_numpy(str)[points["row"]]
    print("\n| lidar | places | measured | estimated | MAE | rank |\n|---|---|---|---|---|---|")
    for name, own in points.groupby(lidar):
        rank = own["actual"].corr(own["estimate"], method="spearman")
        error = (own["actual"] - own["estimate"]).abs().mean()
        print(
            f"| {name} | {len(own)} | {CM * own['actual'].mean():.1f} cm "
            f"| {CM * own['estimate'].mean():.1f} cm | {CM * error:.1f} cm | {rank:.2f} |"
        )


def main(given: argparse.Namespace) -> None:
    """Judge all."""
    every = {}
    for name, (dataset, protocols) in datasets(given.retrained).items():
        print(
            f"\n### {name}: {len(dataset)} places, {len(set(dataset.pieces))} blocks\n", flush=True
        )
        known = [one for one in given.competitors if one in OF_VIRTUAL_DRIVES or name != "all runs"]
        rows, points = judged(dataset, protocols, known)
        told(rows)
        every[name] = rows
        if len(points) and name == "all runs":
            by_lidar(dataset, points)
        if given.json:
            given.json.write_text(json.dumps(every, indent=1))


if __name__ == "__main__":
    main(GIVEN)
