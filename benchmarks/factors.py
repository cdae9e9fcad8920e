"""What the factors cost: `python benchmarks/factors.py [--tiles 4 100] [--literal 2]`.

Tables in Markdown, all from one run in one process on one thread; times are CPU times:

1. terms of a 100 x 100 m street tile of a million points: seconds and peak memory, by factor;
2. factors per sample point once the terms exist, against the literal evaluation of tests/literal.py
   on the same map at the same sample points (which also judges the values);
3. cost per tile of a street of more and more tiles, everything together.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--tiles", type=int, nargs="+", default=[4, 100], help="lengths of the street, in tiles"
    )
    parser.add_argument("--literal", type=int, default=2, help="sample points evaluated literally")
    parser.add_argument("--shifts", type=int, default=21, help="shifts of score_H timed literally")
    parser.add_argument("--spacing", type=float, default=0.13, help="of the tile's surfaces [m]")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import ctypes
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import literal
from street_tiles import TILE, Floats, long_street, street_tile

import tilestream as ts
from tilestream.factors.catalogue import CRITERIA, columns_of
from tilestream.factors.local_similarity import NEIGHBOUR_RADIUS
from tilestream.factors.table import factors_at
from tilestream.factors.terms import tile_terms
from tilestream.factors.vicinity import TileTerms, vicinity_sums
from tilestream.formats.points.pcd import write_pcd
from tilestream.kernels import pairs
from tilestream.kernels.cells import cell_of_points
from tilestream.kernels.neighbours import neighbours_within
from tilestream.ndt import cells_of_mm
from tilestream.pipeline.jobs.along_routes import factors_along
from tilestream.records import Route

CELL = 2.0
COARSE = 0.5
"""Spacing of the surfaces of a long street [m]: an eighth of a million points a tile."""


def seconds(function: Callable[[], Any], repeats: int = 3) -> float:
    """The least CPU time of several runs, the first of which compiles and does not count."""
    function()
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        function()
        best = min(best, time.process_time() - start)
    return best


def peak_mb(function: Callable[[], Any]) -> float:
    """How far the resident memory of a process that does only this rises [MB]."""
    ctypes.CDLL(None).malloc_trim(0)  # else freed memory is taken again and does not show
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        before = resident_mb()
        function()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        os.write(write, f"{peak - before}".encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        answer = pipe.read()
    os.waitpid(child, 0)
    return float(answer)


def resident_mb() -> float:
    """Memory of this process now [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def ingested(folder: Path, blocks: list[Floats], leaf: float) -> ts.TileStore:
    """A store of the points of all blocks."""
    folder.mkdir()
    for k, points in enumerate(blocks):
        write_pcd(folder / f"{k:04}.pcd", points)
    return ts.ingest([folder / "*.pcd"], folder / "map.zarr", tile_size=TILE, map_leaf=leaf)


def show(title: str, head: list[str], rows: list[list[str]]) -> None:
    """Print a table."""
    print(f"\n### {title}\n")
    for row in (head, ["---", *["---:"] * (len(head) - 1)], *rows):
        print("| " + " | ".join(row) + " |", flush=True)


def route_along(length: float) -> Floats:
    """Sample points at 1 m down the middle of the street, 2 m above its crown."""
    x = np.arange(0.5, length, 1.0)
    return np.column_stack([x, np.full(len(x), TILE / 2), np.full(len(x), 2.08)])


def cost_of_terms(store: ts.TileStore) -> None:
    """Table 1: what each factor adds to the terms of a tile."""
    (key,) = store.keys()
    points_mm = store.tile(key).points_mm()
    cells = cells_of_mm(points_mm, round(CELL * 1000))
    cell_of_point = cell_of_points(points_mm, cells.cell_mm, cells.index)
    lists = neighbours_within(cells.index, cells.mean, CELL, NEIGHBOUR_RADIUS)
    counts = pairs.pfh_counts(cells.mean, cells.normal, *lists)
    sufficiency, quality, layout, similarity = CRITERIA
    given = cells, points_mm, cell_of_point
    steps: dict[str, Callable[[], Any]] = {
        "cells (mean, covariance; all factors)": lambda: cells_of_mm(points_mm, cells.cell_mm),
        "cell of each point (all)": lambda: cell_of_points(points_mm, cells.cell_mm, cells.index),
        "`D1_count` ... `D3_ratio`": lambda: sufficiency.terms(*given),
        "`euclidean_dist`, `mahalanobis_dist`": lambda: quality.terms(*given),
        "`normal_H_8`, `_16`, `_90`": lambda: layout.terms(*given),
        "`score_H` and all of the following": lambda: similarity.terms(*given),
        "neighbours (PFH, Bhattacharyya)": lambda: neighbours_within(
            cells.index, cells.mean, CELL, NEIGHBOUR_RADIUS
        ),
        "`pfh_sim_H`": lambda: pairs.entropy_of_counts(
            pairs.pfh_counts(cells.mean, cells.normal, *lists)
        ),
        "`pfh_sim_mnht`": lambda: pairs.histogram_distances(counts, *lists),
        "`bhatt_sim`": lambda: pairs.bhattacharyya_sums(cells.mean, cells.regularised, *lists),
        "**all terms of the tile, from the store**": lambda: tile_terms(store, key, CELL),
    }
    rows = [[name, f"{seconds(step):.3f}", f"{peak_mb(step):.0f}"] for name, step in steps.items()]
    title = f"Terms of a tile: {len(points_mm):,} points, {len(cells):,} cells of {CELL:g} m"
    show(title, ["step", "s", "peak MB"], rows)


def without_points(terms: TileTerms) -> TileTerms:
    """The terms with nothing for the depth image."""
    return replace(terms, depth_mm=terms.depth_mm[:0])


def cost_of_sample_points(store: ts.TileStore, literal_points: int, shifts: int) -> None:
    """Table 2: a sample point from the terms, and literally."""
    (key,) = store.keys()
    terms = tile_terms(store, key, CELL)
    places = route_along(TILE)
    k = len(places)

    def per_point(function: Callable[[], Any]) -> float:
        return 1e3 * seconds(function) / k

    sums = vicinity_sums(places, ts.VLP16, [terms])
    columns = {
        name: per_point(lambda c=criterion: c.factors(sums))
        for name, criterion in zip(("FS", "RQ", "LY", "LS"), CRITERIA, strict=True)
    }
    everything = per_point(lambda: factors_at(places, ts.VLP16, [terms]))
    summing = per_point(lambda: vicinity_sums(places, ts.VLP16, [without_points(terms)]))
    image = per_point(lambda: vicinity_sums(places, ts.VLP16, [terms])) - summing
    alone = places[np.random.default_rng(0).permutation(k)]
    scattered = per_point(lambda: factors_at(alone, ts.VLP16, [terms]))
    rows = [
        ["membership and all sums (17 factors at once)", f"{summing:.3f}"],
        ["depth image (`occupancy_ratio`)", f"{image:.3f}"],
        *([f"columns of {name} from the sums", f"{ms:.3f}"] for name, ms in columns.items()),
        ["**all 20 and their robust twins, along the route**", f"**{everything:.3f}**"],
        ["the same, sample points in random order", f"{scattered:.3f}"],
    ]
    show(f"A sample point once the terms exist (mean of {k} at 1 m)", ["step", "ms"], rows)
    compare(
        store, factors_at(places, ts.VLP16, [terms]), places, everything, literal_points, shifts
    )


def compare(
    store: ts.TileStore,
    ours: dict[str, Floats],
    places: Floats,
    ms: float,
    literal_points: int,
    shifts: int,
) -> None:
    """The literal evaluation of a few sample points, factor by factor, in the same run.

    `score_H` alone would take minutes: of its 441 shifts every few are timed, and scaled up.
    """
    (key,) = store.keys()
    world = literal.world_of(store.tile(key).points(), CELL)
    chosen = np.linspace(0.2 * len(places), 0.8 * len(places), literal_points).astype(int)
    some = literal.SHIFTS[:: max(1, len(literal.SHIFTS) // shifts)]
    spent = {factor.__name__: 0.0 for factor in literal.FAITHFUL}
    worst = dict.fromkeys(spent, 0.0)
    for row in chosen:
        view = literal.view_from(world, places[row], ts.VLP16)
        for factor in literal.FAITHFUL:
            name, start = factor.__name__, time.process_time()
            if name == "score_H" and len(some) < len(literal.SHIFTS):
                for shift in some:
                    literal.score_of_shift(world, view.points, shift)
                spent[name] += (time.process_time() - start) * len(literal.SHIFTS) / len(some)
                worst[name] = np.nan
                continue
            value = factor(view)
            spent[name] += time.process_time() - start
            worst[name] = max(worst[name], abs(ours[name][row] / value - 1.0))
    rows = []
    for c in columns_of("faithful"):
        judged = "not judged" if np.isnan(worst[c.name]) else f"{worst[c.name]:.1e}"
        rows.append([f"`{c.name}`", f"{spent[c.name] / len(chosen):.4f}", judged])
    total = sum(spent.values()) / len(chosen)
    rows.append(["**all 20**", f"**{total:.1f}**", ""])
    rows.append(["**ours, all 20 and their twins**", f"**{ms / 1e3:.6f}**", ""])
    rows.append(["**ratio**", f"**{1e3 * total / ms:,.0f}**", ""])
    head = ["factor", "literal, s per sample point", "largest relative difference"]
    timed = f"`score_H` timed on {len(some)} of 441 shifts" if len(some) < 441 else "all 441 shifts"
    show(f"Literally, at {len(chosen)} of these sample points ({timed})", head, rows)


def cost_per_tile(folder: Path, tiles: list[int]) -> None:
    """Table 3: cells, terms and factors of whole streets, resumable tables written to disk."""
    rows = []
    for n in [min(tiles), *tiles]:  # the first run warms the caches and is not shown
        store = ingested(folder / f"{n}-{len(rows)}", list(long_street(n, 1, COARSE)), 0.2)
        ends = np.column_stack([[0.5, n * TILE - 0.5], [TILE / 2] * 2, [0.08] * 2])
        street = Route("street", ends, np.array([0.0, n * TILE - 1.0]), np.zeros(2))
        before, start = resident_mb(), time.process_time()
        table = factors_along(store, [street], folder / f"out-{n}-{len(rows)}")
        took = time.process_time() - start
        rows.append([str(n), f"{len(table):,}", f"{took / n:.3f}", f"{resident_mb() - before:.0f}"])
    head = ["tiles", "sample points", "s per tile", "memory grown MB"]
    show("Cost per tile: a street of tiles of 125 k points, cells to tables", head, rows[1:])


def main(given: argparse.Namespace) -> None:
    """Print the tables."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = ingested(folder / "tile", [street_tile(0, given.spacing)], 0.2)
        cost_of_terms(store)
        cost_of_sample_points(store, given.literal, given.shifts)
        cost_per_tile(folder, given.tiles)


if __name__ == "__main__":
    main(GIVEN)
