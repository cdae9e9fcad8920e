"""Pictures of the simulated Shinjuku: district and paths, scans and map at its special spots.

    python benchmarks/figures_simulation.py [--preset paper|physical] [--labels FOLDER]
        [--figures FOLDER]

Writes simulation_*.png (needs matplotlib); with the folder of labels that
shinjuku_labels.py left (`…/labels-10/drive0`) also a map of the errors.
"""

import argparse
from pathlib import Path

FIGURES = Path(__file__).resolve().parent / "figures"


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="physical")
    parser.add_argument("--labels", type=Path, help="folder of labels: draws them too")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder of the pictures")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from tilestream.simulation.city import City, build_city
from tilestream.simulation.drive import scans
from tilestream.simulation.settings import load_preset
from tilestream.simulation.survey import survey

mpl.use("Agg")
PLACES = (
    ("canyon: dense shopping street", "IV", 300),
    ("wide crossing", "I", 500),
    ("tunnel", "V", 646),
    ("bridge", "V", 305),
    ("one-sided street", "III", 220),
)
COLOURS = {
    "tunnel": "black",
    "crossing": "tab:orange",
    "bridge": "tab:purple",
    "one-sided": "tab:green",
    "furnished": "tab:olive",
    "narrow": "tab:red",
    "wide": "tab:cyan",
}


def draw_buildings(ax: Axes, city: City, colour: str) -> None:
    """The outlines of all buildings."""
    edges = np.stack([city.footprints.start, city.footprints.end], axis=1)
    ax.add_collection(LineCollection(list(edges), colors=colour, linewidths=0.4))


def district(city: City, path: Path) -> None:
    """Map of the district with the paths coloured by what their stretches are."""
    fig, ax = plt.subplots(figsize=(16, 9.5))
    draw_buildings(ax, city, "0.7")
    for street in city.streets:
        ax.plot(*street.xy.T, color="tab:blue" if street.driven else "0.4", lw=2)
        for spot in street.spots:
            stretch = street.at(np.arange(spot.begin, spot.end + 0.5))
            ax.plot(*stretch.T, color=COLOURS[spot.kind], lw=5, solid_capstyle="butt")
        ax.annotate(
            street.name,
            street.xy[0],
            xytext=(8, -12),
            textcoords="offset points",
            fontsize=14,
            weight="bold",
        )
    for kind, colour in COLOURS.items():
        ax.plot([], [], color=colour, lw=5, label=kind)
    ax.plot([], [], color="tab:blue", lw=2, label="driven")
    ax.plot([], [], color="0.4", lw=2, label="mapped only")
    ax.legend(loc="lower right", fontsize=11)
    ax.set(aspect="equal", xlabel="east [m]", ylabel="north [m]")
    ax.set_title("Simulated Shinjuku on real footprints (Project PLATEAU, CC BY 4.0)")
    fig.tight_layout()
    fig.savefig(path, dpi=70)
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")
    plt.close(fig)


def spots(city: City, path: Path) -> None:
    """Panorama, bird's-eye view of a scan, and the map around it, at each kind of place."""
    fig, axes = plt.subplots(
        len(PLACES), 3, figsize=(19, 4.6 * len(PLACES)), width_ratios=(2.0, 1, 1)
    )
    for (title, name, point), (wide, above, mapped) in zip(PLACES, axes, strict=True):
        street = city.street(name)
        scan = next(iter(scans(city, street, range(point, point + 1))))
        assert scan.T_map_lidar is not None
        assert scan.ring is not None
        azimuth = np.rad2deg(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        ranges = np.linalg.norm(scan.points, axis=1)
        dots = wide.scatter(azimuth, scan.ring, c=np.log10(ranges), s=5, cmap="turbo", marker="s")
        wide.set(xlim=(180, -180), xlabel="azimuth [deg], 0 ahead", ylabel="ring")
        wide.set_title(f"{title}: path {name}, {point} m, {len(ranges)} returns")
        fig.colorbar(dots, ax=wide, label="log10 range [m]")
        x, y, z = scan.points.T
        above.scatter(x, y, c=z, s=0.6, cmap="turbo")
        above.set(xlim=(-60, 60), ylim=(-60, 60), aspect="equal", title="scan from above [m]")
        cloud = survey(city, street, (max(point - 12, 0), point + 12), 0)
        T = scan.T_map_lidar
        local = (cloud - T[:3, 3]) @ T[:3, :3]
        local = local[np.abs(local[:, :2]).max(axis=1) < 60][::3]
        mapped.scatter(
            local[:, 0], local[:, 1], c=local[:, 2], s=0.15, cmap="turbo", vmin=-3, vmax=12
        )
        mapped.set(xlim=(-60, 60), ylim=(-60, 60), aspect="equal", title="map of 24 m, one pass")
    fig.tight_layout()
    fig.savefig(path, dpi=55)
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")
    plt.close(fig)


def errors(city: City, folder: Path, preset: str, path: Path) -> None:
    """Map of the measured errors with the special spots named, and the errors along each path."""
    driven = [street for street in city.streets if street.driven]
    fig = plt.figure(figsize=(17, 15))
    grid = fig.add_gridspec(1 + len(driven), 1, height_ratios=(6, *[1] * len(driven)), hspace=0.5)
    ax = fig.add_subplot(grid[0])
    draw_buildings(ax, city, "0.85")
    for row, street in enumerate(driven):
        parts = [pd.read_parquet(part) for part in sorted(folder.glob(f"{street.name}/errors/*"))]
        table = pd.concat(parts).query("status == 'done'")
        arc, cm = table["arc_length"], 100 * table["error_mean"]
        dots = ax.scatter(table["x"], table["y"], c=cm, s=42, cmap="turbo", vmin=0, vmax=40)
        along = fig.add_subplot(grid[1 + row])
        along.plot(arc, cm, "k.-", lw=0.7, ms=3)
        along.set(xlim=(0, 1165), ylim=(0, 100), ylabel=f"{street.name} [cm]")
        for spot in street.spots_of("tunnel", "crossing", "bridge", "one-sided"):
            along.axvspan(spot.begin, spot.end, color=COLOURS[spot.kind], alpha=0.2, lw=0)
            middle = (spot.begin + spot.end) / 2
            along.text(middle, 88, spot.kind, ha="center", va="top", fontsize=8)
            if spot.kind != "one-sided":
                ax.annotate(
                    f"{street.name}: {spot.kind}",
                    street.at(np.array([middle]))[0],
                    xytext=(14, 10),
                    textcoords="offset points",
                    fontsize=9,
                    arrowprops={"arrowstyle": "-", "color": COLOURS[spot.kind]},
                )
    along.set_xlabel("along the path [m]")
    fig.colorbar(dots, ax=ax, label="mean error of 317 starts [cm]", extend="max", pad=0.01)
    everything = np.concatenate([street.xy for street in driven])
    low, high = everything.min(axis=0) - 40, everything.max(axis=0) + 40
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set_title(f"Measured localization error, preset {preset} (buildings: PLATEAU, CC BY 4.0)")
    fig.savefig(path, dpi=60, bbox_inches="tight")
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB")
    plt.close(fig)


def main(given: argparse.Namespace) -> None:
    """Draw everything."""
    city = build_city(load_preset(given.preset))
    given.figures.mkdir(parents=True, exist_ok=True)
    if given.labels is not None:
        errors(city, given.labels, given.preset, given.figures / "simulation_errors.png")
    district(city, given.figures / "simulation_district.png")
    spots(city, given.figures / "simulation_spots.png")


if __name__ == "__main__":
    main(GIVEN)
