"""Does a covariance per place help a filter? Vehicles drive along labelled drives, each believing
another covariance of its registrations.

    python benchmarks/filter.py RUN... --train RUN... [--seeds N] [--json FILE]

RUN is a run directory of the main job with labels and virtual drives, whose scans are about 2 m
apart. A vehicle has an odometry (the true increments with noise) and registers each scan of the log
in the run's map, by the run's matcher, from its own prediction; an error-state Kalman filter
(kalman.py) makes one pose of both. All have the same noise, first pose, and gate (chi-square of the
innovation, 99.9 %, and 1 m). Of the registration they believe:

constant, Autoware  what `ndt_scan_matcher` ships with: 0.15 m and 0.025 rad
Hessian             the inverse of the negative Hessian in x and y (LAPLACE_APPROXIMATION) …
starts              … or where six more starts end (MULTI_NDT), the rest as Autoware; both also as
                    shipped, where the constant is the least variance
constant, fitted    the mean second moments of errors on the training drives, in the route's frame
ours                from the map alone: virtual drives, calibrated on the training drives
ours, without bias  the same, after the expected error of the place is taken off the registration
true                the second moments of that very drive, of the scans within 3 m: of this scan's
                    own error too, which nobody knows before …
true, other scans   … without those of this scan: what its neighbours tell
constant, true      their mean over the drive: the best constant there is

Those with a factor are multiplied by it for errors that are alike along the way; it is chosen on
the training drives whose scans are as close as the tested ones'. No street is tested by what it has
trained. A vehicle that is more than 1.5 m off for more than 10 m, or more than 2 m, is lost, and
restarts at the truth. In brackets 5 to 95 % of a bootstrap over blocks of a street.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", help="run directories")
    parser.add_argument(
        "--train", type=Path, nargs="+", required=True, help="run directories to learn from"
    )
    parser.add_argument("--seeds", type=int, default=10, help="of the odometry's noise")
    parser.add_argument("--train-seeds", type=int, default=3, help="of that in training")
    parser.add_argument(
        "--odometry", action="append", default=[], help="e.g. scale=0.01; see kalman.Odometry"
    )
    parser.add_argument("--only", default="*", help="drives that are tested, e.g. '*/as-recorded'")
    parser.add_argument("--block", type=float, default=50.0, help="of the bootstrap [m]")
    parser.add_argument("--json", type=Path, help="write all figures into this file too")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from collections.abc import Sequence
from dataclasses import asdict
from fnmatch import fnmatch
from typing import Any

import numpy as np
import pandas as pd
from filter_covariances import AT_RUN_TIME, WITHOUT_BIAS, Contestant, Learnt, learnt_from
from filter_drives import Drive, drives_in
from filter_figures import by_drive, compared, correlation, figures, rows_of
from filter_run import run
from kalman import Odometry

from tilestream.model.covariance import as_json
from tilestream.moments import AXES
from tilestream.pipeline.jobs.train_over import dataset_over

FACTORS = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
"""By which fitted covariances may be multiplied."""
CLOSE = 1.5
"""How many times farther apart scans may be in training than where it is tested."""
FITTED = ("constant, fitted", "ours", WITHOUT_BIAS, "true")
BOUNDS = ("true, other scans", "constant, true")
CM = 100.0


def chosen(
    learnt: Learnt, drives: Sequence[Drive], odometry: Odometry, seeds: int
) -> dict[str, float]:
    """The factors that make the least 95 % horizontal error on training drives, in the mean of its
    logarithm over them: a street of large errors does not decide alone.
    """
    factors = {of: {f"{of}, x {factor:g}": factor for factor in FACTORS} for of in FITTED}
    tables = [run(one, contestants(learnt, one, factors), odometry, seeds) for one in drives]
    p95 = pd.DataFrame(by_drive(pd.concat(tables, ignore_index=True)))
    told = np.log(p95).mean(axis=1)
    return {of: one[min(one, key=told.__getitem__)] for of, one in factors.items()}


def contestants(
    learnt: Learnt, drive: Drive, factors: dict[str, dict[str, float]]
) -> list[Contestant]:
    """What is known before, by what it is of, each by its name with a factor."""
    believed = learnt.believed(drive)
    return [
        believed[of].contestant(name, factor)
        for of, named in factors.items()
        for name, factor in named.items()
    ]


def tested(given: argparse.Namespace, odometry: Odometry) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Rows of all test drives, and what was chosen for each."""
    training = [drive for path in given.train for drive in drives_in(path)]
    dataset = dataset_over({path.name: path for path in given.train})
    known: dict[tuple[str, ...], tuple[Learnt, dict[str, float]]] = {}
    tables, chose = [], {}
    for drive in (drive for path in given.runs for drive in drives_in(path)):
        if not fnmatch(drive.name, given.only):
            continue
        own = [one for one in training if one.street != drive.street]
        close = [one for one in own if one.spacing <= CLOSE * drive.spacing] or own
        names = tuple(one.name for one in own)
        if names not in known:
            others = np.flatnonzero(dataset.streets != drive.street)
            learnt = learnt_from(dataset.take(others))
            known[names] = learnt, chosen(learnt, close, odometry, given.train_seeds)
        learnt, choices = known[names]
        chose[drive.name] = {"chosen": choices, "calibration": as_json(learnt.calibration)}
        print(drive.name, chose[drive.name], flush=True)
        factors = {of: {of: choices[of], f"{of}, x 1": 1.0} for of in FITTED}
        factors |= {of: {of: 1.0} for of in BOUNDS}
        all_of_them = [*AT_RUN_TIME, *contestants(learnt, drive, factors)]
        tables.append(run(drive, all_of_them, odometry, given.seeds))
    return pd.concat(tables, ignore_index=True), chose


def report(table: pd.DataFrame, block: float) -> dict[str, Any]:
    """All figures."""
    rows = rows_of(table, block)
    arc = table.groupby(["drive", "contestant", "seed"], sort=False)["arc_length"]
    spacing = float(arc.diff().median())
    return {
        "spacing": spacing,
        "blocks": rows["ours"].counts.shape[1],
        "contestants": {name: figures(of) for name, of in rows.items()},
        "against": {ours: compared(rows, ours) for ours in ("ours", WITHOUT_BIAS)},
        "p95 by drive": by_drive(table),
        "correlation": {
            name: correlation(rows[name], spacing) for name in ("constant, fitted", "ours")
        },
    }


# --- In words


def told(one: dict[str, float], times: float = 1.0, digits: int = 2) -> str:
    """A figure with its bootstrap."""
    value, low, high = (times * one[name] for name in ("value", "low", "high"))
    return f"{value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def show(title: str, names: str, rows: list[tuple[str, ...]]) -> None:
    """Print a table as Markdown."""
    lines = [head := names.split(", "), ["---"] * len(head), *rows]
    print(f"\n### {title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines))


def tell(found: dict[str, Any]) -> None:
    """Print all figures."""
    each = found["contestants"]
    cost = {one.name: one.registrations for one in AT_RUN_TIME}
    sizes = ("horizontal", "3D", "along", "across")
    show(
        "Error of the filter [cm]: mean / 95 % / largest",
        f"covariance, {', '.join(sizes)}, lost, taken [%], registrations a scan",
        [
            (
                name,
                *(
                    f"{told(e['mean'], CM, 1)} / {told(e['p95'], CM, 1)} / {CM * e['max']:.0f}"
                    for e in (one["error"][size] for size in sizes)
                ),
                str(one["lost"]),
                told(one["taken"], CM, 1),
                str(cost.get(name, 1)),
            )
            for name, one in each.items()
        ],
    )
    for what in ("registration", "filter"):
        show(
            f"Mean normalised squared error of the {what}",
            f"covariance, {', '.join(AXES)}",
            [
                (name, *(told(x) for x in one[f"consistency of the {what}"].values()))
                for name, one in each.items()
            ],
        )
    show(
        "Coverage of the registration's horizontal ellipses [%]",
        f"covariance, {', '.join(f'{float(s):.0%}' for s in each['ours']['coverage'])}",
        [(name, *(told(x, CM, 1) for x in one["coverage"].values())) for name, one in each.items()],
    )
    against = found["against"]
    show(
        "95 % horizontal error against others [%], and the share of the gain of the true ones",
        f"against, {'; '.join(against).replace(', ', ' ')}".replace("; ", ", "),
        [
            (name, *(told(one[name], CM, 1) for one in against.values()))
            for name in next(iter(against.values()))
        ],
    )
    drives = found["p95 by drive"]
    show(
        "95 % horizontal error by drive [cm]",
        f"covariance, {', '.join(drives)}",
        [(name, *(f"{CM * one[name]:.1f}" for one in drives.values())) for name in each],
    )
    for name, axes in found["correlation"].items():
        distances = next(iter(axes.values()))["inflation"]
        show(
            f"Errors along the way, normalised by: {name}",
            f"axis, length [m], {', '.join(f'inflation every {d} m' for d in distances)}",
            [
                (axis, told(one["length"], digits=1), *map(told, one["inflation"].values()))
                for axis, one in axes.items()
            ],
        )


def main(given: argparse.Namespace) -> None:
    """Drive, judge, print."""
    changes = {k: float(v) for k, v in (one.split("=", 1) for one in given.odometry)}
    odometry = Odometry(**changes)
    table, choices = tested(given, odometry)
    found = report(table, given.block)
    found |= {"odometry": asdict(odometry), "seeds": given.seeds, "chosen": choices}
    tell(found)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(GIVEN)
