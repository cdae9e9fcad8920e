"""The report's page of a large map: how large it is, and what it costs to make and to open.

python benchmarks/page.py RUN --places 1000 10000 100000

The places of a finished run are laid beside one another until there are so many, each copy a route
of its own, over the map of the run; the page is opened in headless Chromium from disk. Seconds of
writing are those of one process.
"""

import argparse

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", help="a finished run")
    parser.add_argument("--places", type=int, nargs="+", default=[10_000])
    options = parser.parse_args()

import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import chromium
import numpy as np
import pandas as pd

import tilestream as ts
from tilestream.from_above import seen_from_above
from tilestream.grid import Box
from tilestream.report import Findings, write_report
from tilestream.report.measured import MEASURED_COLUMNS

BESIDE = 60.0
PIXELS = 1_200_000
PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime / 1000"


def laid_out(places: pd.DataFrame, wanted: int) -> pd.DataFrame:
    """So many places: copies of a run's, each a route of its own beside the one before."""
    wide = np.ptp(places["x"]) + BESIDE
    copies = [
        places.assign(
            route_id=places["route_id"].astype(str) + f" {number}",
            x=places["x"] + wide * (number % 10),
            y=places["y"] + wide * (number // 10),
        )
        for number in range(-(-wanted // len(places)))
    ]
    return pd.concat(copies, ignore_index=True).head(wanted)


def findings(run: Path, wanted: int) -> Findings:
    """The report of a run, as if it had so many places."""
    places = pd.read_parquet(run / "report" / "places.parquet").drop(columns="geometry")
    for column in MEASURED_COLUMNS:
        if column.name in places:
            places[column.name] = places[column.name].astype("float64")
    many = laid_out(places, wanted)
    store = ts.open_store(run / "map.zarr")
    at = many[["x", "y"]].to_numpy(np.float64)
    above = seen_from_above(store, sorted(store.marks()), Box.around(at, BESIDE), PIXELS)
    return Findings(f"{wanted:,} places", many, above=above)


def opened(page: Path) -> dict[str, float]:
    """What it costs to open a page: seconds until something is seen and until all is drawn, and
    the memory of the tab's scripts [MB].
    """
    with chromium.chromium_page() as tab:
        began = time.monotonic()
        tab.goto(page.as_uri())
        tab.wait_for("document.documentElement.dataset.charts")
        drawn = time.monotonic() - began
        tab.command("Performance.enable")
        tab.command("HeapProfiler.collectGarbage")
        metrics = {m["name"]: m["value"] for m in tab.command("Performance.getMetrics")["metrics"]}
        moved = tab.evaluate(
            "(async () => { const from = performance.now(); const form ="
            "document.getElementById('choose'); form.elements.least.value = '10';"
            "form.dispatchEvent(new Event('input'));"
            "await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));"
            "return (performance.now() - from) / 1000; })()"
        )
        return {
            "first paint": float(tab.wait_for(PAINT)),
            "drawn": drawn,
            "heap": metrics["JSHeapUsedSize"] / 1e6,
            "search": float(moved),
        }


def main() -> None:
    """Print a table."""
    print(
        "| places | page MB | first paint s | all drawn s | heap MB | a search s | written in s |"
    )
    print("|---|---|---|---|---|---|---|")
    for wanted in options.places:
        found = findings(Path(options.run), wanted)
        with tempfile.TemporaryDirectory() as folder:
            began = time.monotonic()
            write_report(found, folder)
            written = time.monotonic() - began
            page = Path(folder) / "index.html"
            cost = opened(page)
            size = page.stat().st_size / 1e6
        print(
            f"| {wanted:,} | {size:.1f} | {cost['first paint']:.2f} | {cost['drawn']:.2f} |"
            f" {cost['heap']:.0f} | {cost['search']:.2f} | {written:.1f} |"
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"\npeak memory of the writer: {peak:,.0f} MB")


if __name__ == "__main__":
    main()
