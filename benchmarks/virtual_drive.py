"""What the virtual drive costs, and how well it says where a real one errs.

    python benchmarks/virtual_drive.py cost [--tiles 1 4 9]
    python benchmarks/virtual_drive.py city RUN [--every 10] [--set without_ghosts=false]

cost: CPU time of one core per sample point, on street tiles of a million points, VLP-16, 100 m, and
per tile of larger cities. city: RUN is what `tilestream run pipelines/shinjuku.yaml` made; at every
n-th sample point the virtual scan is held against the simulator's own scan, by range, and the
virtual drive against the measured errors, beside two ceilings: the scans themselves from as few
starts, and a repeated drive. Nothing is written into RUN.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_subparsers(dest="part", required=True)
    cost_of = parts.add_parser("cost", help="of the virtual drive, by step")
    cost_of.add_argument("--tiles", type=int, nargs="+", default=[1, 4, 9], help="sizes of a city")
    cost_of.add_argument("--spacing", type=float, default=0.13, help="of the surfaces [m]")
    city_of = parts.add_parser("city", help="against the errors of a simulated city")
    city_of.add_argument("--every", type=int, default=10, help="use each n-th sample point")
    city_of.add_argument("run", type=Path, help="a finished run directory")
    city_of.add_argument("--set", action="append", default=[], help="of the virtual drive")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import itertools
import tempfile
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import yaml
from scipy.stats import spearmanr
from street_tiles import TILE, Floats, long_street

import tilestream as ts
from tilestream.factors.beams import Beams
from tilestream.factors.hessian import hessian_factors
from tilestream.factors.observability import (
    in_view,
    observability,
    whole_places,
)
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import surfel_mm, surfels_in, tile_surfels
from tilestream.factors.virtual_drive import ends_of, stratified_starts, virtual_drive
from tilestream.factors.virtual_scan import look, scan_in_world, virtual_scan
from tilestream.factors.worlds import passed_by
from tilestream.formats.logs import open_log
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import route_of
from tilestream.grid import MM_PER_M, Box
from tilestream.kernels.virtual_scan import cast
from tilestream.local_map import LocalCells
from tilestream.pipeline.jobs.along_routes import observe_along
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.settings import VirtualSettings

BINS = (0.0, 5.0, 10.0, 20.0, 30.0, 50.0, 100.0)
"""Ranges by which scans are compared [m]."""
AGREE = 0.2
"""Beams whose ranges differ by less agree [m]."""
LOOKED_AT = 6
"""Of so many sample points one has its beams compared."""
PAIRS = {"mean": "error_mean", "tail": "error_tail", "floor": "error_floor", "p_fail": "p_fail"}
MATCHERS = {
    "definite": ts.RegistrationSettings(),
    "autoware": ts.RegistrationSettings.autoware(),
}


def cpu_ms(work: Callable[[], Any], repeats: int = 7) -> float:
    """The least CPU time of several runs [ms]; the first compiles and does not count."""
    work()
    found = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        found.append(time.process_time() - began)
    return 1000.0 * min(found)


def show(title: str, rows: pd.DataFrame) -> None:
    """Print a table as Markdown."""
    print(f"\n### {title}\n")
    lines = [list(rows.columns), ["---"] * rows.shape[1], *rows.astype(str).to_numpy().tolist()]
    print("\n".join(f"| {' | '.join(line)} |" for line in lines), flush=True)


# --- 1. Cost


def street(folder: Path, tiles: int, spacing: float) -> ts.TileStore:
    """A street of that many tiles; its surfaces at 0.13 m, of a million points each."""
    folder.mkdir(parents=True)
    for number, points in enumerate(long_street(tiles, 0, spacing)):
        write_pcd(folder / f"{number:03}.pcd", points)
    return ts.ingest([folder / "*.pcd"], folder / "map.zarr", tile_size=TILE)


def cost(folder: Path, spacing: float) -> pd.DataFrame:
    """What each step costs at a sample point in the middle of three tiles."""
    store = street(folder, 3, spacing)
    places = np.array([[1.5 * TILE + x, TILE / 2 + 0.5, 2.08] for x in range(-12, 13)])
    place_mm, heading, seeing = whole_places(places[12]), 0.1, VirtualSettings()
    key, edge_mm = store.grid.key_at(*places[12, :2]), surfel_mm(store)
    beams = Beams.of(ts.VLP16, seeing)
    surfels = surfels_in(store, Box.around(places, 101.0))
    cells = store.cells_in(Box.around(places, 110.0), 2.0)

    def scene() -> Scene:
        near = in_view(surfels, places, ts.VLP16.fov_deg, 100.0)
        return Scene.of(near, whole_places(places), edge_mm)

    made = scene()
    found = look(made, place_mm, heading, seeing, beams)
    scan = virtual_scan(made, found, place_mm, seeing, beams)
    T_map_lidar = upright(place_mm, heading)
    points = len(store.tile(key).points())
    rows = [
        ("surfels of a tile", f"{points:,} points", cpu_ms(lambda: tile_surfels(store, key), 2)),
        ("scene, per sample point", "25 share one", cpu_ms(scene, 3) / 25),
        (
            "balls passed by in a draw",
            "25 share them",
            cpu_ms(lambda: passed_by(surfels.centre_mm, ~surfels.flat, 0, 3), 3) / 25,
        ),
        (
            "beams cast",
            f"{len(beams.direction)} beams",
            cpu_ms(lambda: look(made, place_mm, heading, seeing, beams)),
        ),
        (
            "a scan of them",
            f"{len(scan.points)} returns",
            cpu_ms(lambda: virtual_scan(made, found, place_mm, seeing, beams)),
        ),
        (
            "a scan in another street",
            f"{len(beams.direction)} beams",
            cpu_ms(lambda: scan_in_world(found, place_mm, seeing, beams, 3)),
        ),
    ]
    for name, settings in MATCHERS.items():
        listing = partial(LocalCells.around, cells, places, 110.0, settings)
        rows.append(("cells listed", f"{name}, 25 share them", cpu_ms(listing, 4) / 25))
        at = (listing(), scan.points, T_map_lidar, settings)
        rows.append(("Hessian", name, cpu_ms(partial(hessian_factors, *at), 4)))
        for count in (32, 317):
            starts = partial(ends_of, *at, stratified_starts(count))
            rows.append((f"{count} starts", name, cpu_ms(starts, 4)))
    rows += place_rows(store, places, heading, seeing)
    table = pd.DataFrame(rows, columns=["step", "of", "ms of one core"])
    return table.round({"ms of one core": 1})


def place_rows(
    store: ts.TileStore, places: Floats, heading: float, seeing: VirtualSettings
) -> list[tuple[str, str, float]]:
    """What a place costs with all its draws: its own, and its share of what places near it share.

    The same places given four times share no more than once.
    """

    def seen(times: int) -> float:
        where = np.repeat(places, times, axis=0)
        along = np.full(len(where), heading)
        matcher = MATCHERS["autoware"]
        return cpu_ms(lambda: observability(store, where, along, ts.VLP16, seeing, matcher), 2)

    once, four = seen(1), seen(4)
    own = (four - once) / 3.0
    draws = f"autoware, {seeing.draws} draws"
    return [
        ("a place, its own", draws, own / len(places)),
        ("what it shares", f"{len(places)} do", (once - own) / len(places)),
    ]


def upright(place_mm: Any, heading: float) -> Floats:
    """(4, 4) the pose of an upright lidar."""
    c, s = np.cos(heading), np.sin(heading)
    T_map_lidar = np.eye(4)
    T_map_lidar[:2, :2] = [[c, -s], [s, c]]
    T_map_lidar[:3, 3] = place_mm / MM_PER_M
    return T_map_lidar


def cost_of_cities(folder: Path, sizes: list[int], spacing: float) -> pd.DataFrame:
    """What a tile costs in larger and larger cities, everything together."""
    rows = []
    for tiles in sizes:
        store = street(folder / str(tiles), tiles, spacing)
        ends = np.array([[0.5, TILE / 2 + 0.5, 0.08], [tiles * TILE - 0.5, TILE / 2 + 0.5, 0.08]])
        route = route_of("street", ends)
        began = time.process_time()
        found = observe_along(store, [route], folder / str(tiles) / "out", spacing=5.0)
        seconds = time.process_time() - began
        done = (found["status"] == "done").sum()
        rows.append((tiles, f"{done} of {len(found)}", round(seconds / tiles, 2)))
    return pd.DataFrame(rows, columns=["tiles", "sample points done", "CPU s per tile"])


# --- 2. A simulated city


def errors_of(run: Path, group: str) -> pd.DataFrame:
    """The measured errors of a drive, by sample point; those that are done."""
    parts = [
        pd.read_parquet(path) for path in sorted((run / "tables/errors" / group).glob("*.parquet"))
    ]
    table = pd.concat(parts)
    return table[table["status"] == "done"].set_index("sample", drop=False).sort_index()


def city(run: Path, every: int, changes: dict[str, Any]) -> None:
    """Virtual scans and drives of a simulated city against those that the simulator made."""
    settings = read_settings(run / "config.yaml")
    assert settings.simulate is not None
    assert settings.observe is not None
    seeing = VirtualSettings(**(settings.observe.model_dump() | changes))
    store = ts.open_store(str(run / "map.zarr"))
    logs = Path(settings.simulate.folder or run / "simulation") / "logs"
    tables, ranges, spent = [], [], 0.0
    for group in sorted(path.name for path in (run / "tables/errors").glob("drive0-*")):
        labels = errors_of(run, group)
        labels = labels[labels["sample"] % every == 0]
        places, headings = labels[["x", "y", "z"]].to_numpy(), labels["heading"].to_numpy()
        how = (settings.looking_sensor, seeing, settings.label.registration)
        began = time.process_time()
        found = observability(store, places, headings, *how)
        spent += time.process_time() - began
        log = logs / "drive0" / f"{group.removeprefix('drive0-')}.mcap"
        few = themselves(store, log, labels, seeing, settings)
        ranges += [compared(store, log, labels[::LOOKED_AT], seeing, settings)]
        again = errors_of(run, group.replace("drive0", "drive1")).reindex(labels.index)
        tables.append(
            labels[list(PAIRS.values())]
            .reset_index(drop=True)
            .join(found.filter(regex="^vd_"))
            .join(few.add_prefix("few_"))
            .join(again[list(PAIRS.values())].reset_index(drop=True).add_prefix("again_"))
            .assign(path=group)
        )
    table = pd.concat(tables, ignore_index=True)
    print(f"{len(table)} sample points, {1000.0 * spent / len(table):.0f} ms of one core each")
    show("Beams of the simulator's scans, cast in the map", agreement(np.concatenate(ranges)))
    estimates = {
        "virtual drive": {name: f"vd_{name}" for name in PAIRS},
        "its own scan, as many starts": {name: f"few_vd_{name}" for name in PAIRS},
        "a repeated drive": {name: f"again_{label}" for name, label in PAIRS.items()},
    }
    show("Against the measured errors", against(table, estimates))


def themselves(
    store: ts.TileStore,
    log: Path,
    labels: pd.DataFrame,
    seeing: VirtualSettings,
    settings: RunSettings,
) -> pd.DataFrame:
    """The columns of the virtual drive from the scans themselves."""
    starts = stratified_starts(None if seeing.starts is None else seeing.draws * seeing.starts)
    rows = []
    for scan in open_log(str(log)).scans_at(labels["scan"].tolist()):
        assert scan.T_map_lidar is not None
        box = Box.around(scan.T_map_lidar[None, :3, 3], settings.looking_sensor.range_max + 10.0)
        cells = store.cells_in(box, settings.cell_size)
        how = (settings.label.registration, starts)
        rows.append(virtual_drive([ends_of(cells, scan.points, scan.T_map_lidar, *how)]))
    return pd.DataFrame(rows)


def compared(
    store: ts.TileStore,
    log: Path,
    labels: pd.DataFrame,
    seeing: VirtualSettings,
    settings: RunSettings,
) -> Floats:
    """(n, 2) true and virtual range along the beams that came back in the scans [m]."""
    reach, edge_mm = Beams.of(settings.looking_sensor, seeing).range_max, surfel_mm(store)
    found = []
    for scan in open_log(str(log)).scans_at(labels["scan"].tolist()):
        assert scan.T_map_lidar is not None
        place = scan.T_map_lidar[:3, 3]
        at, near = whole_places(place), seeing.range_min * MM_PER_M
        surfels = surfels_in(store, Box.around(place[None], reach + 1.0))
        surfels = surfels.where(~(surfels.ghost & seeing.without_ghosts))
        scene = Scene.of(surfels, at[None], edge_mm)
        true = np.linalg.norm(scan.points, axis=1)
        beams = np.ascontiguousarray(scan.points / true[:, None] @ scan.T_map_lidar[:3, :3].T)
        met, cosine, row = np.empty(len(true)), np.empty(len(true)), np.empty(len(true), np.int32)
        cast(scene.bricks, at, beams, near, reach * MM_PER_M, met, cosine, row)
        found.append(np.column_stack([true, met]))
    return np.concatenate(found)


def agreement(ranges: Floats) -> pd.DataFrame:
    """Share of beams whose virtual range is right, too short, too long, missing."""
    true, met = ranges.T
    rows = []
    for low, high in [*itertools.pairwise(BINS), (BINS[0], BINS[-1])]:
        some = (true >= low) & (true < high)
        if some.any():
            off = met[some] - true[some]
            shares = [np.abs(off) < AGREE, off <= -AGREE, (off >= AGREE) & np.isfinite(off)]
            texts = [f"{share.mean():.1%}" for share in (*shares, np.isinf(off))]
            rows.append((f"{low:g}-{high:g} m", some.sum(), *texts))
    names = ["range", "beams", "within 0.2 m", "too short", "too long", "no return"]
    return pd.DataFrame(rows, columns=names)


def against(table: pd.DataFrame, estimates: dict[str, dict[str, str]]) -> pd.DataFrame:
    """How estimates rank and meet the labels; the offset is fitted on the other paths.

    skill = 1 - MAE / MAE of the median of the other paths.
    """
    rows = []
    for title, columns in estimates.items():
        for name, column in columns.items():
            both = table[[column, PAIRS[name], "path"]].dropna()
            x, y = both[column].to_numpy(), both[PAIRS[name]].to_numpy()
            fitted, median = np.empty(len(x)), np.empty(len(x))
            for path in both["path"].unique():
                here = (both["path"] == path).to_numpy()
                fitted[here] = x[here] + np.median(y[~here] - x[~here])
                median[here] = np.median(y[~here])
            skill = 1.0 - np.abs(fitted - y).mean() / np.abs(median - y).mean()
            figures = (f"{spearmanr(x, y)[0]:.2f}", f"{skill:.2f}")
            rows.append(
                (title, PAIRS[name], len(x), *figures, f"{x.mean():.3f}", f"{y.mean():.3f}")
            )
    names = ["estimate", "of", "points", "Spearman", "skill", "its mean", "measured"]
    return pd.DataFrame(rows, columns=names)


def changed(settings: list[str]) -> dict[str, Any]:
    """Settings of the virtual drive, from `key=value`."""
    return {key: yaml.safe_load(value) for key, value in (s.split("=", 1) for s in settings)}


def main(given: argparse.Namespace) -> None:
    """Measure what is asked for."""
    if given.part == "city":
        city(given.run, given.every, changed(given.set))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            show("Per sample point", cost(Path(scratch) / "street", given.spacing))
            cities = cost_of_cities(Path(scratch) / "city", given.tiles, given.spacing)
            show("Per tile", cities)


if __name__ == "__main__":
    main(GIVEN)
