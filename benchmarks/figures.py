"""Pictures of the factors: `python benchmarks/figures.py [--spacing M] [--figures FOLDER]`.

Routes and maps come from one drive through what a city can be: canyon, crossing, tunnel, park,
empty lot. A sample point sees 100 m, through walls (definitions, section 2), so each section shows
in its neighbours, and the ends of the map in the first and last of them. The score fields come from
a tunnel, a crossing and a canyon each alone. Needs matplotlib.
"""

import argparse
from pathlib import Path

FIGURES = Path(__file__).resolve().parent / "figures"


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacing", type=float, default=0.2, help="of the sampled surfaces [m]")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder of the pictures")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import tempfile

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from pandas import DataFrame
from scipy.spatial import cKDTree
from street_tiles import SECTION, SECTIONS, Floats, drive, section

import tilestream as ts
from tilestream.factors.catalogue import COLUMNS, columns_of
from tilestream.factors.local_similarity import TEMPERATURE
from tilestream.factors.table import TermsCache, factors
from tilestream.factors.vicinity import vicinity_sums
from tilestream.formats.points.pcd import write_pcd

mpl.use("Agg")
EYE, MIDDLE = 2.08, 50.0
"""Height of the lidar, and y of the road's middle [m]."""
LENGTH = SECTION * len(SECTIONS)
SHADES = {
    "canyon": "#e3e3e3",
    "crossing": "#d6e6f4",
    "tunnel": "#bdbdbd",
    "park": "#dcefd5",
    "empty_lot": "#fbf1d6",
}
UNIT = {column.name: column.unit for column in COLUMNS}
LINE = "#17375e"


def along(cache: TermsCache, x: Floats, y: Floats) -> DataFrame:
    """All factors at places of the drive, 2 m above its road."""
    positions = np.column_stack([x, y, np.full(len(x), EYE)])
    return factors(cache.store, positions, ts.VLP16, 2.0, "all", cache)


def route_figure(x: Floats, table: DataFrame, names: list[str], title: str) -> Figure:
    """A panel per factor along the route, on the colours of the sections."""
    rows = -(-len(names) // 4)
    figure, grid = plt.subplots(rows, 4, figsize=(12.5, 1.45 * rows + 1.1), sharex=True)
    for axes, name in zip(grid.flat, names, strict=False):
        for k, part in enumerate(SECTIONS):
            axes.axvspan(k * SECTION, (k + 1) * SECTION, color=SHADES[part], lw=0)
        style = {"ls": "", "marker": ".", "ms": 1.5} if name == "weak_axis" else {"lw": 1.0}
        axes.plot(x, table[name], color=LINE, **style)
        unit = "" if UNIT[name] == "1" else f" [{UNIT[name]}]"
        axes.set_title(name + unit, fontsize=8.5, pad=2)
        axes.set_xlim(0, LENGTH)
        axes.margins(y=0.12)
        axes.tick_params(labelsize=7, length=2)
    for axes in grid.flat[len(names) :]:
        axes.set_visible(False)
    for axes in grid.flat[max(0, len(names) - 4) : len(names)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("along the route [m]", fontsize=8)
    handles = [Patch(color=shade, label=name.replace("_", " ")) for name, shade in SHADES.items()]
    figure.legend(handles=handles, loc="upper right", ncols=5, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    figure.tight_layout(rect=(0, 0, 1, 0.98), h_pad=0.6)
    return figure


def on_the_ground(points: Floats, step: float) -> tuple[Floats, Floats]:
    """Places on a grid with ground under them and nothing within 1.5 m at the lidar's height."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(1, LENGTH, step), np.arange(1, 100, step)))
    low = points[points[:, 2] < 0.5]
    high = points[(points[:, 2] > 1.0) & (points[:, 2] < 3.0)]
    floor, obstacle = (
        cKDTree(part[:, :2]).query(np.column_stack([x, y]))[0] for part in (low, high)
    )
    free = (floor < 1.0) & (obstacle > 1.5)
    return x[free], y[free]


def map_figure(points: Floats, x: Floats, y: Floats, table: DataFrame) -> Figure:
    """The entropy of the normals over the whole drive, the paper's and its robust twin."""
    names = {
        "normal_H_16": "normal_H_16: the paper's entropy of the normals, 16 x 16 bins [bit]",
        "wall_H": "wall_H: its robust twin, directions of walls only [bit]",
    }
    figure, grid = plt.subplots(2, 1, figsize=(12.5, 5.2), sharex=True)
    walls = points[points[:, 2] > 1.0][::40]
    for axes, (name, title) in zip(grid, names.items(), strict=True):
        shown = axes.scatter(x, y, c=table[name], s=9, marker="s", lw=0, cmap="viridis")
        axes.plot(walls[:, 0], walls[:, 1], ",", color="0.35", alpha=0.5)
        figure.colorbar(shown, ax=axes, pad=0.01, aspect=12, shrink=0.8)
        axes.set_title(title, fontsize=10, loc="left", pad=16)
        axes.set_aspect("equal")
        axes.set_xlim(0, LENGTH)
        axes.set_ylim(0, 100)
        axes.set_ylabel("y [m]", fontsize=8)
        axes.tick_params(labelsize=8)
        for k, part in enumerate(SECTIONS):
            middle = ((k + 0.5) * SECTION, 103.0)
            axes.text(*middle, part.replace("_", " "), ha="center", fontsize=8, color="0.25")
    grid[-1].set_xlabel("x [m]", fontsize=8)
    figure.tight_layout()
    return figure


def field_figure(stores: dict[str, ts.TileStore]) -> Figure:
    """The score field in the middle of each place: as the paper has it, and as a softmax."""
    figure, grid = plt.subplots(2, len(stores), figsize=(10.5, 6.9))
    for (name, store), column in zip(stores.items(), grid.T, strict=True):
        cache = TermsCache(store, 2.0)
        place = np.array([[SECTION / 2, MIDDLE, EYE]])
        sums = vicinity_sums(place, ts.VLP16, cache.around(place, ts.VLP16.range_max))
        table = along(cache, place[:, 0], place[:, 1])
        score = (sums["score"] / sums["points"][:, None]).reshape(21, 21)
        soft = np.exp((score - score.max()) / TEMPERATURE)
        panels = (
            (score / score.max(), None, "score / highest", "score_H"),
            (soft.clip(1e-4), LogNorm(1e-4, 1.0), "softmax / highest", "score_soft_H"),
        )
        for axes, (field, norm, what, entropy) in zip(column, panels, strict=True):
            extent = (-2.1, 2.1, -2.1, 2.1)
            shown = axes.imshow(field.T, origin="lower", extent=extent, cmap="magma", norm=norm)
            bits = table[entropy].iloc[0]
            axes.set_title(f"{name}: {what}\n{entropy} = {bits:.3f} bit", fontsize=9.5)
            axes.set_xlabel("shift along the road, v_x [m]", fontsize=8)
            axes.tick_params(labelsize=8)
            figure.colorbar(shown, ax=axes, fraction=0.045, pad=0.02).ax.tick_params(labelsize=7)
    for axes in grid[:, 0]:
        axes.set_ylabel("shift across, v_y [m]", fontsize=8)
    figure.tight_layout()
    return figure


def store_of(points: Floats, folder: Path) -> ts.TileStore:
    """A store of these points, thinned to 0.2 m."""
    folder.mkdir()
    write_pcd(folder / "points.pcd", points)
    return ts.ingest([folder / "points.pcd"], folder / "map.zarr", map_leaf=0.2)


def save(figure: Figure, path: Path) -> None:
    """Write a picture and say so."""
    figure.savefig(path, dpi=78)
    plt.close(figure)
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


def main(given: argparse.Namespace) -> None:
    """Make the maps, look at them everywhere, draw."""
    given.figures.mkdir(parents=True, exist_ok=True)
    points = drive(0, given.spacing)
    with tempfile.TemporaryDirectory() as name:
        cache = TermsCache(store_of(points, Path(name) / "drive"), 2.0)
        x = np.arange(2.0, LENGTH - 1.0, 1.0)
        table = along(cache, x, np.full(len(x), MIDDLE))
        paper, robust = ([c.name for c in columns_of(kind)] for kind in ("faithful", "robust"))
        grid_x, grid_y = on_the_ground(points, 2.0)
        stores = {
            place: store_of(section(place, 0, given.spacing), Path(name) / place)
            for place in ("tunnel", "crossing", "canyon")
        }
        pictures = {
            "route_faithful": route_figure(x, table, paper, "The paper's 20 factors along a drive"),
            "route_robust": route_figure(x, table, robust, "Their robust twins along it"),
            "normal_entropy_map": map_figure(points, grid_x, grid_y, along(cache, grid_x, grid_y)),
            "score_fields": field_figure(stores),
        }
        for picture, figure in pictures.items():
            save(figure, given.figures / f"{picture}.png")


if __name__ == "__main__":
    main(GIVEN)
