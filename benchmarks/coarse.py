"""What a coarse run saves and what it costs: against a run of all places of the same routes.

    python benchmarks/coarse.py map.zarr --route route.geojson --every 4 8 16 --tolerance 0.05 0.1

All are estimates from the map alone by the model that ships, `physics` with `--model`. CPU time is
of this one process, warm, and without what is made of the map alone. Within tolerance is what a run
of all places says; what a coarse run says of itself stands beside it. A hot spot is a place over
the threshold; it is missed where it is only interpolated, below it. Misses and biases are of the
interpolated places, interpolated less evaluated, of each route the mean.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", help="a tile store, or what one is made of")
    parser.add_argument("--route", nargs="+", default=[], help="default: those of the map")
    parser.add_argument("--every", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--tolerance", type=float, nargs="+", default=[0.05], help="[m]")
    parser.add_argument("--threshold", type=float, default=0.25, help="of a hot spot [m]")
    parser.add_argument("--spacing", type=float, default=1.0, help="of the places [m]")
    parser.add_argument("--range-max", type=float, default=None, help="usable range [m]")
    parser.add_argument("--blind-rear-deg", type=float, default=0.0, help="hidden sector [deg]")
    parser.add_argument("--model", default=None, help="a model file, shipped, physics")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import tilestream as ts
from tilestream.errors import StoreError, UsageError
from tilestream.factors.stations import INTERPOLATED

COLUMNS = (
    *("every", "tolerance [cm]", "first round", "virtual drives", "rounds", "CPU s", "of all"),
    *("interpolated", "within tolerance", "of interpolated", "off, as checked"),
    *("mean miss [cm]", "largest", "bias", "of a route, at most", "hot spots missed"),
)


def estimated(out: Path, store: str, given: argparse.Namespace, **how: Any) -> float:
    """The CPU time of an estimate [s]."""
    began = time.process_time()
    ts.estimate(
        store,
        given.route,
        out=out,
        model=given.model,
        threshold=given.threshold,
        range_max=given.range_max,
        blind_rear_deg=given.blind_rear_deg,
        **{"spacing": given.spacing, **how},
    )
    return time.process_time() - began


def places_of(run: Path) -> pd.DataFrame:
    """The places of a run."""
    return ts.read_run(run).set_index(["route_id", "sample"])[["estimate", "status"]].sort_index()


def row(run: Path, whole: pd.DataFrame, seconds: float, all_seconds: float, limit: float) -> str:
    """A line of the table."""
    told = json.loads((run / "run.json").read_text())["coarse"]
    found = places_of(run).reindex(whole.index)
    between = (found["status"] == INTERPOLATED).to_numpy()
    difference = (found["estimate"] - whole["estimate"])[between] * 100.0
    of_routes = difference.groupby("route_id").mean()
    off = (found["estimate"] - whole["estimate"]).abs().to_numpy()
    known = whole["estimate"].notna().to_numpy() | between
    within = np.nan_to_num(off, nan=np.inf) <= told["tolerance"]
    hot = (whole["estimate"] > limit).to_numpy()
    missed = hot & between & (found["estimate"] <= limit).to_numpy()
    checked = "none"
    if told["checked"]:
        span = f"{told['off_low']:.0%} to {told['off_high']:.0%}"
        checked = f"{told['off']}/{told['checked']} ({span})"
    shares = (told["first"], told["evaluated"])
    figures = (
        told["every"],
        f"{100 * told['tolerance']:g}",
        *(f"{count / told['places']:.0%}" for count in shares),
        told["rounds"],
        f"{seconds:.0f}",
        f"{seconds / all_seconds:.0%}",
        f"{between.mean():.0%}",
        f"{within[known].mean():.1%}",
        f"{within[between].mean():.1%}" if between.any() else "none",
        checked,
        f"{difference.abs().mean():.2f}",
        f"{difference.abs().max():.1f}",
        f"{difference.mean():+.2f}",
        f"{of_routes[of_routes.abs().idxmax()]:+.2f}" if between.any() else "none",
        f"{missed.sum()}/{hot.sum()}",
    )
    return f"| {' | '.join(map(str, figures))} |"


def main(given: argparse.Namespace) -> None:
    """The table."""
    with tempfile.TemporaryDirectory() as name:
        folder, store = Path(name), given.map
        try:
            ts.open_store(store)
        except (StoreError, UsageError):
            store = str(folder / "map.zarr")
            ts.ingest(given.map, store)
        estimated(folder / "warm", store, given, spacing=given.spacing * 10)
        all_seconds = estimated(folder / "all", store, given)
        whole = places_of(folder / "all")
        print(f"{len(whole):,} places; all of them: {all_seconds:.0f} s of CPU\n")
        print(f"| {' | '.join(COLUMNS)} |")
        print("|---" * len(COLUMNS) + "|")
        for every in given.every:
            for tolerance in given.tolerance:
                out = folder / f"{every}-{tolerance:g}"
                seconds = estimated(out, store, given, coarse=every, tolerance=tolerance)
                print(row(out, whole, seconds, all_seconds, given.threshold), flush=True)


if __name__ == "__main__":
    main(GIVEN)
