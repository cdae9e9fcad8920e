"""A real drive end to end: map from every second scan, the others localized from 317 starts each.

    python benchmarks/drive.py [LOG] [--out FOLDER] [--workers N] [--figures FOLDER]

As recorded, and as simpler sensors would have seen it, with the default and the production matcher.
Prints the tables of RESULTS.md and draws drive_errors.png (needs matplotlib). LOG is an MCAP log
with point clouds and poses; default: the drive under TILESTREAM_DATA.
"""

import argparse
import os
from pathlib import Path

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TILESTREAM_DATA", HERE.parents[1] / "shared" / "data"))


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("log", type=Path, nargs="?", default=DATA / "kitti_drive" / "drive.mcap")
    parser.add_argument("--out", type=Path, help="keep map and tables here; continues there")
    parser.add_argument("--workers", type=int, default=1, help="worker processes")
    parser.add_argument("--figures", type=Path, default=HERE / "figures", help="draw into this")
    given = parser.parse_args()
    if not given.log.exists():
        parser.error(f"no log at {given.log}: name one, or set TILESTREAM_DATA")
    return given


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import tempfile

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

import tilestream as ts
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.settings import DEFAULT_MEMORY

mpl.use("Agg")
MAPPED = ts.ScanSelection(every=2, offset=0)
LOCALIZED = ts.ScanSelection(every=2, offset=1)
MATCHERS = {
    "definite": ts.RegistrationSettings(),
    "autoware": ts.RegistrationSettings.autoware(),
}
SENSORS: dict[str, dict[str, float]] = {
    "as recorded": {},
    "16 beams, 30 m": {"beams": 16, "range_max": 30.0},
    "16 beams, 30 m, rear 120 deg blind": {"beams": 16, "range_max": 30.0, "blind_rear_deg": 120.0},
    "16 beams, 20 m, rear 180 deg blind": {"beams": 16, "range_max": 20.0, "blind_rear_deg": 180.0},
    "16 beams, 15 m, rear 180 deg blind": {"beams": 16, "range_max": 15.0, "blind_rear_deg": 180.0},
}
WORST = 4
"""Bad spots that are listed."""


def measure(log: Path, folder: Path, workers: int) -> dict[tuple[str, str], pd.DataFrame]:
    """The errors of the drive by sensor and matcher; what is there is not measured again."""
    store = ts.ingest(log, folder / "map.zarr", scans=MAPPED)
    print(store)
    found = {}
    with dask_client(None, workers, DEFAULT_MEMORY) as client:
        for matcher, registration in MATCHERS.items():
            for sensor, simpler in SENSORS.items():
                found[sensor, matcher] = ts.localize(
                    store,
                    log,
                    folder / matcher / sensor.replace(" ", "_").replace(",", ""),
                    registration=registration,
                    scans=LOCALIZED,
                    reading=Reading(str(log), **simpler),  # type: ignore[arg-type]
                    client=client,
                )
    return found


def error_table(found: dict[tuple[str, str], pd.DataFrame]) -> str:
    """Markdown: the label of all scans in a few numbers, a row per sensor and matcher."""
    names = (
        "sensor, matcher, points, mean [cm], median, p95, max, > 10 cm, > 15, > 20, > 25, p_fail"
    )
    lines = [f"| {names.replace(', ', ' | ')} | failed |", "|---" * 13 + "|"]
    for (sensor, matcher), labels in found.items():
        done = labels[labels["status"] == "done"]
        error = 100.0 * done["error_mean"]
        centimetres = (error.mean(), error.median(), error.quantile(0.95), error.max())
        tails = ((error > limit).mean() for limit in (10.0, 15.0, 20.0, 25.0))
        columns = [
            *(sensor, matcher, f"{done['points'].mean():.0f}"),
            *(f"{value:.1f}" for value in centimetres),
            *(f"{100.0 * share:.0f} %" for share in tails),
            *(f"{done['p_fail'].mean():.3f}", f"{len(labels) - len(done)} of {len(labels)}"),
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def worst_table(labels: pd.DataFrame) -> str:
    """Markdown: where the error is largest, and in which direction."""
    lines = [
        "| scan | at | points | error | along | across | up | p_fail | converged | steps |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in labels.nlargest(WORST, "error_mean").to_dict("records"):
        parts = (row[name] for name in ("error_mean", "along_mean", "across_mean", "up_mean"))
        columns = [
            *(str(row["scan"]), f"{row['arc_length']:.0f} m", str(row["points"])),
            *(f"{100.0 * value:.1f} cm" for value in parts),
            *(f"{row['p_fail']:.2f}", f"{row['converged']:.2f}", f"{row['iterations']:.1f}"),
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def draw(store: ts.TileStore, found: dict[str, pd.DataFrame], path: Path) -> None:
    """The drive in its map, coloured by error, a panel per sensor, each with its own scale."""
    points = np.concatenate([store.tile(key).points() for key in store.keys()])
    labels = next(iter(found.values()))
    low = labels[["x", "y"]].min().to_numpy() - 28.0
    high = labels[["x", "y"]].max().to_numpy() + 28.0
    seen = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1) & (points[:, 2] > -1.2)
    figure, grid = plt.subplots(
        1, len(found), figsize=(11.0, 5.2), layout="constrained", squeeze=False
    )
    panels = grid[0]
    for axes, (title, table) in zip(panels, found.items(), strict=True):
        draw_panel(axes, points[seen][::2], table, title)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="map x [m]")
    panels[0].set_ylabel("map y [m]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80, pil_kwargs={"optimize": True})
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def draw_panel(axes: Axes, points: np.ndarray, labels: pd.DataFrame, title: str) -> None:
    """One drive in its map, the worst three places named."""
    axes.scatter(points[:, 0], points[:, 1], s=0.15, c="0.8", linewidths=0, rasterized=True)
    error = 100.0 * labels["error_mean"]
    dots = axes.scatter(
        labels["x"], labels["y"], c=error, s=42, cmap="viridis_r", edgecolors="k", linewidths=0.4
    )
    for place, row in enumerate(labels.nlargest(3, "error_mean").itertuples()):
        axes.annotate(
            f"scan {row.scan}: {100.0 * row.error_mean:.0f} cm",
            (row.x, row.y),
            xytext=(-14 + 30 * place, -44 - 15 * place),
            textcoords="offset points",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "lw": 0.5},
        )
    axes.get_figure().colorbar(
        dots, ax=axes, location="bottom", shrink=0.8, label="mean 3D error [cm]"
    )
    axes.set_title(title, fontsize=10)
    axes.set_aspect("equal")


def main(given: argparse.Namespace) -> None:
    """Measure, print, draw."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.out or Path(scratch)
        found = measure(given.log, folder, given.workers)
        print(f"\n{error_table(found)}")
        for sensor in SENSORS:
            print(f"\nworst, {sensor}, definite:\n\n{worst_table(found[sensor, 'definite'])}")
        by_mean = {sensor: found[sensor, "definite"]["error_mean"].mean() for sensor in SENSORS}
        chosen = ("as recorded", max(by_mean, key=by_mean.__getitem__))
        store = ts.open_store(str(folder / "map.zarr"))
        draw(store, {s: found[s, "definite"] for s in chosen}, given.figures / "drive_errors.png")


if __name__ == "__main__":
    main(GIVEN)
