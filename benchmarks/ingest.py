"""Ingest beside a plain read of the same file with the same library, in one run.

    python benchmarks/ingest.py [--points MILLIONS] [--repeats N]

Each case runs in a process of its own, so that its peak memory is its own; the time is CPU time of
the work (imports and a small first ingest, which loads the compiled kernels, are outside), the
least of the repeats. Files are generated: a mapped street, tile after tile, as a mapping vehicle
leaves it. The log is the real drive under TILESTREAM_DATA where it is there, else a written one.
"""

import argparse


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=float, default=20.0, help="size of the PCD file [million]")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each case")
    parser.add_argument("--case", nargs=3, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from street_tiles import drive, long_street

import tilestream as ts
from tilestream.formats import open_source
from tilestream.formats.logs import write_log
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.records import Scan, Trajectory

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TILESTREAM_DATA", HERE.parents[1] / "shared" / "data"))
BLOCK = 1_000_000
"""Points that a plain reader takes at a time, as ingest does."""
LEAVES = {"ingest, map_leaf 0.2": 0.2, "ingest, all points kept": 0.0}
GOAL = 3.0
"""Ingest may cost this many plain reads."""


# --- The plain reads


def fromfile(path: Path) -> int:
    """A binary PCD of x, y, z float32 as one array."""
    head = path.read_bytes()[:400].split(b"DATA binary\n")[0]
    return len(np.fromfile(path, "<f4", offset=len(head) + len(b"DATA binary\n"))) // 3


def our_blocks(path: Path) -> int:
    """Our reader alone: finite float64 points, block by block."""
    source = open_source(str(path))
    spans = source.spans(4 * BLOCK)
    return sum(len(block.points) for span in spans for block in source.blocks(span, BLOCK))


def laspy_chunks(path: Path) -> int:
    """Scaled x, y, z float64 of laspy's chunks."""
    with laspy.open(path) as reader:
        return sum(len(np.column_stack([c.x, c.y, c.z])) for c in reader.chunk_iterator(BLOCK))


def ros2_decode(path: Path) -> int:
    """The clouds as mcap_ros2 decodes them, CRCs checked, x, y, z as float64."""
    count = 0
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for message in reader.iter_decoded_messages():
            if message.schema is not None and message.schema.name.endswith("PointCloud2"):
                count += len(xyz_of(message.decoded_message))
    return count


def xyz_of(cloud: object) -> np.ndarray:
    """(n, 3) float64 of a cloud of float32 coordinates."""
    offsets = {field.name: field.offset for field in cloud.fields}  # type: ignore[attr-defined]
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step)  # type: ignore[attr-defined]
    columns = [rows[:, offsets[c] : offsets[c] + 4].copy().view("<f4").ravel() for c in "xyz"]
    return np.column_stack(columns).astype(np.float64)


READS: dict[str, dict[str, Callable[[Path], int]]] = {
    "pcd": {"np.fromfile": fromfile, "our blocks()": our_blocks},
    "laz": {"laspy chunk_iterator": laspy_chunks, "our blocks()": our_blocks},
    "mcap": {"mcap_ros2 decode": ros2_decode, "our blocks()": our_blocks},
}


# --- One case, in its own process


def run_case(kind: str, case: str, path: Path, repeats: int) -> dict[str, float]:
    """CPU and wall seconds of one case, the least of the repeats; points; peak memory."""
    with tempfile.TemporaryDirectory() as scratch:
        warm_up(Path(scratch), path.suffix)
        base = peak_bytes()
        cpu, wall, points = np.inf, np.inf, 0
        for number in range(repeats):
            store = Path(scratch) / f"{number}.zarr"
            began = time.process_time(), time.perf_counter()
            if case in LEAVES:
                made = ts.ingest(path, store, map_leaf=LEAVES[case])
                points = made.sources()[0]["points"]
            else:
                points = READS[kind][case](path)
            cpu = min(cpu, time.process_time() - began[0])
            wall = min(wall, time.perf_counter() - began[1])
        return {"cpu": cpu, "wall": wall, "points": points, "peak": peak_bytes(), "base": base}


def warm_up(folder: Path, ending: str) -> None:
    """A small ingest, thinned and not, so that the kernels are loaded."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform(0.0, 20.0, (1000, 3))
    small = folder / f"small{ending}"
    if ending == ".mcap":
        write_small_log(small, cloud, scans=3)
    else:
        (write_las if ending == ".laz" else write_pcd)(small, cloud)
    for leaf in LEAVES.values():
        ts.ingest(small, folder / f"warm-{leaf}.zarr", map_leaf=leaf)
    READS[ending[1:]][next(iter(READS[ending[1:]]))](small)


def peak_bytes() -> int:
    """Largest resident memory of this process so far; not that of its parent, as rusage has it."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


# --- The files


def street_points(millions: float) -> Iterator[np.ndarray]:
    """A street of 1.6 M points per tile, until there are enough."""
    left = round(millions * 1e6)
    for tile in long_street(1000, seed=1, spacing=0.1):
        yield tile[:left]
        left -= len(tile)
        if left <= 0:
            return


def write_files(folder: Path, millions: float) -> dict[str, Path]:
    """The three files."""
    found = {"pcd": folder / "street.pcd", "laz": folder / "street.laz"}
    write_pcd(found["pcd"], np.concatenate(list(street_points(millions))))
    write_las(found["laz"], np.concatenate(list(street_points(millions / 4.0))))
    real = DATA / "kitti_drive" / "drive.mcap"
    found["mcap"] = real if real.is_file() else folder / "drive.mcap"
    if not real.is_file():
        write_small_log(found["mcap"], drive(3, 0.2), scans=20)
    return found


def write_small_log(path: Path, cloud: np.ndarray, scans: int) -> None:
    """A log of the same cloud seen at several places."""
    stamps = 10**18 + np.arange(scans, dtype=np.int64) * 10**8
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 0, 3] = np.arange(scans)
    write_log(path, [Scan(int(s), cloud) for s in stamps], Trajectory(stamps, poses))


# --- The table


def measure(kind: str, case: str, path: Path, repeats: int) -> dict[str, float]:
    """`run_case` in a fresh process."""
    command = [sys.executable, __file__, "--case", kind, case, str(path), "--repeats", str(repeats)]
    told = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(told.stdout))


def main(given: argparse.Namespace) -> None:
    """Write the files, measure every case, print the table."""
    if given.case:
        kind, case, path = given.case
        print(json.dumps(run_case(kind, case, Path(path), given.repeats)))
        return
    print(
        "| file | case | M points/s of CPU | of wall | peak MB | beyond a warm process | x plain |"
    )
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for kind, path in write_files(Path(scratch), given.points).items():
            plain = 0.0
            for case in [*READS[kind], *LEAVES]:
                found = measure(kind, case, path, given.repeats)
                plain = plain or found["cpu"]
                millions = found["points"] / 1e6
                columns = (
                    f"{kind} {millions:.1f} M" if case in READS[kind] else "",
                    case,
                    f"{millions / found['cpu']:.1f}",
                    f"{millions / found['wall']:.1f}",
                    f"{found['peak'] / 1e6:.0f}",
                    f"{(found['peak'] - found['base']) / 1e6:.0f}",
                    f"{found['cpu'] / plain:.2f}",
                )
                print(f"| {' | '.join(columns)} |", flush=True)
    warm = measure_base()
    print(f"\nA process after its first small ingest: {warm / 1e6:.0f} MB (BASE_BYTES in plan.py)")


def measure_base() -> int:
    """Peak of a process that has imported everything and ingested a thousand points."""
    code = (
        "import tempfile; import numpy as np; import tilestream.cli;"
        "import tilestream as ts; from tilestream.formats.points.pcd import write_pcd;"
        "d = tempfile.mkdtemp(); write_pcd(d + '/a.pcd', np.random.rand(1000, 3));"
        "ts.ingest(d + '/a.pcd', d + '/m.zarr');"
        "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return int(told.stdout) * 1024


if __name__ == "__main__":
    main(GIVEN)
