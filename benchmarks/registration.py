"""Registration against PCL and small_gicp: one street, one scan, 317 starts, one thread, one run.

    python benchmarks/registration.py [--json FILE] [--starts N]

Needs small_gicp (PyPI), and g++ with PCL (Debian: libpcl-dev) for PCL's rows; what is absent is
left out, saying so. With the golden data of the matchers at hand (TILESTREAM_DATA) it also prints
the errors that Autoware, PCL and ndt_omp reached there, beside ours.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--starts", type=int, default=317, help="use only the first N starts")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import functools
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from scenes import facade, ground, in_map, pole, tree, turned

from tilestream.label import start_poses
from tilestream.ndt import cells_of
from tilestream.records import Cells
from tilestream.registration import register
from tilestream.sensor import VLP16, Sensor
from tilestream.settings import RegistrationSettings

Floats = NDArray[np.float64]
GOLDEN = Path(os.environ.get("TILESTREAM_DATA", ROOT.parent / "shared" / "data")) / "matchers"
LEAF = 2.0
"""Edge of the cells and of the scan's voxels [m]."""


@dataclass(frozen=True)
class Row:
    """What one matcher did with the starts."""

    matcher: str
    ms: float
    iterations: float
    median_mm: float
    mean_mm: float
    within_10cm: float
    converged: float

    def __str__(self) -> str:
        return (
            f"{self.matcher:36s} {self.ms:9.3f} {self.iterations:6.1f} {self.median_mm:8.1f}"
            f" {self.mean_mm:8.1f} {100 * self.within_10cm:7.1f} {100 * self.converged:7.1f}"
        )


HEADER = (
    f"{'matcher':36s} {'ms/reg':>9s} {'iter':>6s} {'median':>8s} {'mean':>8s} {'<10 cm':>7s}"
    f" {'conv.':>7s}\n{'':36s} {'':9s} {'':6s} {'mm':>8s} {'mm':>8s} {'%':>7s} {'%':>7s}"
)


def street(seed: int, spacing: float = 0.08) -> Floats:
    """A street of 160 m along x with a crossing, centred on the origin; 2 million points.

    The same street for any seed: only the samples of its surfaces differ.
    """
    rng = np.random.default_rng(seed)
    half = 80.0
    parts = [ground(rng, 2 * half, 24.0, spacing) - [half, 0, 0]]
    across = ground(rng, 2 * half, 14.0, spacing) - [half, 0, 0]
    across = across[np.abs(across[:, 0]) > 12.0]
    parts.append(turned(across, np.pi / 2, (0.0, 0.0)))
    for turn in range(2):
        side = [
            facade(rng, (-half, 12.0), (-40.0, 12.0), 15.0, spacing),
            facade(rng, (-40.0, 12.0), (-40.0, 16.0), 15.0, spacing),
            facade(rng, (-38.0, 16.0), (-7.0, 16.0), 9.0, spacing, bay=4.0),
            facade(rng, (-7.0, 16.0), (-7.0, half), 12.0, spacing),
            facade(rng, (7.0, half), (7.0, 12.0), 18.0, spacing, bay=2.5),
            facade(rng, (7.0, 12.0), (45.0, 12.0), 18.0, spacing, bay=2.5),
            facade(rng, (50.0, 14.0), (half, 14.0), 10.0, spacing, bay=5.0),
        ]
        side += [pole(rng, x, 7.0, 7.0, spacing) for x in np.arange(-72.0, 80.0, 24.0)]
        side += [tree(rng, x, 9.0, 2.0 * spacing) for x in np.arange(-66.0, 80.0, 22.0)]
        parts.append(turned(np.vstack(side), turn * np.pi, (0.0, 0.0)))
    return in_map(np.vstack(parts))


def first_returns(
    points: Floats, T_map_lidar: Floats, sensor: Sensor, rng: np.random.Generator
) -> Floats:
    """A scan of a point map, in the lidar frame, with noise along the beams.

    Points within a quarter of the azimuth step and 0.15 deg of elevation of a beam (or 5 cm, where
    that is more) can return; of those at most 0.5 m behind the nearest, the one closest to the beam
    does, where it is: a point of the surface, and no bias from the width of the window.
    """
    R, t = T_map_lidar[:3, :3], T_map_lidar[:3, 3]
    local = (points - t) @ R
    distance = np.linalg.norm(local, axis=1)
    elevation = np.degrees(np.arcsin(local[:, 2] / distance))
    azimuth = np.degrees(np.arctan2(local[:, 1], local[:, 0])) % 360.0 / sensor.azimuth_step_deg
    beams = np.array(sensor.elevations_deg)
    beam = np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation)
    columns = round(360.0 / sensor.azimuth_step_deg)
    off = np.hypot(elevation - beams[beam], (azimuth - np.rint(azimuth)) * sensor.azimuth_step_deg)
    on = np.flatnonzero(
        (off <= np.maximum(0.15, np.degrees(0.05 / distance)))
        & (distance > 1.0)
        & (distance <= sensor.range_max)
    )
    pixel = beam[on] * columns + np.rint(azimuth[on]).astype(np.int64) % columns
    nearest = np.full(len(beams) * columns, np.inf)
    np.minimum.at(nearest, pixel, distance[on])
    front = distance[on] <= nearest[pixel] + 0.5
    on, pixel = on[front], pixel[front]
    order = np.lexsort([off[on], pixel])
    _, first = np.unique(pixel[order], return_index=True)
    chosen = on[order[first]]
    noise = rng.normal(0.0, sensor.range_noise, len(chosen)) / distance[chosen]
    return local[chosen] * (1.0 + noise)[:, None]


def scene() -> tuple[Floats, Floats, Floats]:
    """Map points, scan in the lidar frame, true pose."""
    yaw, roll, pitch = np.radians([20.0, 0.5, -0.6])
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array(
        [[1, 0, pitch], [0, 1, -roll], [-pitch, roll, 1]]
    )
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    T[:3, 3] = [-6.3, -2.1, 1.92]
    scan = first_returns(street(2), T, VLP16, np.random.default_rng(3))
    return street(1), scan, T


def thinned(scan: Floats) -> Floats:
    """The scan as all matchers get it: one centroid per voxel."""
    voxel = np.floor(scan / LEAF).astype(np.int64)
    _, which, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, which, scan)
    return total / count[:, None]


def summary(
    name: str, ms: float, T: Floats, poses: Floats, iterations: Floats, converged: Floats
) -> Row:
    """A row of the table."""
    error = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1)
    return Row(
        name,
        ms,
        float(np.mean(iterations)),
        1e3 * float(np.median(error)),
        1e3 * float(error.mean()),
        float((error <= 0.1).mean()),
        float(np.mean(converged)),
    )


def least(run: Callable[[], object], repeats: int) -> float:
    """Shortest CPU time of a few runs [ms]; another process on the machine costs neither side."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return 1e3 * min(times)


def ours(
    name: str, settings: RegistrationSettings, cells: Cells, scan: Floats, T: Floats, starts: Floats
) -> Row:
    """tilestream, all starts in one call; the time includes all of `ts.register`."""
    found = register(cells, scan, starts, settings)
    ms = least(lambda: register(cells, scan, starts, settings), 7) / len(starts)
    return summary(name, ms, T, found.T_map_lidar, found.iterations, found.converged)


def pcl(points: Floats, scan: Floats, T: Floats, starts: Floats) -> tuple[Row, float] | None:
    """PCL's NDT by benchmarks/peers/pcl_ndt.cpp: its row, and ms of setInputTarget."""
    program = build_pcl()
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / name) for name in ("map", "scan", "starts", "out")]
        points.astype(np.float32).tofile(files[0])
        scan.astype(np.float32).tofile(files[1])
        starts.tofile(files[2])
        told = subprocess.run([program, *files], check=True, capture_output=True, text=True)
        out = np.fromfile(files[3]).reshape(-1, 19)
    poses = out[:, :16].reshape(-1, 4, 4)
    row = summary("PCL NDT", float(out[:, 17].mean()), T, poses, out[:, 16], out[:, 18])
    return row, float(json.loads(told.stdout)["target_ms"])


def build_pcl() -> Path | None:
    """Compile the driver against the installed PCL; None, saying why, where there is none."""
    source = ROOT / "benchmarks" / "peers" / "pcl_ndt.cpp"
    program = source.parent / "build" / "pcl_ndt"
    if program.exists() and program.stat().st_mtime > source.stat().st_mtime:
        return program
    if not (shutil.which("g++") and shutil.which("pkg-config")):
        print("PCL is left out: it needs g++ and pkg-config")
        return None
    known = subprocess.run(["pkg-config", "--list-all"], capture_output=True, text=True, check=True)
    names = [n.split()[0] for n in known.stdout.splitlines() if n.startswith("pcl_registration")]
    if not names:
        print("PCL is left out: no pcl_registration known to pkg-config (Debian: libpcl-dev)")
        return None
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", names[0]], capture_output=True, text=True, check=True
    )
    program.parent.mkdir(exist_ok=True)
    command = ["g++", "-O3", "-DNDEBUG", "-std=c++17", "-o", str(program), str(source)]
    subprocess.run([*command, *flags.stdout.split()], check=True)
    return program


def small_gicp(points: Floats, scan: Floats, T: Floats, starts: Floats) -> list[Row]:
    """GICP and VGICP of small_gicp with its own defaults, voxels of the cell size.

    What it prepares once per map and scan is not timed.
    """
    if importlib.util.find_spec("small_gicp") is None:
        print("small_gicp is left out: pip install small_gicp")
        return []
    gicp = importlib.import_module("small_gicp")
    target, tree = gicp.preprocess_points(points, downsampling_resolution=0.25, num_threads=1)
    voxels = gicp.GaussianVoxelMap(LEAF)
    voxels.insert(target)
    source, _ = gicp.preprocess_points(scan, downsampling_resolution=0.01, num_threads=1)
    how = {"num_threads": 1, "max_iterations": 30}
    methods = {
        "small_gicp VGICP": functools.partial(gicp.align, voxels, source, **how),
        "small_gicp GICP": functools.partial(gicp.align, target, source, tree, **how),
    }
    rows = []
    for name, align in methods.items():
        found = [align(init_T_target_source=start) for start in starts]
        ms = least(lambda: [align(init_T_target_source=s) for s in starts], 3) / len(starts)  # noqa: B023
        poses = np.array([r.T_target_source for r in found])
        iterations = np.array([r.iterations for r in found], float)
        rows.append(
            summary(name, ms, T, poses, iterations, np.array([r.converged for r in found], float))
        )
    return rows


def first_call() -> float:
    """Seconds from the start of a fresh process to its first registered scan, warm Numba cache."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import numpy as np;"
        "from tilestream.registration import register; from tilestream.ndt import cells_of;"
        "r = np.random.default_rng(0); p = r.uniform(-20, 20, (60000, 3)); p[:, 2] *= 0.01;"
        "print(register(cells_of(p), p[::50], np.eye(4)).iterations[0])"
    )
    command = [sys.executable, "-c", code, str(ROOT)]
    times = []
    for _ in range(2):
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        times.append(time.perf_counter() - begin)
    return min(times)


def golden_table() -> list[Row]:
    """The matchers' own results on the golden scene, and ours."""
    with np.load(GOLDEN / "cells_2m.npz") as c, np.load(GOLDEN / "scan.npz") as s:
        cells = Cells(c["index"], c["count"], c["mean"], c["covariance"], LEAF)
        scan, starts, T = s["scan_thinned_2m"], s["T_map_lidar_starts"], s["T_map_lidar_true"]
    rows = []
    for file in sorted(GOLDEN.glob("*.csv")):
        table = np.genfromtxt(file, delimiter=",", names=True)
        poses = np.zeros((len(table), 3, 4))
        for i in range(3):
            poses[:, i, 3] = table[f"m{i}3"]
        nan = np.full(len(table), np.nan)
        rows.append(summary(file.stem, np.nan, T, poses, table["iterations"], nan))
    rows += [ours(name, how, cells, scan, T, starts) for name, how in MATCHERS.items()]
    return rows


MATCHERS = {
    "tilestream direct7": RegistrationSettings(),
    "tilestream direct1": RegistrationSettings(neighbours="direct1"),
    "tilestream autoware": RegistrationSettings.autoware(),
}


def main(given: argparse.Namespace) -> None:
    """Print the tables."""
    points, raw, T = scene()
    scan, starts = thinned(raw), start_poses(T)[: given.starts]
    cells = cells_of(points, LEAF)
    build = least(lambda: cells_of(points, LEAF), 5)
    print(
        f"{len(points) / 1e6:.2f} M map points, {len(cells)} cells of {LEAF:g} m, "
        f"scan of {len(raw)} points thinned to {len(scan)}, {len(starts)} starts\n\n{HEADER}"
    )
    rows = []
    for name, settings in MATCHERS.items():
        rows.append(ours(name, settings, cells, scan, T, starts))
        print(rows[-1])
    for row in small_gicp(points, scan, T, starts):
        rows.append(row)
        print(row)
    theirs = pcl(points, scan, T, starts)
    figures: dict[str, object] = {}
    if theirs is not None:
        rows.append(theirs[0])
        print(rows[-1])
        figures["setInputTarget_ms"] = theirs[1]
        print(
            f"\nmap build: cells {build:.0f} ms ({1e6 * build / len(points):.1f} ns per point), "
            f"PCL setInputTarget {theirs[1]:.0f} ms: {theirs[1] / build:.1f}x"
        )
    mine, peers = rows[: len(MATCHERS)], rows[len(MATCHERS) :]
    if peers:
        print("\ntimes faster than    " + "".join(f"{r.matcher:>20s}" for r in peers))
        for row in mine:
            print(f"{row.matcher:20s}" + "".join(f"{r.ms / row.ms:20.1f}" for r in peers))
    for row in mine:
        passes = (row.iterations + 1.0) * len(scan)
        print(
            f"{row.matcher}: 317 starts {row.ms * 317 / 1e3:.3f} s, all in all "
            f"{1e6 * row.ms / passes:.1f} ns per scan point and pass"
        )
    seconds = first_call()
    print(f"fresh process, warm cache, until its first scan is registered: {seconds:.1f} s")
    if GOLDEN.is_dir():
        print(f"\ngolden scene (matchers' own results, then ours)\n{HEADER}")
        for row in golden_table():
            print(row)
    if given.json:
        figures |= {"rows": [asdict(r) for r in rows], "cells_ms": build, "first_call_s": seconds}
        given.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main(GIVEN)
