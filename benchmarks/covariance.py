"""Covariances of places against the registrations that they are of, on streets left out.

    python benchmarks/covariance.py RETRAINED [--drives RUN ...] [--json FILE]

Over the runs of pipelines/retrain.py. Each street is left out in all seeds, presets and lidars, the
rest calibrates; then every start within 1 m of the truth that holds is normalised by the covariance
of its place. Per axis the error squared / variance (1 is right), and how many of the starts lie in
the ellipses (x, y) that a Gaussian would fill to 50, 90 and 99 %: of ours, and of one constant that
is fitted on the same streets. Brackets are 90 % intervals by resampled blocks of 200 m.

With --drives, instead, all runs calibrate and other runs are judged, drive by drive: those that
benchmarks/drives.py made of real drives, which train nothing.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("retrained", type=Path, help="the folder of the retraining")
    parser.add_argument("--drives", type=Path, nargs="+", default=[], help="judge these runs")
    parser.add_argument("--json", type=Path, help="write all figures into this file too")
    parser.add_argument(
        "--prediction-error", type=float, default=0.3, help="of the filter in x and in y [m]"
    )
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2, rankdata

from tilestream.label import FAILED, NEAR
from tilestream.model.bootstrap import resampled, span
from tilestream.model.covariance import (
    BIAS,
    ELEMENTS,
    Calibration,
    about_bias,
    calibrated,
    matrices,
)
from tilestream.model.covariance_training import calibration_of, cores_of
from tilestream.model.dataset import Dataset
from tilestream.model.splits import leave_path_out
from tilestream.moments import AXES, PAIRS, SCORES
from tilestream.pipeline.jobs.train_over import dataset_over
from tilestream.pipeline.stages.samples import DatasetFile
from tilestream.records import Float64
from tilestream.tables import read_tables

LEVELS = (0.5, 0.9, 0.99)


def starts_of(folder: Path, dataset: Dataset) -> dict[tuple[str, int], Float64]:
    """(k, 6) errors of the starts within 1 m that hold, by group and sample point."""
    found: dict[tuple[str, int], Float64] = {}
    for group in sorted(set(dataset.rows["group"])):
        run, name = group.split("/", 1)
        below = sorted((folder / "runs" / run / "tables/starts" / name).glob("*.parquet"))
        table = read_tables([str(path) for path in below])
        near = table[(table["distance"] <= NEAR + 1e-9) & (table["error"] <= FAILED)]
        for sample, rows in near.groupby("sample"):
            found[group, int(sample)] = rows[list(AXES)].to_numpy()
    return found


def held_out(dataset: Dataset, prediction_error: float) -> pd.DataFrame:
    """Covariances of every place, and constants, by the other streets: on the index of the rows,
    the constants with `one_` before their names.
    """
    parts = []
    for split in leave_path_out(dataset):
        train = dataset.take(split.train)
        known = calibration_of(train)
        if known is None:
            raise SystemExit(
                "labels without moments, of an older version: run the retraining again"
            )
        core = cores_of(dataset, prediction_error, known.width)
        rows = dataset.rows.iloc[split.train]
        one = {
            f"one_{e}": rows[f"near_{a}_{b}"].mean()
            for e, (a, b) in zip(ELEMENTS, PAIRS, strict=True)
        }
        here = calibrated(core.iloc[split.test], known)
        parts.append(here.assign(**one, width=known.width))
        told = ", ".join(
            f"{axis} {gain:.2f}, {scale:.2f} + ({1e3 * added**0.5:.1f})^2"
            for axis, gain, scale, added in zip(
                AXES, known.gain, known.scale, known.added, strict=True
            )
        )
        print(f"without {split.name}: width {known.width}, {told} [mm, mrad]")
    return pd.concat(parts).reindex(dataset.rows.index)


def normalised(
    dataset: Dataset, places: pd.DataFrame, starts: dict[tuple[str, int], Float64]
) -> pd.DataFrame:
    """A row per place: mean over its starts of the error squared / variance per axis, and the share
    of them in each ellipse, of ours and of the constant.
    """
    ours, inner = matrices(places), about_bias(places)
    bias = places[list(BIAS)].to_numpy()
    ones = matrices(places[[f"one_{e}" for e in ELEMENTS]].set_axis(list(ELEMENTS), axis=1))
    rows = []
    for k, (group, sample) in enumerate(
        zip(dataset.rows["group"], dataset.rows["sample"], strict=True)
    ):
        errors = starts.get((group, int(sample)))
        row: dict[str, float] = {}
        if errors is not None and np.isfinite(ours[k]).all():
            for name, off, covariance in (
                ("ours", errors, ours[k]),
                ("about the expected error", errors - bias[k], inner[k]),
                ("one", errors, ones[k]),
            ):
                for i, axis in enumerate(AXES):
                    row[f"{name} {axis}"] = float((off[:, i] ** 2).mean() / covariance[i, i])
                flat = np.linalg.inv(covariance[:2, :2])
                far = np.einsum("ki,ij,kj->k", off[:, :2], flat, off[:, :2])
                for level in LEVELS:
                    row[f"{name} {level:.0%}"] = float((far <= chi2.ppf(level, 2)).mean())
                row[f"{name} surprise"] = float(
                    np.linalg.slogdet(covariance[:2, :2])[1] + far.mean()
                )
            for i, axis in enumerate(AXES[:3]):
                row[f"square {axis}"] = float((errors[:, i] ** 2).mean())
                row[f"square {axis}, expected error taken"] = float(
                    ((errors[:, i] - bias[k, i]) ** 2).mean()
                )
        rows.append(row)
    return pd.DataFrame(rows, index=dataset.rows.index)


def figures(
    rows: pd.DataFrame, places: pd.DataFrame, found: pd.DataFrame
) -> dict[str, tuple[float, float, float]]:
    """Means over places with the ends of their intervals; ranks of deviations beside."""
    good = found.notna().all(axis=1).to_numpy()  # a place where nothing holds has no covariance
    rows, places, found = rows[good], places[good], found[good]
    _, block = np.unique(rows["piece"], return_inverse=True)
    counts = resampled(int(block.max()) + 1)
    told = {}
    for name in found:
        values = found[name].to_numpy()
        sums, sizes = np.bincount(block, values), np.bincount(block)
        told[str(name)] = (float(values.mean()), *span((counts @ sums) / (counts @ sizes)))
    for axis in AXES[:2]:
        one, two = places[f"cov_{axis}_{axis}"], rows[f"near_{axis}_{axis}"]
        rank = float(np.corrcoef(rankdata(one), rankdata(two))[0, 1])
        told[f"rank {axis}"] = (rank, np.nan, np.nan)
    for name in ("nvtl", "tp"):
        low, high, real = places[f"{name}_low"], places[f"{name}_high"], rows[f"near_{name}"]
        inside = ((low <= real) & (real <= high)).to_numpy(np.float64)
        sums = np.bincount(block, inside)
        told[f"{name} normal"] = (
            float(inside.mean()),
            *span((counts @ sums) / (counts @ np.bincount(block))),
        )
    told["lost, expected"] = (float(places["p_lost"].mean()), np.nan, np.nan)
    told["lost, measured"] = (float(rows["near_p_fail"].mean()), np.nan, np.nan)
    told["places"] = (float(len(rows)), np.nan, np.nan)
    return told


def judged(folder: Path, known: Calibration, prediction_error: float) -> list[dict[str, Any]]:
    """A row per drive of another run: error squared / variance per axis, measured / expected scores
    and how many are normal, expected and measured lost share, and how the signed mean errors of
    virtual and real near starts correlate.
    """
    dataset = DatasetFile(f"{folder}/tables/samples/dataset.parquet").read()
    core = cores_of(dataset, prediction_error, known.width)
    places, told = calibrated(core, known), []
    for group, rows in dataset.rows.groupby("group"):
        here, virtual = places.loc[rows.index], core.loc[rows.index]
        row: dict[str, Any] = {"drive": f"{folder.name}, {group}", "places": len(rows)}
        for axis in AXES:
            row[axis] = float((rows[f"near_{axis}_{axis}"] / here[f"cov_{axis}_{axis}"]).mean())
        for name in SCORES:
            real = rows[f"near_{name}"]
            row[name] = float((real / here[name]).median())
            normal = real.between(here[f"{name}_low"], here[f"{name}_high"])
            row[f"{name} normal"] = float(normal.mean())
        row["lost, expected"], row["lost"] = here["p_lost"].mean(), rows["near_p_fail"].mean()
        for axis in AXES[:3]:
            row[f"sides {axis}"] = float(virtual[f"bias_{axis}"].corr(rows[f"near_{axis}"]))
        told.append(row)
    return told


def of_drives(dataset: Dataset) -> None:
    """Judge other runs by the calibration of all of a dataset, and print."""
    known = calibration_of(dataset)
    if known is None:
        raise SystemExit("labels without moments, of an older version: run the retraining again")
    rows = [row for f in GIVEN.drives for row in judged(f, known, GIVEN.prediction_error)]
    table = pd.DataFrame(rows).set_index("drive").T
    print("| | " + " | ".join(map(str, table)) + " |\n" + "|---" * (len(table.columns) + 1) + "|")
    for name, values in table.iterrows():
        print(f"| {name} | " + " | ".join(f"{value:.3g}" for value in values) + " |")
    if GIVEN.json is not None:
        GIVEN.json.write_text(json.dumps(rows, indent=1) + "\n")


def main() -> None:
    """Judge and print."""
    runs = {run.name: run for run in sorted((GIVEN.retrained / "runs").iterdir())}
    done = {n: r for n, r in runs.items() if (r / "tables/samples/dataset.parquet").exists()}
    for name in sorted(set(runs) - set(done)):
        print(f"{name} is not done: left out")
    dataset = dataset_over(done)
    if GIVEN.drives:
        of_drives(dataset)
        return
    places = held_out(dataset, GIVEN.prediction_error)
    found = normalised(dataset, places, starts_of(GIVEN.retrained, dataset))
    kinds = {"all": np.ones(len(dataset), np.bool_)}
    kinds |= {
        name: (dataset.rows["lidar"] == name).to_numpy() for name in set(dataset.rows["lidar"])
    }
    all_told: dict[str, Any] = {
        name: figures(dataset.rows[kinds[name]], places[kinds[name]], found[kinds[name]])
        for name in sorted(kinds, key=lambda one: (one != "all", one))
    }
    names = list(all_told["all"])
    print("| | " + " | ".join(all_told) + " |")
    print("|---" * (len(all_told) + 1) + "|")
    for name in names:
        cells = []
        for told in all_told.values():
            value, low, high = told[name]
            ends = f" ({low:.2f} to {high:.2f})" if np.isfinite(low) else ""
            cells.append(f"{value:.3g}{ends}")
        print(f"| {name} | " + " | ".join(cells) + " |")
    if GIVEN.json is not None:
        GIVEN.json.write_text(json.dumps(all_told, indent=1) + "\n")


if __name__ == "__main__":
    main()
